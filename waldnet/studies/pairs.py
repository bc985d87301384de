"""Targets near each other, tracked from nothing: does each keep its track?

One seeded run of a scenario is played, distributed or centralised, and told apart by what became of its targets:
whether a track came to hold another target than before (swap), or a target was not held, or by another track than at
first (loss). Both are judged as ``waldnet evaluate`` does it (``studies.evaluate.holding``).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.sprt import CONFIRMED
from waldnet.common.messages import Decision, Tracks
from waldnet.evaluation.holding import NONE, Holding, hold
from waldnet.evaluation.paths import Paths, tracks_at
from waldnet.evaluation.runs import Run
from waldnet.offline.centralised import Centralised
from waldnet.offline.replay import Replay
from waldnet.scenarios.world import Truth, simulate_all, truth

#: With the feedback of the scenario, or without any; all plots to one tracker.
Way: TypeAlias = Literal["distributed", "without feedback", "centralised"]


class Outcome(NamedTuple):
    """What became of the targets of one run.

    Attributes:
        swapped: a track came to hold another target than it held before.
        lost: after the settling time a target was never held, is not at the end, or is by another track than at first.
        breaks: how often a target was held, then not, then again, after the settling time.
        false_tracks: confirmed tracks that at no time were close to any target.
        rmse_m: of positions while held.
    """

    swapped: bool
    lost: bool
    breaks: int
    false_tracks: int
    rmse_m: float

    @property
    def kept(self) -> bool:
        """Each target kept its track."""
        return not (self.swapped or self.lost)


def play(scenario: Scenario, way: Way, seed: int, cutoff_m: float, settled_s: float) -> Outcome:
    """Play one run.

    Args:
        scenario: a network whose targets are there all the time.
        way: nodes and center, or one tracker; the same plots.
        seed: of the world.
        cutoff_m: farther from a target, a track does not hold it.
        settled_s: scenario time until which tracks may start, and become one; judged is from then on.
    """
    scans = simulate_all(scenario, seed)
    if way == "without feedback":
        fusion = scenario.fusion.model_copy(update={"feedback": "none"})
        scenario = scenario.model_copy(update={"fusion": fusion})
    run = Centralised.of(scenario).run(scans) if way == "centralised" else Replay(scenario, scans).run()
    return judge(scenario, truth(scenario, seed), run, cutoff_m, settled_s)


def judge(
    scenario: Scenario, world: Truth, messages: Iterable[Tracks | Decision], cutoff_m: float, settled_s: float
) -> Outcome:
    """What became of the targets of a world in a run that said so."""
    times_s = np.array([scenario.to_seconds(int(time_ns)) for time_ns in world.times_ns])
    d = scenario.motion.dimensions
    run = run_of(scenario, [message for message in messages if isinstance(message, Tracks)])
    judged = times_s >= settled_s
    targets = Paths(np.arange(len(world.x)), world.x[:, judged, :d])
    holding = hold(targets, tracks_at(run, times_s[judged]), cutoff_m, 2.0)
    held = np.isfinite(holding.error_m)
    return Outcome(
        swapped=_swapped(holding),
        lost=_lost(holding),
        breaks=int((np.diff(held.astype(int), axis=1) == 1).sum() - (~held[:, 0] & held.any(axis=1)).sum()),
        false_tracks=int((~holding.near.any(axis=1)).sum()),
        rmse_m=float(np.sqrt((holding.error_m[held] ** 2).mean())) if held.any() else np.nan,
    )


def run_of(scenario: Scenario, pictures: Sequence[Tracks]) -> Run:
    """The confirmed tracks of what a center said."""
    d = scenario.motion.dimensions
    times_s = np.array([scenario.to_seconds(tracks.time_ns) for tracks in pictures])
    ids = np.unique(np.concatenate([np.empty(0, np.int64), *(_confirmed(tracks)[0] for tracks in pictures)]))
    positions = np.full((len(ids), len(times_s), d), np.nan)
    for k, tracks in enumerate(pictures):
        known, x = _confirmed(tracks)
        positions[np.searchsorted(ids, known), k] = x[:, :d]
    return Run(scenario.name, times_s, ids, positions, None)


def _confirmed(tracks: Tracks) -> tuple[np.ndarray, Array]:
    confirmed = tracks.status == CONFIRMED
    return tracks.ids[confirmed], tracks.x[confirmed]


def _swapped(holding: Holding) -> bool:
    return any(len(np.unique(target[target != NONE])) > 1 for target in holding.target)


def _lost(holding: Holding) -> bool:
    """Not held at the end, or not by the track that held it first."""
    held = holding.track != NONE
    if not held[:, -1].all():
        return True
    first = holding.track[np.arange(len(held)), held.argmax(axis=1)]
    return bool((holding.track[:, -1] != first).any())
