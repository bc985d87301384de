"""How often a test without a target would confirm one, from runs with a target (importance sampling).

For an exact LR, P(sup LR >= B | h0) <= 1 / B (theory.md §7); whether a mode's LR keeps that is its calibration. Seen
directly, B = 1e6 takes many millions of runs without a target. But any event A that is decided at a stopping time tau
has

    P(A | h0) = E( 1{A} p0(data up to tau) / p1(data up to tau) | h1 )

so runs *with* a target, where crossings are common, tell the same number when each counts with the inverse of the true
likelihood ratio of its data up to its first crossing. The true one, not the mode's: that is what makes it a test.

References:
    theory.md §7; Siegmund, Importance sampling in the Monte Carlo study of sequential tests, Annals of Statistics 4,
    1976.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from waldnet.common.estimation.gaussian import Array

_BOOTSTRAPS = 1000


class Interval(NamedTuple):
    """Confidence intervals, one per threshold, shape (G,) each."""

    low: Array
    high: Array


class Calibration(NamedTuple):
    """Probabilities that a test without a target crosses, one per threshold.

    All arrays have shape (G,). A few runs that hold most of the sum (``largest_share`` near 1, ``effective_runs``
    small) mean heavy tails: then neither interval is to be trusted. So it is with a mode that crosses where the true LR
    is still low, or has fallen again.

    Attributes:
        b: the thresholds B on LR.
        probability: estimates of P(max over the scans of LR >= B | h0).
        standard_error: of the estimates.
        normal: intervals from mean and standard error.
        bootstrap: percentiles over resampled runs.
        crossed: how many runs crossed.
        effective_runs: (sum w)^2 / sum w^2 of the weights: so many runs of equal weight would be as good.
        largest_share: of one run in the sum of the weights.
    """

    b: Array
    probability: Array
    standard_error: Array
    normal: Interval
    bootstrap: Interval
    crossed: Array
    effective_runs: Array
    largest_share: Array


def calibration(
    log_lr_mode: Array, log_weight: Array, b: Array, rng: np.random.Generator, confidence: float = 0.95
) -> Calibration:
    """Estimate P(sup LR >= B | h0) of a mode from runs drawn with a target.

    Args:
        log_lr_mode: log LR of the mode after every scan, shape (R, K), R > 1.
        log_weight: log of the true (or nearly true) likelihood ratio p1 / p0 of all data up to every scan, (R, K).
        b: thresholds B on LR, shape (G,), positive.
        rng: of the bootstrap.
        confidence: of each interval.

    Returns:
        the estimates. Where no run crossed nothing is known and the intervals are 0 to 1.

    Raises:
        ValueError: when shapes differ, or a number that counts is not finite.
    """
    if log_lr_mode.shape != log_weight.shape or log_lr_mode.ndim != 2 or len(log_lr_mode) < 2:
        raise ValueError(
            f"log_lr_mode {log_lr_mode.shape}, log_weight {log_weight.shape}: expected one shape (R, K), R > 1"
        )
    if np.isnan(log_lr_mode).any():
        raise ValueError("log_lr_mode: has NaN, which is neither above a threshold nor below")
    log_w = crossing_weights(log_lr_mode, log_weight, np.log(b))
    runs, crossed = len(log_w), np.isfinite(log_w).sum(axis=0)
    # Relative to the largest, so that nothing under- or overflows whatever the weights.
    top = np.where(crossed > 0, log_w.max(axis=0), 0.0)
    w = np.exp(log_w - top)
    mean, spread = w.mean(axis=0), w.std(axis=0, ddof=1) / np.sqrt(runs)
    tail = ndtri(0.5 + 0.5 * confidence) * spread
    resampled = np.quantile(_resampled_means(w, rng), [0.5 - 0.5 * confidence, 0.5 + 0.5 * confidence], axis=0)
    scale, total = np.exp(top), np.maximum(w.sum(axis=0), np.finfo(np.float64).tiny)
    return Calibration(
        b=b,
        probability=scale * mean,
        standard_error=scale * spread,
        normal=_interval(scale * np.maximum(mean - tail, 0.0), scale * (mean + tail), crossed),
        bootstrap=_interval(scale * resampled[0], scale * resampled[1], crossed),
        crossed=crossed,
        effective_runs=w.sum(axis=0) ** 2 / np.maximum(np.square(w).sum(axis=0), np.finfo(np.float64).tiny),
        largest_share=w.max(axis=0) / total,
    )


def crossing_weights(log_lr_mode: Array, log_weight: Array, log_b: Array) -> Array:
    """Logarithm of every run's weight: that of its data up to the first scan with log LR >= log B.

    Args:
        log_lr_mode: shape (R, K).
        log_weight: shape (R, K).
        log_b: thresholds, shape (G,).

    Returns:
        ``-log_weight`` at the first crossing, shape (R, G); -inf for a run that never crosses.

    Raises:
        ValueError: when a weight that counts is not finite.
    """
    # The running maximum only rises: the first crossing of any threshold is found in it.
    highest = np.maximum.accumulate(log_lr_mode, axis=1)
    log_w = np.full((len(log_lr_mode), len(log_b)), -np.inf)
    for column, threshold in enumerate(log_b):
        above = highest >= threshold
        runs = np.flatnonzero(above.any(axis=1))
        log_w[runs, column] = -log_weight[runs, above[runs].argmax(axis=1)]
        if not np.isfinite(log_w[runs, column]).all():
            raise ValueError("log_weight: is not finite at a crossing; data drawn with a target cannot rule it out")
    return log_w


def _resampled_means(w: Array, rng: np.random.Generator) -> Array:
    """Means over runs drawn anew with replacement, shape (R, G) to (bootstraps, G)."""
    runs = len(w)
    counts = (np.bincount(rng.integers(runs, size=runs), minlength=runs) for _ in range(_BOOTSTRAPS))
    return np.stack([drawn @ w for drawn in counts]) / runs


def _interval(low: Array, high: Array, crossed: Array) -> Interval:
    return Interval(np.where(crossed > 0, low, 0.0), np.where(crossed > 0, high, 1.0))
