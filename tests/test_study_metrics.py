"""What a run comes to, against the textbook, another library, and one run at a time."""

from __future__ import annotations

from datetime import datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom
from stonesoup.metricgenerator.ospametric import GOSPAMetric
from stonesoup.types.state import State

from waldnet.common.estimation.sprt import CONFIRMED, DELETED, TENTATIVE, Status, Thresholds, decide, thresholds
from waldnet.studies.course import Course, Worlds
from waldnet.studies.gospa import gospa, gospa_of_one
from waldnet.studies.metrics import (
    Evidence,
    Result,
    evidence,
    first_decisions,
    fuse_decisions,
    gospa_per_scan,
    lost,
    monitor,
    reduce,
)
from waldnet.studies.shares import quantile, share_of

LIMITS = thresholds(1e-2, 0.9)  # log A = -2.29, log B = 4.50
seeds = st.integers(0, 2**32 - 1)


def result_of(log_lr: object, **changes: object) -> Result:
    values = np.asarray(log_lr, np.float64)
    plain = Result(np.arange(values.shape[1]), values, np.zeros(values.shape), np.zeros(values.shape), 1.0, 0.0)
    return plain._replace(**changes)


def walks(seed: int, *shape: int) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).normal(0.2, 1.5, shape), axis=1)


@given(seeds, st.integers(0, 4), st.integers(0, 4))
@settings(max_examples=60, deadline=None)
def test_gospa_is_that_of_stone_soup(seed: int, a: int, b: int) -> None:
    rng = np.random.default_rng(seed)
    X, Y = rng.uniform(0, 30, (a, 2)), rng.uniform(0, 30, (b, 2))
    c, p = rng.uniform(2, 25), rng.choice([1.0, 2.0, 3.0])
    now = datetime(2026, 1, 1)
    sides = [[State(point[:, None], timestamp=now) for point in points] for points in (X, Y)]
    expected = 0.0
    if a + b:
        metric, _ = GOSPAMetric(c=c, p=p).compute_gospa_metric(*sides)
        expected = metric.value["distance"]
    assert gospa(X, Y, c, p) == pytest.approx(expected, abs=1e-9)


@given(seeds, st.booleans(), st.booleans())
@settings(max_examples=40, deadline=None)
def test_gospa_of_one_target_is_gospa(seed: int, reported: bool, there: bool) -> None:
    x, y = np.random.default_rng(seed).uniform(0, 12, (2, 3))
    expected = gospa(x[None] if reported else np.empty((0, 3)), y[None] if there else np.empty((0, 3)), 5.0, 2.0)
    distance = np.array(np.linalg.vector_norm(x - y) if there else np.nan)
    assert gospa_of_one(distance, np.array(reported), np.array(there), 5.0) == pytest.approx(expected)


def test_shares_have_the_bounds_of_clopper_and_pearson() -> None:
    for count, runs in ((0, 30), (1, 30), (17, 30), (30, 30)):
        share, low, high = share_of(count, runs)
        assert share == count / runs
        if count:
            assert binom.sf(count - 1, runs, low) == pytest.approx(0.025, abs=1e-9)
        else:
            assert low == 0.0
        if count < runs:
            assert binom.cdf(count, runs, high) == pytest.approx(0.025, abs=1e-9)
        else:
            assert high == 1.0
    assert np.isnan(share_of(0, 0)).all()


def test_quantiles_are_values_that_occurred() -> None:
    assert [quantile(np.array([3, 1, 2, 10]), q) for q in (0.1, 0.5, 0.9)] == [1, 2, 10]
    assert quantile(np.array([-np.inf, 1.0, 2.0]), 0.1) == -np.inf
    assert np.isnan(quantile(np.array([]), 0.5))


def one_by_one(log_lr: np.ndarray, limits: Thresholds) -> tuple[int, int]:
    for k, value in enumerate(log_lr):
        if value > limits.log_b:
            return Status.CONFIRMED, k + 1
        if value < limits.log_a:
            return Status.DELETED, k + 1
    return Status.TENTATIVE, 0


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_first_decisions_are_those_of_walds_test_run_by_run(seed: int) -> None:
    paths = walks(seed, 20, 12)
    decided = first_decisions(Evidence(paths, LIMITS))
    assert list(zip(decided.kind, decided.scans, strict=True)) == [one_by_one(path, LIMITS) for path in paths]


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_monitoring_begins_with_the_first_decision_and_goes_on_as_the_center_does(seed: int) -> None:
    paths = walks(seed, 20, 40)
    life = monitor(Evidence(paths, LIMITS))
    for path, statuses in zip(paths, life, strict=True):
        log_lr, status = np.zeros(1), np.array([TENTATIVE])
        for step, expected in zip(np.diff(path, prepend=0.0), statuses, strict=True):
            log_lr, status, _, _ = decide(log_lr + step, status, LIMITS)
            assert status[0] == expected
    kind, scans = first_decisions(Evidence(paths, LIMITS))
    at = np.where(scans > 0, scans - 1, 39)
    assert (life[np.arange(20), at] == kind).all()


def test_a_confirmed_track_that_loses_its_target_is_deleted_and_stays_so() -> None:
    life = monitor(Evidence(np.array([[5.0, 4.0, 2.0, 20.0]]), LIMITS))
    assert life.tolist() == [[CONFIRMED, CONFIRMED, DELETED, DELETED]]


def test_an_impossible_scan_deletes_and_is_no_number_afterwards() -> None:
    seen = Evidence(np.array([[1.0, -np.inf, -np.inf]]), LIMITS)
    assert monitor(seen).tolist() == [[TENTATIVE, DELETED, DELETED]]
    assert first_decisions(seen).scans.tolist() == [2]


def fused_one_by_one(local: np.ndarray, limits: Thresholds) -> list[float]:
    own, total, sums = [0.0] * local.shape[1], 0.0, []
    before = np.zeros(local.shape[1])
    for now in local:
        for s, step in enumerate(now - before):
            own[s] += step
            if own[s] > limits.log_b:
                total, own[s] = total + limits.log_b, 0.0
            elif own[s] < limits.log_a:
                total, own[s] = total + limits.log_a, 0.0
        before = now
        sums.append(total)
    return sums


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_decisions_of_sensors_add_up_sensor_by_sensor(seed: int) -> None:
    local = walks(seed, 6, 30, 3)
    fused = fuse_decisions(local, LIMITS)
    np.testing.assert_allclose(fused, [fused_one_by_one(run, LIMITS) for run in local], atol=1e-9)


def test_the_first_sensor_to_decide_decides_unless_another_says_the_opposite() -> None:
    """Sensor 0 confirms at scan 2; in run 1 sensor 1 deletes at the same time, and sensor 0 confirms anew at scan 4."""
    first, silent, against = [3.0, 6.0, 8.0, 12.0], [0.0] * 4, [0.0, -3.0, -3.0, -3.0]
    local = np.array([np.transpose([first, silent]), np.transpose([first, against])])
    seen = evidence(result_of(np.zeros((2, 4)), local_log_lr=local), LIMITS)
    assert first_decisions(seen).kind.tolist() == [CONFIRMED, CONFIRMED]
    assert first_decisions(seen).scans.tolist() == [2, 4]
    assert monitor(seen)[:, 1].tolist() == [CONFIRMED, TENTATIVE]
    both = LIMITS.log_a + LIMITS.log_b
    np.testing.assert_allclose(seen.log_lr[1], [0.0, both, both, both + LIMITS.log_b])


def test_a_sensor_that_saw_the_impossible_has_said_all_it_can() -> None:
    """Once log LR is -inf, its steps are no numbers; the other sensor goes on."""
    local = np.array([np.transpose([[-np.inf] * 4, [1.0, 5.0, 5.0, 10.0]])])
    fused = fuse_decisions(local, LIMITS)
    a, b = LIMITS.log_a, LIMITS.log_b
    np.testing.assert_allclose(fused, [[a, a + b, a + b, a + 2 * b]])


def test_other_thresholds_are_other_decisions_of_the_sensors() -> None:
    local = np.array([[[1.0], [2.0], [3.0], [4.0]]])
    low = evidence(result_of(np.zeros((1, 4)), local_log_lr=local), thresholds(0.3, 0.9))  # log B = 1.1
    assert first_decisions(low).scans.tolist() == [2]
    assert first_decisions(evidence(result_of(np.zeros((1, 4)), local_log_lr=local), LIMITS)).scans.tolist() == [0]


def test_errors_are_those_of_the_position_and_nees_that_of_the_state() -> None:
    rng = np.random.default_rng(3)
    x, truth, A = rng.normal(size=(2, 3, 4)), rng.normal(size=(2, 3, 4)), rng.normal(size=(2, 3, 4, 4))
    P = A @ A.mT + np.eye(4)
    truth[1, 0] = np.nan
    worlds = Worlds(np.arange(2), np.arange(3), truth, ())
    result = reduce(Course(np.zeros((2, 3)), x, P, 10.0, 2.0), worlds, 2)
    for run, k in ((0, 0), (0, 2), (1, 1)):
        off = x[run, k] - truth[run, k]
        assert result.error_m[run, k] == pytest.approx(np.hypot(off[0], off[1]))
        assert result.nees[run, k] == pytest.approx(off @ np.linalg.inv(P[run, k]) @ off)
    assert np.isnan(result.error_m[1, 0])
    assert np.isnan(result.nees[1, 0])
    assert (result.uplink_bytes, result.downlink_bytes) == (10.0, 2.0)


def test_a_track_that_is_no_number_is_lost() -> None:
    x = np.zeros((1, 2, 4))
    x[0, 1] = np.nan
    worlds = Worlds(np.arange(1), np.arange(2), np.zeros((1, 2, 4)), ())
    result = reduce(Course(np.zeros((1, 2)), x, np.tile(np.eye(4), (1, 2, 1, 1)), 0.0, 0.0), worlds, 2)
    assert result.error_m.tolist() == [[0.0, np.inf]]
    assert lost(result, 1000.0).tolist() == [True]


def test_lost_is_beyond_the_distance_after_the_last_scan_and_only_of_a_target() -> None:
    errors = np.array([[5000.0, 1000.0], [0.0, 1000.1], [np.nan, np.nan]])
    assert lost(result_of(np.zeros((3, 2)), error_m=errors), 1000.0).tolist() == [False, True, False]


def test_gospa_of_a_run_follows_what_is_reported() -> None:
    errors = np.array([[30.0, 30.0, 5000.0, 30.0], [np.nan] * 4])
    life = np.array([[TENTATIVE, CONFIRMED, CONFIRMED, DELETED], [TENTATIVE, CONFIRMED, DELETED, DELETED]])
    missed = 1000.0 / np.sqrt(2.0)
    np.testing.assert_allclose(
        gospa_per_scan(result_of(np.zeros((2, 4)), error_m=errors), life, 1000.0),
        [[missed, 30.0, 1000.0, missed], [0.0, missed, 0.0, 0.0]],
    )
