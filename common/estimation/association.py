"""Plots and tracks: gate, PDAF update with its weight sum, tight association.

Everything is done in whitened coordinates: with ``S_k = L L'``, ``w_j = L^-1 nu_j`` and ``W = P H' L^-T`` the gain
times an innovation is ``K nu = W w`` and ``K S_k K' = W W'``, so that Eq. (7) needs neither K nor S_k. The difference
``P - K S_k K'`` is computed in Joseph's form: as it stands it loses all digits where a sharp plot meets a wide prior.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv

from common.estimation.gaussian import (
    LOG_2PI,
    Array,
    BoolArray,
    Gaussian,
    cholesky,
    half_log_det,
    log_sum_exp,
    squared_norm,
    symmetric,
    times_transposed,
    whiten,
)
from common.estimation.sensing import Linearised


class Plots(NamedTuple):
    """The plots of one scan, ragged scans of a batch padded.

    Attributes:
        z: shape (..., M, m).
        valid: shape (..., M); false marks padding.
    """

    z: Array
    valid: BoolArray


class Clutter(NamedTuple):
    """What is not the target.

    Attributes:
        p_d: detection probability, shape (...).
        log_rho_f: logarithm of the density of false plots [1/volume of z], shape (...).
        p_g: probability that the target's plot is inside the gate; 1 is no gate.
    """

    p_d: Array
    log_rho_f: Array
    p_g: float


class Innovations(NamedTuple):
    """All plots of a scan seen from a predicted track.

    Attributes:
        w: whitened innovations, shape (..., M, m).
        W: whitened gain, shape (..., n, m).
        J: whitened Jacobian L^-1 H, shape (..., m, n).
        M: whitened measurement noise L^-1 R L^-T, shape (..., m, m).
        distance: squared Mahalanobis distances, shape (..., M).
        log_pdf: log N(z_j; z_hat, S_k), shape (..., M).
    """

    w: Array
    W: Array
    J: Array
    M: Array
    distance: Array
    log_pdf: Array


class Filtered(NamedTuple):
    """A track after a scan.

    Attributes:
        density: the posterior Gaussian.
        log_p_bar: logarithm of the weight sum, shape (...).
    """

    density: Gaussian
    log_p_bar: Array


def innovate(predicted: Gaussian, z: Array, sensor: Linearised) -> Innovations:
    """Innovations of all plots against predicted tracks.

    Args:
        predicted: shapes (..., n), (..., n, n).
        z: plots, shape (..., M, m), batch axes broadcast against those of ``predicted``.
        sensor: the measurement function linearised at ``predicted.x``.

    Returns:
        the innovations.
    """
    PH = times_transposed(predicted.P, sensor.H)
    L = cholesky(symmetric(times_transposed(PH.mT, sensor.H)) + sensor.R)
    L_plot = L[..., None, :, :]
    w = whiten(L_plot, z - sensor.z[..., None, :])
    distance = squared_norm(w)
    log_pdf = -0.5 * distance - half_log_det(L)[..., None] - 0.5 * LOG_2PI * L.shape[-1]
    n, m = PH.shape[-2:]
    right = np.empty((*PH.shape[:-2], 2 * n + m, m))
    right[..., :n, :], right[..., n : 2 * n, :], right[..., 2 * n :, :] = PH, sensor.H.mT, sensor.R
    right = whiten(L_plot, right)
    W, J, M = right[..., :n, :], right[..., n : 2 * n, :].mT, right[..., 2 * n :, :].mT
    return Innovations(w, W, J, whiten(L_plot, M), distance, log_pdf)


@cache
def gate_threshold(p_g: float, m: int) -> float:
    """Squared Mahalanobis distance that an m-dimensional plot of the target stays below with probability ``p_g``."""
    return float(2.0 * gammaincinv(m / 2.0, p_g))


def gate(innovations: Innovations, valid: BoolArray, p_g: float) -> BoolArray:
    """Which plots lie inside the gate (chi-square test), shape (..., M)."""
    return valid & (innovations.distance <= gate_threshold(p_g, innovations.w.shape[-1]))


def log_weights(innovations: Innovations, inside: BoolArray, clutter: Clutter) -> Array:
    """Logarithms of the unnormalised weights p*_j (Eq. 6), j = 0 the missed detection.

    Args:
        innovations: of M plots.
        inside: plots that count, shape (..., M).
        clutter: detection probability, false plots, gate.

    Returns:
        log p*_j, shape (..., 1 + M); -inf for impossible hypotheses.
    """
    miss = _log(1.0 - clutter.p_d * clutter.p_g)
    plot = (_log(clutter.p_d) - clutter.log_rho_f)[..., None] + innovations.log_pdf
    weights = np.empty((*plot.shape[:-1], 1 + plot.shape[-1]))
    weights[..., 0] = miss
    weights[..., 1:] = np.where(inside, plot, -np.inf)
    return weights


def normalise(log_p_star: Array) -> tuple[Array, Array]:
    """Weights p_j and log p_bar (Eq. 6) from log p*_j, shape (..., 1 + M).

    Returns:
        p_j, shape (..., 1 + M), and log p_bar, shape (...). A scan that h1 holds for impossible (p_d = 1 and no plot in
        the gate) gives log p_bar = -inf and, as nothing can be learnt from it, p_0 = 1.
    """
    log_p_bar = log_sum_exp(log_p_star)
    possible = np.isfinite(log_p_bar)
    p = np.exp(log_p_star - np.where(possible, log_p_bar, 0.0)[..., None])
    p[..., 0] += ~possible
    return p, log_p_bar


def absorb(predicted: Gaussian, innovations: Innovations, p: Array) -> Gaussian:
    """Moment-matched update with given association weights (Eq. 7).

    Args:
        predicted: shapes (..., n), (..., n, n).
        innovations: of M plots.
        p: weights, shape (..., 1 + M), sum one, p[..., 0] the missed detection.

    Returns:
        the posterior Gaussians.
    """
    w, W, hit = innovations.w, innovations.W, p[..., 1:]
    # Padding may hold anything, and 0 times NaN is no zero.
    w = np.where(hit[..., None] > 0.0, w, 0.0)
    weighted = hit[..., None] * w
    mean = np.vecmat(hit, w)
    spread = weighted.mT @ w - mean[..., :, None] * mean[..., None, :]
    # Joseph's form: P - W W' = A P A' + W M W', every term positive semidefinite.
    A = np.eye(W.shape[-2]) - W @ innovations.J
    rest = innovations.M + p[..., 0, None, None] * np.eye(w.shape[-1]) + spread
    return Gaussian(predicted.x + np.matvec(W, mean), symmetric(A @ predicted.P @ A.mT + W @ rest @ W.mT))


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
    innovations = innovate(predicted, plots.z, sensor)
    inside = gate(innovations, plots.valid, clutter.p_g)
    p, log_p_bar = normalise(log_weights(innovations, inside, clutter))
    return Filtered(absorb(predicted, innovations, p), log_p_bar)


def tight(
    factor: Gaussian, association: Gaussian, plots: Plots, sensors: tuple[Linearised, Linearised], clutter: Clutter
) -> tuple[Filtered, Gaussian]:
    """One scan with tight association (Eq. 12, 13): the association filter alone decides who is who.

    The detection probability in ``clutter`` is one number for both filters: whether the sensor sees the target is for
    the honest density to say, not for the factor, which is n_sensors times too wide.

    Args:
        factor: predicted factors, shapes (..., n), (..., n, n).
        association: predicted association filters, same shapes.
        plots: of the scan.
        sensors: linearised at ``factor.x`` and at ``association.x``.
        clutter: detection probability, false plots, gate (of the association filter).

    Returns:
        the factor with its log p_bar (Eq. 13), and the association filter.
    """
    seen_by_factor = innovate(factor, plots.z, sensors[0])
    seen = innovate(association, plots.z, sensors[1])
    inside = gate(seen, plots.valid, clutter.p_g)
    q, log_q_bar = normalise(log_weights(seen, inside, clutter))
    log_p_star = log_weights(seen_by_factor, inside, clutter)
    # q log q -> 0 for q -> 0; an impossible scan stays impossible.
    terms = np.where(q > 0.0, q * (np.where(q > 0.0, log_p_star, 0.0) - _log(np.where(q > 0.0, q, 1.0))), 0.0)
    log_p_bar = np.where(np.isfinite(log_q_bar), terms.sum(axis=-1), -np.inf)
    return Filtered(absorb(factor, seen_by_factor, q), log_p_bar), absorb(association, seen, q)


def _log(value: Array) -> Array:
    """Logarithm with log 0 = -inf and no warning."""
    return np.log(value, out=np.full_like(value, -np.inf), where=value > 0.0)
