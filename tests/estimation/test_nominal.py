"""The one model that stands for several: limit of their averages, composition; and the average itself."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import TypeAlias

import numpy as np
import pytest

from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.estimation.imm import Imm, predict_stationary
from waldnet.common.estimation.motion import ConstantAcceleration, ConstantVelocity, CoordinatedTurn, predict

Draw: TypeAlias = Callable[..., Gaussian]

FAMILIES = {
    "psd": Imm.of((ConstantVelocity(2, 0.5), ConstantVelocity(2, 40.0)), 30.0),
    "turns": Imm.of((ConstantVelocity(2, 0.5), CoordinatedTurn(2, 1.0, 0.15), CoordinatedTurn(2, 1.0, -0.15)), 12.0),
    "acceleration": Imm.of((ConstantAcceleration(2, 0.1), ConstantAcceleration(2, 5.0)), 20.0),
    "space": Imm.of((ConstantVelocity(3, 1.0), CoordinatedTurn(3, 1.0, 0.1)), 15.0),
}


@pytest.mark.parametrize("imm", FAMILIES.values(), ids=FAMILIES)
def test_the_nominal_model_is_the_average_over_ever_shorter_intervals(imm: Imm, draw: Draw) -> None:
    """The difference halves when the intervals do."""
    prior, dt = draw(np.random.default_rng(1), (), imm.n, 5.0), 4.0
    whole = predict(prior, imm.transition(np.array(dt)), imm.noise(np.array(dt)))
    errors = []
    for steps in (50, 100):
        stepwise = prior
        for _ in range(steps):
            stepwise = predict_stationary(stepwise, imm, np.array(dt / steps))
        scale = np.sqrt(whole.P.diagonal())
        difference = np.abs(stepwise.P - whole.P) / np.outer(scale, scale)
        errors.append([np.abs((stepwise.x - whole.x) / scale).max(), difference.max()])
    assert (np.array(errors[1]) <= 0.6 * np.array(errors[0]) + 1e-12).all()
    assert np.max(errors[1]) < 0.01


@pytest.mark.parametrize("imm", FAMILIES.values(), ids=FAMILIES)
def test_the_nominal_model_composes(imm: Imm) -> None:
    assert (imm.n, imm.dimensions) == (imm.nominal.n, imm.nominal.dimensions)
    F1, F2, F = (imm.transition(np.array(dt)) for dt in (0.7, 2.9, 3.6))
    Q1, Q2, Q = (imm.noise(np.array(dt)) for dt in (0.7, 2.9, 3.6))
    np.testing.assert_allclose(F2 @ F1, F, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(F2 @ Q1 @ F2.T + Q2, Q, rtol=1e-12, atol=1e-12)


def test_nominal_models() -> None:
    assert FAMILIES["psd"].nominal == ConstantVelocity(2, 20.25)
    assert FAMILIES["turns"].nominal == ConstantVelocity(2, 2.5 / 3.0)
    assert FAMILIES["acceleration"].nominal == ConstantAcceleration(2, 2.55)
    assert Imm.of(FAMILIES["turns"].models, 12.0, 70.0).nominal == ConstantVelocity(2, 70.0)
    assert Imm.of(FAMILIES["acceleration"].models, 12.0, 0.0).nominal == ConstantAcceleration(2, 0.0)
    assert FAMILIES["space"].nominal == CoordinatedTurn(3, 1.0, 0.05)


def test_stationary_prediction_of_models_that_differ_in_noise_only_is_the_nominal_one(draw: Draw) -> None:
    imm, prior, dt = FAMILIES["psd"], draw(np.random.default_rng(1), (4,), 4), np.array([0.1, 1.0, 5.0, 60.0])
    ours, nominal = predict_stationary(prior, imm, dt), predict(prior, imm.transition(dt), imm.noise(dt))
    np.testing.assert_allclose(ours.x, nominal.x, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(ours.P, nominal.P, rtol=1e-12)


def test_stationary_prediction_has_the_moments_of_samples(draw: Draw) -> None:
    """A million samples; every moment within 5 of its standard errors."""
    rng, size, dt = np.random.default_rng(1), 1_000_000, np.array(3.0)
    prior = draw(rng, (), 4, 2.0)
    ours = predict_stationary(prior, FAMILIES["turns"], dt)
    x = rng.multivariate_normal(prior.x, prior.P, size)
    mode = rng.integers(3, size=size)
    for i, model in enumerate(FAMILIES["turns"].models):
        of = mode == i
        noise = rng.multivariate_normal(np.zeros(4), model.noise(dt), int(of.sum()))
        x[of] = x[of] @ model.transition(dt).T + noise
    deviation = x - ours.x
    assert (np.abs(deviation.mean(axis=0)) < 5.0 * np.sqrt(ours.P.diagonal() / size)).all()
    for i, j in product(range(4), repeat=2):
        products = deviation[:, i] * deviation[:, j]
        assert abs(products.mean() - ours.P[i, j]) < 5.0 * products.std() / np.sqrt(size)
