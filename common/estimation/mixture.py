"""Gaussian mixtures over association histories: branch, prune, combine (theory.md §9), mirrored in the factor (§5).

A track is a mixture of components, one per history or group of histories. As in ``association``, several filters of the
same track stand on a leading axis F and share their histories: the last one, the honest one, says which branches live
and which are combined; the first one is the factor, whose evidence is carried along (Eq. 17). With a single filter
both are the same, and the mixture is the multi-hypothesis tracker of Eq. (15).

Tracks have different numbers of branches, so that these stand in flat arrays, those of a track together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.association import Expected, Plots, in_view, innovations, within_reach
from waldnet.common.estimation.batch import take
from waldnet.common.estimation.gating import IntArray
from waldnet.common.estimation.gaussian import (
    Array,
    BoolArray,
    Gaussian,
    log_sum_exp,
    quadratic,
    squared_norm,
    symmetric,
)


class Mixture(NamedTuple):
    """Gaussian mixtures, one per track, its components in several filters.

    Attributes:
        log_w: logarithms of the honest weights, sum one, shape (T, C); -inf is no component.
        log_g: log evidence of the components in the factor, shape (T, C).
        density: means and covariances, shapes (F, T, C, n), (F, T, C, n, n).
    """

    log_w: Array
    log_g: Array
    density: Gaussian


class Reduction(NamedTuple):
    """How far a mixture may grow.

    Attributes:
        components: most components that are left.
        prune: branches lighter than this share of the heaviest are dropped.
        combine: branches closer than this to a heavier one (squared Mahalanobis distance) are combined with it.
        rest: what is left when there are as many components as may be goes into the lightest one; else it is dropped.
    """

    components: int = 15
    prune: float = 1e-4
    combine: float = 0.5
    rest: bool = True


#: Nothing is dropped and nothing combined.
EXACT = Reduction(components=2**31, prune=0.0, combine=0.0)


class Ancestry(NamedTuple):
    """Where the components of mixtures come from: a row for every branch that lives on, those of a component together.

    Attributes:
        track, component: numbers of the new component, shape (N,), ascending.
        parent: number of the component that it comes from, shape (N,).
        plot: number of its plot in the scan, -1: missed, shape (N,).
        log_share: logarithms of its share a in the component (Eq. 17), 0 where nothing was combined, shape (N,).
    """

    track: IntArray
    component: IntArray
    parent: IntArray
    plot: IntArray
    log_share: Array


class _Branches(NamedTuple):
    """Histories, in flat arrays: those of a track together, the heaviest first.

    Attributes:
        track: shape (N,), ascending.
        log_w, log_g: as in ``Mixture``, shape (N,); log_w is not normalised.
        x, P: shapes (N, F, n), (N, F, n, n).
    """

    track: IntArray
    log_w: Array
    log_g: Array
    x: Array
    P: Array


def single(density: Gaussian, log_g: Array) -> Mixture:
    """Mixtures of one component each.

    Args:
        density: shapes (F, T, n), (F, T, n, n); F = 1 for a tracker of one sensor.
        log_g: log evidence so far, shape (T,).

    Returns:
        T mixtures with C = 1.
    """
    return Mixture(np.zeros((len(log_g), 1)), log_g[:, None], Gaussian(density.x[:, :, None], density.P[:, :, None]))


def step(prior: Mixture, expected: Expected, plots: Plots, reduction: Reduction) -> Mixture:
    """Branch every component with every plot in its gate and with a missed detection, then reduce (Eq. 15, 17).

    Args:
        prior: predicted to the time of the scan.
        expected: its components as the sensor will see them, batch axes (F, T, C).
        plots: of the scan, z of shape (M, m), or of every track, shape (T, 1, M, m).
        reduction: what may be left.

    Returns:
        the mixtures after the scan.

    References:
        theory.md Eq. (15), (17); W. Koch, Tracking and sensor data fusion (2014), §3.3.
    """
    near = within_reach(expected, plots)
    hit = _hit(prior, expected, near, _hits(prior, expected, near))
    return _chosen(prior, _missed(prior, expected), hit, reduction)


def step_traced(prior: Mixture, expected: Expected, plots: Plots, reduction: Reduction) -> tuple[Mixture, Ancestry]:
    """``step``, and where the components come from, for retrodiction.

    Args:
        prior: predicted to the time of the scan.
        expected: its components as the sensor will see them, batch axes (F, T, C).
        plots: of the scan, z of shape (M, m), or of every track, shape (T, 1, M, m).
        reduction: what may be left.

    Returns:
        the mixtures after the scan, and the parents of their components.
    """
    tracks, plots = len(prior.log_w), in_view(expected, plots)
    hits = _hits(prior, expected, plots)
    branches = _joined(prior, _missed(prior, expected), _hit(prior, expected, plots, hits))
    rows = _survivors(branches, reduction.prune, tracks)
    branches = take(branches, rows)
    label, leader = _groups(branches, tracks, reduction)
    _, missed = np.nonzero(prior.log_w > -np.inf)
    parent = np.concatenate((missed, hits[1]))[rows]
    plot = np.concatenate((np.full(len(missed), -1), hits[2]))[rows]
    order = np.lexsort((label, branches.track))
    order = order[label[order] >= 0]
    slot = branches.track[order] * (label.max(initial=0) + 1) + label[order]
    first = np.flatnonzero(np.diff(slot, prepend=-1))
    log_w = branches.log_w[order]
    total = np.logaddexp.reduceat(log_w, first)
    log_share = log_w - np.repeat(total, np.diff(first, append=len(slot)))
    ancestry = Ancestry(branches.track[order], label[order], parent[order], plot[order], log_share)
    return _merged(branches, label, leader, tracks), ancestry


def step_with(prior: Mixture, log_p_star: Array, density: Gaussian, reduction: Reduction) -> Mixture:
    """``step`` where every hypothesis about the scan has a density of its own.

    Args:
        prior: predicted to the time of the scan.
        log_p_star: log p*_j of every component, j = 0 the missed detection, shape (F, T, C, 1 + M).
        density: of every component under each hypothesis, shapes (F, T, C, 1 + M, n), (F, T, C, 1 + M, n, n).
        reduction: what may be left.

    Returns:
        the mixtures after the scan.
    """
    alive = (prior.log_w > -np.inf)[..., None] & np.ones(log_p_star.shape[-1], np.bool_)
    hit = alive & (log_p_star[-1] > -np.inf)
    hit[..., 0] = False
    alive[..., 1:] = False

    def branches(which: BoolArray) -> _Branches:
        at = track, component, hypothesis = np.nonzero(which)
        x, P = (np.moveaxis(array[:, track, component, hypothesis], 1, 0) for array in density)
        log_w, log_g = (
            log[track, component] + weight[at] for log, weight in zip(prior[:2], log_p_star[[-1, 0]], strict=True)
        )
        return _Branches(track, log_w, log_g, x, P)

    return _chosen(prior, branches(alive), branches(hit), reduction)


def _chosen(prior: Mixture, missed: _Branches, hit: _Branches, reduction: Reduction) -> Mixture:
    """The mixture of all branches, reduced."""
    branches = _joined(prior, missed, hit)
    return _combined(_pruned(branches, reduction.prune, len(prior.log_w)), len(prior.log_w), reduction)


def _joined(prior: Mixture, missed: _Branches, hit: _Branches) -> _Branches:
    """All branches; there is a missed one for every component that lives."""
    branches = _Branches(*(np.concatenate(pair) for pair in zip(missed, hit, strict=True)))
    # Where h1 holds the scan for impossible (p_d = 1 and no plot in the gate), nothing can be learnt from it.
    best = np.full(len(prior.log_w), -np.inf)
    np.maximum.at(best, branches.track, branches.log_w)
    if (lost := best == -np.inf).any():
        rows = lost[branches.track[: len(missed.track)]]
        branches.log_w[: len(rows)][rows] = prior.log_w[prior.log_w > -np.inf][rows]
    return branches


def reduced(mixture: Mixture, reduction: Reduction) -> Mixture:
    """Mixtures with fewer components."""
    alive = np.nonzero(mixture.log_w > -np.inf)
    x, P = (np.moveaxis(array[:, alive[0], alive[1]], 1, 0) for array in mixture.density)
    branches = _Branches(alive[0], mixture.log_w[alive], mixture.log_g[alive], x, P)
    return _combined(_pruned(branches, reduction.prune, len(mixture.log_w)), len(mixture.log_w), reduction)


def terms(mixture: Mixture, count: int) -> Mixture:
    """The K terms of a report (theory.md §5): the K-1 heaviest components, and all others merged into one."""
    return reduced(mixture, Reduction(components=count, prune=0.0, combine=-1.0))


def _missed(prior: Mixture, expected: Expected) -> _Branches:
    """The branches of a missed detection, one for every component that lives."""
    alive = np.nonzero(prior.log_w > -np.inf)
    log_miss = np.broadcast_to(expected.log_miss, prior.log_w.shape)[alive]
    x, P = (np.moveaxis(array[:, alive[0], alive[1]], 1, 0) for array in expected.density)
    return _Branches(alive[0], prior.log_w[alive] + log_miss, prior.log_g[alive] + log_miss, x, P)


def _hits(prior: Mixture, expected: Expected, near: Plots) -> tuple[IntArray, ...]:
    """Numbers of track, component and plot, for every component that lives and every plot in its gate."""
    nu = innovations(near.z, expected.z[-1, :, :, None], expected.angular)
    distance = squared_norm(np.matvec(expected.whitener[-1, :, :, None], nu))
    inside = (distance <= expected.gate) & (prior.log_w > -np.inf)[..., None]
    if near.valid is not None:
        inside &= near.valid
    return np.nonzero(inside)


def _hit(prior: Mixture, expected: Expected, near: Plots, hits: tuple[IntArray, ...]) -> _Branches:
    """The branches with a plot."""
    track, component, _ = hits
    pairs = (*prior.log_w.shape, near.z.shape[-2])
    # All filters of all branches, the branches first: shapes (N, F, ...).
    z = np.broadcast_to(near.z, (*pairs, near.z.shape[-1]))[hits]
    white, peak, mean, W, P, x = (
        np.ascontiguousarray(np.moveaxis(array[:, track, component], 1, 0))
        for array in (expected.whitener, expected.log_peak, expected.z, expected.W, expected.P_hit, expected.density.x)
    )
    w = np.matvec(white, innovations(z[:, None], mean, expected.angular))
    log_p = peak - 0.5 * squared_norm(w) + np.broadcast_to(expected.log_hit, prior.log_w.shape)[track, component, None]
    if near.log_relative is not None:
        log_p -= np.broadcast_to(near.log_relative, pairs)[hits][:, None]
    if near.log_in_view is not None:
        log_p += np.broadcast_to(near.log_in_view, pairs)[hits][:, None]
    log_w, log_g = prior.log_w[track, component] + log_p[:, -1], prior.log_g[track, component] + log_p[:, 0]
    return _Branches(track, log_w, log_g, x + np.matvec(W, w), P)


def _pruned(branches: _Branches, share: float, tracks: int) -> _Branches:
    """The survivors."""
    return take(branches, _survivors(branches, share, tracks))


def _survivors(branches: _Branches, share: float, tracks: int) -> IntArray:
    """The branches that are not lighter than a share of their track's heaviest, those of a track by weight."""
    order = np.lexsort((-branches.log_w, branches.track))
    track, log_w = branches.track[order], branches.log_w[order]
    first = np.searchsorted(track, np.arange(tracks))
    limit = np.log(share) if share > 0.0 else -np.inf
    kept = (log_w >= log_w[first[track]] + limit) & (log_w > -np.inf)
    rows: IntArray = order[kept]
    return rows


def _combined(branches: _Branches, tracks: int, reduction: Reduction) -> Mixture:
    """Mixtures of the branches, combined."""
    return _merged(branches, *_groups(branches, tracks, reduction), tracks)


def _groups(branches: _Branches, tracks: int, reduction: Reduction) -> tuple[IntArray, IntArray]:
    """Local combining: branches around the heaviest become one component, then around the next heaviest, ... ."""
    track = branches.track
    label = np.full(len(track), -1)
    left = np.arange(len(track))
    leader = np.zeros(len(track), np.intp)
    x, P = branches.x[:, -1], branches.P[:, -1]
    for count in range(reduction.components):
        first = np.flatnonzero(np.diff(track[left], prepend=-1))
        mine = np.repeat(left[first], np.diff(first, append=len(left)))
        near = left == mine
        others = np.flatnonzero(~near)
        if reduction.combine > 0.0:
            one, other = mine[others], left[others]
            near[others] = quadratic(x[one] - x[other], P[one] + P[other])[0] < reduction.combine
        label[left[near]], leader[left[near]] = count, mine[near]
        left = left[~near]
        if not len(left):
            break
    else:
        # As many components as there may be.
        if reduction.rest:
            label[left] = reduction.components - 1
            last = np.zeros(tracks, np.intp)
            ends = np.flatnonzero(label == reduction.components - 1)
            last[track[ends][::-1]] = leader[ends][::-1]
            leader[left] = last[track[left]]
    return label, leader


def _merged(branches: _Branches, label: IntArray, leader: IntArray, tracks: int) -> Mixture:
    """Moments of the branches with the same label (>= 0) in the same track, and their evidence (Eq. 17).

    Args:
        branches: of all tracks.
        label: of each branch, -1: dropped, shape (N,).
        leader: the branch to which means are relative, so that large coordinates cost no digits, shape (N,).
        tracks: how many there are.
    """
    size = int(label.max(initial=0)) + 1
    slot = branches.track * size + label
    order = np.argsort(slot, kind="stable")
    order = order[label[order] >= 0]
    slot, group = slot[order], take(branches, order)
    first = np.flatnonzero(np.diff(slot, prepend=-1))
    lengths = np.diff(first, append=len(slot))

    def total(values: Array) -> Array:
        result: Array = np.add.reduceat(values, first, axis=0)
        return result

    top = np.maximum.reduceat(group.log_w, first)
    log_w = top + np.log(total(np.exp(group.log_w - np.repeat(top, lengths))))
    log_a = group.log_w - np.repeat(log_w, lengths)
    a = np.exp(log_a)
    reference = branches.x[leader[order]]
    d = group.x - reference
    mean = total(a[:, None, None] * d)
    spread = total(a[:, None, None, None] * (group.P + d[..., :, None] * d[..., None, :]))
    P = symmetric(spread - mean[..., :, None] * mean[..., None, :])
    where = np.divmod(slot[first], size)
    n, filters = d.shape[-1], d.shape[1]
    mixture = Mixture(
        np.full((tracks, size), -np.inf),
        np.full((tracks, size), -np.inf),
        Gaussian(np.empty((filters, tracks, size, n)), np.empty((filters, tracks, size, n, n))),
    )
    # A share may underflow, and 0 times -inf is no zero.
    evidence = np.where(a > 0.0, group.log_g, 0.0)
    mixture.log_w[where], mixture.log_g[where] = log_w, total(a * (evidence - log_a))
    # Where there is no component any density does; that of the heaviest is one that a sensor can see.
    heaviest = np.flatnonzero(where[1] == 0)
    for array, values in zip(mixture.density, (reference[first] + mean, P), strict=True):
        array[:] = np.moveaxis(values[heaviest], 1, 0)[:, :, None]
        array[:, *where] = np.moveaxis(values, 1, 0)
    mixture.log_w[:] -= log_sum_exp(mixture.log_w)[:, None]
    return mixture
