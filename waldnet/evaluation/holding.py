"""Which track holds which target when: breaks, swaps, duplicates and false tracks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import Array, BoolArray
from waldnet.common.messages import IntArray
from waldnet.evaluation.ospa import match
from waldnet.evaluation.paths import Paths, distances

#: Of a target that no track holds, and of a track that holds none.
NONE = -1


class Holding(NamedTuple):
    """Targets and the tracks that hold them over time.

    Attributes:
        track: row of the track that holds each target, or NONE, shape (targets, K).
        target: row of the target that each track holds, or NONE, shape (tracks, K).
        error_m: distance of the target from its track; NaN where none holds it, shape (targets, K).
        near: whether any target is closer to a track than the cutoff, shape (tracks, K).
    """

    track: IntArray
    target: IntArray
    error_m: Array
    near: BoolArray


class TargetFate(NamedTuple):
    """What became of one target.

    Attributes:
        target: its number.
        first_s: first judged time at which it is there.
        last_s: last judged time at which it is there.
        confirmed_after_s: from the first time until a confirmed track held it; None if none ever did.
        confirmed_after_scans: so many measurement times of the run in this stretch, both ends included.
        held_share: share of the judged times of its presence at which a track held it.
        breaks: how often it was held, then not, then again.
        swaps: how often a track came to hold it that had held another target last.
        ids: of the tracks that ever held it.
        rmse_m: of its tracks' positions while they held it; None if none ever did.
    """

    target: int
    first_s: float
    last_s: float
    confirmed_after_s: float | None
    confirmed_after_scans: int | None
    held_share: float
    breaks: int
    swaps: int
    ids: tuple[int, ...]
    rmse_m: float | None


def hold(targets: Paths, tracks: Paths, cutoff_m: float, p: float) -> Holding:
    """Follow who holds whom: yesterday's track as long as it is closer than the cutoff, the rest optimally.

    Args:
        targets: that truly were there.
        tracks: that were reported.
        cutoff_m: farther from a target, a track does not hold it.
        p: order of the distance of which the rest has the smallest sum.

    References:
        Bernardin & Stiefelhagen, Evaluating multiple object tracking performance: the CLEAR MOT metrics (2008),
        Sec. 2.1.
    """
    track, target = (np.full(paths.there.shape, NONE) for paths in (targets, tracks))
    error_m, near = np.full(track.shape, np.nan), np.zeros(target.shape, bool)
    for k in range(targets.positions.shape[1]):
        distance = distances(targets, tracks, k)
        near[:, k] = (distance < cutoff_m).any(axis=0)
        kept = _still_held(track[:, k - 1], distance, cutoff_m) if k else np.empty((2, 0), np.int64)
        rest = distance.copy()
        rest[kept[0]] = rest[:, kept[1]] = np.inf
        rows, columns = np.concatenate([kept, match(rest, cutoff_m, p)], axis=1)
        track[rows, k], target[columns, k] = columns, rows
        error_m[rows, k] = distance[rows, columns]
    return Holding(track, target, error_m, near)


def _still_held(track: IntArray, distance: Array, cutoff_m: float) -> IntArray:
    rows = np.flatnonzero(track != NONE)
    near = rows[distance[rows, track[rows]] < cutoff_m]
    return np.stack([near, track[near]])


def fates(holding: Holding, targets: Paths, tracks: Paths, times_s: Array, run_s: Array) -> list[TargetFate]:
    """What became of every target.

    Args:
        holding: of the targets and tracks.
        targets: each there at some time.
        tracks: that were reported.
        times_s: at which was judged, shape (K,).
        run_s: measurement times of the run.
    """
    swaps = _swaps(holding)
    found = []
    for row, (number, there) in enumerate(zip(targets.ids, targets.there, strict=True)):
        track, present_s = holding.track[row, there], times_s[there]
        held = track != NONE
        after_s = scans = rmse_m = None
        if held.any():
            confirmed_s = present_s[held.argmax()]
            after_s = float(confirmed_s - present_s[0])
            scans = int(((run_s >= present_s[0]) & (run_s <= confirmed_s)).sum())
            rmse_m = float(np.sqrt(np.nanmean(holding.error_m[row] ** 2)))
        fate = TargetFate(
            target=int(number),
            first_s=float(present_s[0]),
            last_s=float(present_s[-1]),
            confirmed_after_s=after_s,
            confirmed_after_scans=scans,
            held_share=float(held.mean()),
            breaks=max(int((np.diff(held.astype(int), prepend=0) == 1).sum()) - 1, 0),
            swaps=int(swaps[row]),
            ids=tuple(tracks.ids[np.unique(track[held])].tolist()),
            rmse_m=rmse_m,
        )
        found.append(fate)
    return found


def _swaps(holding: Holding) -> IntArray:
    """How often each target was taken over by a track that had held another, shape (targets,)."""
    swaps = np.zeros(len(holding.track), np.int64)
    for target in holding.target:
        held = target[target != NONE]
        np.add.at(swaps, held[1:][np.diff(held) != 0], 1)
    return swaps


class Idle(NamedTuple):
    """Confirmed tracks that hold no target.

    Attributes:
        duplicate: whether a track is near a target that another holds, shape (tracks, K).
        false: whether a track is near no target, shape (tracks, K).
        duplicates: ids of tracks that never held a target, and were near one at some time.
        false_tracks: ids of tracks that were never near a target.
    """

    duplicate: BoolArray
    false: BoolArray
    duplicates: IntArray
    false_tracks: IntArray


def idle(holding: Holding, tracks: Paths) -> Idle:
    """Tell apart the tracks that hold no target."""
    held = holding.target != NONE
    near = holding.near.any(axis=1)
    return Idle(
        duplicate=holding.near & ~held,
        false=tracks.there & ~holding.near,
        duplicates=tracks.ids[near & ~held.any(axis=1)],
        false_tracks=tracks.ids[~near],
    )
