"""Wald's test of a normal mean shift: error rates and lengths as integral equations have them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from exact_walk import leave, renewal_constant

from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.sprt import Status, Thresholds, decide, thresholds

#: Shift d, alpha = beta; true alpha = true beta, and the mean length: by symmetry the same under both hypotheses.
FIGURES = [
    (1.0, 0.05, 0.0286, 6.920),
    (0.5, 0.05, 0.0379, 24.19),
    (0.25, 0.05, 0.0435, 90.53),
    (1.0, 0.01, 0.00563, 10.51),
]
RUNS = 100_000


class Outcome(NamedTuple):
    """Outcome of many tests: whether h1 was accepted, and after how many observations; shapes (runs,)."""

    accepted: Array
    lengths: Array


def carried_out(mean: float, d: float, limits: Thresholds, runs: int, rng: np.random.Generator) -> Outcome:
    """Tests of h1: N(d, 1) against h0: N(0, 1) on data N(mean, 1), each until decided."""
    accepted, lengths = np.zeros(runs), np.zeros(runs)
    log_lr, status, running = np.zeros(runs), np.full(runs, Status.TENTATIVE, np.uint8), np.arange(runs)
    while len(running):
        log_lr = log_lr + d * rng.normal(mean, 1.0, len(running)) - 0.5 * d**2
        verdict = decide(log_lr, status, limits)
        lengths[running] += 1.0
        accepted[running[verdict.accepted]] = 1.0
        goes_on = ~(verdict.accepted | verdict.rejected)
        log_lr, status, running = verdict.log_lr[goes_on], verdict.status[goes_on], running[goes_on]
    return Outcome(accepted, lengths)


def deviation(sample: Array, expected: float) -> float:
    """Of the mean, in its standard errors."""
    return float((sample.mean() - expected) / (sample.std(ddof=1) / np.sqrt(len(sample))))


@pytest.mark.parametrize(("d", "alpha", "true_alpha", "length"), FIGURES)
def test_figures_of_the_integral_equation(d: float, alpha: float, true_alpha: float, length: float) -> None:
    """To the digits given; twice the nodes change nothing; and h1 is h0 mirrored."""
    limits = thresholds(alpha, 1.0 - alpha)
    h0, finer, h1 = (
        leave(limits.log_a, limits.log_b, d, h1, nodes) for h1, nodes in ((False, 200), (False, 400), (True, 400))
    )
    assert f"{h0.above:.3g}" == f"{true_alpha:.3g}"
    assert f"{h0.steps:.4g}" == f"{length:.4g}"
    assert h0 == pytest.approx(finer, rel=1e-9)
    assert 1.0 - h1.above == pytest.approx(finer.above, rel=1e-9)
    assert h1.steps == pytest.approx(finer.steps, rel=1e-9)


@pytest.mark.parametrize("d", [0.5, 1.0])
def test_far_thresholds_are_passed_as_renewal_theory_says(d: float) -> None:
    """Another way to the same walk: e^b P(above) tends to a constant that an infinite series gives (Siegmund)."""
    reached = leave(-35.0, 12.0, d, under_h1=False, nodes=400)
    assert reached.above * np.exp(12.0) == pytest.approx(renewal_constant(d), rel=1e-9)


@pytest.mark.parametrize(("d", "alpha"), [figures[:2] for figures in FIGURES])
def test_the_test_has_the_exact_error_rates_and_lengths(d: float, alpha: float) -> None:
    """100,000 tests each; every mean within 4 of its standard errors, which are far smaller than Wald's slack."""
    limits = thresholds(alpha, 1.0 - alpha)
    exact = leave(limits.log_a, limits.log_b, d, under_h1=False)
    rng = np.random.default_rng([int(100 * d), int(1000 * alpha)])
    h0, h1 = carried_out(0.0, d, limits, RUNS, rng), carried_out(d, d, limits, RUNS, rng)
    for errors in (h0.accepted, 1.0 - h1.accepted):
        assert abs(deviation(errors, exact.above)) < 4.0
        assert deviation(errors, alpha) < -6.0
    for lengths in (h0.lengths, h1.lengths):
        assert abs(deviation(lengths, exact.steps)) < 4.0


@pytest.mark.parametrize("d", [0.1, 0.5, 1.0, 3.0])
@pytest.mark.parametrize(("alpha", "beta"), [(0.05, 0.05), (0.01, 0.2), (0.3, 0.02), (1e-4, 0.05)])
def test_walds_inequalities(alpha: float, beta: float, d: float) -> None:
    """alpha' <= alpha / (1 - beta), beta' <= beta / (1 - alpha), alpha' + beta' <= alpha + beta."""
    limits = thresholds(alpha, 1.0 - beta)
    false_alarm, miss = (
        leave(limits.log_a, limits.log_b, d, under_h1=False).above,
        1.0 - leave(limits.log_a, limits.log_b, d, under_h1=True).above,
    )
    assert 0.0 < false_alarm < alpha / (1.0 - beta)
    assert 0.0 < miss < beta / (1.0 - alpha)
    assert false_alarm + miss < alpha + beta
