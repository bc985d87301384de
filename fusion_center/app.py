"""Command line of the fusion center."""

from __future__ import annotations

import json
import time

from waldnet.common.config import load_scenario
from waldnet.common.health import answering
from waldnet.common.inbox import Inbox
from waldnet.common.logs import LogFormat, configure
from waldnet.common.process import HealthSocket, Hidden, NetworkOptions, Speed, Verbose, stopped_by_signals
from waldnet.common.transport import open_zenoh
from waldnet.fusion_center.center import Center
from waldnet.fusion_center.shell import CenterShell
from waldnet.scenarios.catalogue import find


def center(
    scenario: str,
    *,
    options: NetworkOptions | None = None,
    speed: Speed = 1.0,
    wait: float = 10.0,
    health: HealthSocket = None,
    log: LogFormat = "auto",
    verbose: Verbose = False,
    with_parent: Hidden = False,
) -> None:
    """Run the fusion center: order the reports, compute the likelihood ratio, decide, publish.

    Once it listens, one JSON line on standard output says where.

    Args:
        scenario: scenario file, or name of one that comes along.
        options: the network.
        speed: seconds of measurement time per second, for sources without a clock; max: as fast as all go together.
        wait: seconds to wait for the others once a sensor has joined; then the clock starts with those that are there.
        health: local socket at which this process answers how it is (see: python -m waldnet.common.health).
        log: how to log to standard error; auto: colour on a terminal, JSON elsewhere.
        verbose: log decisions on tracks that were never confirmed too.
        with_parent: end when standard input closes.
    """
    configure(log)
    loaded = load_scenario(find(scenario))
    network = (options or NetworkOptions()).over(loaded)
    fusion = Center.of(loaded, speed=speed, wait_s=wait, first_epoch=time.time_ns())
    inbox = Inbox()
    stoppable = stopped_by_signals(inbox.stop, with_parent=with_parent)
    with stoppable, answering(health, inbox.asked), open_zenoh(network) as bus:
        print(json.dumps({"listening": bus.endpoints()}), flush=True)  # noqa: T201 (for whoever started it)
        CenterShell(bus, network, loaded, fusion, inbox=inbox, verbose=verbose).run()
