"""Shares and globalisation: what the product of the factors is before and after (theory.md §4)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.motion import ConstantVelocity
from waldnet.common.estimation.representation import Share, globalise, shrink

Draw: TypeAlias = Callable[..., Gaussian]

SHAPES = [(), (1,), (3, 1, 2)]
MOTION = ConstantVelocity(2, 4.0)
DT = np.array(2.5)


def information_sum(factors: Gaussian) -> tuple[Array, Array]:
    """Eq. (9)."""
    J = np.linalg.inv(factors.P)
    P = np.linalg.inv(J.sum(axis=0))
    return P @ np.einsum("sij,sj->i", J, factors.x), P


def stacked(factor: Gaussian, count: int) -> Gaussian:
    return Gaussian(np.stack([factor.x] * count), np.stack([factor.P] * count))


@pytest.mark.parametrize("n_sensors", [1, 2, 5, 32])
def test_the_factors_of_a_new_track_multiply_to_its_prior(n_sensors: int, draw: Draw) -> None:
    prior = draw(np.random.default_rng(n_sensors), (), 4, 100.0)
    x, P = information_sum(stacked(Share(float(n_sensors)).start(prior), n_sensors))
    np.testing.assert_allclose(x, prior.x, rtol=1e-9)
    np.testing.assert_allclose(P, prior.P, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("n_sensors", [2, 5])
def test_equal_factors_predict_to_the_predicted_product(n_sensors: int, draw: Draw) -> None:
    prior = draw(np.random.default_rng(n_sensors), (), 4, 100.0)
    share = Share(float(n_sensors))
    x, P = information_sum(stacked(share.predict(share.start(prior), MOTION, DT), n_sensors))
    F, Q = MOTION.transition(DT), MOTION.noise(DT)
    np.testing.assert_allclose(x, F @ prior.x, rtol=1e-9)
    np.testing.assert_allclose(P, F @ prior.P @ F.T + Q, rtol=1e-9, atol=1e-9)


def test_a_share_of_one_is_the_plain_kalman_prediction(draw: Draw) -> None:
    prior = draw(np.random.default_rng(1), (), 4)
    share = Share(1.0)
    np.testing.assert_array_equal(share.start(prior).P, prior.P)
    F, Q = MOTION.transition(DT), MOTION.noise(DT)
    ours = share.predict(prior, MOTION, DT)
    np.testing.assert_allclose(ours.x, F @ prior.x, rtol=1e-12)
    np.testing.assert_allclose(ours.P, F @ prior.P @ F.T + Q, rtol=1e-12)


@pytest.mark.parametrize("share", [1.0, 3.0])
def test_predicting_in_one_step_or_in_many_is_the_same(share: float, draw: Draw) -> None:
    factor = draw(np.random.default_rng(2), (), 4)
    many = factor
    for dt in (0.5, 1.25, 0.25, 0.5):
        many = Share(share).predict(many, MOTION, np.array(dt))
    once = Share(share).predict(factor, MOTION, DT)
    np.testing.assert_allclose(many.x, once.x, rtol=1e-12)
    np.testing.assert_allclose(many.P, once.P, rtol=1e-12)


def test_globalised_factors_have_one_covariance_and_the_same_product(draw: Draw) -> None:
    factors = draw(np.random.default_rng(3), (4,), 4, 30.0)
    common = globalise(factors.P)
    expected = 4.0 * np.linalg.inv(np.linalg.inv(factors.P).sum(axis=0))
    np.testing.assert_allclose(common.P, expected, rtol=1e-9, atol=1e-9)
    for G, x, P in zip(common.G, *factors, strict=True):
        np.testing.assert_allclose(G @ x, expected @ np.linalg.inv(P) @ x, rtol=1e-9, atol=1e-9)
    x, P = information_sum(Gaussian(np.matvec(common.G, factors.x), np.stack([common.P] * 4)))
    x_before, P_before = information_sum(factors)
    np.testing.assert_allclose(x, x_before, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(P, P_before, rtol=1e-9, atol=1e-9)


def test_only_globalised_factors_predict_exactly(draw: Draw) -> None:
    """The relaxed evolution of unequal factors drops an integral; with one covariance for all it does not."""
    factors, F, Q = draw(np.random.default_rng(4), (3,), 4), MOTION.transition(DT), MOTION.noise(DT)
    x, P = information_sum(factors)
    common = globalise(factors.P)
    equal = Gaussian(np.matvec(common.G, factors.x), np.stack([common.P] * 3))
    x_dkf, P_dkf = information_sum(Share(3.0).predict(equal, MOTION, DT))
    np.testing.assert_allclose(x_dkf, F @ x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(P_dkf, F @ P @ F.T + Q, rtol=1e-9)
    _, P_federated = information_sum(Share(3.0).predict(factors, MOTION, DT))
    assert np.abs(P_federated - P_dkf).max() > 0.1


@pytest.mark.parametrize("sigma", [(50.0, 20.0), (1.0, 1e3)])
def test_shrink_is_the_covariance_of_a_kalman_update(sigma: tuple[float, float], draw: Draw) -> None:
    P, H, R = draw(np.random.default_rng(5), (), 4, 100.0).P, np.eye(2, 4), np.diag(np.square(sigma))
    information_form = np.linalg.inv(np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H)
    np.testing.assert_allclose(shrink(P, H, R), information_form, rtol=1e-8, atol=1e-8)


@given(shape=st.sampled_from(SHAPES), n_sensors=st.integers(1, 4), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_a_batch_equals_the_loop(shape: tuple[int, ...], n_sensors: int, seed: int, draw: Draw) -> None:
    rng = np.random.default_rng(seed)
    P, dt = draw(rng, (*shape, n_sensors), 4).P, np.asarray(rng.uniform(0.1, 9.0, size=shape))
    factor, share, H, R = draw(rng, shape, 4), Share(float(n_sensors)), np.eye(2, 4), np.diag([0.5, 2.0])
    common, predicted, shrunk = globalise(P), share.predict(factor, MOTION, dt), shrink(factor.P, H, R)
    assert common.P.shape == predicted.P.shape == shrunk.shape == (*shape, 4, 4)
    for row in np.ndindex(shape):
        one = globalise(P[row])
        np.testing.assert_allclose(common.P[row], one.P, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(common.G[row], one.G, rtol=1e-10, atol=1e-10)
        alone = share.predict(Gaussian(factor.x[row], factor.P[row]), MOTION, np.array(dt[row]))
        np.testing.assert_allclose(predicted.x[row], alone.x, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(predicted.P[row], alone.P, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(shrunk[row], shrink(factor.P[row], H, R), rtol=1e-12, atol=1e-12)
