"""GOSPA and OSPA(2) of tracks and targets over time, with their parts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import IntArray
from waldnet.evaluation.paths import Paths, distances


class Gospa(NamedTuple):
    """Over time, in metres; ``total^p`` is the sum of the parts, each to the p.

    Attributes:
        total, localisation, missed, false: shape (K,).
    """

    total: Array
    localisation: Array
    missed: Array
    false: Array


class Ospa2(NamedTuple):
    """Over time, in metres; ``total^p`` is the sum of the parts, each to the p.

    Attributes:
        total, localisation, cardinality: shape (K,).
    """

    total: Array
    localisation: Array
    cardinality: Array


def match(distance: Array, c: float, p: float) -> tuple[IntArray, IntArray]:
    """Pairs closer than c, such that the sum of ``distance^p``, and ``c^p`` for each pair less, is smallest.

    Args:
        distance: not negative, shape (a, b).
        c: cutoff.
        p: order.

    Returns:
        rows and columns of the pairs.
    """
    near = distance < c
    # The others find no partner anyway.
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    at = np.ix_(rows, columns)
    i, j = linear_sum_assignment(np.minimum(distance[at], c) ** p)
    paired = near[at][i, j]
    return rows[i[paired]], columns[j[paired]]


def gospa_over_time(targets: Paths, tracks: Paths, c: float, p: float) -> Gospa:
    """GOSPA with alpha = 2 at every time: a missed target and a false track cost ``c^p / 2`` each.

    Args:
        targets: that truly were there.
        tracks: that were reported.
        c: cutoff [m].
        p: order.

    References:
        Rahmathullah, García-Fernández & Svensson, Generalized optimal sub-pattern assignment metric (2017), Prop. 1.
    """
    times = targets.positions.shape[1]
    localisation, pairs = np.zeros(times), np.zeros(times)
    for k in range(times):
        distance = distances(targets, tracks, k)
        matched = match(distance, c, p)
        localisation[k], pairs[k] = (distance[matched] ** p).sum(), len(matched[0])
    missed = c**p / 2.0 * (targets.there.sum(axis=0) - pairs)
    false = c**p / 2.0 * (tracks.there.sum(axis=0) - pairs)
    return Gospa(*(part ** (1.0 / p) for part in (localisation + missed + false, localisation, missed, false)))


def ospa2_over_time(targets: Paths, tracks: Paths, times_s: Array, window_s: float, c: float, p: float) -> Ospa2:
    """OSPA(2) in a window that ends at every time, open at its begin.

    The distance of a track from a target is the mean, over the times in the window at which either is there, of their
    distance, cut off at c; c where only one is there. OSPA is taken of the tracks and targets of the window with it.

    Args:
        targets: that truly were there.
        tracks: that were reported.
        times_s: ascending, shape (K,).
        window_s: length of the window.
        c: cutoff [m].
        p: order.

    References:
        Beard, Vo & Vo, A solution for large-scale multi-object tracking (2020), Sec. V.
    """
    there = targets.there, tracks.there
    begins = np.searchsorted(times_s, times_s - window_s, side="right")

    def at_time(k: int) -> Array:
        """Whether either is there, and how far apart they are, shape (2, targets, tracks)."""
        either = there[0][:, None, k] | there[1][None, :, k]
        return np.stack([either, np.where(either, np.minimum(distances(targets, tracks, k), c), 0.0)])

    in_window = np.zeros((2, len(targets.ids), len(tracks.ids)))
    parts = np.zeros((2, len(times_s)))
    for k, (before, begin) in enumerate(zip(np.append(0, begins), begins, strict=False)):
        in_window += at_time(k)
        for gone in range(before, begin):
            in_window -= at_time(gone)
        rows, columns = (np.flatnonzero(each[:, begin : k + 1].any(axis=1)) for each in there)
        either, apart = in_window[:, rows[:, None], columns]
        # Sums that were taken back may be a little below zero.
        parts[:, k] = _ospa_parts(np.maximum(apart / either, 0.0), c, p)
    localisation, cardinality = parts
    return Ospa2(*(part ** (1.0 / p) for part in (localisation + cardinality, localisation, cardinality)))


def _ospa_parts(distance: Array, c: float, p: float) -> tuple[float, float]:
    """Localisation and cardinality, to the p, of OSPA between two sets with these distances."""
    fewer, more = sorted(distance.shape)
    if not more:
        return 0.0, 0.0
    matched = match(distance, c, p)
    localisation = (distance[matched] ** p).sum() + c**p * (fewer - len(matched[0]))
    return float(localisation / more), float(c**p * (more - fewer) / more)
