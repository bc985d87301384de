"""Where targets truly were, as JSON Lines: one position of one target a line.

``{"target": 1, "time": 0.16, "position": [east, north]}``: the target's number, time in seconds since the scenario's
epoch, position in metres, with a third number in 3-D.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

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
