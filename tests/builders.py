"""Scenarios, worlds and reports for tests."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.messages import NEVER, Begin, Clock, Decision, Join, Message, Report, Scan, Start, Stop, Tracks
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.center import Center
from waldnet.fusion_center.state import Event, Tick
from waldnet.fusion_center.state import State as CenterState
from waldnet.offline.network import run_in_memory
from waldnet.offline.replay import Replay
from waldnet.recording.inputs import Source
from waldnet.recording.record import Record
from waldnet.recording.run_folder import RunFolder
from waldnet.sensor_node.sources import schedule_of
from waldnet.sensor_node.state import Schedule
from waldnet.sensor_node.state import State as NodeState
from waldnet.sensor_node.tracker import LocalTracker

BOX = {"shape": "box", "center": [0.0, 0.0], "size": [20_000.0, 20_000.0]}


def sensor_table(name: str = "a", **changes: Any) -> dict[str, Any]:
    """A sensor as the scenario file has it."""
    return {
        "name": name,
        "position": [3000.0, 0.0],
        "sigma": [50.0, 50.0],
        "p_d": 0.9,
        "false_plots": 2.0,
        "field_of_view": BOX,
        "scan_interval": 2.0,
        **changes,
    }


def hypothesis_table(x: float = 0.0, y: float = 0.0, **changes: Any) -> dict[str, Any]:
    """A hypothesis as the scenario file has it, at (x, y)."""
    return {"state": [x, y, 150.0, 0.0], "sigma": [100.0, 100.0, 20.0, 20.0], **changes}


def scenario(*sensors: dict[str, Any], **tables: Any) -> Scenario:
    """A scenario of the given sensors (default: a and b), one target that is drawn from the only hypothesis."""
    return Scenario.model_validate(
        {
            "name": "test",
            "motion": {"psd": 10.0},
            "sensor": sensors or (sensor_table("a"), sensor_table("b")),
            "simulation": {"duration": 20.0},
            "target": [{"hypothesis": 0}],
            "hypothesis": [hypothesis_table()],
            **tables,
        }
    )


def same(first: Sequence[Any], second: Sequence[Any]) -> bool:
    """Whether two messages of the same type are equal, arrays and their dtypes included."""
    if type(first) is not type(second):
        return False
    for one, other in zip(first, second, strict=True):
        if isinstance(one, np.ndarray):
            if one.dtype != other.dtype or not np.array_equal(one, other):
                return False
        elif type(one) is not type(other) or one != other:
            return False
    return True


def all_same(first: Sequence[Sequence[Any]], second: Sequence[Sequence[Any]]) -> bool:
    """Whether two lists of messages are equal."""
    return len(first) == len(second) and all(same(one, other) for one, other in zip(first, second, strict=True))


def live_as_replayed(plot: Scenario, scans: Sequence[Scan]) -> Record:
    """What nodes and center say to each other on a bus in lockstep, which must be what the replay says."""
    replayed = Record(plot)
    for message in Replay(plot, scans).run():
        replayed.note(message)
    live = run_in_memory(plot, scans)
    assert all_same(live.decisions, replayed.decisions)
    assert live.pictures.keys() == replayed.pictures.keys()
    assert all_same(list(live.pictures.values()), list(replayed.pictures.values()))
    return live


def write_report(record: Record, folder: Path, extra: Mapping[str, Any], source: Source | None = None) -> list[Path]:
    """The folder of a run in which everything of a record was heard; the files that a run leaves."""
    written = RunFolder(folder, record.scenario, source)
    for time_ns in sorted(record.pictures):
        written.note(record.pictures[time_ns])
    for message in (*record.decisions, *record.scans):
        written.note(message)
    report = written.finish(extra)
    assert not report.failures
    return report.files


def only(kind: type[Any], messages: Iterable[Message]) -> list[Any]:
    """The messages of one type."""
    return [message for message in messages if isinstance(message, kind)]


class Stage:
    """A center, its state, and everything it said."""

    def __init__(self, plot: Scenario, **options: Any) -> None:
        self.scenario = plot
        self.center = Center.of(plot, **options)
        self.state: CenterState = self.center.initial()
        self.said: list[Message] = []

    def tell(self, event: Event, at_s: float = 0.0) -> list[Message]:
        """One event at a wall time; the answer."""
        self.state, messages = self.center.step(self.state, event, round(at_s * NS_PER_S))
        self.said += messages
        return messages

    def tick(self, at_s: float) -> list[Message]:
        """Time has passed."""
        return self.tell(Tick(), at_s)

    def join(self, name: str, next_s: float | None, incarnation: int = 1, at_s: float = 0.0) -> list[Message]:
        """A sensor joins; ``next_s`` None: it has nothing to report."""
        return self.tell(Join(name, incarnation, self.ns(next_s), self.center.digest), at_s)

    def join_all(self, **next_s: float) -> dict[str, Start]:
        """All sensors join, the next scan of each at 2 s unless given; the tracks each was told of."""
        names = self.scenario.sensor_names
        starts = [start for name in names for start in only(Start, self.join(name, next_s.get(name, 2.0)))]
        return {start.sensor: start for start in starts}

    def ns(self, time_s: float | None) -> int:
        """Scenario seconds in wire time."""
        return NEVER if time_s is None else self.scenario.to_ns(time_s)

    def report(self, name: str, time_s: float, next_s: float | None = None, **changes: Any) -> Report:
        """A report that fits: of track 0, at the origin, with no evidence.

        Args:
            name: of the sensor.
            time_s: of its scan.
            next_s: when it will see next; None: 2 s later.
            changes: fields to set.
        """
        number = self.scenario.sensor_names.index(name)
        n = self.scenario.motion.build().n
        report = Report(
            sensor=name,
            sequence=0,
            time_ns=self.ns(time_s),
            next_ns=self.ns(time_s + 2.0 if next_s is None else next_s),
            epoch=self.state.members[number].epoch,
            ids=np.array([0]),
            terms=np.array([1]),
            log_g=np.array([0.0]),
            x=np.zeros((1, n)),
            P=1e4 * np.eye(n)[None],
        )
        return report._replace(**changes)

    @property
    def clear_s(self) -> list[float | None]:
        """How far the clock told the nodes to go, one after the other; None: everything is done."""
        return [
            None if clock.clear_ns == NEVER else self.scenario.to_seconds(clock.clear_ns)
            for clock in only(Clock, self.said)
        ]

    @property
    def decisions(self) -> list[Decision]:
        """All decisions so far."""
        return only(Decision, self.said)

    @property
    def tracks(self) -> Tracks:
        """The picture of now."""
        return self.center.tracks(self.state)


class Node:
    """A sensor's tracker and its state."""

    def __init__(self, plot: Scenario, name: str, start: Start | None = None, schedule: Schedule | None = None) -> None:
        self.tracker = LocalTracker.of(plot, name, schedule)
        self.state: NodeState = self.tracker.initial()
        if start is not None:
            self.start(start)

    def start(self, start: Start) -> None:
        """Take over tracks."""
        self.told(start)

    def told(self, message: Start | Begin | Stop) -> None:
        """The center says something."""
        self.state = self.tracker.told(self.state, message)

    def scan(self, scan: Scan, next_ns: int = NEVER) -> Report:
        """Filter a scan."""
        self.state, report = self.tracker.scan(self.state, scan, next_ns)
        return report


def reports_of(plot: Scenario, starts: dict[str, Start], scans: Sequence[Scan]) -> list[Report]:
    """What the nodes of a network report of the scans, by time."""
    schedule = schedule_of(scans, plot)
    nodes = {name: Node(plot, name, start, schedule) for name, start in starts.items()}
    reports = []
    for at, scan in enumerate(scans):
        later = [other.time_ns for other in scans[at + 1 :] if other.sensor == scan.sensor]
        reports.append(nodes[scan.sensor].scan(scan, later[0] if later else NEVER))
    return reports
