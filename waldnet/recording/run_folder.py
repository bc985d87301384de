"""The folder of a run: what was seen and decided, written as it is heard and with bounded memory."""

from __future__ import annotations

import json
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.errors import ConfigError
from waldnet.common.files import LinesFile, replacing, write_atomically
from waldnet.common.messages import NEVER, Decision, IntArray, Message, Scan, Tracks
from waldnet.common.quantities import NS_PER_S
from waldnet.recording.inputs import InputFolder, Source
from waldnet.recording.lines import TrackLines, decision_entry
from waldnet.recording.sketch import Sketch

_SUMMARY, _TRACKS, _JOURNAL = "decisions.json", "tracks.jsonl", "decisions.jsonl"
_LOG_LR, _PLAN = "log_lr.png", "plan.png"
#: What a run writes; the last two are the launcher's.
_NAMES = (_SUMMARY, _TRACKS, _JOURNAL, _LOG_LR, _PLAN, "input", "logs", "network.toml")


def refuse_used(folder: Path) -> None:
    """Let no run write over another one.

    Raises:
        ConfigError: the folder holds files of a run.
    """
    if found := [name for name in _NAMES if (folder / name).exists()]:
        raise ConfigError(
            f"{folder}: holds a run already ({', '.join(found)}), which is not overwritten: "
            "give another --out, or remove the folder"
        )


class Report(NamedTuple):
    """What was written in the end.

    Attributes:
        files: that are whole.
        failures: what could not be written, and why.
    """

    files: list[Path]
    failures: list[str]


def describe(error: OSError) -> str:
    """An error of the system in words: which file, and why."""
    return f"{error.filename or 'standard output'}: {error.strerror}"


class RunFolder:
    """Writes down one run.

    Decisions are written as they come; pictures, and the plots that led to them, once they are older than
    ``fusion.window``: until then a late report may replace them. ``finish`` writes the rest, summary and figures.

    Memory stays bounded: it holds the pictures of the window, what the figures are drawn from, and, 16 bytes each,
    where the last line of every track and every decision stand in their files.

    Attributes:
        lost: why sensors went before their end, by name.
        plots_shed: scans missing among those that came, by sensor: full links carry reports first.
        refused: messages that were left out, by reason.
        sketch: what the figures are drawn from.
    """

    def __init__(self, path: Path, scenario: Scenario, source: Source | None = None) -> None:
        """Begin to write.

        Args:
            path: the folder; must exist.
            scenario: what runs.
            source: what the run will go on, to be kept; None: nothing is.

        Raises:
            OSError: a file cannot be written, or is there already.
        """
        self.path, self.scenario = path, scenario
        self.lost: dict[str, str] = {}
        self.plots_shed: dict[str, int] = {}
        self.refused: Counter[str] = Counter()
        self.sketch = Sketch(scenario)
        self._tracks, self._journal = LinesFile(path / _TRACKS), LinesFile(path / _JOURNAL)
        self._input = None if source is None else InputFolder(path, source, scenario)
        self._lines = TrackLines(scenario)
        self._window_ns = round(scenario.fusion.window * NS_PER_S)
        self._pending: dict[int, Tracks] = {}
        self._newest_ns = self._written_ns = -NEVER
        self._first_ns: int | None = None
        self._live: dict[int, int] = {}
        self._ended, self._decided = _Index(), _Index()
        self._undone = array("q")
        self._n = scenario.motion.build().n
        self._widths = {sensor.name: len(sensor.sigma) for sensor in scenario.sensors}

    @property
    def pending(self) -> int:
        """How many pictures a late report may still replace."""
        return len(self._pending)

    @property
    def end_ns(self) -> int:
        """Time of the last scan of all sources."""
        return self.scenario.epoch_ns if self._input is None else self._input.end_ns

    def note(self, message: Message) -> str | None:
        """Write down a message that belongs to the run.

        Returns:
            why it was left out, if it was.

        Raises:
            OSError: a file cannot be written; what is in it stays readable.
        """
        reason = self._fault(message)
        if reason is not None:
            return self.refuse(reason)
        match message:
            case Tracks():
                self._pending[message.time_ns] = message
                self._newest_ns = max(self._newest_ns, message.time_ns)
                self._write_pictures(self._newest_ns - self._window_ns)
            case Decision():
                (place,) = self._journal.append([json.dumps(decision_entry(message, self.scenario), allow_nan=False)])
                self._decided.add(message.track, place)
                if message.kind == "withdrawn":
                    self._undone.append(place)
            case Scan():
                self.sketch.add_scan(message)
                if self._input is not None:
                    self._input.show(message)
            case _:
                pass
        return None

    def refuse(self, reason: str) -> str:
        """Count a message that is left out; returns the reason."""
        self.refused[reason] += 1
        return reason

    def finish(self, extra: Mapping[str, Any]) -> Report:
        """Write what is left, the summary and the figures; what cannot be written costs nothing else.

        Args:
            extra: further entries of the summary, such as the seed.
        """
        report = Report([], [])
        with self._tracks, self._journal:
            self._attempt(report, None, lambda: self._write_pictures(NEVER))
            self._attempt(report, self.path / _SUMMARY, lambda: self._write_summary(extra))
            if (self.path / _TRACKS).exists():
                report.files.append(self.path / _TRACKS)
            if self._input is not None:
                last_ns, source = max(self._written_ns, 0), self._input
                self._attempt(report, source.path, lambda: source.finish(last_ns, self.lost))
            self._draw(report)
        report.files.sort(key=lambda file: _NAMES.index(file.name))
        if self.path / _SUMMARY in report.files:
            (self.path / _JOURNAL).unlink(missing_ok=True)
        return report

    def _attempt(self, report: Report, file: Path | None, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            report.failures.append(describe(error))
        else:
            report.files.extend([] if file is None else [file])

    def _fault(self, message: Message) -> str | None:
        """Why a message cannot belong to the run; None: it can."""
        last_ns = NEVER if self._input is None else self._input.end_ns
        match message:
            case Tracks(x=x) if x.shape[1] != self._n:
                return f"a picture with states of {x.shape[1]} numbers, the scenario's have {self._n}"
            case Tracks(time_ns=time_ns) if time_ns <= self._written_ns:
                return "a picture older than fusion.window"
            case Tracks(time_ns=time_ns) | Scan(time_ns=time_ns) if time_ns > last_ns:
                return f"a {type(message).__name__} later than the last scan of all sources"
            case Scan(sensor=sensor) if sensor not in self._widths:
                return f"plots of {sensor!r}, a sensor that the scenario does not have"
            case Scan(sensor=sensor, z=z, position=position) if (
                z.shape[1] != self._widths[sensor] or len(position) != self.scenario.motion.dimensions
            ):
                return f"plots of {sensor} of {z.shape[1]} numbers, seen from {len(position)} coordinates"
            case _:
                return None

    def _write_pictures(self, before_ns: int) -> None:
        """Write the pictures of the times before."""
        for time_ns in sorted(time_ns for time_ns in self._pending if time_ns < before_ns):
            tracks = self._pending[time_ns]
            lines = list(self._lines.by_track(tracks))
            places = self._tracks.append(line for _, line in lines)
            now = set(tracks.ids.tolist())
            self._live.update((track, at) for (track, _), at in zip(lines, places, strict=True) if track in now)
            for track in [track for track in self._live if track not in now]:
                self._ended.add(track, self._live.pop(track))
            self.sketch.add_picture(tracks)
            self._first_ns, self._written_ns = self._first_ns or time_ns, time_ns
            del self._pending[time_ns]
            if self._input is not None:
                self._input.write_until(time_ns, self.lost)

    def _write_summary(self, extra: Mapping[str, Any]) -> None:
        """Decisions and outcome as JSON."""
        limits = self.scenario.decision.thresholds
        span_ns = () if self._first_ns is None else (self._first_ns, self._written_ns)
        first_s, last_s = map(self.scenario.to_seconds, span_ns) if span_ns else (None, None)
        summary = {
            "scenario": self.scenario.name,
            **extra,
            "first_time": first_s,
            "last_time": last_s,
            "thresholds": {"log_a": limits.log_a, "log_b": limits.log_b},
            "tracks": _Streamed(self._track_entries, len(self._live) + len(self._ended)),
            "withdrawn": _Streamed(self._withdrawn, len(self._undone)),
            "sensors_lost": dict(self.lost),
            "plots_shed": dict(self.plots_shed),
            "messages_refused": dict(self.refused),
        }
        with replacing(self.path / _SUMMARY) as file:
            file.writelines(part.encode() for part in json.JSONEncoder(indent=2).iterencode(summary))
            file.write(b"\n")

    def _track_entries(self) -> Iterator[dict[str, Any]]:
        """How every track stood in the end, and what was decided about it, by track."""
        index = _Index()
        index.extend(self._ended)
        for track, place in self._live.items():
            index.add(track, place)
        last, decided = index.sorted(), self._decided.sorted()
        with (self.path / _TRACKS).open("rb") as lines, (self.path / _JOURNAL).open("rb") as journal:
            for track in np.unique(last.tracks).tolist():
                line = _entry(lines, last.of(track)[-1])
                yield {
                    "track": track,
                    **{name: line[name] for name in ("status", "log_lr", "log_lr_total")},
                    "last_time": line["time"],
                    "x": line["x"],
                    "supported": line["supported"],
                    "decisions": _standing([_entry(journal, place) for place in decided.of(track)]),
                }

    def _withdrawn(self) -> Iterator[dict[str, Any]]:
        """Decisions that late reports undid."""
        with (self.path / _JOURNAL).open("rb") as journal:
            for place in self._undone:
                yield _entry(journal, place)

    def _draw(self, report: Report) -> None:
        """The figures."""
        from waldnet.recording.figures import (  # Matplotlib takes a second to import; only reports need it.
            draw_log_lr,
            draw_plan,
        )

        decided = self._decided.sorted()
        with (self.path / _JOURNAL).open("rb") as journal:
            decisions = {
                track: _standing([_entry(journal, place) for place in decided.of(track)])
                for track in self.sketch.histories()
            }
        self._draw_figure(report, _LOG_LR, lambda: draw_log_lr(self.sketch, decisions))
        self._draw_figure(report, _PLAN, lambda: draw_plan(self.sketch))

    def _draw_figure(self, report: Report, name: str, draw: Callable[[], bytes]) -> None:
        file = self.path / name
        try:
            picture = draw()
        except Exception as error:  # a figure must not cost what else is reported
            report.failures.append(f"{file}: cannot be drawn: {error}")
        else:
            self._attempt(report, file, lambda: write_atomically(file, picture))


class _Index:
    """Where the lines of tracks stand in a file."""

    def __init__(self) -> None:
        self._tracks, self._places = array("q"), array("q")

    def __len__(self) -> int:
        return len(self._tracks)

    def add(self, track: int, place: int) -> None:
        """Add a line; later ones stand later in the file."""
        self._tracks.append(track)
        self._places.append(place)

    def extend(self, other: _Index) -> None:
        """Add all lines of another index."""
        self._tracks.extend(other._tracks)
        self._places.extend(other._places)

    def sorted(self) -> _Sorted:
        """By track, and those of a track as they stand in the file."""
        tracks, places = (np.array(column, np.int64) for column in (self._tracks, self._places))
        order = np.lexsort((places, tracks))
        return _Sorted(tracks[order], places[order])


class _Sorted(NamedTuple):
    """Tracks, ascending, and places of their lines, shape (N,)."""

    tracks: IntArray
    places: IntArray

    def of(self, track: int) -> list[int]:
        """The places of one track's lines, ascending."""
        low, high = np.searchsorted(self.tracks, [track, track + 1])
        places: list[int] = self.places[low:high].tolist()
        return places


def _entry(file: BinaryIO, place: int) -> dict[str, Any]:
    """The object of a line."""
    file.seek(place)
    entry: dict[str, Any] = json.loads(file.readline())
    return entry


def _standing(entries: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The decisions about one track that were not withdrawn."""
    kept: list[dict[str, Any]] = []
    for entry in entries:
        if entry["kind"] == "withdrawn":
            kept = [one for one in kept if one["time"] != entry["time"]]
        else:
            kept.append(entry)
    return kept


class _Streamed(list[Any]):
    """A list for the JSON encoder whose entries are made one after the other."""

    def __init__(self, entries: Callable[[], Iterator[Any]], count: int) -> None:
        super().__init__()
        self._entries, self._count = entries, count

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Any]:
        return self._entries()
