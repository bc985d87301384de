"""Recorded plots as JSON Lines: one scan a line, empty scans too.

``{"sensor": "radar-1", "time": 2.0, "plots": [[x, y], ...]}``: time in seconds since the scenario's epoch, plots in the
sensor's own measurement space (docs/how-to/sensors.md); a sensor that moves gives its ``position``, its ``velocity``
over ground, and the ``heading`` of its platform. In a ``Scan`` azimuths count from north, whatever the file's count
from.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.errors import PlotsError, PlotsWarning
from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.limits import FULL_CIRCLE, MAX_PLOTS, MAX_VALUE
from waldnet.common.messages import Scan
from waldnet.common.quantities import NS_PER_S
from waldnet.scenarios.json_lines import numbers, read_lines, seconds

#: What a line may say of the sensor.
_POSE = ("position", "velocity", "heading")


def read_plots(path: Path, scenario: Scenario) -> list[Scan]:
    """Read and validate a file of recorded plots; arguments, order and errors as for ``read_entries``."""
    return [scan for scan, _ in read_entries(path, scenario)]


def read_entries(path: Path, scenario: Scenario) -> list[tuple[Scan, dict[str, Any]]]:
    """Read and validate a file of recorded plots.

    Args:
        path: the file.
        scenario: names its sensors and their dimensions, and the sensors of the recording that it ignores.

    Returns:
        the scans, each with the object of its line, by time; those of one time in the order of the scenario's sensors.

    Raises:
        PlotsError: naming file, line and reason of every fault, up to a bound.

    Warns:
        PlotsWarning: where a sensor that measures range rates moves, and its velocity is not told.
    """
    first_line: dict[tuple[str, int], int] = {}

    def parse(entry: dict[str, Any], number: int) -> tuple[Scan | None, dict[str, Any]]:
        scan = scan_of(entry, scenario)
        if scan is not None and (before := first_line.setdefault((scan.sensor, scan.time_ns), number)) != number:
            raise ValueError(
                f"{scan.sensor} has a scan at {scenario.to_seconds(scan.time_ns)} s already, line {before}"
            )
        return scan, entry

    lines = read_lines(path, "scan", ("sensor", "time", "plots"), parse, PlotsError, _POSE)
    read = [(scan, entry) for scan, entry in lines if scan is not None]
    if not read:
        raise PlotsError(f"{path}: has no scan, expected one a line")
    place = _place(scenario)
    read.sort(key=lambda each: place(each[0]))
    scans = [scan for scan, _ in read]
    for config in scenario.sensors:
        if config.kind == "polar-doppler":
            own = [scan for scan in scans if scan.sensor == config.name]
            _check_velocities(path, own, [first_line[scan.sensor, scan.time_ns] for scan in own])
    return read


def _check_velocities(path: Path, scans: Sequence[Scan], lines: Sequence[int]) -> None:
    """Range rates of a sensor that moves can only be read with its velocity.

    Args:
        path: the file.
        scans: of a sensor that measures range rates, by time.
        lines: that they stand in.
    """
    without = [line for scan, line in zip(scans, lines, strict=True) if not len(scan.velocity)]
    if without and len(without) < len(scans):
        told = min(set(lines) - set(without))
        reason = f"velocity is missing: {scans[0].sensor} measures range rates, and line {told} has one"
        raise PlotsError(f"{path}:{min(without)}: {reason}")
    positions = np.array([scan.position for scan in scans])
    moves = np.flatnonzero((positions[1:] != positions[:-1]).any(axis=-1))
    if without and len(moves):
        seconds_between = np.diff([scan.time_ns for scan in scans]) / NS_PER_S
        speeds = np.linalg.vector_norm(np.diff(positions, axis=0), axis=-1) / seconds_between
        text = (
            f"{path}:{lines[moves[0] + 1]}: {scans[0].sensor} measures range rates and moves (median speed "
            f"{np.median(speeds):.3g} m/s), but no velocity is told: its range rates are taken as over ground. If they "
            "are relative to the sensor, each line needs its velocity; else velocity = [0, 0] in [[sensor]] says so"
        )
        warnings.warn(text.replace("[0, 0]", str([0] * positions.shape[1])), PlotsWarning, stacklevel=4)


def in_order(scans: Iterable[Scan], scenario: Scenario) -> list[Scan]:
    """Scans by time; those of one time in the order of the scenario's sensors."""
    place = _place(scenario)
    return sorted(scans, key=place)


def _place(scenario: Scenario) -> Callable[[Scan], tuple[int, int]]:
    """Tells the place of a scan among the others: its time, then the number of its sensor."""
    numbers = {name: number for number, name in enumerate(scenario.sensor_names)}
    return lambda scan: (scan.time_ns, numbers[scan.sensor])


def write_plots(file: TextIO, scans: Iterable[Scan], scenario: Scenario) -> None:
    """Write scans as JSON Lines."""
    file.writelines(plots_line(scan, scenario) + "\n" for scan in scans)


def plots_line(scan: Scan, scenario: Scenario) -> str:
    """A scan as JSON."""
    return json.dumps(plots_entry(scan, scenario))


def plots_entry(scan: Scan, scenario: Scenario) -> dict[str, Any]:
    """A scan as the object of a line."""
    config = scenario.sensor(scan.sensor)
    relative = config.azimuth == "heading"
    line: dict[str, Any] = {
        "sensor": scan.sensor,
        "time": scenario.to_seconds(scan.time_ns),
        "position": scan.position.tolist(),
    }
    if len(scan.velocity):
        line["velocity"] = scan.velocity.tolist()
    if relative or scan.heading != (config.heading or 0.0):
        line["heading"] = scan.heading
    line["plots"] = (_turned(scan.z, config, -scan.heading) if relative else scan.z).tolist()
    return line


def scan_of(entry: dict[str, Any], scenario: Scenario) -> Scan | None:
    """The scan of a line's object; None if the scenario ignores its sensor.

    Raises:
        ValueError: saying what is wrong with it.
    """
    name, time_s = entry["sensor"], seconds(entry["time"])
    if scenario.recording is not None and name in scenario.recording.ignore:
        return None
    if name not in scenario.sensor_names:
        raise ValueError(f"sensor: {name!r} is not one of {', '.join(scenario.sensor_names)}")
    sensor = scenario.sensor(name)
    pose = _pose(entry, sensor, scenario.motion.dimensions)
    plots = entry["plots"]
    if not isinstance(plots, list):
        raise ValueError(f"plots: {plots!r} is not a list of plots")
    if len(plots) > MAX_PLOTS:
        raise ValueError(f"plots: has {len(plots)} plots, expected at most {MAX_PLOTS}")
    m, limits = len(sensor.sigma), sensor.limits
    z = [_vector(plot, m, f"plots.{j}", sys.float_info.max) for j, plot in enumerate(plots)]
    for j, plot in enumerate(z):
        # Degrees, for example, or a number that stands for "not available".
        if fault := limits.fault(plot):
            raise ValueError(f"plots.{j}: {fault}")
    seen = np.array(z).reshape(-1, m)
    if sensor.azimuth == "heading":
        seen = _turned(seen, sensor, pose.heading)
    return Scan(name, scenario.to_ns(time_s), pose.position, seen, pose.velocity, pose.heading)


def _pose(entry: dict[str, Any], sensor: SensorConfig, d: int) -> SensorPose:
    """Pose of a sensor in a line, as far as it is told."""
    told = {key: _vector(entry[key], d, key) for key in ("position", "velocity") if entry.get(key) is not None}
    heading = entry.get("heading")
    if heading is not None and not _is_angle(heading):
        raise ValueError(f"heading: {heading!r} is no angle in radians (-2 pi to 2 pi)")
    if heading is None and sensor.heading is None and sensor.azimuth == "heading":
        raise ValueError(f"heading is missing: azimuths of {sensor.name} count from it")
    return sensor.pose(d, **told, heading=heading)


def _is_angle(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= FULL_CIRCLE


def _turned(z: Array, sensor: SensorConfig, angle: float) -> Array:
    """Plots whose azimuths count from elsewhere, in [0, 2 pi), shape (M, m)."""
    z, azimuth = z.copy(), sensor.numbers.index("azimuth")
    z[:, azimuth] = np.remainder(z[:, azimuth] + angle, 2.0 * np.pi)
    return z


def _vector(value: Any, size: int, where: str, largest: float = MAX_VALUE) -> Array:
    return np.array(numbers(value, (size,), where, largest), dtype=np.float64)
