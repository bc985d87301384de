"""Converts ship reports (AIS) in the Solent to trajectories as a simulation reads them.

``python -m waldnet.scenarios.solent.convert SolentAIS_20160112_130211.csv`` writes
``truth.jsonl`` anew, beside this module.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_smoothing_spline

from waldnet.common.estimation.gaussian import Array

#: Of the local frame [degrees].
LATITUDE, LONGITUDE = 50.75, -1.2
COLUMNS = ("Time", "MMSI", "Latitude_degrees", "Longitude_degrees")
#: WGS84: equatorial radius [m] and squared eccentricity.
_RADIUS, _ECCENTRICITY = 6_378_137.0, 6.69437999014e-3
#: No ship is faster [m/s]; a clock may be wrong by so much [s].
_FASTEST, _CLOCK_S = 30.0, 10.0
#: A longer silence ends a trajectory [s], unless the ship came not even so far meanwhile [m].
_SILENCE_S, _STILL_M = 240.0, 100.0
#: Fewer reports make no trajectory: a smoothing spline needs five.
_FEWEST = 5
#: A smoothing spline of this parameter is the path of a target of nearly constant velocity (psd 0.05 m^2/s^3), smoothed
#: from positions with 10 m of noise: it minimises sum of (p - f)^2 / sigma^2 plus integral of f''^2 / psd.
_SMOOTHING = 10.0**2 / 0.05
#: Straight legs stay so close to the smooth path [m].
_TOLERANCE_M = 1.0


class Report(NamedTuple):
    """Where a ship said it was: Unix time [s], degrees."""

    time_s: float
    latitude: float
    longitude: float


class Trajectory(NamedTuple):
    """Straight legs of one ship.

    Attributes:
        target: the ship's number (MMSI, nine digits); before it 1, 2 and so on for its second trajectory, its third.
        times_s: whole seconds since the epoch, shape (K,).
        positions: east, north [m], shape (K, 2).
    """

    target: int
    times_s: Array
    positions: Array


def read(path: Path) -> dict[str, list[Report]]:
    """Reports of each ship, by time.

    Raises:
        ValueError: the file is missing or wrong; the message has the line.
    """
    ships: dict[str, list[Report]] = {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = csv.DictReader(file)
            if missing := [name for name in COLUMNS if name not in (rows.fieldnames or ())]:
                raise ValueError(f"{path}:1: no column {missing[0]}, expected {', '.join(COLUMNS)}")
            for row in rows:
                try:
                    ships.setdefault(row["MMSI"], []).append(parse_report(row))
                except ValueError as error:
                    raise ValueError(f"{path}:{rows.line_num}: {error}") from None
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}; expected ship reports as CSV") from error
    if not ships:
        raise ValueError(f"{path}: no reports, expected one a line")
    return {ship: sorted(reports) for ship, reports in ships.items()}


def parse_report(row: Mapping[str, str | None]) -> Report:
    """Read one line of the file, whose times are taken for UTC.

    Raises:
        ValueError: what is wrong with it.
    """
    if not (row["MMSI"] or "").isdecimal():
        raise ValueError(f"MMSI: {row['MMSI']!r}, expected a ship's number")
    time = row["Time"]
    try:
        time_s = datetime.fromisoformat(time or "").replace(tzinfo=UTC).timestamp()
    except ValueError:
        raise ValueError(f"Time: {time!r}, expected one like 2016-01-12 13:02:11.218") from None
    return Report(time_s, _degrees(row, "Latitude_degrees", 90.0), _degrees(row, "Longitude_degrees", 180.0))


def to_local(latitude: Array, longitude: Array) -> Array:
    """East and north [m] in the plane that touches the ellipsoid at the origin, shapes (...) to (..., 2).

    Distances in it are those on the ellipsoid but for 0.2 m at 30 km; how far the sea falls below it is left out.
    """
    away = _geocentric(latitude, longitude) - _geocentric(np.array(LATITUDE), np.array(LONGITUDE))
    (sp, cp), (sl, cl) = ((math.sin(a), math.cos(a)) for a in (math.radians(LATITUDE), math.radians(LONGITUDE)))
    return np.asarray(away @ np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp]]).T)


def trajectories(ship: str, reports: Sequence[Report], epoch_s: float) -> Iterator[Trajectory]:
    """The trajectories of one ship: none if it lay still all the time, several if it was silent for long."""
    times = np.array([report.time_s for report in reports]) - epoch_s
    places = to_local(np.array([report.latitude for report in reports]), np.array([r.longitude for r in reports]))
    kept = _believed(times, places)
    times, places = times[kept], places[kept]
    if np.ptp(places, axis=0).max() < _STILL_M:
        return
    steps = np.linalg.vector_norm(np.diff(places, axis=0), axis=-1)
    silent = np.flatnonzero((np.diff(times) > _SILENCE_S) & (steps > _STILL_M)) + 1
    pieces = zip(np.split(times, silent), np.split(places, silent), strict=True)
    long_enough = [piece for piece in pieces if len(piece[0]) >= _FEWEST]
    for number, (own_times, own_places) in enumerate(long_enough):
        yield Trajectory(number * 10**9 + int(ship), *smooth(own_times, own_places))


def smooth(times_s: Array, positions: Array) -> tuple[Array, Array]:
    """Straight legs between whole seconds along the smoothed path, shapes (K,), (K, 2) to (L,), (L, 2)."""
    seconds = np.arange(math.ceil(times_s[0]), math.floor(times_s[-1]) + 1.0)
    path = np.stack([make_smoothing_spline(times_s, axis, lam=_SMOOTHING)(seconds) for axis in positions.T], axis=-1)
    corners = [*_corners(path, 0, len(seconds) - 1), len(seconds) - 1]
    return seconds[corners], path[corners]


def write(path: Path, ships: Sequence[Trajectory]) -> None:
    """Write positions as JSON Lines, to the decimetre; trajectories in the order in which they begin."""
    with path.open("w", encoding="utf-8", newline="\n") as file:
        for target, times_s, positions in sorted(ships, key=lambda one: (one.times_s[0], one.target)):
            for time_s, place in zip(times_s.tolist(), positions.tolist(), strict=True):
                # adding 0.0 makes -0.0 a plain zero
                line = {"target": target, "time": time_s, "position": [round(metres, 1) + 0.0 for metres in place]}
                file.write(json.dumps(line) + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code is 1, and nothing is written, when the reports are wrong."""
    parser = argparse.ArgumentParser(prog="python -m waldnet.scenarios.solent.convert", description=__doc__)
    parser.add_argument("reports", type=Path, help="SolentAIS_20160112_130211.csv")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "truth.jsonl", help="file to write")
    options = parser.parse_args(arguments)
    try:
        ships = read(options.reports)
        epoch_s = math.floor(min(reports[0].time_s for reports in ships.values()))
        made = [one for ship, reports in ships.items() for one in trajectories(ship, reports, epoch_s)]
        write(options.out, made)
    except (OSError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    points = sum(len(one.times_s) for one in made)
    sys.stdout.write(f"epoch {epoch_s}, {len(ships)} ships, {len(made)} trajectories, {points} positions\n")
    return 0


def _degrees(row: Mapping[str, str | None], column: str, largest: float) -> float:
    text = row[column]
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not abs(value) <= largest:
        raise ValueError(f"{column}: {text!r}, expected degrees from -{largest:g} to {largest:g}")
    return value


def _geocentric(latitude: Array, longitude: Array) -> Array:
    """Earth-centred coordinates on the ellipsoid [m], shapes (...) to (..., 3)."""
    p, l_ = np.radians(latitude), np.radians(longitude)
    normal = _RADIUS / np.sqrt(1.0 - _ECCENTRICITY * np.sin(p) ** 2)
    flat = normal * np.cos(p)
    return np.stack([flat * np.cos(l_), flat * np.sin(l_), (1.0 - _ECCENTRICITY) * normal * np.sin(p)], axis=-1)


def _believed(times_s: Array, places: Array) -> list[int]:
    """Reports that the ship can have reached from the one before."""
    kept = [0]
    for i in range(1, len(times_s)):
        since = times_s[i] - times_s[kept[-1]]
        if since > 0.0 and math.dist(places[i], places[kept[-1]]) <= _FASTEST * max(since, _CLOCK_S):
            kept.append(i)
    return kept


def _corners(path: Array, first: int, last: int) -> list[int]:
    """Where legs must begin so that an evenly timed path stays close to them (Douglas and Peucker, in time)."""
    share = np.linspace(0.0, 1.0, last - first + 1)[:, None]
    away = np.linalg.vector_norm(path[first] + share * (path[last] - path[first]) - path[first : last + 1], axis=-1)
    farthest = first + int(np.argmax(away))
    if away.max() <= _TOLERANCE_M:
        return [first]
    return [*_corners(path, first, farthest), *_corners(path, farthest, last)]


if __name__ == "__main__":
    sys.exit(main())
