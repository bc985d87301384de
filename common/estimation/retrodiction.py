"""Retrodiction: what the past was, seen from now. Single Gaussians and mixtures (theory.md §9).

A step goes from the smoothed density at the next time back to a filtered one, by Rauch-Tung-Striebel::

    G = P F' (F P F' + Q)^-1        x~ = x + G (x~+ - F x)        P~ = (I - G F) P (I - G F)' + G (P~+ + Q) G'    (15a)

Textbooks write ``P + G (P~+ - F P F' - Q) G'``, which is the same number and loses its positive sign to rounding.

A mixture is retrodicted history by history, which is exact, or component by component: a father weighs what his sons
weigh together, and where all of them have died so has he.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.gating import IntArray
from waldnet.common.estimation.gaussian import (
    Array,
    Gaussian,
    gram,
    log_sum_exp,
    settled_whitener,
    symmetric,
    times_transposed,
)
from waldnet.common.estimation.mixture import Ancestry, Mixture
from waldnet.common.estimation.motion import Motion


class Generation(NamedTuple):
    """The components of mixtures after one scan, and how they came from those of the scan before.

    Attributes:
        log_w: logarithms of the filter's weights, shape (T, C); -inf is no component.
        density: filtered densities, shapes (T, C, n), (T, C, n, n).
        ancestry: parents in the generation before; of the first generation it is not used.
        F, Q: transition and process noise since the generation before, shape (n, n), or (T, n, n) where tracks differ;
            of the first generation they are not used.
    """

    log_w: Array
    density: Gaussian
    ancestry: Ancestry
    F: Array
    Q: Array


class Histories(NamedTuple):
    """Retrodicted mixtures in flat arrays: a row for every history that lives in the last generation.

    Attributes:
        track: shape (H,).
        component: number of the component that the history went through, shape (H,).
        log_w: logarithms of the weights, those of a track with sum one, shape (H,).
        density: smoothed densities, shapes (H, n), (H, n, n).
    """

    track: IntArray
    component: IntArray
    log_w: Array
    density: Gaussian


class Retrodicted(NamedTuple):
    """Retrodicted mixtures, one Gaussian for every component.

    Attributes:
        log_w: logarithms of the weights, those of a track with sum one, shape (T, C); -inf: all descendants have died.
        density: smoothed densities, shapes (T, C, n), (T, C, n, n); where all descendants have died, the filtered ones.
    """

    log_w: Array
    density: Gaussian


def generation(mixture: Mixture, ancestry: Ancestry, F: Array, Q: Array) -> Generation:
    """What retrodiction needs of a mixture after a scan: its honest filter.

    Args:
        mixture: after ``mixture.step_traced``.
        ancestry: from there.
        F: transition with which it was predicted, shape (n, n) or (T, n, n).
        Q: process noise, same shape.

    Returns:
        one entry of what ``histories`` and ``descendants`` take.
    """
    x, P = mixture.density
    return Generation(mixture.log_w, Gaussian(x[-1], P[-1]), ancestry, F, Q)


def backward(filtered: Gaussian, F: Array, Q: Array, later: Gaussian) -> Gaussian:
    """One step back (Eq. 15a).

    Args:
        filtered: densities given the data up to their time, shapes (..., n), (..., n, n).
        F: transition to the later time, shape (..., n, n).
        Q: process noise until then, shape (..., n, n).
        later: densities at the later time given all data, same shapes as ``filtered``.

    Returns:
        densities at the earlier time given all data.

    Raises:
        numpy.linalg.LinAlgError: when a predicted covariance is not positive definite.

    References:
        theory.md Eq. (15a); Rauch, Tung & Striebel, Maximum likelihood estimates of linear dynamic systems (1965).
    """
    x, P = filtered
    FP = F @ P
    _, W, _ = settled_whitener(symmetric(FP @ F.mT) + Q)
    G = np.ascontiguousarray((gram(W) @ FP).mT)
    # I - G F leaves of the filtered deviation what the later state does not tell.
    rest = np.eye(x.shape[-1]) - G @ F
    covariance = times_transposed(rest @ P, rest) + times_transposed(G @ (later.P + Q), G)
    return Gaussian(x + np.matvec(G, later.x - np.matvec(F, x)), symmetric(covariance))


def smooth(filtered: Gaussian, motion: Motion, intervals: Array) -> Gaussian:
    """Fixed-interval smoothing of single Gaussians (Eq. 15a).

    Args:
        filtered: densities after each time's data, times on the first axis, shapes (K, ..., n), (K, ..., n, n).
        motion: motion model.
        intervals: from each time to the next [s], shape (K-1,) or (K-1, ...).

    Returns:
        densities given the data of all times, same shapes.

    Raises:
        ValueError: unless there is one interval fewer than there are times.

    References:
        theory.md Eq. (15a); W. Koch, Fixed-interval retrodiction approach to Bayesian IMM-MHT, IEEE TAES 36(1), 2000.
    """
    x, P = filtered
    if len(intervals) != len(x) - 1:
        raise ValueError(f"{len(intervals)} intervals, {len(x)} times: one interval fewer than times is needed")
    F, Q = motion.transition(intervals), motion.noise(intervals)
    result = Gaussian(x.copy(), P.copy())
    for k in range(len(x) - 2, -1, -1):
        later = Gaussian(result.x[k + 1], result.P[k + 1])
        result.x[k], result.P[k] = backward(Gaussian(x[k], P[k]), F[k], Q[k], later)
    return result


def histories(generations: Sequence[Generation]) -> list[Histories]:
    """Retrodict mixtures history by history, with their exact weights.

    Every history that lives in the last generation is smoothed on its own and keeps its weight. Where components were
    combined, a history branches backwards into all of theirs, with their shares; the numbers are exact as long as
    nothing was combined or dropped, and grow with what was combined. For a fixed lag give
    the last few generations only.

    Args:
        generations: mixtures after scan upon scan, the last one newest.

    Returns:
        retrodicted mixtures, one for each generation.

    References:
        theory.md §9; W. Koch, Fixed-interval retrodiction approach to Bayesian IMM-MHT, IEEE TAES 36(1), 2000.
    """
    last = generations[-1]
    track, component = np.nonzero(last.log_w > -np.inf)
    density = Gaussian(last.density.x[track, component], last.density.P[track, component])
    result = [Histories(track, component, last.log_w[track, component], density)]
    for k in range(len(generations) - 1, 0, -1):
        result.append(_before(result[-1], generations[k], generations[k - 1]))
    return result[::-1]


def _before(later: Histories, now: Generation, before: Generation) -> Histories:
    """Histories one generation earlier; one that went through a combined component goes on in each of its parts."""
    ancestry, size = now.ancestry, now.log_w.shape[1]
    slots = ancestry.track * size + ancestry.component
    mine = later.track * size + later.component
    first = np.searchsorted(slots, mine)
    counts = np.searchsorted(slots, mine, side="right") - first
    son = np.repeat(np.arange(len(mine)), counts)
    row = np.repeat(first - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    track, parent = ancestry.track[row], ancestry.parent[row]
    filtered = Gaussian(before.density.x[track, parent], before.density.P[track, parent])
    density = backward(filtered, *_moved(now, track), Gaussian(later.density.x[son], later.density.P[son]))
    return Histories(track, parent, later.log_w[son] + ancestry.log_share[row], density)


def descendants(generations: Sequence[Generation]) -> list[Retrodicted]:
    """Retrodict mixtures component by component: a father weighs the sum of his sons.

    Strong sons strengthen weak fathers; where all sons have died, so has the father. A father's density is that of all
    his descendants, by moments: a step back is linear, so mean and covariance of every component are those of its
    histories, and only their shape is lost. The work is that of the filter, however long the past; for a fixed lag give
    the last few generations only.

    Args:
        generations: mixtures after scan upon scan, the last one newest.

    Returns:
        retrodicted mixtures, one for each generation.

    References:
        theory.md §9; W. Koch, Fixed-interval retrodiction approach to Bayesian IMM-MHT, IEEE TAES 36(1), 2000.
    """
    last = generations[-1]
    result = [Retrodicted(last.log_w, last.density)]
    for k in range(len(generations) - 1, 0, -1):
        result.append(_fathers(result[-1], generations[k], generations[k - 1]))
    return result[::-1]


def _fathers(later: Retrodicted, now: Generation, before: Generation) -> Retrodicted:
    """Weights and moments of the components of one generation earlier."""
    track, component, parent, _, log_share = now.ancestry
    log_w = later.log_w[track, component] + log_share
    order = np.lexsort((parent, track))
    order = order[log_w[order] > -np.inf]
    track, component, parent, log_w = track[order], component[order], parent[order], log_w[order]
    filtered = Gaussian(before.density.x[track, parent], before.density.P[track, parent])
    sons = Gaussian(later.density.x[track, component], later.density.P[track, component])
    x, P = backward(filtered, *_moved(now, track), sons)
    first = np.flatnonzero(np.diff(track * before.log_w.shape[1] + parent, prepend=-1))
    total = np.logaddexp.reduceat(log_w, first)
    lengths = np.diff(first, append=len(track))
    a = np.exp(log_w - np.repeat(total, lengths))
    # Relative to the filtered mean, so that large coordinates cost no digits.
    d = x - filtered.x
    mean = np.add.reduceat(a[:, None] * d, first)
    spread = np.add.reduceat(a[:, None, None] * (P + d[:, :, None] * d[:, None, :]), first)
    where = track[first], parent[first]
    result = Retrodicted(
        np.full_like(before.log_w, -np.inf), Gaussian(before.density.x.copy(), before.density.P.copy())
    )
    result.log_w[where] = total
    result.density.x[where] += mean
    result.density.P[where] = symmetric(spread - mean[:, :, None] * mean[:, None, :])
    result.log_w[:] -= log_sum_exp(result.log_w)[:, None]
    return result


def _moved(now: Generation, track: IntArray) -> tuple[Array, Array]:
    """F and Q of each row's track, shapes (N, n, n)."""
    shape = (len(now.log_w), *now.F.shape[-2:])
    return np.broadcast_to(now.F, shape)[track], np.broadcast_to(now.Q, shape)[track]
