"""Recorded trajectories of targets, which simulated sensors look at: a file as `scenarios.truth` has them.

A target is there from its first to its last line; in between it moves straight and evenly from each position to the
next.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.errors import TruthError
from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import IntArray
from waldnet.common.quantities import NS_PER_S
from waldnet.scenarios.truth import read_truth


class Trajectory(NamedTuple):
    """Where a target was.

    Attributes:
        times_ns: ascending, shape (K,), K > 1.
        positions: shape (K, d) [m].
    """

    times_ns: IntArray
    positions: Array

    def states(self, times_ns: IntArray, n: int) -> Array:
        """Position, velocity, and 0 for the rest of a state, shapes (M,) to (M, n); NaN when it is not there."""
        d = self.positions.shape[-1]
        leg = np.clip(np.searchsorted(self.times_ns, times_ns, side="right") - 1, 0, len(self.times_ns) - 2)
        legs_s = np.diff(self.times_ns) / NS_PER_S
        velocity = (np.diff(self.positions, axis=0) / legs_s[:, None])[leg]
        since_s = (times_ns - self.times_ns[leg]) / NS_PER_S
        x = np.zeros((len(times_ns), n))
        x[:, :d] = self.positions[leg] + velocity * since_s[:, None]
        x[:, d : 2 * d] = velocity
        x[(times_ns < self.times_ns[0]) | (times_ns > self.times_ns[-1])] = np.nan
        return x


def read_trajectories(scenario: Scenario) -> list[Trajectory]:
    """Recorded targets of a scenario's simulation, in the order of their numbers; none without a file.

    Raises:
        TruthError: naming file and reason, and the line that is wrong.
    """
    if scenario.simulation is None or scenario.simulation.truth is None:
        return []
    return list(trajectories_of(scenario.simulation.truth, scenario).values())


def trajectories_of(path: Path, scenario: Scenario) -> dict[int, Trajectory]:
    """Trajectories of a file of true positions, by the numbers of the targets.

    Raises:
        TruthError: naming file and reason, and the line that is wrong.
    """
    targets = read_truth(path, (scenario.motion.dimensions,))
    if not targets:
        raise TruthError(f"{path}: has no position, expected one a line")
    found = {}
    for target, (times_s, positions) in targets.items():
        if len(times_s) < 2:
            raise TruthError(f"{path}: target {target} has one position, expected two or more")
        times_ns = np.array([scenario.to_ns(time_s) for time_s in times_s.tolist()])
        found[target] = Trajectory(times_ns, positions)
    return found
