"""Node and center as processes of a benchmark: the product's shells, with a watch in the hand.

    python -m waldnet.benchmarks.participants node WORLD NAME CENTER
    python -m waldnet.benchmarks.participants center WORLD SPEED

Clocks are the machine's monotonic one, which all its processes share. The stamps of a run are printed at its end.
"""

from __future__ import annotations

import json
import sys
import time
from collections import deque

from waldnet.benchmarks.worlds import World
from waldnet.common.config import Network
from waldnet.common.inbox import Inbox
from waldnet.common.logs import configure
from waldnet.common.messages import Message, Picked, Report, Scan, Tracks
from waldnet.common.process import stopped_by_signals
from waldnet.common.transport import open_zenoh
from waldnet.fusion_center.center import Center
from waldnet.fusion_center.shell import CenterShell
from waldnet.fusion_center.state import Event
from waldnet.sensor_node.shell import NodeShell
from waldnet.sensor_node.tracker import LocalTracker


class TimedNode(NodeShell):
    """Notes for every scan: its time, when work began, when the report was out."""

    stamps: list[tuple[int, int, int]]
    _began_at = 0

    def _process(self, scan: Scan) -> None:
        self._began_at = time.monotonic_ns()
        super()._process(scan)

    def _publish(self, message: Message) -> bool:
        sent = super()._publish(message)
        if isinstance(message, Report | Picked):
            self.stamps.append((message.time_ns, self._began_at, time.monotonic_ns()))
        return sent


class TimedCenter(CenterShell):
    """Notes for every picture its time and when it was out, and for every time when the last report came in."""

    stamps: list[tuple[int, int]]
    came: dict[int, int]
    arrivals: deque[int]

    def _step(self, event: Event) -> None:
        if isinstance(event, Report | Picked):
            at = self.arrivals.popleft()
            self.came[event.time_ns] = max(at, self.came.get(event.time_ns, 0))
        super()._step(event)

    def _publish(self, message: Message) -> None:
        super()._publish(message)
        if isinstance(message, Tracks):
            self.stamps.append((message.time_ns, time.monotonic_ns()))


class TimedInbox(Inbox):
    """Notes when each report came in, in the order in which they are worked off."""

    def __init__(self) -> None:
        super().__init__()
        self.arrivals: deque[int] = deque()

    def heard(self, key: str, payload: bytes) -> None:
        """Put bytes."""
        if key.endswith("/report"):
            self.arrivals.append(time.monotonic_ns())
        super().heard(key, payload)


def node(world: World, name: str, center: str) -> dict[str, object]:
    """Run one sensor node to its end; returns its stamps."""
    scenario = world.scenario()
    network = Network(name=scenario.network.name, connect=(center,))
    inbox = Inbox()
    scans = world.seen_by(name)
    with stopped_by_signals(inbox.stop, with_parent=True), open_zenoh(network) as bus:
        shell = TimedNode(bus, network, LocalTracker.of(scenario, name), scans, inbox=inbox)
        shell.stamps = []
        shell.run()
    return {"node": shell.stamps}


def center(world: World, speed: float) -> dict[str, object]:
    """Run the center to its end; returns its stamps."""
    scenario = world.scenario()
    network = Network(name=scenario.network.name, listen=("tcp/127.0.0.1:0",))
    inbox = TimedInbox()
    with stopped_by_signals(inbox.stop, with_parent=True), open_zenoh(network) as bus:
        print(json.dumps({"listening": bus.endpoints()}), flush=True)
        fusion = Center.of(scenario, speed=speed, wait_s=60.0, first_epoch=time.time_ns())
        shell = TimedCenter(bus, network, scenario, fusion, inbox=inbox)
        shell.stamps, shell.came, shell.arrivals = [], {}, inbox.arrivals
        shell.run()
    return {"center": shell.stamps, "came": list(shell.came.items())}


def main() -> None:
    """Play the part that the command line names."""
    configure("json")
    role, world, *rest = sys.argv[1:]
    stamps = node(World.of(world), *rest) if role == "node" else center(World.of(world), float(rest[0]))
    print(json.dumps(stamps), flush=True)


if __name__ == "__main__":
    main()
