"""Joint association: near tracks share plots, and a plot is that of one of them at most (theory.md §9, Eq. 21).

Of a scan, every track that exists causes one plot or none, and every plot comes from one track or is false. Seen from
one track, the others change one thing only: plot j is free for it with the probability ``nu_j`` that, by themselves,
they leave it alone. So joint association is a factor per track and plot, which raises the density of false plots there
from rho_f to rho_f / nu_j; every filter of ``association``, ``mixture`` and ``notch`` then goes on as if its track were
alone.

Only plots in the gates of several tracks count. Tracks that these connect are a cluster, and clusters do not touch each
other: those of few tracks are solved exactly, the others by loopy belief propagation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from waldnet.common.estimation.gating import IntArray
from waldnet.common.estimation.gaussian import Array, BoolArray, log_sum_exp

#: Clusters of up to so many tracks are solved exactly; the work doubles with every track.
MOST_EXACT = 8
#: Messages are passed until no logarithm changes by more.
_TOLERANCE = 1e-6
_MOST_ROUNDS = 200
#: To miss a plot, or to be none at all, is never less probable than this share of a track's best plot, as a logarithm.
#: Far below all that can be told apart, it keeps every W of Eq. (21) above zero where p_d = 1.
_LOG_LEAST = -1000.0


class Claims(NamedTuple):
    """Which tracks may have caused which plots of a scan; existence is in the weights.

    Attributes:
        track, plot: numbers of the pairs, by track, shape (N,).
        log_hit: log of r w_j, shape (N,).
        log_none: log of 1 - r + r w_0, shape (T,).
    """

    track: IntArray
    plot: IntArray
    log_hit: Array
    log_none: Array


class Joint(NamedTuple):
    """What the tracks of a scan leave to each other, and to others.

    Attributes:
        log_nu: log of nu (Eq. 21) for every hypothesis with a plot, shape (T, C, M); 0 where it is impossible anyway.
        unclaimed: probability that a plot of the scan is that of none of the tracks, shape (plots,).
        false: that it is that of no track which is a target, shape (plots,).
    """

    log_nu: Array
    unclaimed: Array
    false: Array


def joint(
    log_w: Array,
    log_p_star: Array,
    number: IntArray | None,
    plots: int,
    existence: Array,
    target: Array | None = None,
) -> Joint:
    """Associate tracks that share the plots of a scan (Eq. 21).

    Args:
        log_w: log weights of the components of each track, sum one, shape (T, C).
        log_p_star: log p*_j of every component as if it were alone (Eq. 6), j = 0 the missed detection, in the filter
            that associates, shape (T, C, 1 + M).
        number: which plot of the scan each is, see ``Plots``, shape (T, C, M); None: they are in order.
        plots: how many the scan has.
        existence: probability of each track to exist, before the scan, shape (T,).
        target: probability of each track to be that of a target, if it exists, shape (T,); None: all are.

    Returns:
        what to add to log p*_j, j > 0, and what is left over.

    References:
        theory.md Eq. (21); Musicki & Evans, Joint integrated probabilistic data association (2004).
    """
    weights = log_w[..., None] + log_p_star
    hits = weights[..., 1:] > -np.inf
    at = track, component, rank = np.nonzero(hits)
    plot = np.broadcast_to(np.arange(plots) if number is None else number, hits.shape)[at]
    # Components of a track that have a plot in common make one claim.
    key, mine = np.unique(track * plots + plot, return_inverse=True)
    with np.errstate(divide="ignore"):  # a track that does not exist, or surely does
        log_r, log_not = np.log(existence), np.log1p(-existence)
    log_hit = np.full(len(key), -np.inf)
    np.logaddexp.at(log_hit, mine, weights[track, component, 1 + rank])
    track, plot = np.divmod(key, max(plots, 1))
    claims = Claims(track, plot, log_r[track] + log_hit, np.logaddexp(log_not, log_r + log_sum_exp(weights[..., 0])))
    log_nu = log_free(claims)
    shared = np.zeros(hits.shape)
    shared[at] = log_nu[mine]
    left = unclaimed(claims, log_nu, plots)
    return Joint(shared, left, left if target is None else unclaimed(claims, log_nu, plots, target))


def log_free(claims: Claims) -> Array:
    """Log of nu (Eq. 21): the probability that, by themselves, the other tracks leave a plot to this one.

    Exact in clusters of up to ``MOST_EXACT`` tracks. In greater ones by loopy belief propagation, exact where no two
    tracks share more than one plot and no ring of tracks closes; theory.md §9 says how far off it is elsewhere.

    Args:
        claims: of all tracks.

    Returns:
        log nu of each pair, shape (N,); exactly 0 for a plot that no other track claims.
    """
    track, plot, *_ = claims
    log_nu = np.zeros(len(track))
    sharing = np.bincount(plot)[plot] > 1
    if not sharing.any():
        return log_nu
    track, plot = (np.unique(part[sharing], return_inverse=True)[1] for part in (track, plot))
    log_nu[sharing] = _solved(track, plot, _log_odds(claims, sharing))
    return log_nu


def _solved(track: IntArray, plot: IntArray, log_odds: Array) -> Array:
    """Log nu of pairs that share: each cluster as its size asks for, those of a size together."""
    by_track, by_plot = _clusters(track, plot)
    cluster, row, column = by_track[track], _ranks(by_plot)[plot], _ranks(by_track)[track]
    tracks = np.bincount(by_track)[cluster]
    many, found = tracks > MOST_EXACT, np.empty(len(track))
    found[many] = _propagated(track[many], plot[many], log_odds[many])
    for size in np.unique(tracks[~many]):
        those = tracks == size
        _, table = np.unique(cluster[those], return_inverse=True)
        where = table, row[those], column[those]
        tables = np.full((table.max() + 1, row[those].max() + 1, size), -np.inf)
        tables[where] = log_odds[those]
        found[those] = _enumerated(tables)[where]
    return found


def unclaimed(claims: Claims, log_nu: Array, plots: int, target: Array | None = None) -> Array:
    """Probability of each plot of the scan to be that of none of the tracks, or targets (Eq. 21), shape (plots,)."""
    log_claim = claims.log_hit + log_nu
    log_total = claims.log_none.copy()
    np.logaddexp.at(log_total, claims.track, log_claim)
    claim = np.exp(log_claim - log_total[claims.track])
    claimed = np.bincount(claims.plot, claim if target is None else claim * target[claims.track], plots)
    left: Array = np.maximum(1.0 - claimed, 0.0)
    return left


def _log_odds(claims: Claims, sharing: BoolArray) -> Array:
    """Log odds of each shared plot against all that a track may do without a shared plot."""
    track, _, log_hit, log_none = claims
    log_rest, best = log_none.copy(), np.full(len(log_none), -np.inf)
    np.logaddexp.at(log_rest, track[~sharing], log_hit[~sharing])
    np.maximum.at(best, track, log_hit)
    log_rest = np.maximum(log_rest, best + _LOG_LEAST)
    odds: Array = log_hit[sharing] - log_rest[track[sharing]]
    return odds


def _clusters(track: IntArray, plot: IntArray) -> tuple[IntArray, IntArray]:
    """The cluster of each track and of each plot: those that pairs connect."""
    tracks = int(track.max()) + 1
    size = tracks + int(plot.max()) + 1
    graph = coo_array((np.ones(len(track)), (track, tracks + plot)), (size, size))
    label: IntArray = connected_components(graph, directed=False)[1].astype(np.intp)
    return label[:tracks], label[tracks:]


def _ranks(group: IntArray) -> IntArray:
    """Number of each member within its group."""
    order = np.argsort(group, kind="stable")
    counts = np.bincount(group)
    rank = np.empty(len(group), np.intp)
    rank[order] = np.arange(len(group)) - np.repeat(np.cumsum(counts) - counts, counts)
    return rank


def _enumerated(log_odds: Array) -> Array:
    """Log nu by all joint events: plot after plot, the sets of tracks that have one already.

    Args:
        log_odds: of clusters with as many tracks, -inf where a plot is not the track's, shape (G, plots, tracks).

    Returns:
        log of W(without the track, plot unused) / W(without the track), shape (G, plots, tracks).
    """
    clusters, plots, tracks = log_odds.shape
    # Weights of the plots before each one by the tracks that have them, of those from it on by the tracks that cannot.
    before, after = (np.full((plots + 1, clusters, 2**tracks), start) for start in (-np.inf, 0.0))
    before[0, :, 0] = 0.0
    for plot in range(plots):
        before[plot + 1] = before[plot]
        for track in range(tracks):
            (free, _), (_, taken) = _halves(before[plot], track), _halves(before[plot + 1], track)
            np.logaddexp(taken, free + log_odds[:, plot, track, None, None], out=taken)
    for plot in reversed(range(plots)):
        after[plot] = after[plot + 1]
        for track in range(tracks):
            (_, taken), (free, _) = _halves(after[plot + 1], track), _halves(after[plot], track)
            np.logaddexp(free, taken + log_odds[:, plot, track, None, None], out=free)
    log_nu = np.empty(log_odds.shape)
    for track in range(tracks):
        left = _halves(before[:-1], track)[0] + _halves(after[1:], track)[1]
        log_nu[..., track] = log_sum_exp(left.reshape(plots, clusters, -1)).T - after[0, :, 1 << track, None]
    return log_nu


def _halves(by_set: Array, track: int) -> tuple[Array, Array]:
    """The sets without a track, and the same with it: views, shape (..., 2**tracks) to (..., i, j)."""
    split = by_set.reshape(*by_set.shape[:-1], -1, 2, 2**track)
    return split[..., 0, :], split[..., 1, :]


def _propagated(track: IntArray, plot: IntArray, log_odds: Array) -> Array:
    """Log nu by loopy belief propagation: tracks tell plots how much they want them, plots tell how free they are.

    Args:
        track: number of the track of each pair, shape (N,).
        plot: number of its plot, shape (N,).
        log_odds: shape (N,).

    Returns:
        log nu of each pair, shape (N,).

    References:
        Williams & Lau, Approximate evaluation of marginal association probabilities with belief propagation (2014).
    """
    log_nu = np.zeros(len(track))
    by_track, by_plot = (track, _ranks(track)), (plot, _ranks(plot))
    for _ in range(_MOST_ROUNDS):
        wanted = log_odds - _log_one_and_others(log_odds + log_nu, by_track)
        last, log_nu = log_nu, -_log_one_and_others(wanted, by_plot)
        if np.abs(log_nu - last).max(initial=0.0) < _TOLERANCE:
            break
    return log_nu


def _log_one_and_others(values: Array, at: tuple[IntArray, IntArray]) -> Array:
    """Log of one plus all the others of the same row; as sums from both sides, since a difference would lose digits.

    Args:
        values: logarithms, shape (N,).
        at: row and column of each, shape (N,).
    """
    row, column = at
    table = np.full((int(row.max(initial=-1)) + 1, int(column.max(initial=-1)) + 3), -np.inf)
    table[:, 0] = 0.0
    table[row, column + 1] = values
    left, right = np.logaddexp.accumulate(table, axis=1), np.logaddexp.accumulate(table[:, ::-1], axis=1)[:, ::-1]
    others: Array = np.logaddexp(left[row, column], right[row, column + 2])
    return others
