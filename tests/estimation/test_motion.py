"""Motion models against numeric integration, matrix exponentials, Stone Soup, their limits and themselves."""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from fractions import Fraction
from math import factorial
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.linalg import expm
from stonesoup.models.transition.linear import ConstantAcceleration as TheirConstantAcceleration
from stonesoup.models.transition.linear import KnownTurnRate

from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.motion import ConstantAcceleration, ConstantVelocity, CoordinatedTurn, Kinematic, predict

Draw: TypeAlias = Callable[..., Gaussian]

DIMENSIONS = [2, 3]
INTERVALS = st.floats(1e-6, 1e4)
MODELS = [
    model
    for d in DIMENSIONS
    for model in (
        ConstantVelocity(d, 7.0),
        ConstantAcceleration(d, 7.0),
        *(CoordinatedTurn(d, 7.0, rate) for rate in (0.0, 1e-9, -1e-5, 0.03, -0.4, 2.5)),
    )
]


def drift(model: Kinematic) -> Array:
    """A of ``dx = A x dt + dw``: each derivative drives the one before; a turn rotates the velocity."""
    A = np.eye(model.n, k=model.dimensions)
    if isinstance(model, CoordinatedTurn):
        east, north = model.dimensions, model.dimensions + 1
        A[north, east], A[east, north] = model.turn_rate, -model.turn_rate
    return A


def diffusion(model: Kinematic) -> Array:
    """Spectral density of dw: only the highest derivative is driven."""
    lower = model.n - model.dimensions
    return np.diag([0.0] * lower + [model.psd] * model.dimensions)


def van_loan(model: Kinematic, dt: float) -> tuple[Array, Array]:
    """F and Q from one matrix exponential (Van Loan 1978)."""
    A, n = drift(model), model.n
    M = expm(np.block([[-A, diffusion(model)], [np.zeros((n, n)), A.T]]) * dt)
    F: Array = M[n:, n:].T
    return F, F @ M[:n, n:]


def assert_close_in_units(ours: Array, expected: Array, model: Kinematic, dt: float, tolerance: float) -> None:
    """Every entry to a tolerance relative to its own scale: powers of dt differ by many orders of magnitude."""
    per_axis = dt ** (0.5 - np.arange(model.n // model.dimensions))
    scale = np.repeat(per_axis, model.dimensions) * dt ** (model.n // model.dimensions - 1)
    np.testing.assert_allclose(ours / np.outer(scale, scale), expected / np.outer(scale, scale), rtol=0, atol=tolerance)


@pytest.mark.parametrize("dimensions", DIMENSIONS)
def test_state_is_position_then_velocity_then_acceleration(dimensions: int) -> None:
    d = dimensions
    state = np.arange(1.0, 3 * d + 1.0)
    p, v, a = state[:d], state[d : 2 * d], state[2 * d :]
    cv, ca = ConstantVelocity(d, 1.0), ConstantAcceleration(d, 1.0)
    assert (cv.n, cv.dimensions, ca.n, ca.dimensions) == (2 * d, d, 3 * d, d)
    np.testing.assert_allclose(cv.transition(np.array(3.0)) @ state[: 2 * d], [*(p + 3.0 * v), *v])
    np.testing.assert_allclose(ca.transition(np.array(3.0)) @ state, [*(p + 3.0 * v + 4.5 * a), *(v + 3.0 * a), *a])


def test_a_turn_of_a_quarter_is_to_the_left_and_leaves_the_vertical_alone() -> None:
    """From east to north on a circle of radius speed / turn_rate, climbing straight."""
    model = CoordinatedTurn(3, 1.0, 0.1)
    turned = model.transition(np.array(np.pi / 2.0 / 0.1)) @ np.array([5.0, 6.0, 7.0, 30.0, 0.0, -2.0])
    seconds = np.pi / 0.2
    np.testing.assert_allclose(turned, [5.0 + 300.0, 6.0 + 300.0, 7.0 - 2.0 * seconds, 0.0, 30.0, -2.0], atol=1e-12)


@pytest.mark.parametrize("dt", [1e-3, 0.5, 4.0])
@pytest.mark.parametrize("model", MODELS, ids=str)
def test_noise_is_the_integral_of_what_drives_the_state(model: Kinematic, dt: float) -> None:
    A, G = drift(model), diffusion(model)
    integral, _ = quad_vec(lambda t: expm(A * t) @ G @ expm(A * t).T, 0.0, dt, epsrel=1e-12, epsabs=0.0)
    assert_close_in_units(model.noise(np.array(dt)), integral, model, dt, 1e-10)


@pytest.mark.parametrize("dt", [1e-3, 0.5, 2.0, 60.0])
@pytest.mark.parametrize("model", MODELS, ids=str)
def test_transition_and_noise_are_those_of_van_loan(model: Kinematic, dt: float) -> None:
    F, Q = van_loan(model, dt)
    np.testing.assert_allclose(model.transition(np.array(dt)), F, rtol=1e-10, atol=1e-12)
    # Beyond some turns the exponential itself has lost digits: F and Q there are what the integral says.
    assert_close_in_units(model.noise(np.array(dt)), Q, model, dt, 1e-10)


@given(
    dt1=INTERVALS,
    dt2=INTERVALS,
    dimensions=st.sampled_from(DIMENSIONS),
    psd=st.sampled_from([0.0, 1e-6, 10.0, 1e4]),
    acceleration=st.booleans(),
)
@settings(max_examples=100, deadline=None)
def test_two_intervals_compose_to_their_sum(
    dt1: float, dt2: float, dimensions: int, psd: float, acceleration: bool
) -> None:
    model = (ConstantAcceleration if acceleration else ConstantVelocity)(dimensions, psd)
    F1, F2, F = (model.transition(np.array(dt)) for dt in (dt1, dt2, dt1 + dt2))
    Q1, Q2, Q = (model.noise(np.array(dt)) for dt in (dt1, dt2, dt1 + dt2))
    np.testing.assert_allclose(F2 @ F1, F, rtol=1e-13)
    np.testing.assert_allclose(F2 @ Q1 @ F2.T + Q2, Q, rtol=1e-12)


@given(
    dt1=st.floats(1e-6, 100.0),
    dt2=st.floats(1e-6, 100.0),
    dimensions=st.sampled_from(DIMENSIONS),
    turn_rate=st.floats(-3.0, 3.0) | st.floats(-1e-3, 1e-3),
)
@settings(max_examples=200, deadline=None)
def test_two_turns_compose_to_their_sum(dt1: float, dt2: float, dimensions: int, turn_rate: float) -> None:
    model, dt = CoordinatedTurn(dimensions, 5.0, turn_rate), dt1 + dt2
    F1, F2, F = (model.transition(np.array(dt)) for dt in (dt1, dt2, dt))
    Q1, Q2, Q = (model.noise(np.array(dt)) for dt in (dt1, dt2, dt))
    np.testing.assert_allclose(F2 @ F1, F, rtol=1e-12, atol=1e-12 * (1.0 + dt))
    assert_close_in_units(F2 @ Q1 @ F2.T + Q2, Q, model, dt, 1e-11)


def alternating(t: Fraction, first: int) -> float:
    """``sum_k (-1)^k t^(2k) / (2k + first)!``: sin t / t, (1 - cos t) / t^2, (t - sin t) / t^3 for 1, 2, 3."""
    terms = 5 if t < 1e-2 else 70
    return float(sum((-(t**2)) ** k / factorial(2 * k + first) for k in range(terms)))


@pytest.mark.parametrize("theta", [0.0, 1e-30, 1e-12, 1e-6, 1e-3, 0.1, 0.5, 0.999999, 1.0, 1.000001, 3.0, 30.0])
def test_turns_of_any_size_keep_all_digits(theta: float) -> None:
    """Against exact rational series, entry by entry: where sin and cos cancel nothing is lost, down to CV."""
    dt, q = 2.0, 3.0
    model = CoordinatedTurn(2, q, theta / dt)
    F, Q = model.transition(np.array(dt)), model.noise(np.array(dt))
    t = Fraction(model.turn_rate) * Fraction(dt)
    along, across = dt * alternating(t, 1), dt * float(t) * alternating(t, 2)
    pp, pv = 2 * q * dt**3 * alternating(t, 3), q * dt**2 * alternating(t, 2)
    skew = q * dt**2 * float(t) * alternating(t, 3)
    tolerance = {"rtol": 1e-14 * max(1.0, theta), "atol": 0.0}
    np.testing.assert_allclose(F[:2, 2:], [[along, -across], [across, along]], **tolerance)
    np.testing.assert_allclose(Q[:2, :2], pp * np.eye(2), **tolerance)
    np.testing.assert_allclose(Q[:2, 2:], [[pv, skew], [-skew, pv]], **tolerance)
    np.testing.assert_array_equal(Q, Q.T)


@pytest.mark.parametrize("dimensions", DIMENSIONS)
def test_no_turn_is_constant_velocity(dimensions: int) -> None:
    dt = np.array([0.0, 1e-3, 2.0, 300.0])
    straight, turn = ConstantVelocity(dimensions, 4.0), CoordinatedTurn(dimensions, 4.0, 0.0)
    np.testing.assert_allclose(turn.transition(dt), straight.transition(dt), rtol=1e-15)
    np.testing.assert_allclose(turn.noise(dt), straight.noise(dt), rtol=1e-15)


def test_stone_soup_moves_alike() -> None:
    """Acceleration with its noise; of a turn only F: their noise is not the integral over the turn."""
    dt = 2.5
    axis = TheirConstantAcceleration(3.0)
    pick = np.ix_([0, 2, 4], [0, 2, 4])
    ours = ConstantAcceleration(2, 3.0)
    interval = timedelta(seconds=dt)
    np.testing.assert_allclose(ours.transition(np.array(dt))[pick], axis.matrix(time_interval=interval), rtol=1e-14)
    np.testing.assert_allclose(ours.noise(np.array(dt))[pick], axis.covar(time_interval=interval), rtol=1e-14)
    theirs = KnownTurnRate(turn_noise_diff_coeffs=(1.0, 1.0), turn_rate=-0.3).matrix(time_interval=interval)
    order = [0, 2, 1, 3]
    F = CoordinatedTurn(2, 1.0, -0.3).transition(np.array(dt))
    np.testing.assert_allclose(F, np.asarray(theirs, np.float64)[np.ix_(order, order)], rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_no_time_no_motion(model: Kinematic) -> None:
    np.testing.assert_array_equal(model.transition(np.array(0.0)), np.eye(model.n))
    np.testing.assert_array_equal(model.noise(np.array(0.0)), np.zeros((model.n, model.n)))


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2), (0,)])
@pytest.mark.parametrize("model", MODELS, ids=str)
def test_a_batch_of_intervals_equals_the_loop(model: Kinematic, shape: tuple[int, ...]) -> None:
    dt = np.asarray(np.random.default_rng(1).uniform(0.1, 9.0, size=shape))
    F, Q = model.transition(dt), model.noise(dt)
    assert F.shape == Q.shape == (*shape, model.n, model.n)
    for row in np.ndindex(shape):
        one = np.array(dt[row])
        np.testing.assert_allclose(F[row], model.transition(one), rtol=1e-14, atol=1e-15)
        np.testing.assert_allclose(Q[row], model.noise(one), rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2)])
@pytest.mark.parametrize("model", MODELS[::3], ids=str)
def test_predict_equals_the_loop(model: Kinematic, shape: tuple[int, ...], draw: Draw) -> None:
    rng = np.random.default_rng(2)
    prior, dt = draw(rng, shape, model.n), np.asarray(rng.uniform(0.1, 9.0, size=shape))
    ours = predict(prior, model.transition(dt), model.noise(dt))
    for row in np.ndindex(shape):
        F, Q = van_loan(model, float(dt[row]))
        np.testing.assert_allclose(ours.x[row], F @ prior.x[row], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(ours.P[row], F @ prior.P[row] @ F.T + Q, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(ours.P, ours.P.mT)


def test_predict_broadcasts_one_interval_over_all_tracks(draw: Draw) -> None:
    model, prior, dt = ConstantVelocity(2, 3.0), draw(np.random.default_rng(3), (5,), 4), np.array([2.0])
    ours = predict(prior, model.transition(dt), model.noise(dt))
    for row in range(5):
        one = predict(Gaussian(prior.x[row], prior.P[row]), model.transition(dt[0]), model.noise(dt[0]))
        np.testing.assert_allclose(ours.x[row], one.x, rtol=1e-14)
        np.testing.assert_allclose(ours.P[row], one.P, rtol=1e-13, atol=1e-13)
