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
from common.quantities import MAX_SECONDS

#: No coordinate is larger; NaN and infinities are none.
_LARGEST = 1e15
#: Numbers of a plot that cannot be just any: degrees, for example, are soon found out.
_RANGES = {
    "range": (0.0, np.inf, "distance"),
    "azimuth": (-2.0 * np.pi, 2.0 * np.pi, "angle in radians"),
    "elevation": (-0.5 * np.pi, 0.5 * np.pi, "elevation in radians"),
}
_KEYS = {"sensor", "time", "plots", "position"}


def read_plots(path: Path, scenario: Scenario) -> list[Scan]:
    """Read and validate a file of recorded plots.

    Args:
        path: the file.
        scenario: names its sensors and their dimensions.

    Returns:
        the scans, by time; those of one time in the order of the scenario's sensors.

    Raises:
        PlotsError: naming file, line and reason.
    """
    scans: list[Scan] = []
    first_line: dict[tuple[str, int], int] = {}
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise PlotsError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise PlotsError(f"{path}: is no UTF-8 text: {error.reason} at byte {error.start}") from None
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            scan = _parse(line, scenario)
            before = first_line.setdefault((scan.sensor, scan.time_ns), number)
            if before != number:
                raise ValueError(
                    f"{scan.sensor} has a scan at {scenario.to_seconds(scan.time_ns)} s already, line {before}"
                )
        except ValueError as error:
            raise PlotsError(f"{path}:{number}: {error}") from None
        scans.append(scan)
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


def _parse(line: str, scenario: Scenario) -> Scan:
    try:
        entry = json.loads(line)
    except json.JSONDecodeError as error:
        raise ValueError(f"is no JSON: {error.msg} at column {error.colno}") from None
    except RecursionError:
        raise ValueError("is no scan: nested too deeply") from None
    if not isinstance(entry, dict):
        raise ValueError(f"is a JSON {type(entry).__name__}, expected an object with sensor, time and plots")
    if missing := sorted({"sensor", "time", "plots"} - entry.keys()):
        raise ValueError(f"{missing[0]} is missing")
    if unknown := sorted(entry.keys() - _KEYS):
        raise ValueError(f"{unknown[0]!r} is no known key; expected {', '.join(sorted(_KEYS))}")
    name, time = entry["sensor"], entry["time"]
    if name not in scenario.sensor_names:
        raise ValueError(f"sensor: {name!r} is not one of {', '.join(scenario.sensor_names)}")
    if not _is_number(time) or abs(time) > MAX_SECONDS:
        raise ValueError(f"time: {time!r} is not a number of seconds between -{MAX_SECONDS:g} and {MAX_SECONDS:g}")
    sensor = scenario.sensor(name)
    d = scenario.motion.dimensions
    position = sensor.stand(d) if entry.get("position") is None else _numbers(entry["position"], d, "position")
    plots = entry["plots"]
    if not isinstance(plots, list):
        raise ValueError(f"plots: {plots!r} is not a list of plots")
    m = len(sensor.sigma)
    z = [_numbers(plot, m, f"plots.{j}") for j, plot in enumerate(plots)]
    for j, plot in enumerate(z):
        _check_range(plot, sensor.numbers, f"plots.{j}")
    return Scan(name, scenario.to_ns(time), position, np.array(z).reshape(-1, m))


def _numbers(value: Any, size: int, where: str) -> Array:
    if not isinstance(value, list) or len(value) != size or not all(_is_number(number) for number in value):
        raise ValueError(f"{where}: {value!r} is not a list of {size} finite numbers")
    return np.array(value, dtype=np.float64)


def _check_range(plot: Array, numbers: tuple[str, ...], where: str) -> None:
    for value, name in zip(plot, numbers, strict=True):
        low, high, meaning = _RANGES.get(name, (-np.inf, np.inf, ""))
        if not low <= value <= high:
            raise ValueError(f"{where}: {name} {value:g} is no {meaning}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST
