"""Plots and tracks: gate, PDAF update with its weight sum, tight association.

A scan has two halves. What its plots do not change, most of the matrices, is worked out by ``expect`` as soon as the
time of the scan is known; ``update`` is what is left to do when the plots are there.

Everything is done in whitened coordinates: with ``S_k = L L'``, ``w_j = L^-1 nu_j`` and ``W = P H' L^-T`` the gain
times an innovation is ``K nu = W w`` and ``K S_k K' = W W'``, so that Eq. (7) is the covariance after a plot that is
surely the target's, plus ``W (p_0 I + spread of the w_j) W'``: sums of positive semidefinite terms only.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv

from waldnet.common.estimation.field_of_view import View
from waldnet.common.estimation.gating import IntArray, Near, inside_boxes
from waldnet.common.estimation.gaussian import (
    LOG_2PI,
    Array,
    BoolArray,
    Gaussian,
    as_array,
    identity,
    joseph,
    settled_whitener,
    squared_norm,
    symmetric,
    times_transposed,
)
from waldnet.common.estimation.sensing import Linearised

#: Up to so many pairs of track and plot it is cheaper to look at all of them.
_FEW_PAIRS = 4000
#: Of what can be compared: the greatest of impossible weights is not -inf.
_LOWEST = float(np.finfo(np.float64).min)


class _PlotsFields(NamedTuple):
    z: Array
    valid: BoolArray | None
    log_relative: Array | None
    number: IntArray | None
    log_in_view: Array | None


class Plots(_PlotsFields):
    """The plots of one scan, ragged scans of a batch padded; lists of numbers are welcome.

    Attributes:
        z: shape (..., M, m).
        valid: shape (..., M); false marks padding. None: there is none.
        log_relative: log of the density of false plots where a plot lies, relative to ``Clutter.log_rho_f``, shape
            (..., M). None: it is the same everywhere.
        number: which plot of its scan each is, where each track has those near it, shape (..., M). None: in order, all.
        log_in_view: log of the probability that a track is in the field of view if a plot is its own (Eq. 6a), shape
            (..., M). None: it surely is, or ``in_view`` has not worked it out yet.
    """

    __slots__ = ()

    def __new__(
        cls,
        z: ArrayLike,
        valid: BoolArray | None = None,
        log_relative: Array | None = None,
        number: IntArray | None = None,
        log_in_view: Array | None = None,
    ) -> Self:
        """Take lists for arrays."""
        return tuple.__new__(cls, (as_array(z), valid, log_relative, number, log_in_view))


class _ClutterFields(NamedTuple):
    p_d: Array
    log_rho_f: Array
    p_g: float
    view: View | None


class Clutter(_ClutterFields):
    """How a sensor detects, and what it takes for a target; plain numbers are welcome.

    Attributes:
        p_d: detection probability in the field of view, shape (...).
        log_rho_f: logarithm of the density of false plots [1/volume of z], shape (...).
        p_g: probability that the target's plot is inside the gate; 1 is no gate.
        view: where a target can be detected; None: everywhere.
    """

    __slots__ = ()

    def __new__(cls, p_d: ArrayLike, log_rho_f: ArrayLike, p_g: float, view: View | None = None) -> Self:
        """Take lists for arrays."""
        return tuple.__new__(cls, (as_array(p_d), as_array(log_rho_f), p_g, view))


class Expected(NamedTuple):
    """Predicted tracks as a sensor will see them.

    The filters of a track stand on the first axis: one, or its factor and its association filter. The last one says
    which plot is whose.

    Attributes:
        density: the predicted Gaussians, shapes (F, ..., n), (F, ..., n, n).
        z: expected plots, shape (F, ..., m).
        sigma: standard deviations of the plots around them, shape (F, ..., m).
        whitener: L^-1 of ``S_k = L L'``, shape (F, ..., m, m).
        W: whitened gains, shape (F, ..., n, m).
        P_hit: covariances after a plot that is surely the target's, shape (F, ..., n, n).
        log_peak: log N(z; z, S_k), shape (F, ...).
        log_miss: log p*_0 (Eq. 6, 6a), shape (...).
        log_hit: log (p_d / rho_f), shape (...); -inf for tracks that are surely out of view.
        gate: squared Mahalanobis distance up to which a plot counts.
        angular: which numbers of a plot are angles.
        view: where a target can be detected; None: everywhere.
        edge: tracks that may be in view or not, so that each plot must tell, shape (...); None: there is none.
    """

    density: Gaussian
    z: Array
    sigma: Array
    whitener: Array
    W: Array
    P_hit: Array
    log_peak: Array
    log_miss: Array
    log_hit: Array
    gate: float
    angular: tuple[int, ...]
    view: View | None = None
    edge: BoolArray | None = None


#: Weights p_j, shape (..., 1 + M), and log p_bar, shape (...), from log p*_j, shape (..., 1 + M).
Choice: TypeAlias = Callable[[Array], tuple[Array, Array]]


class Filtered(NamedTuple):
    """Tracks after a scan.

    Attributes:
        density: the posterior Gaussians.
        log_p_bar: logarithm of the weight sum, shape (...).
    """

    density: Gaussian
    log_p_bar: Array


def expect(predicted: Gaussian, sensor: Linearised, clutter: Clutter) -> Expected:
    """Work out all of a scan that its plots do not change.

    Args:
        predicted: one or two filters of every track, shapes (F, ..., n), (F, ..., n, n).
        sensor: the measurement function linearised at ``predicted.x``.
        clutter: detection probability, false plots, gate, field of view: one for all filters of a track, because
            whether the sensor sees the target is for the honest density to say, not for a factor that is n_sensors
            times too wide.

    Returns:
        what ``update`` needs.
    """
    PH = times_transposed(predicted.P, sensor.H)
    S = symmetric(times_transposed(PH.mT, sensor.H)) + sensor.R
    _, white, half_log_det = settled_whitener(S)
    m = white.shape[-1]
    W = times_transposed(PH, white)
    p_miss, p_hit, edge = _in_view(Gaussian(predicted.x[-1], predicted.P[-1]), clutter)
    return Expected(
        density=predicted,
        z=sensor.z,
        sigma=np.sqrt(S.diagonal(axis1=-2, axis2=-1)),
        whitener=white,
        W=W,
        P_hit=joseph(predicted.P, W @ white, sensor.H, sensor.R),
        log_peak=-half_log_det - 0.5 * LOG_2PI * m,
        log_miss=_log(1.0 - p_miss * clutter.p_g),
        log_hit=_log(p_hit) - clutter.log_rho_f,
        gate=gate_threshold(clutter.p_g, m),
        angular=sensor.angular,
        view=clutter.view,
        edge=edge,
    )


def _in_view(honest: Gaussian, clutter: Clutter) -> tuple[Array, Array, BoolArray | None]:
    """Detection probabilities of tracks that may be out of view.

    Args:
        honest: predicted, shapes (..., n), (..., n, n).
        clutter: detection probability and field of view.

    Returns:
        the mean detection probability, which a miss tells of, and the one in the field of view, which a plot tells of
        (0 where no plot can be the target's), shapes (...); which tracks may be in view or not, shape (...), None:
        none.
    """
    if clutter.view is None:
        return clutter.p_d, clutter.p_d, None
    inside = clutter.view.probability_inside(honest)
    if (inside == 1.0).all():
        return clutter.p_d, clutter.p_d, None
    edge = (inside > 0.0) & (inside < 1.0)
    mean = clutter.p_d * inside
    return mean, np.where(edge, clutter.p_d, mean), edge if edge.any() else None


def normalise(log_p_star: Array) -> tuple[Array, Array]:
    """Weights p_j and log p_bar (Eq. 6): every hypothesis counts as it is probable, which makes a PDAF.

    Args:
        log_p_star: logarithms of p*_j, j = 0 the missed detection, shape (..., 1 + M).

    Returns:
        p_j, shape (..., 1 + M), and log p_bar, shape (...). A scan that h1 holds for impossible (p_d = 1 and no plot in
        the gate) gives log p_bar = -inf and, as nothing can be learnt from it, p_0 = 1.
    """
    top = log_p_star.max(axis=-1, keepdims=True, initial=_LOWEST)
    p = np.exp(log_p_star - top)
    p_bar = p.sum(axis=-1, keepdims=True)
    impossible = p_bar == 0.0
    p_bar += impossible
    p /= p_bar
    p[..., :1] += impossible
    return p, np.where(impossible, -np.inf, top + np.log(p_bar))[..., 0]


def update(expected: Expected, plots: Plots, choose: Choice = normalise) -> Filtered:
    """Filter one scan (Eq. 6, 7; with two filters Eq. 12, 13).

    Args:
        expected: tracks, predicted to the time of the scan.
        plots: of the scan; no plots is evidence too.
        choose: how much each hypothesis counts: PDAF, nearest neighbour, or Kalman with a gate.

    Returns:
        posteriors of all filters, shapes (F, ..., n), (F, ..., n, n), and log p_bar of the first, shape (...).
    """
    return Filtered(*weigh_and_absorb(expected, plots, choose)[:2])


def weigh_and_absorb(expected: Expected, plots: Plots, choose: Choice) -> tuple[Gaussian, Array, Array]:
    """``update``, and as third the logarithm of the weight sum of the filter that associates, shape (...)."""
    plots = within_reach(expected, plots)
    w, log_pdf, inside = compared(expected, plots)
    q, log_q_bar = choose(log_weights(expected, log_pdf[-1], inside, plots))
    # Eq. (13): with log q_j = log (weight j) - log q_bar, only the densities of the plots do not cancel.
    log_p_bar = log_q_bar + np.vecdot(q[..., 1:], log_pdf[0] - log_pdf[-1])
    return absorb(expected, w, q), log_p_bar, log_q_bar


def compared(expected: Expected, plots: Plots) -> tuple[Array, Array, BoolArray]:
    """How plots lie to what was expected.

    Returns:
        whitened innovations w, shape (F, ..., M, m), 0 for padding; log N(z_j; H x, S_k), shape (F, ..., M); and which
        plots are in the gate of the filter that associates, shape (..., M).
    """
    nu = innovations(plots.z, expected.z[..., None, :], expected.angular)
    if plots.valid is not None:
        # Padding may hold anything, and 0 times NaN is no zero.
        nu = np.where(plots.valid[..., None], nu, 0.0)
    w = times_transposed(nu, expected.whitener)
    distance = squared_norm(w)
    inside = distance[-1] <= expected.gate
    if plots.valid is not None:
        inside &= plots.valid
    return w, expected.log_peak[..., None] - 0.5 * distance, inside


def weights_alone(expected: Expected, plots: Plots) -> Array:
    """Log p*_j (Eq. 6) in the filter that associates, tracks taken one by one, shape (..., 1 + M)."""
    honest = expected._replace(z=expected.z[-1:], whitener=expected.whitener[-1:], log_peak=expected.log_peak[-1:])
    _, log_pdf, inside = compared(honest, plots)
    return log_weights(expected, log_pdf[0], inside, plots)


def innovations(z: Array, expected: Array, angular: tuple[int, ...]) -> Array:
    """``z - H x``, shapes (..., m), the differences of angles taken around the circle."""
    nu: Array = z - expected
    for i in angular:
        nu[..., i] = np.remainder(nu[..., i] + np.pi, 2.0 * np.pi) - np.pi
    return nu


def within_reach(expected: Expected, plots: Plots) -> Plots:
    """The plots inside the box around each track's gate, where that is less work than to look at all of them.

    With all plots the result would be the same, in a time that grows with the product of tracks and plots. Of tracks
    at the edge of the field of view, it is worked out how probably they are inside if a plot is theirs (Eq. 6a).

    Args:
        expected: the tracks, batch axes (F, ...).
        plots: one scan, z of shape (M, m), or scans whose batch axes broadcast against those of the tracks.

    Returns:
        plots with the batch axes of the tracks, or of the scans; as they are where they were chosen already.
    """
    return in_view(expected, _near(expected, plots))


def in_view(expected: Expected, plots: Plots) -> Plots:
    """Plots with the probability of each track at the edge of the field of view to be inside, if a plot is its own.

    The density of such a track after plot j is ``N(x; x_j, P_j)``, cut off at the edge, so the plot weighs (Eq. 6a)

        (p_d/rho_f) N(z_j; H x, S_k) P(inside | x_j, P_j)

    Args:
        expected: the tracks, batch axes (F, ...).
        plots: of the scan.

    Returns:
        plots; as they are where no track is at the edge, or where that was worked out already.
    """
    if expected.edge is None or plots.log_in_view is not None:
        return plots
    return plots._replace(log_in_view=_log_in_view(expected, expected.edge, plots))


def _log_in_view(expected: Expected, edge: BoolArray, plots: Plots) -> Array:
    """Logarithms for the pairs of track and plot that are in the gate; 0 elsewhere, shape (..., M)."""
    assert expected.view is not None
    many, m = plots.z.shape[-2:]
    batch = np.broadcast_shapes(edge.shape, plots.z.shape[:-2])
    rows = np.broadcast_to(edge, batch)

    def chosen(array: Array, *size: int) -> Array:
        picked: Array = np.broadcast_to(array, (*batch, *size))[rows]
        return picked

    n = expected.density.x.shape[-1]
    nu = innovations(chosen(plots.z, many, m), chosen(expected.z[-1], m)[:, None], expected.angular)
    valid = np.broadcast_to(np.True_ if plots.valid is None else plots.valid, (*batch, many))[rows]
    w = times_transposed(np.where(valid[..., None], nu, 0.0), chosen(expected.whitener[-1], m, m))
    row, plot = np.nonzero((squared_norm(w) <= expected.gate) & valid)
    x, W, P = (
        chosen(array[-1], *size)[row]
        for array, size in ((expected.density.x, (n,)), (expected.W, (n, m)), (expected.P_hit, (n, n)))
    )
    inside = expected.view.probability_inside(Gaussian(x + np.matvec(W, w[row, plot]), P))
    chances, log_in_view = np.zeros((int(rows.sum()), many)), np.zeros((*batch, many))
    chances[row, plot] = _log(inside)
    log_in_view[rows] = chances
    return log_in_view


def _near(expected: Expected, plots: Plots) -> Plots:
    """``within_reach``, as far as it is for boxes to say."""
    if plots.number is not None:
        return plots
    pairs = plots.z.shape[-2] * expected.z[0, ..., 0].size
    if pairs <= _FEW_PAIRS or expected.gate == np.inf or len(expected.angular) == plots.z.shape[-1]:
        return plots
    # A little more, so that rounding loses none.
    reach = np.sqrt(expected.gate) * expected.sigma[-1] * (1.0 + 1e-9)
    center = expected.z[-1]
    if plots.z.ndim > 2 and not expected.angular:
        return _inside_common_boxes(plots, center, reach)
    if plots.z.ndim > 2 or plots.valid is not None:
        return plots
    *batch, m = center.shape
    near = inside_boxes(plots.z, center.reshape(-1, m), reach.reshape(-1, m), expected.angular)
    which = near.which.reshape(*batch, -1)
    return Plots(
        plots.z[which],
        near.valid.reshape(which.shape),
        None if plots.log_relative is None else plots.log_relative[which],
        which,
    )


def _inside_common_boxes(plots: Plots, center: Array, reach: Array) -> Plots:
    """Of scans that several tracks or components share, the plots inside the box around all their gates."""
    which, inside = inside_common_boxes(plots, center, reach)
    relative = plots.log_relative
    return Plots(
        np.take_along_axis(plots.z, which[..., None], axis=-2),
        inside,
        None if relative is None else np.take_along_axis(relative, which, axis=-1),
        which,
    )


def inside_common_boxes(plots: Plots, center: Array, reach: Array) -> Near:
    """Of scans that several tracks or components share, which plots are inside the box around all their gates.

    Args:
        plots: z of shape (..., M, m), with size one where tracks share a scan.
        center: expected plots, shape (..., m).
        reach: half of each side of the boxes, shape (..., m); negative is no box.

    Returns:
        numbers of the plots, padded, with the batch axes of the scans.
    """
    none = (reach < 0.0).any(axis=-1, keepdims=True)
    low, high = np.where(none, np.inf, center - reach), np.where(none, -np.inf, center + reach)
    shared = tuple(axis for axis, size in enumerate(plots.z.shape[:-2]) if size == 1)
    low, high = low.min(axis=shared, keepdims=True)[..., None, :], high.max(axis=shared, keepdims=True)[..., None, :]
    inside = ((low <= plots.z) & (plots.z <= high)).all(axis=-1)
    if plots.valid is not None:
        inside &= plots.valid
    most = int(inside.sum(axis=-1).max(initial=0))
    which = np.argsort(~inside, axis=-1, kind="stable")[..., :most]
    return Near(which, np.take_along_axis(inside, which, axis=-1))


@cache
def gate_threshold(p_g: float, m: int) -> float:
    """Squared Mahalanobis distance that an m-dimensional plot of the target stays below with probability ``p_g``."""
    return float(2.0 * gammaincinv(m / 2.0, p_g))


def log_weights(expected: Expected, log_pdf: Array, inside: BoolArray, plots: Plots) -> Array:
    """Logarithms of the unnormalised weights p*_j (Eq. 6, 6a), j = 0 the missed detection.

    Args:
        expected: the tracks.
        log_pdf: log N(z_j; H x, S_k) of the filter that associates, shape (..., M).
        inside: plots that count, shape (..., M).
        plots: how dense false ones are there, and whether a track that has one is in view, see ``Plots``.

    Returns:
        log p*_j, shape (..., 1 + M); -inf for impossible hypotheses.
    """
    weights = np.empty((*log_pdf.shape[:-1], 1 + log_pdf.shape[-1]))
    weights[..., 0] = expected.log_miss
    log_hit = expected.log_hit[..., None]
    if plots.log_relative is not None:
        log_hit = log_hit - plots.log_relative
    if plots.log_in_view is not None:
        log_hit = log_hit + plots.log_in_view
    weights[..., 1:] = np.where(inside, log_hit + log_pdf, -np.inf)
    return weights


def nearest(log_p_star: Array) -> tuple[Array, Array]:
    """Nearest neighbour: the heaviest hypothesis, missed detection included, counts alone (theory.md §9).

    Args:
        log_p_star: logarithms of p*_j, j = 0 the missed detection, shape (..., 1 + M).

    Returns:
        weights, one of them 1, shape (..., 1 + M), and the logarithm of that hypothesis' p*_j, shape (...).
    """
    best = log_p_star.argmax(axis=-1)[..., None]
    log_p_bar = np.take_along_axis(log_p_star, best, axis=-1)
    p = np.zeros_like(log_p_star)
    np.put_along_axis(p, np.where(log_p_bar == -np.inf, 0, best), 1.0, axis=-1)
    return p, log_p_bar[..., 0]


def kalman(log_p_star: Array) -> tuple[Array, Array]:
    """Kalman filter with a gate: the closest plot in the gate is the target's; none there is a missed detection.

    Args:
        log_p_star: logarithms of p*_j, j = 0 the missed detection, shape (..., 1 + M).

    Returns:
        weights, one of them 1, shape (..., 1 + M), and the logarithm of that hypothesis' p*_j, shape (...).
    """
    hit = (log_p_star[..., 1:] > -np.inf).any(axis=-1)
    certain = log_p_star.copy()
    certain[..., 0] = np.where(hit, -np.inf, certain[..., 0])
    return nearest(certain)


def absorb(expected: Expected, w: Array, p: Array) -> Gaussian:
    """Moment-matched update with given association weights (Eq. 7).

    Args:
        expected: the tracks.
        w: whitened innovations, shape (F, ..., M, m).
        p: weights, shape (..., 1 + M), sum one, p[..., 0] the missed detection.

    Returns:
        the posterior Gaussians.
    """
    W, hit = expected.W, p[..., 1:]
    mean = np.vecmat(hit, w)
    rest = (hit[..., None] * w).mT @ w - mean[..., :, None] * mean[..., None, :]
    rest += p[..., 0, None, None] * identity(w.shape[-1])
    x = expected.density.x + np.matvec(W, mean)
    return Gaussian(x, expected.P_hit + symmetric(times_transposed(W @ rest, W)))


def pdaf(predicted: Gaussian, plots: Plots, sensor: Linearised, clutter: Clutter) -> Filtered:
    """Probabilistic data association filter: one scan (Eq. 6, 7).

    Args:
        predicted: shapes (..., n), (..., n, n).
        plots: of the scan; no plots is evidence too.
        sensor: linearised at ``predicted.x``.
        clutter: detection probability, false plots, gate.

    Returns:
        the posterior and log p_bar.

    References:
        theory.md Eq. (6), (7); Bar-Shalom, Daum & Huang, The probabilistic data association filter (2009).
    """
    return _filter(predicted, plots, sensor, clutter, normalise)


def nearest_neighbour(predicted: Gaussian, plots: Plots, sensor: Linearised, clutter: Clutter) -> Filtered:
    """Nearest neighbour filter: the most probable hypothesis of a scan, missed detection included, counts alone.

    Args:
        predicted: shapes (..., n), (..., n, n).
        plots: of the scan; no plots is evidence too.
        sensor: linearised at ``predicted.x``.
        clutter: detection probability, false plots, gate.

    Returns:
        the posterior, and the logarithm of that hypothesis' weight in place of log p_bar.

    References:
        theory.md §9.
    """
    return _filter(predicted, plots, sensor, clutter, nearest)


def kalman_filter(predicted: Gaussian, plots: Plots, sensor: Linearised, clutter: Clutter) -> Filtered:
    """Kalman filter with a gate: the closest plot in the gate is the target's; none there is a missed detection.

    Args:
        predicted: shapes (..., n), (..., n, n).
        plots: of the scan; none leaves the prediction as it is.
        sensor: linearised at ``predicted.x``.
        clutter: detection probability, false plots, gate (``p_g = 1``: every plot is in it).

    Returns:
        the posterior, and the logarithm of the weight of what was taken for true in place of log p_bar.

    References:
        theory.md §9.
    """
    return _filter(predicted, plots, sensor, clutter, kalman)


def _filter(predicted: Gaussian, plots: Plots, sensor: Linearised, clutter: Clutter, choose: Choice) -> Filtered:
    """Filter tracks that have one density each."""
    one = Gaussian(predicted.x[None], predicted.P[None])
    density, log_p_bar = update(expect(one, sensor._replace(z=sensor.z[None]), clutter), plots, choose)
    return Filtered(Gaussian(density.x[0], density.P[0]), log_p_bar)


def _log(value: Array) -> Array:
    """Logarithm with log 0 = -inf and no warning."""
    return np.log(value, out=np.full_like(value, -np.inf), where=value > 0.0)
