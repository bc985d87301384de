"""Loopback: the center and the nodes of a network in one process, without clock or bus.

It drives the pure steps of ``Center`` and ``LocalTracker``: replay, studies, benchmarks and traces of the protocol use
it. Messages are handed over as objects, at once, in the order in which they were published.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from waldnet.common.codec import as_sent
from waldnet.common.config import Scenario
from waldnet.common.messages import NEVER, Message, Picked, Report, Scan, ToNode, ToNodes
from waldnet.fusion_center.center import Center
from waldnet.fusion_center.state import Event
from waldnet.sensor_node.state import Look, Schedule
from waldnet.sensor_node.tracker import LocalTracker

#: Names in ``Sent`` that are not names of sensors: the center, every node, and whoever listens.
CENTER, NODES, ALL = "the center", "all nodes", "everybody"


class Sent(NamedTuple):
    """A message on its way.

    Attributes:
        sender: name of a sensor, or ``CENTER``.
        receiver: name of a sensor, ``CENTER``, ``NODES`` or ``ALL``.
        message: as the receiver gets it.
    """

    sender: str
    receiver: str
    message: Message


Tap = Callable[[Sent], None]


class Loopback:
    """A network whose messages reach their receivers at once.

    ``join`` and ``scan`` do whole exchanges. ``report``, ``fuse`` and ``tell`` are their parts: hold back what one of
    them returned, and the message is late; drop it, and it is lost.

    Attributes:
        center: the steps of the center.
        state: of the center.
        trackers: the steps of every node, by name of the sensor.
        nodes: state of every node, by name of the sensor.
    """

    def __init__(self, center: Center, trackers: Iterable[LocalTracker], tap: Tap | None = None) -> None:
        """Set up a center and nodes that know nothing of each other yet.

        Args:
            center: the steps of the center.
            trackers: the steps of the nodes, in the order of the scenario's sensors.
            tap: called with every message that is sent.
        """
        self.center, self.state = center, center.initial()
        self.trackers = {tracker.name: tracker for tracker in trackers}
        self.nodes = {name: tracker.initial() for name, tracker in self.trackers.items()}
        self._tap = tap

    @classmethod
    def of(
        cls, scenario: Scenario, *, schedule: Schedule | None = None, speed: float = 0.0, tap: Tap | None = None
    ) -> Loopback:
        """The network of a scenario.

        Args:
            scenario: the network.
            schedule: scan times of all sensors; needed by mode ``dkf`` only.
            speed: seconds of measurement time per second of wall time; 0: lockstep.
            tap: called with every message that is sent.

        Raises:
            ValueError: when the scenario's mode needs a schedule and there is none.
        """
        trackers = [LocalTracker.of(scenario, name, schedule) for name in scenario.sensor_names]
        return cls(Center.of(scenario, speed=speed), trackers, tap)

    def join(self, name: str, next_ns: int, *, incarnation: int = 0, now_ns: int = 0) -> list[Message]:
        """Let a node join.

        Args:
            name: of its sensor.
            next_ns: time of its first scan; NEVER: it has none.
            incarnation: number of its process; another one than before: the process was restarted.
            now_ns: wall time.

        Returns:
            what the center published.
        """
        join = self.trackers[name].join(self.nodes[name], incarnation, next_ns)
        self._send(name, CENTER, join)
        return self.deliver(join, now_ns)

    def scan(self, scan: Scan | Look, next_ns: int = NEVER, now_ns: int = 0) -> list[Message]:
        """Let a node filter a scan, the center work in its report, and the nodes hear the answer.

        Args:
            scan: of one of the sensors; in a study, with plots that may be of every track its own.
            next_ns: time of the sensor's next scan; NEVER: this is its last.
            now_ns: wall time.

        Returns:
            what the center published.
        """
        return self.deliver(self.report(scan, next_ns), now_ns)

    def deliver(self, event: Event, now_ns: int = 0) -> list[Message]:
        """Let the center work in an event, and the nodes hear the answer, which is returned."""
        messages = self.fuse(event, now_ns)
        self.tell(messages)
        return messages

    def report(self, scan: Scan | Look, next_ns: int = NEVER) -> Report | Picked:
        """Let a node filter a scan; its report, as the center would get it. The center does not hear of it."""
        name = scan.sensor if isinstance(scan, Scan) else self.center.names[scan.number]
        tracker, node = self.trackers[name], self.nodes[name]
        step = tracker.scan(node, scan, next_ns) if isinstance(scan, Scan) else tracker.look(node, scan, next_ns)
        self.nodes[name], report = step
        report = as_sent(report, tracker.rounding)
        if self._tap is not None and isinstance(scan, Scan):
            self._send(name, ALL, scan)
        self._send(name, CENTER, report)
        return report

    def fuse(self, event: Event, now_ns: int = 0) -> list[Message]:
        """Let the center work in an event; what it publishes. The nodes do not hear of it."""
        self.state, messages = self.center.step(self.state, event, now_ns)
        return messages

    def tell(self, messages: Iterable[Message]) -> None:
        """Let the nodes hear messages of the center."""
        for message in messages:
            if isinstance(message, ToNode):
                self._send(CENTER, message.sensor, message)
                self._follow(message.sensor, message)
            elif isinstance(message, ToNodes):
                self._send(CENTER, NODES, message)
                for name in self.nodes:
                    self._follow(name, message)
            else:
                self._send(CENTER, ALL, message)

    def _follow(self, name: str, message: ToNode | ToNodes) -> None:
        self.nodes[name] = self.trackers[name].told(self.nodes[name], message)

    def _send(self, sender: str, receiver: str, message: Message) -> None:
        if self._tap is not None:
            self._tap(Sent(sender, receiver, message))
