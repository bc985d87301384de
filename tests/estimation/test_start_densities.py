"""Densities that tracks start from, against the Kalman filter with a prior that says nothing of the position."""

import numpy as np
import pytest

from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.estimation.initiation import apart, from_plots, with_second
from waldnet.common.estimation.motion import ConstantAcceleration, ConstantVelocity
from waldnet.common.estimation.polar import Polar, PolarDoppler
from waldnet.common.estimation.sensing import Measurement, Position

STAND = np.array([300.0, -200.0])
SPREAD = np.array([15.0, 15.0])


def kalman(prior: Gaussian, z: np.ndarray, H: np.ndarray, R: np.ndarray, expected: np.ndarray) -> Gaussian:
    S = H @ prior.P @ H.T + R
    K = prior.P @ H.T @ np.linalg.inv(S)
    return Gaussian(prior.x + K @ (z - expected), prior.P - K @ S @ K.T)


def test_a_position_is_taken_over_with_its_noise() -> None:
    z = np.array([[1000.0, 2000.0], [-40.0, 7.0]])
    x, P = from_plots(z, Position((50.0, 30.0), 4), STAND, SPREAD)
    np.testing.assert_allclose(x, np.hstack([z, np.zeros((2, 2))]), atol=1e-9)
    np.testing.assert_allclose(P, np.repeat(np.diag([2500.0, 900.0, 225.0, 225.0])[None], 2, axis=0), rtol=1e-12)


def test_a_state_with_acceleration_has_its_spread() -> None:
    _, P = from_plots(np.zeros((1, 2)), Position((50.0, 30.0), 6), STAND, np.array([15.0, 15.0, 2.0, 2.0]))
    np.testing.assert_allclose(np.diag(P[0]), [2500.0, 900.0, 225.0, 225.0, 4.0, 4.0], rtol=1e-12)


@pytest.mark.parametrize("measurement", [Polar((40.0, 0.01), 4), PolarDoppler((40.0, 0.01, 0.5), 4, 100.0)])
def test_polar_plots_are_those_of_the_kalman_filter_that_knows_nothing_of_the_position(
    measurement: Measurement,
) -> None:
    truth = np.array([4000.0, 2500.0, -20.0, 10.0])
    z = measurement.observe(truth, STAND)
    found = from_plots(z[None], measurement, STAND, SPREAD)
    at = np.append(truth[:2], [0.0, 0.0])
    seen = measurement.linearise(Gaussian(at, np.diag([1e-6, 1e-6, 225.0, 225.0])), STAND)
    vague = Gaussian(at, np.diag([1e12, 1e12, 225.0, 225.0]))
    # The position that a plot tells of is exact, so that only the range rate differs from what was expected.
    x, P = kalman(vague, z, seen.H, seen.R, seen.z)
    np.testing.assert_allclose(found.x[0], x, atol=1e-3)
    np.testing.assert_allclose(found.P[0], P, rtol=1e-4, atol=1e-3)


def test_a_range_rate_tells_of_the_velocity_along_the_line_of_sight_only() -> None:
    measurement = PolarDoppler((40.0, 0.01, 0.5), 4, 100.0)
    z = np.array([[1000.0, 0.0, -12.0]])  # due north, approaching
    x, P = from_plots(z, measurement, np.zeros(2), SPREAD)
    assert x[0, 3] == pytest.approx(-12.0, rel=0.01)
    assert x[0, 2] == pytest.approx(0.0, abs=1e-6)
    assert np.sqrt(P[0, 2, 2]) == pytest.approx(15.0)
    assert np.sqrt(P[0, 3, 3]) < 0.6


@pytest.mark.parametrize("motion", [ConstantVelocity(2, 10.0), ConstantAcceleration(2, 1.0)])
def test_two_plots_are_two_steps_of_the_kalman_filter(motion: ConstantVelocity | ConstantAcceleration) -> None:
    measurement = Position((50.0, 30.0), motion.n)
    spread = np.array([15.0, 15.0, 2.0, 2.0])[: motion.n - 2]
    first = from_plots(np.array([[0.0, 0.0], [10.0, 10.0]]), measurement, STAND, spread)
    dt, z = np.array([2.0, 3.0]), np.array([[20.0, -15.0], [400.0, 0.0]])
    found, distance = with_second(first, dt, z, measurement, STAND, motion)
    for i in range(2):
        F, Q = motion.transition(dt[i]), motion.noise(dt[i])
        prior = Gaussian(F @ first.x[i], F @ first.P[i] @ F.T + Q)
        x, P = kalman(prior, z[i], measurement.H, measurement.R, prior.x[:2])
        nu, S = z[i] - prior.x[:2], measurement.H @ prior.P @ measurement.H.T + measurement.R
        np.testing.assert_allclose(found.x[i], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.P[i], P, rtol=1e-9, atol=1e-9)
        assert distance[i] == pytest.approx(nu @ np.linalg.inv(S) @ nu)


def test_no_plots_start_nothing() -> None:
    x, P = from_plots(np.empty((0, 2)), Position((50.0, 30.0), 4), STAND, SPREAD)
    assert (x.shape, P.shape) == ((0, 4), (0, 4, 4))


@pytest.mark.parametrize("spread", [300.0, 3000.0, 1e5])
def test_those_apart_are_what_one_after_the_other_finds(spread: float) -> None:
    rng = np.random.default_rng(round(spread))
    root = rng.normal(0.0, 60.0, (2, 80, 2, 2))
    (new, known), P = rng.uniform(-spread, spread, (2, 80, 2)), root @ root.mT + np.eye(2)
    x, covariances, expected = list(known), list(P[1]), []
    for own_x, own_P in zip(new, P[0], strict=True):
        nu, S = np.array(x) - own_x, np.array(covariances) + own_P
        free = bool((np.einsum("ki,kij,kj->k", nu, np.linalg.inv(S), nu) > 9.2).all())
        expected.append(free)
        if free:
            x.append(own_x)
            covariances.append(own_P)
    assert apart(Gaussian(new, P[0]), Gaussian(known, P[1]), 9.2).tolist() == expected
    assert apart(Gaussian(new[:0], P[0, :0]), Gaussian(known, P[1]), 9.2).shape == (0,)
    assert apart(Gaussian(new, P[0]), Gaussian(known[:0], P[1, :0]), 9.2).any()
