"""A whole network in one process, without clock or bus: the same pure steps, in order of measurement time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from waldnet.common.config import Scenario
from waldnet.common.messages import NEVER, Decision, Message, Scan, Tracks
from waldnet.offline.loopback import Loopback, Tap
from waldnet.sensor_node.sources import schedule_of


class Replay:
    """A network that is fed scan by scan."""

    def __init__(self, scenario: Scenario, scans: Sequence[Scan], tap: Tap | None = None) -> None:
        """Set up center and nodes.

        Args:
            scenario: the network.
            scans: all scans, by time.
            tap: called with every message that is sent.
        """
        self._scans = scans
        self._network = Loopback.of(scenario, schedule=schedule_of(scans, scenario), tap=tap)
        self._next = _next_times(scans, scenario.sensor_names)

    def run(self) -> Iterator[Tracks | Decision]:
        """Feed all scans; yields the picture after every measurement time, and the decisions before it."""
        for name, times in self._next.items():
            yield from _for_display(self._network.join(name, next(times)))
        for scan in self._scans:
            yield from _for_display(self._network.scan(scan, next(self._next[scan.sensor])))

    @property
    def left_out(self) -> dict[str, int]:
        """What was not worked in so far: reports, tracks of reports, plots; how many of each, if any."""
        state, nodes = self._network.state, self._network.nodes.values()
        unusable_plots = state.counts.unusable_plots + sum(node.unusable for node in nodes)
        found = {
            **{f"reports of {name} refused: {why}": number for (name, why), number in state.refused.items()},
            "tracks left out of reports: no Gaussian density": state.counts.unusable_tracks,
            "plots left out: numbers that no sensor can mean": unusable_plots,
        }
        return {what: count for what, count in found.items() if count}


def _for_display(messages: Sequence[Message]) -> Iterator[Tracks | Decision]:
    return (message for message in messages if isinstance(message, Tracks | Decision))


def _next_times(scans: Sequence[Scan], names: Sequence[str]) -> dict[str, Iterator[int]]:
    """For every sensor, the times of its scans one after the other, NEVER at the end."""
    times: dict[str, list[int]] = {name: [] for name in names}
    for scan in scans:
        times[scan.sensor].append(scan.time_ns)
    return {name: iter([*own, NEVER]) for name, own in times.items()}
