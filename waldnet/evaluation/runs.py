"""Recorded runs: the confirmed tracks of what ``waldnet run`` and ``waldnet replay --json`` write."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.errors import EvaluationError
from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.sprt import CONFIRMED, Status
from waldnet.common.limits import MAX_ESTIMATE
from waldnet.common.messages import IntArray, Tracks
from waldnet.scenarios.json_lines import identity, numbers, read_lines, seconds

_STATUS = tuple(status.name.lower() for status in Status)


class Run(NamedTuple):
    """What a run reported.

    Attributes:
        name: of its folder.
        times_s: measurement times with a track of any status, ascending, shape (K,).
        ids: of tracks that were confirmed at any time, ascending, shape (N,).
        positions: while confirmed, else NaN [m], shape (N, K, d).
        span_s: first and last measurement time, with a track or without; None where nothing was measured or told.
        centralised_of: of a centralised run, names of the runs whose plots it had; else none.
    """

    name: str
    times_s: Array
    ids: IntArray
    positions: Array
    span_s: tuple[float, float] | None
    centralised_of: tuple[str, ...] = ()


class Line(NamedTuple):
    """A track at a measurement time; its position [m] while it is confirmed, else None."""

    time_s: float
    track: int
    position: list[float] | None


def read_runs(paths: Sequence[Path], d: int) -> list[Run]:
    """Read several runs, each under the shortest end of its path that tells it from the others.

    Args:
        paths: folders of ``waldnet run``, or files of what ``waldnet replay --json`` prints.
        d: dimensions of the truth.

    Raises:
        EvaluationError: naming file, line and reason.
    """
    return [read_run(path, d)._replace(name=name) for path, name in zip(paths, names(paths), strict=True)]


def names(paths: Sequence[Path]) -> list[str]:
    """The last parts of the paths, as many as tell them apart."""
    parts = [(path.with_suffix("") if path.is_file() else path).absolute().parts for path in paths]
    for length in range(1, max(map(len, parts)) + 1):
        ends = ["/".join(part[-length:]) for part in parts]
        if len(set(ends)) == len(ends):
            return ends
    raise EvaluationError("a run is given twice: " + ", ".join(map(str, paths)))


def read_run(path: Path, d: int) -> Run:
    """Read the tracks of a run.

    Args:
        path: folder of ``waldnet run``, or a file of what ``waldnet replay --json`` prints.
        d: dimensions of the truth.

    Returns:
        the run, under its last name.

    Raises:
        EvaluationError: naming file, line and reason.
    """
    file = path / "tracks.jsonl" if path.is_dir() else path
    run = make_run(path.name, _read_lines(file, d), d)
    told = _read_span(path / "decisions.json") if path.is_dir() else None
    return run._replace(span_s=told or run.span_s)


def run_of(name: str, pictures: Sequence[Tracks], scenario: Scenario, d: int) -> Run:
    """The run of a scenario with the pictures of all measurement times, by time; d: dimensions of the truth."""
    times_s = [scenario.to_seconds(tracks.time_ns) for tracks in pictures]
    lines = [
        Line(time_s, track, x[:d].tolist() if status == CONFIRMED else None)
        for time_s, tracks in zip(times_s, pictures, strict=True)
        for track, status, x in zip(tracks.ids.tolist(), tracks.status, tracks.x, strict=True)
    ]
    return make_run(name, lines, d)._replace(span_s=(times_s[0], times_s[-1]) if times_s else None)


def make_run(name: str, lines: Sequence[Line], d: int) -> Run:
    """The run of a name that says these lines, by time; d: dimensions of the truth."""
    times_s = np.unique(np.array([line.time_s for line in lines]))
    confirmed = [line for line in lines if line.position is not None]
    ids, rows = np.unique(np.array([line.track for line in confirmed], dtype=np.int64), return_inverse=True)
    positions = np.full((len(ids), len(times_s), d), np.nan)
    if confirmed:
        columns = np.searchsorted(times_s, [line.time_s for line in confirmed])
        positions[rows, columns] = [line.position for line in confirmed]
    span_s = (float(times_s[0]), float(times_s[-1])) if len(times_s) else None
    return Run(name, times_s, ids, positions, span_s)


def _read_lines(file: Path, d: int) -> list[Line]:
    first_line: dict[tuple[int, float], int] = {}

    def parse(entry: dict[str, Any], number: int) -> Line:
        time_s, track = seconds(entry["time"]), identity(entry["track"], "track")
        before = first_line.setdefault((track, time_s), number)
        if before != number:
            raise ValueError(f"track {track} is there at {time_s} s already, line {before}")
        if entry["status"] not in _STATUS:
            raise ValueError(f"status: {entry['status']!r} is not one of {', '.join(_STATUS)}")
        # Position and velocity, perhaps acceleration.
        x = numbers(entry["x"], (2 * d, 3 * d), f"x, where the truth has {d} coordinates", MAX_ESTIMATE)
        return Line(time_s, track, x[:d] if entry["status"] == "confirmed" else None)

    return list(read_lines(file, "track", ("time", "track", "status", "x"), parse, EvaluationError, optional=None))


def _read_span(file: Path) -> tuple[float, float] | None:
    """First and last measurement time of a run; None where its report does not say."""
    try:
        told = json.loads(file.read_text(encoding="utf-8"))
        return seconds(told["first_time"]), seconds(told["last_time"])
    except (OSError, ValueError, TypeError, KeyError):
        return None
