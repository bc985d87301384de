"""How often a track is lost, and what its log LR comes to: many seeded runs of one scenario (theory.md §12)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from common.config import DecisionConfig, Scenario
from common.estimation.gaussian import Array, BoolArray
from common.messages import Tracks
from scenarios.world import simulate_all, truth
from studies.replay import Replay

#: Farther from the truth after the last scan, a track is lost [m].
LOST_M = 1000.0


class Outcome(NamedTuple):
    """Outcome of seeded runs, for the track of hypothesis 0 and the target drawn from it.

    Attributes:
        log_lr: sum of all log Lambda, shape (runs,).
        lost: shape (runs,).
    """

    log_lr: Array
    lost: BoolArray


def outcome(scenario: Scenario, seeds: range) -> Outcome:
    """Run a scenario with every seed, only computing: nothing is reset or deleted.

    Args:
        scenario: its target 0 belongs to its hypothesis 0.
        seeds: of the simulated worlds; the same seeds give the same plots to every variant of a scenario.
    """
    hypothesis = scenario.hypotheses[:1]
    scenario = scenario.model_copy(update={"decision": DecisionConfig(enabled=False), "hypotheses": hypothesis})
    results = [_run(scenario, seed) for seed in seeds]
    log_lr, errors = np.array(results).T
    return Outcome(log_lr, errors > LOST_M)


def variant(scenario: Scenario, association: str) -> Scenario:
    """The scenario with another association."""
    return scenario.model_copy(update={"fusion": scenario.fusion.model_copy(update={"association": association})})


def _run(scenario: Scenario, seed: int) -> tuple[float, float]:
    last = [m for m in Replay(scenario, simulate_all(scenario, seed)).run() if isinstance(m, Tracks)][-1]
    d = scenario.motion.dimensions
    error = np.linalg.vector_norm(last.x[0, :d] - truth(scenario, seed).x[0, -1, :d])
    return float(last.log_lr_total[0]), float(error)
