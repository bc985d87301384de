"""Command line of a sensor node."""

from __future__ import annotations

from pathlib import Path

from waldnet.common.config import load_scenario
from waldnet.common.health import answering
from waldnet.common.inbox import Inbox
from waldnet.common.logs import LogFormat, configure
from waldnet.common.process import HealthSocket, Hidden, NetworkOptions, Seed, stopped_by_signals
from waldnet.common.transport import open_zenoh
from waldnet.scenarios.catalogue import find
from waldnet.sensor_node.shell import NodeShell
from waldnet.sensor_node.sources import source
from waldnet.sensor_node.tracker import LocalTracker


def node(
    scenario: str,
    sensor: str,
    *,
    options: NetworkOptions | None = None,
    plots: Path | None = None,
    seed: Seed | None = None,
    patience: float = 30.0,
    health: HealthSocket = None,
    log: LogFormat = "auto",
    with_parent: Hidden = False,
) -> None:
    """Run one sensor: filter its scans and report to the fusion center.

    Args:
        scenario: scenario file, or name of one that comes along.
        sensor: name of the sensor in the scenario.
        options: the network.
        plots: recorded plots (JSON Lines) instead of the scenario's.
        seed: of the simulated world, instead of the scenario's.
        patience: seconds to wait for the first answer of a center before giving up.
        health: local socket at which this process answers how it is (see: python -m waldnet.common.health).
        log: how to log to standard error; auto: colour on a terminal, JSON elsewhere.
        with_parent: end when standard input closes.
    """
    configure(log)
    loaded = load_scenario(find(scenario))
    inbox = Inbox()
    seen = source(loaded, loaded.sensor(sensor).name, plots=plots, seed=seed)
    tracker = LocalTracker.of(loaded, sensor, seen.schedule)
    network = (options or NetworkOptions()).over(loaded)
    stoppable = stopped_by_signals(inbox.stop, with_parent=with_parent)
    with stoppable, answering(health, inbox.asked), open_zenoh(network) as bus:
        NodeShell(bus, network, tracker, seen.scans, inbox=inbox, patience_s=patience).run()
