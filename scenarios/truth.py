"""Where targets truly were, as JSON Lines: one position of one target a line.

``{"target": 1, "time": 0.16, "position": [east, north]}``: the target's number, time in seconds since the scenario's
epoch, position in metres, with a third number in 3-D.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
from numpy.typing import ArrayLike

from waldnet.common.config import Scenario
from waldnet.common.errors import TruthError
from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import IntArray
from waldnet.common.quantities import NS_PER_S
from waldnet.scenarios.json_lines import identity, numbers, read_lines, seconds


class Whereabouts(NamedTuple):
    """Of one target.

    Attributes:
        times_s: ascending, since the scenario's epoch, shape (K,).
        positions: [m], shape (K, d).
    """

    times_s: Array
    positions: Array


def read_truth(path: Path, dimensions: Sequence[int] = (2, 3)) -> dict[int, Whereabouts]:
    """Read and validate a file of true positions, in any order.

    Args:
        path: the file; without a line there is no target.
        dimensions: that positions may have; all have the same.

    Returns:
        the whereabouts of every target, by its number.

    Raises:
        TruthError: naming file, line and reason.
    """
    first_line: dict[tuple[int, int], int] = {}
    sizes = list(dimensions)

    def parse(entry: dict[str, Any], number: int) -> tuple[int, float, list[float]]:
        target, time_s = identity(entry["target"], "target"), seconds(entry["time"])
        position = numbers(entry["position"], sizes, "position")
        sizes[:] = [len(position)]
        before = first_line.setdefault((target, round(time_s * NS_PER_S)), number)
        if before != number:
            raise ValueError(f"target {target} has a position at {time_s} s already, line {before}")
        return target, time_s, position

    lines = sorted(read_lines(path, "position", ("target", "time", "position"), parse, TruthError))
    return {target: _whereabouts(list(own)) for target, own in groupby(lines, key=lambda line: line[0])}


def truth_of(columns: Mapping[str, ArrayLike]) -> dict[int, Whereabouts]:
    """True positions from columns, one row for every position of a target, in any order.

    Args:
        columns: "target" (number), "time" [s], "position" [m], shapes (K,), (K,), (K, d).

    Returns:
        the whereabouts of every target, by its number.

    Raises:
        TruthError: naming the column, or the row, and the reason.
    """
    if missing := sorted({"target", "time", "position"} - set(columns)):
        raise TruthError(f"truth: column {missing[0]!r} is missing")
    target, time_s, position = (_column(columns, name) for name in ("target", "time", "position"))
    if not target.ndim == time_s.ndim == 1 or not len(target) == len(time_s) == len(position):
        shapes = f"{target.shape}, {time_s.shape} and {position.shape}"
        raise TruthError(f"truth: target, time and position have shapes {shapes}, expected (K,), (K,) and (K, d)")
    if not len(target):
        return {}
    if position.ndim != 2 or position.shape[1] not in (2, 3):
        raise TruthError(f"truth: position: has shape {position.shape}, expected (K, 2) or (K, 3)")
    for name, column in (("target", target), ("time", time_s), ("position", position)):
        if not (good := np.isfinite(column.reshape(len(column), -1)).all(axis=-1)).all():
            raise TruthError(f"truth: {name}: row {int(np.argmin(good))} is not finite")
    order = np.lexsort((time_s, target))
    target, time_s, position = target[order].astype(np.int64), time_s[order], position[order]
    again = (np.diff(target) == 0) & (np.diff(time_s) == 0.0)
    if again.any():
        k = int(np.argmax(again))
        raise TruthError(f"truth: target {target[k]} has two positions at {time_s[k]} s")
    numbers, first = np.unique(target, return_index=True)
    times, positions = np.split(time_s, first[1:]), np.split(position, first[1:])
    return dict(zip(numbers.tolist(), map(Whereabouts, times, positions), strict=True))


def _column(columns: Mapping[str, ArrayLike], name: str) -> Array:
    try:
        return np.array(columns[name], np.float64)
    except (TypeError, ValueError):
        raise TruthError(f"truth: {name}: is no array of numbers") from None


def _whereabouts(lines: list[tuple[int, float, list[float]]]) -> Whereabouts:
    _, times_s, positions = zip(*lines, strict=True)
    return Whereabouts(np.array(times_s, dtype=np.float64), np.array(positions, dtype=np.float64))


def write_truth(file: TextIO, times_ns: IntArray, x: Array, scenario: Scenario) -> None:
    """Write the positions of a simulated world's targets, numbered from 0.

    Args:
        file: to write to.
        times_ns: shape (K,).
        x: states, NaN where a target is not there, shape (targets, K, n).
        scenario: whose world it is.
    """
    positions = x[..., : scenario.motion.dimensions]
    for k, time_ns in enumerate(times_ns):
        for target in np.flatnonzero(np.isfinite(positions[:, k]).all(axis=-1)):
            line = {
                "target": int(target),
                "time": scenario.to_seconds(int(time_ns)),
                "position": positions[target, k].tolist(),
            }
            file.write(json.dumps(line) + "\n")
