"""Importance sampling for calibration, on the normal mean shift: integral equations, direct runs, coverage."""

from __future__ import annotations

import re

import numpy as np
import pytest
from exact_walk import ever_above, renewal_constant
from scipy.stats import binomtest

from waldnet.common.estimation.gaussian import Array
from waldnet.studies.importance import calibration, crossing_weights

B = np.array([2.0, 10.0, 1e2, 1e4, 1e6])


def log_lrs(
    mean: float, shift: float, runs: int, scans: int, rng: np.random.Generator, believed: float
) -> tuple[Array, Array]:
    """Log LR of N(shift, 1) against N(0, 1), and of a mode that believes in another shift, on data N(mean, 1)."""
    z = rng.normal(mean, 1.0, (runs, scans))
    true, mode = (np.cumsum(d * z - 0.5 * d**2, axis=1) for d in (shift, believed))
    return true, mode


@pytest.mark.parametrize("d", [0.5, 1.0])
def test_the_exact_test_has_its_exact_probabilities(d: float) -> None:
    """Down to 1e-6 from 10,000 runs: within 4 standard errors of the integral equation and, far out, of the limit."""
    rng = np.random.default_rng(int(10 * d))
    true, mode = log_lrs(d, d, 10_000, round(150 / d**2), rng, believed=d)
    ours = calibration(mode, true, B, rng)
    exact = np.array([ever_above(float(np.log(b)), d) for b in B])
    assert (ours.crossed == 10_000).all()
    assert (np.abs(ours.probability - exact) < 4.0 * ours.standard_error).all()
    assert (ours.standard_error < 0.02 * exact).all()
    assert abs(ours.probability[-1] * B[-1] - renewal_constant(d)) < 4.0 * B[-1] * ours.standard_error[-1]
    # An exact LR keeps Ville's bound, by far more than the error.
    assert (ours.probability + 4.0 * ours.standard_error < 1.0 / B).all()


@pytest.mark.parametrize("believed", [0.7, 1.4])
def test_modes_that_believe_too_little_or_too_much(believed: float) -> None:
    """Runs and weights of the true shift 1, a mode of another: under h0 that is the exact LR of the other."""
    rng = np.random.default_rng(int(10 * believed))
    true, mode = log_lrs(1.0, 1.0, 10_000, 200, rng, believed)
    ours = calibration(mode, true, B, rng)
    exact = np.array([ever_above(float(np.log(b)), believed) for b in B])
    assert (np.abs(ours.probability - exact) < 4.0 * ours.standard_error).all()
    assert (ours.standard_error < 0.2 * exact).all()


@pytest.mark.parametrize("believed", [0.7, 1.0, 1.4])
def test_direct_runs_without_a_target_cross_as_often(believed: float) -> None:
    """B = 10 and 100: the 99.98 % interval of 100,000 direct runs, and 4 standard errors beside it."""
    rng = np.random.default_rng(int(10 * believed))
    true, mode = log_lrs(1.0, 1.0, 10_000, 200, rng, believed)
    ours = calibration(mode, true, np.array([10.0, 100.0]), rng)
    _, without = log_lrs(0.0, 1.0, 100_000, 60, rng, believed)
    crossings = (without.max(axis=1)[:, None] >= np.log(ours.b)).sum(axis=0)
    for estimate, error, count in zip(ours.probability, ours.standard_error, crossings, strict=True):
        seen = binomtest(int(count), len(without)).proportion_ci(0.9998)
        assert seen.low - 4.0 * error < estimate < seen.high + 4.0 * error


def test_a_mode_that_is_sure_too_soon_is_found_out() -> None:
    """Twice the true log LR crosses B where the truth crosses sqrt(B): Ville's bound is broken beyond doubt."""
    rng = np.random.default_rng(5)
    true, _ = log_lrs(1.0, 1.0, 5000, 200, rng, believed=1.0)
    ours = calibration(2.0 * true, true, np.array([1e4]), rng)
    assert ours.normal.low > 10.0 / 1e4
    assert ours.bootstrap.low > 10.0 / 1e4
    expected = ever_above(float(np.log(1e2)), 1.0)
    assert abs(ours.probability[0] - expected) < 4.0 * ours.standard_error[0]


def test_intervals_cover_as_often_as_they_say() -> None:
    """120 estimates from 400 runs each; the coverage of 90 % intervals, normal and bootstrap, fits 90 % (99.9 %)."""
    rng, covered = np.random.default_rng(6), np.zeros(2, np.int64)
    exact = ever_above(float(np.log(1e3)), 1.0)
    for _ in range(120):
        true, mode = log_lrs(1.0, 1.0, 400, 80, rng, believed=1.0)
        ours = calibration(mode, true, np.array([1e3]), rng, confidence=0.9)
        covered += [bool(low < exact < high) for low, high in (ours.normal, ours.bootstrap)]
    for count in covered:
        assert binomtest(int(count), 120, 0.9).pvalue > 1e-3


def test_every_run_counts_at_its_first_crossing() -> None:
    log_lr = np.array([[0.0, 3.0, 1.0, 5.0], [3.0, 9.0, 9.0, 9.0], [1.0, 1.0, 2.5, -np.inf]])
    weight = np.arange(12.0).reshape(3, 4)
    never = -np.inf
    expected = [[-1.0, -3.0, never], [-4.0, -5.0, -5.0], [never, never, never]]
    np.testing.assert_array_equal(crossing_weights(log_lr, weight, np.array([3.0, 4.0, 6.0])), expected)


def test_figures_of_a_sample_by_hand() -> None:
    """Weights 1/2, 1/4, 0, 0: one run holds two thirds."""
    log_lr, weight = np.array([[1.0], [1.0], [-1.0], [-1.0]]), np.log([[2.0], [4.0], [3.0], [3.0]])
    ours = calibration(log_lr, weight, np.array([1.0]), np.random.default_rng(1))
    values = np.array([0.5, 0.25, 0.0, 0.0])
    assert ours.crossed == 2
    np.testing.assert_allclose(ours.probability, values.mean())
    np.testing.assert_allclose(ours.standard_error, values.std(ddof=1) / 2.0)
    np.testing.assert_allclose(ours.effective_runs, 0.75**2 / (0.25 + 0.0625))
    np.testing.assert_allclose(ours.largest_share, 2.0 / 3.0)
    np.testing.assert_allclose(ours.normal.high, values.mean() + 1.959964 * values.std(ddof=1) / 2.0, rtol=1e-6)
    assert ours.normal.low == 0.0
    assert 0.0 <= ours.bootstrap.low < ours.probability < ours.bootstrap.high <= 0.5


def test_heavy_tails_are_visible() -> None:
    """A mode that crosses at once, whatever the data, counts with 1 / LR: log-normal, ever heavier with the scans."""
    rng = np.random.default_rng(7)
    true, _ = log_lrs(1.0, 1.0, 5000, 12, rng, believed=1.0)
    early, late = (calibration(np.ones((5000, 1)), true[:, k : k + 1], np.ones(1), rng) for k in (0, 11))
    assert early.effective_runs > 1000.0 > 100.0 > late.effective_runs
    assert early.largest_share < 0.05 < 0.1 < late.largest_share


def test_where_nothing_crossed_nothing_is_known() -> None:
    ours = calibration(np.zeros((3, 2)), np.zeros((3, 2)), np.array([0.5, 10.0]), np.random.default_rng(1))
    assert ours.probability.tolist() == [1.0, 0.0]
    assert ours.crossed.tolist() == [3, 0]
    assert ours.effective_runs.tolist() == [3.0, 0.0]
    assert ours.largest_share.tolist() == [pytest.approx(1 / 3), 0.0]
    for interval in (ours.normal, ours.bootstrap):
        assert (interval.low[1], interval.high[1]) == (0.0, 1.0)


def test_weights_beyond_floating_point() -> None:
    """1/LR of exp(-900) is no number; probability is zero then, but the shares are still told."""
    log_lr, weight = np.full((4, 1), 50.0), np.array([[900.0], [900.0], [901.0], [902.0]])
    ours = calibration(log_lr, weight, np.array([10.0]), np.random.default_rng(1))
    w = np.exp([0.0, 0.0, -1.0, -2.0])
    np.testing.assert_allclose(ours.effective_runs, w.sum() ** 2 / np.square(w).sum())
    np.testing.assert_allclose(ours.largest_share, 1.0 / w.sum())
    assert ours.probability == 0.0


@pytest.mark.parametrize(
    ("log_lr", "weight", "fault"),
    [
        (np.zeros((3, 2)), np.zeros((3, 3)), "log_lr_mode (3, 2), log_weight (3, 3): expected one shape (R, K), R > 1"),
        (np.zeros((1, 2)), np.zeros((1, 2)), "log_lr_mode (1, 2), log_weight (1, 2): expected one shape (R, K), R > 1"),
        (np.full((3, 2), np.nan), np.zeros((3, 2)), "log_lr_mode: has NaN"),
        (np.ones((3, 2)), np.full((3, 2), -np.inf), "log_weight: is not finite at a crossing"),
    ],
)
def test_data_that_cannot_be(log_lr: Array, weight: Array, fault: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(fault)}"):
        calibration(log_lr, weight, np.array([2.0]), np.random.default_rng(1))
