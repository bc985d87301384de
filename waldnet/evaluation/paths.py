"""Targets and tracks at the same times: what all measures are worked out of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from waldnet.common.errors import EvaluationError
from waldnet.common.estimation.gaussian import Array, BoolArray
from waldnet.common.messages import IntArray
from waldnet.evaluation.runs import Run
from waldnet.scenarios.truth import Whereabouts


class Paths(NamedTuple):
    """Targets, or tracks, at the times of an evaluation.

    Attributes:
        ids: ascending, shape (N,).
        positions: [m], shape (N, K, d); NaN where it is not there.
    """

    ids: IntArray
    positions: Array

    @property
    def there(self) -> BoolArray:
        """Whether it is there, shape (N, K)."""
        return np.isfinite(self.positions[..., 0])

    def seen(self) -> Paths:
        """Only those that are there at any time."""
        some = self.there.any(axis=-1)
        return Paths(self.ids[some], self.positions[some])


def distances(targets: Paths, tracks: Paths, k: int) -> Array:
    """Between all targets and all tracks at time k [m]: infinite where one is not there, shape (targets, tracks)."""
    apart = np.linalg.vector_norm(targets.positions[:, None, k] - tracks.positions[None, :, k], axis=-1)
    return np.where(np.isnan(apart), np.inf, apart)


def judged_times(truth: Mapping[int, Whereabouts], runs: Sequence[Run]) -> Array:
    """Times at which runs are judged: all their measurement times from the first to the last point of the truth.

    Where no run has a track yet, or ever, the times of the truth stand for them; without any target, all times of the
    runs are judged.

    Args:
        truth: of every target.
        runs: to compare; a run of which another goes on is judged to the end of that.

    Returns:
        ascending, since the scenario's epoch [s], shape (K,).

    Raises:
        EvaluationError: truth and runs have no time in common, or say no time at all.
    """
    known = np.unique(np.concatenate([np.empty(0), *(target.times_s for target in truth.values())]))
    said = np.unique(np.concatenate([run.times_s for run in runs]))
    spans = [run.span_s for run in runs if run.span_s is not None]
    begin = min((first for first, _ in spans), default=-np.inf)
    end = max((last for _, last in spans), default=np.inf)
    until = min(said[0], end) if len(said) else end
    times = np.union1d(known[(known >= begin) & (known <= until)], said)
    if len(known):
        times = times[(times >= known[0]) & (times <= known[-1])]
    if not len(times):
        raise EvaluationError(
            f"nothing to judge: the truth tells of {_range(known)}, the runs of {_range(said)}; "
            "both must be in seconds since the same epoch"
        )
    return times


def _range(times_s: Array) -> str:
    return f"{times_s[0]:g} s to {times_s[-1]:g} s" if len(times_s) else "no time at all"


def targets_at(truth: Mapping[int, Whereabouts], times_s: Array, gap_s: float, d: int) -> Paths:
    """Targets, linearly between the points of their truth where those are no farther apart than ``gap_s``."""
    paths = [sampled(target.times_s, target.positions, times_s, gap_s) for target in truth.values()]
    ids = np.array(list(truth), dtype=np.int64)
    return Paths(ids, np.array(paths).reshape(len(ids), len(times_s), d)).seen()


def tracks_at(run: Run, times_s: Array) -> Paths:
    """Confirmed tracks; at measurement times that are another run's only, linearly between their own."""
    if not len(run.ids):
        return Paths(run.ids, np.empty((0, len(times_s), run.positions.shape[-1])))
    over_time = np.moveaxis(run.positions, 1, 0)
    return Paths(run.ids, np.moveaxis(sampled(run.times_s, over_time, times_s, np.inf), 0, 1)).seen()


def sampled(times_s: Array, values: Array, at_s: Array, gap_s: float) -> Array:
    """Linear interpolation that knows nothing outside, in long gaps, and beside a NaN.

    Args:
        times_s: ascending, shape (K,), K > 0.
        values: shape (K, ...).
        at_s: shape (M,).
        gap_s: points farther apart are not joined.

    Returns:
        shape (M, ...); the values themselves at ``times_s``.
    """
    before = np.clip(np.searchsorted(times_s, at_s, side="right") - 1, 0, None)
    after = np.minimum(before + 1, len(times_s) - 1)
    apart = times_s[after] - times_s[before]
    share = (at_s - times_s[before]) / np.where(apart > 0.0, apart, 1.0)
    unknown = (at_s < times_s[0]) | (at_s > times_s[-1]) | ((share > 0.0) & (apart > gap_s))
    share, unknown = (each.reshape(-1, *(1,) * (values.ndim - 1)) for each in (share, unknown))
    between = np.where(share > 0.0, (1.0 - share) * values[before] + share * values[after], values[before])
    return np.where(unknown, np.nan, between)
