"""A whole network in one process, without clock or bus: the same pure steps, in order of measurement time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from waldnet.common.codec import as_sent
from waldnet.common.config import Scenario
from waldnet.common.messages import (
    NEVER,
    Advice,
    Begin,
    Decision,
    Join,
    Message,
    Picked,
    Rebase,
    Report,
    Scan,
    Start,
    Stop,
    Tracks,
)
from waldnet.fusion_center.center import Center
from waldnet.sensor_node.sources import schedule_of
from waldnet.sensor_node.state import State as NodeState
from waldnet.sensor_node.tracker import LocalTracker


class Replay:
    """A network that is fed scan by scan."""

    def __init__(self, scenario: Scenario, scans: Sequence[Scan]) -> None:
        """Set up center and nodes.

        Args:
            scenario: the network.
            scans: all scans, by time.
        """
        schedule = schedule_of(scans, scenario)
        self._scans = scans
        self._center = Center.of(scenario, speed=0.0)
        self._state = self._center.initial()
        self._trackers = {name: LocalTracker.of(scenario, name, schedule) for name in scenario.sensor_names}
        self._nodes: dict[str, NodeState] = {name: tracker.initial() for name, tracker in self._trackers.items()}
        self._next = _next_times(scans, scenario.sensor_names)

    def run(self) -> Iterator[Tracks | Decision]:
        """Feed all scans; yields the picture after every measurement time, and the decisions before it."""
        for incarnation, (name, times) in enumerate(self._next.items()):
            yield from self._tell_center(Join(name, incarnation, next(times), self._center.digest))
        for scan in self._scans:
            name = scan.sensor
            tracker = self._trackers[name]
            self._nodes[name], report = tracker.scan(self._nodes[name], scan, next(self._next[name]))
            yield from self._tell_center(as_sent(report, tracker.rounding))

    @property
    def left_out(self) -> dict[str, int]:
        """What was not worked in so far: reports, tracks of reports, plots; how many of each, if any."""
        counts = self._state.counts
        found = {
            **{f"reports of {name} refused: {why}": number for (name, why), number in self._state.refused.items()},
            "tracks left out of reports: no Gaussian density": counts.unusable_tracks,
            "plots left out: numbers that no sensor can mean": counts.unusable_plots
            + sum(node.unusable for node in self._nodes.values()),
        }
        return {what: count for what, count in found.items() if count}

    def _tell_center(self, message: Report | Picked | Join) -> Iterator[Tracks | Decision]:
        self._state, answers = self._center.step(self._state, message, 0)
        for answer in answers:
            if isinstance(answer, Tracks | Decision):
                yield answer
            else:
                self._tell_nodes(answer)

    def _tell_nodes(self, message: Message) -> None:
        nodes, trackers = self._nodes, self._trackers
        match message:
            case Start(sensor=name) | Stop(sensor=name):
                nodes[name] = trackers[name].told(nodes[name], message)
            case Begin() | Advice() | Rebase():
                for name, tracker in trackers.items():
                    nodes[name] = tracker.told(nodes[name], message)
            case _:
                pass


def _next_times(scans: Sequence[Scan], names: Sequence[str]) -> dict[str, Iterator[int]]:
    """For every sensor, the times of its scans one after the other, NEVER at the end."""
    times: dict[str, list[int]] = {name: [] for name in names}
    for scan in scans:
        times[scan.sensor].append(scan.time_ns)
    return {name: iter([*own, NEVER]) for name, own in times.items()}
