"""The step of the likelihood ratio: Eq. (10), Eq. (11), silence, members."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from waldnet.common.estimation import ratio
from waldnet.common.estimation.gaussian import Array, BoolArray, Gaussian, product

Draw: TypeAlias = Callable[..., Gaussian]

SHAPES = [(), (1,), (3, 1, 2)]
SEEDS = st.integers(0, 2**32 - 1)


def log_lambda(before: Gaussian, after: Gaussian, log_p_bar: Array, members: BoolArray | None = None) -> Array:
    """From factors; evidence of members alone."""
    evidence = log_p_bar if members is None else np.where(members, log_p_bar, 0.0)
    return ratio.log_lambda(product(before, members), product(after, members), evidence)


def log_c(factors: Gaussian) -> float:
    """Eq. (8), folded."""
    x, P, total = factors.x[0], factors.P[0], 0.0
    for x_s, P_s in zip(factors.x[1:], factors.P[1:], strict=True):
        total += float(multivariate_normal(x, P + P_s).logpdf(x_s))
        J, J_s = np.linalg.inv(P), np.linalg.inv(P_s)
        P = np.linalg.inv(J + J_s)
        x = P @ (J @ x + J_s @ x_s)
    return total


def replaced(factors: Gaussian, others: Gaussian, numbers: list[int]) -> Gaussian:
    x, P = factors.x.copy(), factors.P.copy()
    x[..., numbers, :], P[..., numbers, :, :] = others.x[..., numbers, :], others.P[..., numbers, :, :]
    return Gaussian(x, P)


@pytest.mark.parametrize("n_sensors", [1, 2, 5])
def test_equation_10_written_out(n_sensors: int, draw: Draw) -> None:
    rng = np.random.default_rng(n_sensors)
    before, after, log_p_bar = draw(rng, (n_sensors,), 4), draw(rng, (n_sensors,), 4), rng.normal(size=n_sensors)
    expected = log_c(after) - log_c(before) + log_p_bar.sum()
    assert log_lambda(before, after, log_p_bar) == pytest.approx(expected, rel=1e-10, abs=1e-10)


@given(n_sensors=st.integers(1, 6), seed=SEEDS)
@settings(max_examples=40, deadline=None)
def test_report_by_report_equals_all_at_once(n_sensors: int, seed: int, draw: Draw) -> None:
    """Eq. (11), in any order of the sensors, adds up to Eq. (10)."""
    rng = np.random.default_rng(seed)
    before, after = draw(rng, (n_sensors,), 4), draw(rng, (n_sensors,), 4)
    log_p_bar = rng.normal(0.0, 5.0, n_sensors)
    total, now = 0.0, before
    for number in rng.permutation(n_sensors):
        then = replaced(now, after, [int(number)])
        total += float(log_lambda(now, then, np.where(np.arange(n_sensors) == number, log_p_bar, 0.0)))
        now = then
    assert total == pytest.approx(float(log_lambda(before, after, log_p_bar)), rel=1e-9, abs=1e-9)


def test_silence_is_exactly_one(draw: Draw) -> None:
    before = draw(np.random.default_rng(1), (3, 4), 4)
    np.testing.assert_array_equal(log_lambda(before, before, np.zeros((3, 4))), np.zeros(3))


def test_a_silent_sensor_neither_helps_nor_hurts(draw: Draw) -> None:
    """Sensor 1 keeps its factor: only what the reporters change counts."""
    rng = np.random.default_rng(2)
    before, news = draw(rng, (3,), 4), draw(rng, (3,), 4)
    after = replaced(before, news, [0, 2])
    expected = log_c(after) - log_c(before) + 1.5 - 0.25
    assert log_lambda(before, after, np.array([1.5, 0.0, -0.25])) == pytest.approx(expected, rel=1e-10)


def test_those_who_are_no_members_do_not_count(draw: Draw) -> None:
    rng = np.random.default_rng(3)
    before, after, log_p_bar = draw(rng, (4,), 4), draw(rng, (4,), 4), rng.normal(size=4)
    members = np.array([False, True, True, False])
    expected = log_lambda(
        Gaussian(before.x[members], before.P[members]), Gaussian(after.x[members], after.P[members]), log_p_bar[members]
    )
    assert log_lambda(before, after, log_p_bar, members) == pytest.approx(float(expected), rel=1e-11)


def test_an_impossible_scan_refutes_the_track_but_only_if_a_member_says_so(draw: Draw) -> None:
    before, after = draw(np.random.default_rng(4), (2,), 4), draw(np.random.default_rng(5), (2,), 4)
    impossible = np.array([-np.inf, 0.0])
    assert log_lambda(before, after, impossible) == -np.inf
    assert np.isfinite(log_lambda(before, after, impossible, np.array([False, True])))


@given(shape=st.sampled_from(SHAPES), n_sensors=st.integers(1, 4), seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_a_batch_equals_the_loop(shape: tuple[int, ...], n_sensors: int, seed: int, draw: Draw) -> None:
    rng = np.random.default_rng(seed)
    before, after = draw(rng, (*shape, n_sensors), 4), draw(rng, (*shape, n_sensors), 4)
    log_p_bar, members = rng.normal(size=(*shape, n_sensors)), rng.random((*shape, n_sensors)) < 0.7
    members[..., 0] = True
    ours = log_lambda(before, after, log_p_bar, members)
    assert ours.shape == shape
    for row in np.ndindex(shape):
        there = Gaussian(before.x[row], before.P[row]), Gaussian(after.x[row], after.P[row])
        one = log_lambda(*there, log_p_bar[row], members[row])
        np.testing.assert_allclose(ours[row], one, rtol=1e-11, atol=1e-11)
