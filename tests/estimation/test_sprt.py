"""Wald's thresholds, the life of a track under them, and the error rates they promise."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.stats import binomtest

from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.sprt import Status, Thresholds, decide, thresholds

TENTATIVE, CONFIRMED, DELETED = Status.TENTATIVE, Status.CONFIRMED, Status.DELETED
LIMITS = Thresholds(-3.0, 9.0)


@pytest.mark.parametrize(("p0", "p1"), [(1e-4, 0.95), (0.05, 0.9), (1e-12, 1 - 1e-12), (0.4, 0.6)])
def test_thresholds_of_wald(p0: float, p1: float) -> None:
    limits = thresholds(p0, p1)
    assert np.exp(limits.log_a) == pytest.approx((1 - p1) / (1 - p0), rel=1e-12)
    assert np.exp(limits.log_b) == pytest.approx(p1 / p0, rel=1e-12)
    assert limits.log_a < 0.0 < limits.log_b


@pytest.mark.parametrize(("p0", "p1"), [(0.5, 0.5), (0.9, 0.1), (0.0, 0.9), (0.1, 1.0), (-0.1, 0.5), (0.5, np.nan)])
def test_thresholds_that_cannot_be(p0: float, p1: float) -> None:
    text = f"p0 = {p0}, p1 = {p1}: 0 < p0 < p1 < 1 is needed, or log A < 0 < log B fails"
    with pytest.raises(ValueError, match=f"^{re.escape(text)}$"):
        thresholds(p0, p1)


@pytest.mark.parametrize(
    ("log_lr", "before", "expected", "goes_on_with", "accepted", "rejected"),
    [
        (9.1, TENTATIVE, CONFIRMED, 0.0, True, False),
        (-3.1, TENTATIVE, DELETED, -3.1, False, True),
        (8.9, TENTATIVE, TENTATIVE, 8.9, False, False),
        (-2.9, TENTATIVE, TENTATIVE, -2.9, False, False),
        (9.0, TENTATIVE, TENTATIVE, 9.0, False, False),
        (-3.0, TENTATIVE, TENTATIVE, -3.0, False, False),
        (5.0, CONFIRMED, CONFIRMED, 5.0, False, False),
        (9.1, CONFIRMED, CONFIRMED, 0.0, True, False),
        (-3.1, CONFIRMED, DELETED, -3.1, False, True),
        (50.0, DELETED, DELETED, 50.0, False, False),
        (-50.0, DELETED, DELETED, -50.0, False, False),
        (-np.inf, CONFIRMED, DELETED, -np.inf, False, True),
    ],
)
@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2)])
def test_one_step(
    shape: tuple[int, ...],
    log_lr: float,
    before: Status,
    expected: Status,
    goes_on_with: float,
    accepted: bool,
    rejected: bool,
) -> None:
    verdict = decide(np.full(shape, log_lr), np.full(shape, before, np.uint8), LIMITS)
    assert verdict.status.dtype == np.uint8
    for got, wanted in zip(verdict, (goes_on_with, expected, accepted, rejected), strict=True):
        np.testing.assert_array_equal(got, np.full(shape, wanted))


def test_confirmed_tracks_are_kept_longer_where_that_is_wanted() -> None:
    limits = thresholds(1e-4, 0.99, keep=0.999999)
    assert limits[:2] == thresholds(1e-4, 0.99)[:2]
    assert limits.log_a_kept == thresholds(1e-4, 0.999999).log_a
    log_lr, status = np.array([-5.0, -5.0, -13.0, -14.0]), np.array([0, 1, 1, 1], np.uint8)
    np.testing.assert_array_equal(decide(log_lr, status, limits).status, [2, 1, 1, 2])
    with pytest.raises(ValueError, match=r"^p0 = 0\.1, keep = 0\.05: 0 < p0 < keep < 1 is needed"):
        thresholds(0.1, 0.9, keep=0.05)


def test_tracks_of_a_batch_are_decided_one_by_one() -> None:
    log_lr = np.array([10.0, -4.0, 0.0, 10.0, -4.0, 10.0])
    status = np.array([0, 0, 0, 1, 1, 2], np.uint8)
    verdict = decide(log_lr, status, LIMITS)
    np.testing.assert_array_equal(verdict.status, [1, 2, 0, 1, 2, 2])
    np.testing.assert_array_equal(verdict.log_lr, [0.0, -4.0, 0.0, 0.0, -4.0, 10.0])
    np.testing.assert_array_equal(log_lr, [10.0, -4.0, 0.0, 10.0, -4.0, 10.0])
    np.testing.assert_array_equal(status, [0, 0, 0, 1, 1, 2])


def test_the_life_of_a_track() -> None:
    """Confirmed at the second step, confirmed anew at the fifth, then lost; what comes after moves nothing."""
    log_lr, status = np.array(0.0), np.array(TENTATIVE, np.uint8)
    lived = []
    for step in (5.0, 5.0, 4.0, 4.0, 2.0, 1.0, -3.0, -2.0, 100.0):
        verdict = decide(log_lr + step, status, LIMITS)
        log_lr, status = verdict.log_lr, verdict.status
        lived.append((float(log_lr), int(status)))
    confirmed = [(0.0, 1), (4.0, 1), (8.0, 1), (0.0, 1), (1.0, 1), (-2.0, 1)]
    assert lived == [(5.0, 0), *confirmed, (-4.0, 2), (96.0, 2)]


def outcomes(mean: float, shift: float, limits: Thresholds, runs: int, rng: np.random.Generator) -> tuple[int, int]:
    """How often h1 and h0 are accepted: N(mean, 1) data, h1: N(shift, 1), h0: N(0, 1); every run until decided."""
    status: Array = np.zeros(runs, np.uint8)
    log_lr, accepted, rejected = np.zeros(runs), 0, 0
    while len(log_lr):
        step = shift * rng.normal(mean, 1.0, len(log_lr)) - 0.5 * shift**2
        verdict = decide(log_lr + step, status, limits)
        accepted, rejected = accepted + int(verdict.accepted.sum()), rejected + int(verdict.rejected.sum())
        goes_on = ~(verdict.accepted | verdict.rejected)
        log_lr, status = verdict.log_lr[goes_on], verdict.status[goes_on]
    return accepted, rejected


@pytest.mark.parametrize(("p0", "p1"), [(0.02, 0.9), (0.1, 0.8)])
@pytest.mark.parametrize("shift", [0.2, 1.0])
def test_error_rates_keep_walds_bounds(p0: float, p1: float, shift: float) -> None:
    """Wald: P(h1|h0) <= 1/B and P(h0|h1) <= A; the rates themselves are known too.

    Siegmund (Sequential analysis, 1985): the walk leaves [log A, log B] by 0.583 shift on average, so the rates are
    those of a continuous walk between thresholds that much farther out. Confidence of every interval: 99.98 %.
    """
    runs, limits = 20_000, thresholds(p0, p1)
    rng = np.random.default_rng([int(100 * p0), int(10 * shift)])
    false_alarms, _ = outcomes(0.0, shift, limits, runs, rng)
    _, misses = outcomes(shift, shift, limits, runs, rng)
    A, B = np.exp(limits.log_a - 0.583 * shift), np.exp(limits.log_b + 0.583 * shift)
    expected = (1.0 - A) / (B - A), A * (B - 1.0) / (B - A)
    bounds = np.exp(-limits.log_b), np.exp(limits.log_a)
    for errors, bound, rate in zip((false_alarms, misses), bounds, expected, strict=True):
        interval = binomtest(errors, runs).proportion_ci(0.9998)
        assert interval.low <= bound
        # 5 % for what Siegmund's approximation leaves out at the larger shift.
        assert 0.95 * interval.low <= rate <= 1.05 * interval.high
