"""Negative information: what a plot, and a miss, say about a target that may hide in the clutter notch (Eq. 19).

A GMTI radar detects with ``p_d(x) = p_d (1 - c_n N(n_c(x); 0, v_n))``, n_c the speed of the target away from it. So
each hypothesis ends in two terms, N as an ordinary update leaves it, and N after a fictitious measurement ``n_c = 0``
with variance v_n and weight ``b``: positive for a missed detection, which speaks for the notch, negative for a plot.

Both terms differ along one direction only. With n_c linear, ``y = n_c(x) ~ N(y0, s2)`` and ``k = P h / s2``, the rest
of the state, ``x - k y``, is independent of y, and the notch does not touch it; so the mean of x moves by k times the
shift of y's, and its covariance changes by ``k k'`` times the change of its variance. For two terms of weights 1 - b
and b, with ``rho = s2 / (s2 + v_n)`` and ``d = rho y0``::

    mean(y) = y0 - b d          var(y) = s2 (1 - b rho) + b (1 - b) d^2

For a plot ``b = -kappa / (1 - kappa)``, ``kappa = c_n N(0; y0, s2 + v_n) <= 1``. The covariance of x stays positive
definite as ``var(y) > 0``: the signed mixture is N(y; y0, s2) times ``1 - exp(-y^2 / 2 v_n) >= 0``, hence a density.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.association import (
    Choice,
    Expected,
    Filtered,
    Plots,
    compared,
    in_view,
    log_weights,
    normalise,
)
from waldnet.common.estimation.detection import Notch, log_blind
from waldnet.common.estimation.gaussian import Array, Gaussian, moments, symmetric, times_transposed
from waldnet.common.estimation.sight import approach

#: Smallest variance that is divided by, relative to v_n: of a state that is known exactly.
_EXACT = 1e-30
#: A plot from the middle of the notch is impossible; its term keeps this share, so that nothing is divided by zero.
_LEAST = 1e-30


class Hypotheses(NamedTuple):
    """Every hypothesis about a scan, for each filter: j = 0 the missed detection, j > 0 plot j is the target.

    Attributes:
        log_p_star: unnormalised weights log p*_j, the notch included, shape (F, ..., 1 + M).
        density: the state under each hypothesis, moments matched, shapes (F, ..., 1 + M, n), (F, ..., 1 + M, n, n).
    """

    log_p_star: Array
    density: Gaussian


def hypotheses(expected: Expected, plots: Plots, notch: Notch, stand: Array) -> Hypotheses:
    """Weights and densities of the hypotheses about one scan of a radar with a clutter notch (Eq. 19).

    Args:
        expected: tracks predicted to the time of the scan; their detection probability without the notch.
        plots: of the scan; no plots is evidence too.
        notch: of the radar.
        stand: where the radar stands [m], shape (d,).

    Returns:
        for each filter; which plots lie in the gate is for the last one to say.
    """
    plots = in_view(expected, plots)
    w, log_pdf, inside = compared(expected, plots)
    log_p_star = np.stack([log_weights(expected, pdf, inside, plots) for pdf in log_pdf])
    plain = _plain(expected, np.where(inside[..., None], w, 0.0))
    return _with_notch(log_p_star, plain, -np.expm1(expected.log_miss), notch, stand)


def filtered(given: Hypotheses, choose: Choice = normalise) -> Filtered:
    """Merge the hypotheses as ``association.update`` does (Eq. 7, 13), each with a density of its own.

    Args:
        given: of one or two filters; the last one says how much each hypothesis counts.
        choose: how: PDAF, nearest neighbour, or Kalman with a gate.

    Returns:
        posteriors of all filters, shapes (F, ..., n), (F, ..., n, n), and log p_bar of the first, shape (...).
    """
    return Filtered(*merged(given, choose)[:2])


def merged(given: Hypotheses, choose: Choice) -> tuple[Gaussian, Array, Array]:
    """``filtered``, and as third the logarithm of the weight sum of the filter that associates, shape (...)."""
    log_p_star, density = given
    q, log_q_bar = choose(log_p_star[-1])
    # Of a scan that is impossible for every hypothesis, q_0 = 1 and log q_bar = -inf already say all.
    counts = (q > 0.0) & (log_p_star[-1] > -np.inf)
    first, last = (np.where(counts, log_p_star[f], 0.0) for f in (0, -1))
    log_p_bar = log_q_bar + np.vecdot(q, first - last)
    return moments(np.broadcast_to(q, log_p_star.shape), density), log_p_bar, log_q_bar


def _plain(expected: Expected, w: Array) -> Gaussian:
    """Densities under each hypothesis without the notch: the prediction, and one update per plot."""
    x, P = expected.density
    M, n = w.shape[-2], x.shape[-1]
    means, covariances = np.empty((*x.shape[:-1], 1 + M, n)), np.empty((*x.shape[:-1], 1 + M, n, n))
    means[..., :1, :] = x[..., None, :]
    means[..., 1:, :] = x[..., None, :] + times_transposed(w, expected.W)
    covariances[..., :1, :, :] = P[..., None, :, :]
    covariances[..., 1:, :, :] = expected.P_hit[..., None, :, :]
    return Gaussian(means, covariances)


def _with_notch(log_p_star: Array, plain: Gaussian, p: Array, notch: Notch, stand: Array) -> Hypotheses:
    """Put the notch into weights and densities.

    Args:
        log_p_star: without the notch, shape (F, ..., 1 + M).
        plain: densities without the notch.
        p: probability that a target outside the notch is detected and its plot gated, shape (...).
        notch: of the radar.
        stand: where the radar stands [m], shape (d,).
    """
    seen = approach(plain, stand)
    Ph = np.matvec(plain.P, seen.slope)
    s2, v_n = np.vecdot(seen.slope, Ph), notch.v_n
    # What the line leaves out blurs the notch.
    spread = s2 + seen.rest
    log_kappa = log_blind(seen.speed, spread, v_n)
    kappa, open_ = np.exp(log_kappa), np.maximum(-np.expm1(log_kappa), _LEAST)
    missed = 1.0 - p * open_[..., 0]
    b = -kappa / open_
    b[..., 0] = p * kappa[..., 0] / np.where(missed > 0.0, missed, 1.0)
    weights = log_p_star + np.log(open_)
    with np.errstate(divide="ignore"):  # a target that cannot be missed
        weights[..., 0] = np.log(missed)
    rho = s2 / (spread + v_n)
    d = rho * seen.speed
    change = b * (1.0 - b) * d * d - b * rho * s2
    k = Ph / np.maximum(s2, _EXACT * v_n)[..., None]
    x = plain.x - (b * d)[..., None] * k
    return Hypotheses(
        weights, Gaussian(x, symmetric(plain.P + change[..., None, None] * k[..., :, None] * k[..., None, :]))
    )
