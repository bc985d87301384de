"""Measures the ferry's sensors against the truth of two boats.

``python -m waldnet.scenarios.autoferry.measure`` prints tables in Markdown from the files beside this module. A plot

ithin 25 m of a boat is the boat's, a bearing within 0.1 rad is; a plot is at most one boat's, and all others are false.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.sight import to_polar
from waldnet.scenarios.autoferry.convert import CAMERAS, SCENARIOS
from waldnet.scenarios.measure import assign
from waldnet.scenarios.persistence import LAG_S, Watch, correlation, fitted, watches

#: Up to where a boat is looked for [m].
REACH = {"radar": 500.0, "lidar": 125.0, "daylight": 300.0, "infrared": 300.0}
#: How far from a boat a plot may be [m], a bearing [rad].
NEAR_M, NEAR_RAD = 25.0, 0.1
#: Two boats are in one line for whoever sees less than this between them [rad].
IN_LINE_RAD = 0.1
RANGES = (0, 50, 100, 150, 200, 300, 500)
_BY_SCENARIO = (
    *("sensor", "scenario", "scans", "interval [s]", "its spread [s]", "p_d boat 1", "p_d boat 2"),
    *("false plots", "bias [m, rad]", "sigma [m, rad]", "directions [°]"),
)
_BY_SENSOR = ("sensor", "reach [m]", "p_d", "shadowed", "after a miss", "false plots", "bias [m, rad]", "rms [m, rad]")
_BY_PERSISTENCE = (
    "sensor",
    "p_d while visible",
    "visible [s]",
    "hidden [s]",
    "gained per scan",
    f"errors {LAG_S:.0f} s later",
)


class Boat(NamedTuple):
    """A boat during a scan.

    Attributes:
        number: of the boat.
        range: from the ship [m].
        shadowed: whether the other boat is nearer and in line.
        error: of its plot (east, north [m], of cameras azimuth [rad]); None if it has none.
    """

    number: int
    range: float
    shadowed: bool
    error: Array | None


class Look(NamedTuple):
    """A scan, compared with the truth."""

    time_s: float
    azimuths: Array
    boats: tuple[Boat, ...]
    false_plots: int


def compare(folder: Path, scenario: int, sensor: str) -> list[Look]:
    """All scans of one sensor, compared with the truth."""
    tracks: dict[int, list[list[float]]] = {}
    for point in _lines(folder / f"scenario{scenario}-truth.jsonl"):
        tracks.setdefault(point["target"], []).append([point["time"], *point["position"]])
    boats = {number: np.array(rows).T for number, rows in sorted(tracks.items())}
    scans = (scan for scan in _lines(folder / f"scenario{scenario}.jsonl") if scan["sensor"] == sensor)
    return [_look(scan, boats) for scan in scans]


def _look(scan: dict[str, Any], boats: dict[int, Array]) -> Look:
    camera = scan["sensor"] in CAMERAS
    time_s = scan["time"]
    places = np.array([[np.interp(time_s, t, east), np.interp(time_s, t, north)] for t, east, north in boats.values()])
    polar = to_polar(places - scan["position"])
    z = np.array(scan["plots"]).reshape(-1, 1 if camera else 2)
    errors = _turn(z - polar[:, None, 1:]) if camera else z - places[:, None]
    distances, near = np.linalg.vector_norm(errors, axis=-1), NEAR_RAD if camera else NEAR_M
    found = {int(boat): errors[boat, plot] for boat, plot in zip(*assign(distances, near), strict=True)}
    in_line = bool(np.abs(_turn(np.diff(polar[:, 1]))) < IN_LINE_RAD)
    ranges = polar[:, 0]
    seen = tuple(
        Boat(number, float(ranges[i]), in_line and ranges[i] > ranges.min(), found.get(i))
        for i, number in enumerate(boats)
    )
    azimuths = z[:, 0] if camera else to_polar(z - scan["position"])[:, 1]
    return Look(time_s, azimuths, seen, len(z) - len(found))


def by_scenario(sensor: str, scenario: int, looks: Sequence[Look]) -> list[str]:
    """A row: interval and its spread, p_d of each boat, false plots, bias and noise."""
    intervals = np.diff([look.time_s for look in looks])
    errors = np.array([boat.error for boat in _within(looks, sensor) if boat.error is not None])
    digits = 3 if sensor in CAMERAS else 1
    return [
        sensor,
        str(scenario),
        str(len(looks)),
        f"{np.median(intervals):.3f}",
        f"{intervals.std():.3f}",
        *(_p_d(boat for boat in _within(looks, sensor) if boat.number == number) for number in (1, 2)),
        f"{np.mean([look.false_plots for look in looks]):.2f}",
        ", ".join(f"{bias:.{digits}f}" for bias in errors.mean(axis=0)),
        ", ".join(f"{sigma:.{digits}f}" for sigma in errors.std(axis=0)),
        f"{_directions(looks):.0f}",
    ]


def by_sensor(sensor: str, looks: Sequence[Look]) -> list[str]:
    """A row: over all scenarios p_d, that of shadowed boats and after a miss, false plots, errors with all biases."""
    boats = list(_within(looks, sensor))
    errors = np.array([boat.error for boat in boats if boat.error is not None])
    digits = 3 if sensor in CAMERAS else 1
    return [
        sensor,
        f"{REACH[sensor]:.0f}",
        _p_d(boats),
        _p_d(boat for boat in boats if boat.shadowed),
        f"{_again(looks, sensor):.2f}",
        f"{np.mean([look.false_plots for look in looks]):.1f}",
        ", ".join(f"{bias:.{digits}f}" for bias in errors.mean(axis=0)),
        ", ".join(f"{rms:.{digits}f}" for rms in np.sqrt(np.square(errors).mean(axis=0))),
    ]


def by_range(sensor: str, looks: Sequence[Look]) -> list[str]:
    """A row: p_d of both boats in classes of range."""
    boats = [boat for look in looks for boat in look.boats]
    classes = itertools.pairwise(RANGES)
    return [sensor, *(_p_d(boat for boat in boats if low <= boat.range < high) for low, high in classes)]


def by_persistence(sensor: str, recordings: Iterable[Sequence[Look]]) -> list[str]:
    """A row: how long boats are visible and hidden, and how errors persist."""
    seen = [watch for looks in recordings for boat in (0, 1) for watch in _watches(sensor, looks, boat)]
    persistence, again = fitted(seen), correlation(seen)
    return [
        sensor,
        f"{persistence.p_d:.2f}",
        *(f"{time_s:.0f}" for time_s in persistence.visibility),
        f"{persistence.gained:.2f}",
        "-" if np.isnan(again) else f"{again:.2f}",
    ]


def _watches(sensor: str, looks: Sequence[Look], boat: int) -> list[Watch]:
    boats = [look.boats[boat] for look in looks]
    none = np.full(1 if sensor in CAMERAS else 2, np.nan)
    errors = np.array([none if boat.error is None else boat.error for boat in boats])
    within = np.array([boat.range < REACH[sensor] for boat in boats])
    return watches(np.array([look.time_s for look in looks]), within, errors)


def tables(folder: Path) -> str:
    """All tables, in Markdown."""
    looks = {(sensor, number): compare(folder, number, sensor) for sensor in REACH for number in SCENARIOS}
    pooled = {sensor: [look for number in SCENARIOS for look in looks[sensor, number]] for sensor in REACH}
    ranges = [f"{low}-{high} m" for low, high in itertools.pairwise(RANGES)]
    first = _table(_BY_SCENARIO, (by_scenario(*key, seen) for key, seen in looks.items()))
    second = _table(_BY_SENSOR, (by_sensor(*item) for item in pooled.items()))
    third = _table(["p_d", *ranges], (by_range(*item) for item in pooled.items()))
    fourth = _table(
        _BY_PERSISTENCE, (by_persistence(sensor, (looks[sensor, number] for number in SCENARIOS)) for sensor in REACH)
    )
    return "\n".join([*first, "", *second, "", *third, "", *fourth])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m waldnet.scenarios.autoferry.measure", description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).parent, help="of scenarioN.jsonl")
    sys.stdout.write(tables(parser.parse_args(arguments).folder) + "\n")
    return 0


def _within(looks: Iterable[Look], sensor: str) -> Iterator[Boat]:
    return (boat for look in looks for boat in look.boats if boat.range < REACH[sensor])


def _p_d(boats: Iterable[Boat]) -> str:
    found = [boat.error is not None for boat in boats]
    return f"{np.mean(found):.2f}" if found else "-"


def _again(looks: Sequence[Look], sensor: str) -> float:
    """How often a boat is found in the scan after one that missed it."""
    found: list[bool] = []
    for before, after in itertools.pairwise(looks):
        pairs = zip(before.boats, after.boats, strict=True) if before.time_s < after.time_s else ()
        found += [b.error is not None for a, b in pairs if a.error is None and max(a.range, b.range) < REACH[sensor]]
    return float(np.mean(found))


def _directions(looks: Iterable[Look]) -> float:
    """Degrees of the horizon, in steps of 10, from which plots came."""
    azimuths = np.degrees(np.concatenate([look.azimuths for look in looks])) % 360.0
    return 10.0 * len(np.unique(azimuths // 10.0))


def _turn(angle: Array) -> Array:
    """The same angle in [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    for cells in (head, ["---"] * len(head), *rows):
        yield f"| {' | '.join(cells)} |"


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    with path.open(encoding="utf-8") as file:
        yield from map(json.loads, file)


if __name__ == "__main__":
    sys.exit(main())
