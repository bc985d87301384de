"""A whole network in one process, without clock or bus: the same pure steps, in order of measurement time."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

from waldnet.common.config import Scenario
from waldnet.common.errors import PlotsError
from waldnet.common.messages import NEVER, Decision, Message, Scan, Tracks
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.state import Presence
from waldnet.offline.loopback import Loopback, Tap
from waldnet.sensor_node.state import Schedule

#: After so many measurement times those that are past are dropped.
_SCHEDULED = 1000


class Replay:
    """A network that is fed scan by scan, measurement time after measurement time.

    Nothing needs to be known of later scans, so they may come without end. Once the scans of a measurement time are
    complete, the center is told that those sensors are there and the others not: it waits for the former only.
    """

    def __init__(self, scenario: Scenario, scans: Iterable[Scan], tap: Tap | None = None) -> None:
        """Set up center and nodes.

        Args:
            scenario: the network.
            scans: all scans, by time; taken one by one as the replay goes on.
            tap: called with every message that is sent.
        """
        self._scenario = scenario
        self._scans = scans
        self._times_ns: list[int] = []
        self._scanning: list[tuple[int, ...]] = []
        self._network = Loopback.of(scenario, schedule=Schedule(self._times_ns, self._scanning), tap=tap)

    def run(self) -> Iterator[Tracks | Decision]:
        """Feed all scans; yields the picture after every measurement time, and the decisions before it.

        Raises:
            PlotsError: when a scan does not follow the one before.
        """
        network, there = self._network, dict[str, bool]()
        for group in measurement_times(self._scans, self._scenario):
            time_ns, scanning = group[0].time_ns, {scan.sensor for scan in group}
            if not there:
                there = dict.fromkeys(network.trackers, True)
                for name in there:
                    yield from _for_display(network.join(name, time_ns))
            self._note(time_ns, scanning)
            for name, was_there in there.items():
                if was_there != (name in scanning):
                    there[name] = name in scanning
                    yield from _for_display(network.deliver(Presence(name, there[name])))
            for scan in group:
                # Its next scan comes later: when, nobody needs to know.
                yield from _for_display(network.scan(scan, time_ns + 1))

    def _note(self, time_ns: int, scanning: Collection[str]) -> None:
        """Add a measurement time to the schedule, and drop those that all tracks of all nodes have behind them."""
        names, nodes = self._scenario.sensor_names, self._network.nodes.values()
        self._times_ns.append(time_ns)
        self._scanning.append(tuple(number for number, name in enumerate(names) if name in scanning))
        if len(self._times_ns) % _SCHEDULED == 0:
            window_ns = round(self._scenario.fusion.window * NS_PER_S)
            oldest_ns = min(time_ns - window_ns, *(int(node.tracks.times_ns.min(initial=NEVER)) for node in nodes))
            gone = bisect_left(self._times_ns, oldest_ns)
            del self._times_ns[:gone], self._scanning[:gone]

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


def measurement_times(scans: Iterable[Scan], scenario: Scenario) -> Iterator[list[Scan]]:
    """The scans of one measurement time after the other, in the order of the sensors.

    A measurement time is complete once all sensors have scanned, else with the first later scan, or the last of all.

    Args:
        scans: by time; taken one by one, so there may be no end of them.
        scenario: names the sensors.

    Raises:
        PlotsError: when a scan is older than the one before, of a sensor that the scenario does not have, or the
            second of its sensor at one time. What came before it has been yielded.
    """
    numbers = {name: number for number, name in enumerate(scenario.sensor_names)}
    group: dict[int, Scan] = {}
    newest_ns, told = -NEVER, True
    for scan in scans:
        fault = _fault(scan, group, newest_ns, scenario)
        if not told and (fault or scan.time_ns > newest_ns):
            told = True
            yield [group[number] for number in sorted(group)]
        if fault:
            raise PlotsError(fault)
        if scan.time_ns > newest_ns:
            group, newest_ns = {}, scan.time_ns
        group[numbers[scan.sensor]] = scan
        told = len(group) == len(numbers)
        if told:
            yield [group[number] for number in sorted(group)]
    if not told:
        yield [group[number] for number in sorted(group)]


def _fault(scan: Scan, group: Mapping[int, Scan], newest_ns: int, scenario: Scenario) -> str:
    """Why a scan cannot follow those of the newest measurement time; empty if it can."""
    time_s, newest_s = scenario.to_seconds(scan.time_ns), scenario.to_seconds(newest_ns)
    if scan.sensor not in scenario.sensor_names:
        return f"scan at {time_s} s: sensor {scan.sensor!r} is not one of {', '.join(scenario.sensor_names)}"
    if scan.time_ns < newest_ns:
        return f"scan of {scan.sensor} at {time_s} s comes after one at {newest_s} s, expected are scans by time"
    if scan.time_ns == newest_ns and any(scan.sensor == other.sensor for other in group.values()):
        return f"scan of {scan.sensor} at {time_s} s is its second at that time, expected is one"
    return ""
