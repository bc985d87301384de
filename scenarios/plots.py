"""Recorded plots as JSON Lines: one scan a line, empty scans too.

``{"sensor": "radar-1", "time": 2.0, "plots": [[x, y], ...]}``: time in seconds since the scenario's epoch, plots in the
sensor's own measurement space (docs/how-to/sensors.md); a sensor that moves gives its ``position``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from common.config import Scenario
from common.errors import PlotsError
from common.estimation.gaussian import Array
from common.messages import Scan
from scenarios.json_lines import numbers, read_lines, seconds

#: Numbers of a plot that cannot be just any: degrees, for example, are soon found out.
_RANGES = {
    "range": (0.0, np.inf, "distance"),
    "azimuth": (-2.0 * np.pi, 2.0 * np.pi, "angle in radians"),
    "elevation": (-0.5 * np.pi, 0.5 * np.pi, "elevation in radians"),
}


def read_plots(path: Path, scenario: Scenario) -> list[Scan]:
    """Read and validate a file of recorded plots.

    Args:
        path: the file.
        scenario: names its sensors and their dimensions, and the sensors of the recording that it ignores.

    Returns:
        the scans, by time; those of one time in the order of the scenario's sensors.

    Raises:
        PlotsError: naming file, line and reason of every fault, up to a bound.
    """
    first_line: dict[tuple[str, int], int] = {}

    def parse(entry: dict[str, Any], number: int) -> Scan | None:
        scan = _parse(entry, scenario)
        if scan is not None and (before := first_line.setdefault((scan.sensor, scan.time_ns), number)) != number:
            raise ValueError(
                f"{scan.sensor} has a scan at {scenario.to_seconds(scan.time_ns)} s already, line {before}"
            )
        return scan

    lines = read_lines(path, "scan", ("sensor", "time", "plots"), parse, PlotsError, ("position",))
    scans = [scan for scan in lines if scan is not None]
    if not scans:
        raise PlotsError(f"{path}: has no scan, expected one a line")
    return in_order(scans, scenario)


def in_order(scans: Iterable[Scan], scenario: Scenario) -> list[Scan]:
    """Scans by time; those of one time in the order of the scenario's sensors."""
    numbers = {name: number for number, name in enumerate(scenario.sensor_names)}
    return sorted(scans, key=lambda scan: (scan.time_ns, numbers[scan.sensor]))


def write_plots(file: TextIO, scans: Iterable[Scan], scenario: Scenario) -> None:
    """Write scans as JSON Lines."""
    for scan in scans:
        line = {
            "sensor": scan.sensor,
            "time": scenario.to_seconds(scan.time_ns),
            "position": scan.position.tolist(),
            "plots": scan.z.tolist(),
        }
        file.write(json.dumps(line) + "\n")


def _parse(entry: dict[str, Any], scenario: Scenario) -> Scan | None:
    """The scan of a line; None if the scenario ignores its sensor."""
    name, time_s = entry["sensor"], seconds(entry["time"])
    if scenario.recording is not None and name in scenario.recording.ignore:
        return None
    if name not in scenario.sensor_names:
        raise ValueError(f"sensor: {name!r} is not one of {', '.join(scenario.sensor_names)}")
    sensor = scenario.sensor(name)
    d = scenario.motion.dimensions
    position = sensor.stand(d) if entry.get("position") is None else _vector(entry["position"], d, "position")
    plots = entry["plots"]
    if not isinstance(plots, list):
        raise ValueError(f"plots: {plots!r} is not a list of plots")
    m = len(sensor.sigma)
    z = [_vector(plot, m, f"plots.{j}") for j, plot in enumerate(plots)]
    for j, plot in enumerate(z):
        _check_range(plot, sensor.numbers, f"plots.{j}")
    return Scan(name, scenario.to_ns(time_s), position, np.array(z).reshape(-1, m))


def _vector(value: Any, size: int, where: str) -> Array:
    return np.array(numbers(value, (size,), where), dtype=np.float64)


def _check_range(plot: Array, numbers: tuple[str, ...], where: str) -> None:
    for value, name in zip(plot, numbers, strict=True):
        low, high, meaning = _RANGES.get(name, (-np.inf, np.inf, ""))
        if not low <= value <= high:
            raise ValueError(f"{where}: {name} {value:g} is no {meaning}")
