"""Converts the Autoferry dataset to this project's JSON Lines.

``python -m waldnet.scenarios.autoferry.convert FOLDER_OF_THE_DATASET`` writes all scenarios anew, beside this module.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeGuard, TypeVar

SCENARIOS = (2, 3, 5, 13, 16)
SENSORS: Mapping[int, str] = {1: "lidar", 2: "radar", 3: "daylight", 4: "infrared"}
CAMERAS = ("daylight", "infrared")

Vector = tuple[float, float]
T = TypeVar("T")


class Scan(NamedTuple):
    """What one sensor saw at one time.

    Attributes:
        sensor: one of the values of ``SENSORS``.
        time_s: Unix time.
        position: of the ship, (east, north) in metres from the origin.
        plots: (east, north) in metres from the origin, of cameras (azimuth,) in radians from the ship, clockwise from
            north; none is a miss, not a gap.
    """

    sensor: str
    time_s: float
    position: Vector
    plots: tuple[tuple[float, ...], ...]


class Truth(NamedTuple):
    """Where satellite navigation saw a boat.

    Attributes:
        time_s: Unix time.
        target: number of the boat.
        position: (east, north) in metres from the origin.
    """

    time_s: float
    target: int
    position: Vector


class Recording(NamedTuple):
    """One scenario.

    Attributes:
        epoch_s: whole Unix second at or before the first detection of any sensor.
        scans: of all sensors, by time.
        truth: each boat and time once, by time.
    """

    epoch_s: int
    scans: tuple[Scan, ...]
    truth: tuple[Truth, ...]


def read(folder: Path, number: int) -> Recording:
    """Read one scenario of the dataset.

    Raises:
        ValueError: a file is missing or wrong; the message lists every fault found, with its place.
    """
    path = folder / f"scenario{number}_detections.json"
    truth_path = folder / f"scenario{number}_groundTruth.json"
    detections, references = load(path), load(truth_path)
    if len(references) != len(detections):
        raise ValueError(f"{truth_path}: {len(references)} entries, expected one per detection: {len(detections)}")
    if not detections:
        raise ValueError(f"{path}: no detections")
    scans = _parse_all(path, detections, parse_scan)
    truth = _parse_all(truth_path, references, parse_truth)
    return Recording(
        epoch_s=math.floor(min(scan.time_s for scan in scans)),
        scans=tuple(sorted(scans, key=lambda scan: scan.time_s)),
        truth=_unique(truth_path, (state for states in truth for state in states)),
    )


def load(path: Path) -> list[object]:
    """Read a file that holds one JSON list.

    Raises:
        ValueError: there is no such file, or it holds something else.
    """
    try:
        content: object = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}; expected a file of the Autoferry dataset") from error
    except ValueError as error:
        raise ValueError(f"{path}: no JSON: {error}") from error
    if not isinstance(content, list):
        raise ValueError(f"{path}: {type(content).__name__}, expected a list")
    return content


def parse_scan(record: object) -> Scan:
    """Read one entry of a file of detections.

    Raises:
        ValueError: what is wrong with it.
    """
    sensor_id = _field(record, "sensorID")
    if not _is_whole(sensor_id) or sensor_id not in SENSORS:
        raise ValueError(f"sensorID: {_short(sensor_id)}, expected one of {', '.join(map(str, SENSORS))}")
    sensor = SENSORS[sensor_id]
    time_s = _number("time", _field(record, "time"))
    ship = _field(record, "ownshipPosition")
    if not _are_numbers(ship, 2):
        raise ValueError(f"ownshipPosition: {_short(ship)}, expected [north, east]")
    north, east = ship
    measurement = _field(record, "measurement")
    if sensor in CAMERAS:
        return Scan(sensor, time_s, (east, north), parse_bearings(measurement))
    return Scan(sensor, time_s, (east, north), tuple((east + e, north + n) for e, n in parse_plots(measurement)))


def parse_plots(measurement: object) -> tuple[Vector, ...]:
    """Turn a measurement of radar or lidar into (east, north) of each plot from the ship.

    The dataset writes ``[[n1, n2, ...], [e1, e2, ...]]``, but ``[n, e]`` for one plot and ``[]`` for none.

    Raises:
        ValueError: it is none of these.
    """
    if measurement == []:
        return ()
    if _are_numbers(measurement, 2):
        north, east = measurement
        return ((east, north),)
    match measurement:
        case [list(norths), list(easts)] if _are_numbers(norths, len(easts)) and _are_numbers(easts, len(norths)):
            return tuple(zip(easts, norths, strict=True))
    raise ValueError(f"measurement: {_short(measurement)}, expected [[n1, n2, ...], [e1, e2, ...]], [n, e] or []")


def parse_bearings(measurement: object) -> tuple[tuple[float], ...]:
    """Turn a measurement of a camera into plots: azimuths in radians, clockwise from north, as the dataset has them.

    The dataset writes ``[b1, b2, ...]``, but ``b`` for one bearing and ``[]`` for none.

    Raises:
        ValueError: it is none of these, or an angle beyond a whole circle.
    """
    bearings = measurement if isinstance(measurement, list) else [measurement]
    if not _are_numbers(bearings, len(bearings)) or any(abs(bearing) > 2.0 * math.pi for bearing in bearings):
        raise ValueError(f"measurement: {_short(measurement)}, expected radians: [b1, b2, ...], b or []")
    return tuple((bearing,) for bearing in bearings)


def parse_truth(entry: object) -> list[Truth]:
    """Read one entry of a file of ground truth: the boats at the time of one detection.

    Raises:
        ValueError: what is wrong with it.
    """
    if not isinstance(entry, list):
        raise ValueError(f"{_short(entry)}, expected a list of boats")
    return [_parse_state(record) for record in entry]


def scan_line(scan: Scan, epoch_s: int) -> str:
    """Write a scan as a line of JSON: time to the microsecond, places to the millimetre, bearings to 1e-5 rad."""
    digits = 5 if scan.sensor in CAMERAS else 3
    return json.dumps(
        {
            "sensor": scan.sensor,
            "time": round(scan.time_s - epoch_s, 6),
            "position": _rounded(scan.position, 3),
            "plots": [_rounded(plot, digits) for plot in scan.plots],
        }
    )


def truth_line(truth: Truth, epoch_s: int) -> str:
    """Write a boat's place at one time as a line of JSON, to the microsecond and millimetre."""
    time_s = round(truth.time_s - epoch_s, 6)
    return json.dumps({"target": truth.target, "time": time_s, "position": _rounded(truth.position, 3)})


def write(recording: Recording, folder: Path, number: int) -> None:
    """Write ``scenarioN.jsonl`` and ``scenarioN-truth.jsonl``."""
    epoch_s = recording.epoch_s
    _write_lines(folder / f"scenario{number}.jsonl", (scan_line(scan, epoch_s) for scan in recording.scans))
    _write_lines(folder / f"scenario{number}-truth.jsonl", (truth_line(truth, epoch_s) for truth in recording.truth))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code is 1, and nothing is written, when the dataset is wrong."""
    parser = argparse.ArgumentParser(prog="python -m waldnet.scenarios.autoferry.convert", description=__doc__)
    parser.add_argument("dataset", type=Path, help="folder that holds scenarioN_detections.json")
    parser.add_argument("--scenario", type=int, action="append", help=f"number, repeatable; without it: {SCENARIOS}")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder to write to")
    options = parser.parse_args(arguments)
    try:
        recordings = {number: read(options.dataset, number) for number in options.scenario or SCENARIOS}
        for number, recording in recordings.items():
            write(recording, options.out, number)
    except (OSError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    for number, (epoch_s, scans, truth) in recordings.items():
        sys.stdout.write(f"scenario{number}: epoch {epoch_s}, {len(scans)} scans, {len(truth)} positions of boats\n")
    return 0


def _parse_all(path: Path, entries: Sequence[object], parse: Callable[[object], T]) -> list[T]:
    parsed: list[T] = []
    faults: list[str] = []
    for index, entry in enumerate(entries):
        try:
            parsed.append(parse(entry))
        except ValueError as error:
            faults.append(f"{path}: entry {index}: {error}")
    if faults:
        raise ValueError("\n".join(faults))
    return parsed


def _parse_state(record: object) -> Truth:
    target = _field(record, "targetID")
    if not _is_whole(target):
        raise ValueError(f"targetID: {_short(target)}, expected a whole number")
    position = _field(record, "position")
    if not _are_numbers(position, 3):
        raise ValueError(f"position: {_short(position)}, expected [north, east, down]")
    north, east, _ = position
    return Truth(_number("time", _field(record, "time")), target, (east, north))


def _unique(path: Path, states: Iterable[Truth]) -> tuple[Truth, ...]:
    known: dict[tuple[float, int], Truth] = {}
    for state in states:
        first = known.setdefault((state.time_s, state.target), state)
        if first != state:
            raise ValueError(
                f"{path}: target {state.target} at {state.time_s}: {state.position}, and {first.position} before it"
            )
    return tuple(sorted(known.values()))


def _field(record: object, name: str) -> object:
    if not isinstance(record, dict):
        raise ValueError(f"{_short(record)}, expected an object")
    if name not in record:
        raise ValueError(f"{name}: missing")
    return record[name]


def _number(name: str, value: object) -> float:
    if not _is_number(value):
        raise ValueError(f"{name}: {_short(value)}, expected a number")
    return value


def _is_whole(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _are_numbers(value: object, count: int) -> TypeGuard[list[float]]:
    return isinstance(value, list) and len(value) == count and all(map(_is_number, value))


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _rounded(numbers: Iterable[float], digits: int) -> list[float]:
    # adding 0.0 makes -0.0 a plain zero
    return [round(number, digits) + 0.0 for number in numbers]


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8", newline="\n")


if __name__ == "__main__":
    sys.exit(main())
