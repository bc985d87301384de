"""Constant velocity against numeric integration, matrix exponentials and itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.linalg import block_diag, expm

from common.estimation.gaussian import Array, Gaussian
from common.estimation.motion import ConstantVelocity, predict

Draw: TypeAlias = Callable[..., Gaussian]

DIMENSIONS = [2, 3]
INTERVALS = st.floats(1e-6, 1e4)


def drift(dimensions: int) -> Array:
    """A of ``dx = A x dt + dw``."""
    return np.eye(2 * dimensions, k=dimensions)


def van_loan(dimensions: int, psd: float, dt: float) -> tuple[Array, Array]:
    """F and Q from one matrix exponential (Van Loan 1978)."""
    A, n = drift(dimensions), 2 * dimensions
    M = expm(np.block([[-A, diffusion(dimensions, psd)], [np.zeros((n, n)), A.T]]) * dt)
    F: Array = M[n:, n:].T
    return F, F @ M[:n, n:]


def diffusion(dimensions: int, psd: float) -> Array:
    """Spectral density of dw: only the velocities are driven."""
    return block_diag(np.zeros((dimensions, dimensions)), psd * np.eye(dimensions))


@pytest.mark.parametrize("dimensions", DIMENSIONS)
def test_state_is_position_then_velocity(dimensions: int) -> None:
    model = ConstantVelocity(dimensions, 1.0)
    state = np.arange(1.0, 2 * dimensions + 1.0)
    expected = [*(state[:dimensions] + 3.0 * state[dimensions:]), *state[dimensions:]]
    assert (model.n, model.dimensions) == (2 * dimensions, dimensions)
    np.testing.assert_allclose(model.transition(np.array(3.0)) @ state, expected)


@pytest.mark.parametrize("dt", [1e-3, 0.5, 2.0, 60.0])
@pytest.mark.parametrize("dimensions", DIMENSIONS)
def test_noise_is_the_integral_of_white_acceleration(dimensions: int, dt: float) -> None:
    A, G = drift(dimensions), diffusion(dimensions, 7.0)
    eye = np.eye(2 * dimensions)
    integral, _ = quad_vec(lambda tau: (eye + A * tau) @ G @ (eye + A * tau).T, 0.0, dt, epsrel=1e-12, epsabs=0.0)
    model = ConstantVelocity(dimensions, 7.0)
    np.testing.assert_allclose(model.noise(np.array(dt)), integral, rtol=1e-11, atol=1e-13 * dt**3)
    np.testing.assert_allclose(model.transition(np.array(dt)), expm(A * dt), rtol=1e-12)


@given(
    dt1=INTERVALS, dt2=INTERVALS, dimensions=st.sampled_from(DIMENSIONS), psd=st.sampled_from([0.0, 1e-6, 10.0, 1e4])
)
@settings(max_examples=50, deadline=None)
def test_two_intervals_compose_to_their_sum(dt1: float, dt2: float, dimensions: int, psd: float) -> None:
    model = ConstantVelocity(dimensions, psd)
    F1, F2, F = (model.transition(np.array(dt)) for dt in (dt1, dt2, dt1 + dt2))
    Q1, Q2, Q = (model.noise(np.array(dt)) for dt in (dt1, dt2, dt1 + dt2))
    np.testing.assert_allclose(F2 @ F1, F, rtol=1e-13)
    np.testing.assert_allclose(F2 @ Q1 @ F2.T + Q2, Q, rtol=1e-12)


@pytest.mark.parametrize("dimensions", DIMENSIONS)
def test_no_time_no_motion(dimensions: int) -> None:
    model = ConstantVelocity(dimensions, 5.0)
    np.testing.assert_array_equal(model.transition(np.array(0.0)), np.eye(2 * dimensions))
    np.testing.assert_array_equal(model.noise(np.array(0.0)), np.zeros((2 * dimensions, 2 * dimensions)))


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2), (0,)])
@pytest.mark.parametrize("dimensions", DIMENSIONS)
def test_a_batch_of_intervals_equals_the_loop(dimensions: int, shape: tuple[int, ...]) -> None:
    model = ConstantVelocity(dimensions, 2.0)
    dt = np.random.default_rng(1).uniform(0.1, 9.0, size=shape)
    dt = np.asarray(dt)
    F, Q = model.transition(dt), model.noise(dt)
    assert F.shape == Q.shape == (*shape, 2 * dimensions, 2 * dimensions)
    for row in np.ndindex(shape):
        one = np.array(dt[row])
        np.testing.assert_array_equal(F[row], model.transition(one))
        np.testing.assert_array_equal(Q[row], model.noise(one))


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2)])
def test_predict_equals_the_loop(shape: tuple[int, ...], draw: Draw) -> None:
    rng = np.random.default_rng(2)
    model, prior, dt = ConstantVelocity(2, 3.0), draw(rng, shape, 4), np.asarray(rng.uniform(0.1, 9.0, size=shape))
    ours = predict(prior, model.transition(dt), model.noise(dt))
    for row in np.ndindex(shape):
        F, Q = van_loan(2, 3.0, float(dt[row]))
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
