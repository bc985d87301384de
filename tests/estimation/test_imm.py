"""The interacting multiple model against a textbook loop, enumeration, its limits; batches against loops."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.stats import multivariate_normal

from waldnet.common.estimation.association import Clutter, Plots, pdaf
from waldnet.common.estimation.gaussian import Array, Gaussian, moments
from waldnet.common.estimation.imm import (
    FilteredModes,
    Imm,
    Modes,
    imm_pdaf,
    merge,
    mix,
    mix_log,
    predict_models,
    predict_modes,
    start,
)
from waldnet.common.estimation.motion import ConstantAcceleration, ConstantVelocity, CoordinatedTurn, Kinematic, predict
from waldnet.common.estimation.sensing import Position

Draw: TypeAlias = Callable[..., Gaussian]

NOWHERE = np.zeros(2)
SHAPES = [(), (1,), (3, 1, 2)]
CV, FAST = ConstantVelocity(2, 0.5), ConstantVelocity(2, 40.0)
LEFT, RIGHT = CoordinatedTurn(2, 1.0, 0.15), CoordinatedTurn(2, 1.0, -0.15)
THREE = Imm.of((CV, LEFT, RIGHT), 12.0)
FAMILIES = {
    "psd": Imm.of((CV, FAST), 30.0),
    "turns": THREE,
    "acceleration": Imm.of((ConstantAcceleration(2, 0.1), ConstantAcceleration(2, 5.0)), 20.0),
    "four": Imm.of((CV, FAST, LEFT, RIGHT), 5.0),
    "space": Imm.of((ConstantVelocity(3, 1.0), CoordinatedTurn(3, 1.0, 0.1)), 15.0),
}


def clutter(p_d: float, rho_f: float = 1e-3, p_g: float = 1.0) -> Clutter:
    return Clutter(np.array(p_d), np.array(np.log(rho_f)), p_g)


def scan(modes: Modes, z: Array, conditions: Clutter, sensor: Position) -> FilteredModes:
    return imm_pdaf(modes, Plots(z), sensor.linearise(modes.densities, NOWHERE), conditions)


def some_modes(draw: Draw, rng: np.random.Generator, shape: tuple[int, ...], imm: Imm, spread: float = 3.0) -> Modes:
    r = len(imm.models)
    mu = rng.dirichlet(np.ones(r), shape)
    return Modes(np.log(mu), draw(rng, (*shape, r), imm.n, spread))


# Models and chain -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("models", "sojourn", "fault"),
    [
        ((), 1.0, "at least one model is needed, and all must share one state"),
        ((CV, ConstantAcceleration(2, 1.0)), 1.0, "at least one model is needed, and all must share one state"),
        # Six numbers each, but other ones.
        ((ConstantVelocity(3, 1.0), ConstantAcceleration(2, 1.0)), 1.0, "all must share one state"),
        ((CV, FAST), 0.0, "sojourn = 0.0: is not positive"),
        ((CV, FAST), np.nan, "sojourn = nan: is not positive"),
    ],
)
def test_models_that_do_not_mix(models: tuple[Kinematic, ...], sojourn: float, fault: str) -> None:
    with pytest.raises(ValueError, match=re.escape(fault) + "$"):
        Imm.of(models, sojourn)


@pytest.mark.parametrize("dt", [0.0, 1e-9, 0.3, 2.0, 50.0, 1e6])
@pytest.mark.parametrize("r", [1, 2, 3, 5])
def test_the_chain_is_the_exponential_of_its_generator(r: int, dt: float) -> None:
    imm = Imm.of((CV,) * r, 12.0)
    generator = np.full((r, r), 1.0 / 12.0 / max(r - 1, 1))
    np.fill_diagonal(generator, -1.0 / 12.0 if r > 1 else 0.0)
    ours = imm.mode_transition(np.array(dt))
    np.testing.assert_allclose(ours, expm(generator * dt), rtol=1e-9, atol=1e-16)
    np.testing.assert_allclose(ours.sum(axis=-1), 1.0, rtol=1e-15)


@pytest.mark.parametrize("shape", [*SHAPES, (0,)])
def test_chains_over_two_intervals_compose_and_batch(shape: tuple[int, ...]) -> None:
    dt = np.asarray(np.random.default_rng(1).uniform(0.0, 30.0, (2, *shape)))
    first, second, both = (THREE.mode_transition(t) for t in (dt[0], dt[1], dt[0] + dt[1]))
    assert both.shape == (*shape, 3, 3)
    np.testing.assert_allclose(first @ second, both, rtol=1e-13)
    for row in np.ndindex(shape):
        np.testing.assert_allclose(first[row], THREE.mode_transition(np.array(dt[0][row])), rtol=1e-14)


# Textbook -------------------------------------------------------------------------------------------------------------


class Book(NamedTuple):
    """The loop's modes: mu, x, P by mode; merged x, P; weight sum."""

    mu: list[float]
    x: list[Array]
    P: list[Array]
    merged_x: Array
    merged_P: Array
    p_bar: float


def book_pdaf(x: Array, P: Array, zs: Array, conditions: Clutter, sensor: Position) -> tuple[Array, Array, float]:
    """One PDAF as Bar-Shalom, Daum & Huang print it: K, beta_0, spread of the innovations."""
    H, p_d, rho = sensor.H, float(conditions.p_d), float(np.exp(conditions.log_rho_f))
    S = H @ P @ H.T + sensor.R
    weights = [p_d / rho * multivariate_normal(H @ x, S).pdf(z) for z in zs]
    p_bar = 1.0 - p_d + sum(weights)
    betas = [weight / p_bar for weight in weights]
    beta_0 = (1.0 - p_d) / p_bar
    K = P @ H.T @ np.linalg.inv(S)
    nus = [z - H @ x for z in zs]
    nu = sum((beta * v for beta, v in zip(betas, nus, strict=True)), np.zeros(len(S)))
    spread = sum((b * np.outer(v, v) for b, v in zip(betas, nus, strict=True)), np.zeros_like(S)) - np.outer(nu, nu)
    certain = P - K @ S @ K.T
    return x + K @ nu, beta_0 * P + (1.0 - beta_0) * certain + K @ spread @ K.T, p_bar


def book_imm(book: Book, imm: Imm, dt: float, zs: Array, conditions: Clutter, sensor: Position) -> Book:
    """One cycle, Bar-Shalom, Li & Kirubarajan §11.6.6, steps 1 to 5, with PDAF in place of Kalman filters."""
    r = len(imm.models)
    leave = 1.0 / imm.sojourn
    generator = np.array([[-leave if i == j else leave / (r - 1) for j in range(r)] for i in range(r)])
    p = expm(generator * dt)
    c = [sum(p[i, j] * book.mu[i] for i in range(r)) for j in range(r)]
    xs, Ps, likelihoods = [], [], []
    for j in range(r):
        mixing = [p[i, j] * book.mu[i] / c[j] for i in range(r)]
        x0 = sum((mixing[i] * book.x[i] for i in range(r)), np.zeros(imm.n))
        P0 = np.zeros((imm.n, imm.n))
        for i in range(r):
            d = book.x[i] - x0
            P0 = P0 + mixing[i] * (book.P[i] + np.outer(d, d))
        F, Q = imm.models[j].transition(np.array(dt)), imm.models[j].noise(np.array(dt))
        x, P, likelihood = book_pdaf(F @ x0, F @ P0 @ F.T + Q, zs, conditions, sensor)
        xs.append(x)
        Ps.append(P)
        likelihoods.append(likelihood)
    total = sum(c[j] * likelihoods[j] for j in range(r))
    mu = [c[j] * likelihoods[j] / total for j in range(r)]
    merged_x = sum((mu[j] * xs[j] for j in range(r)), np.zeros(imm.n))
    merged_P = np.zeros((imm.n, imm.n))
    for j in range(r):
        d = xs[j] - merged_x
        merged_P = merged_P + mu[j] * (Ps[j] + np.outer(d, d))
    return Book(mu, xs, Ps, merged_x, merged_P, total)


@pytest.mark.parametrize("p_d", [0.4, 0.95, 1.0])
@pytest.mark.parametrize("imm", FAMILIES.values(), ids=FAMILIES)
def test_cycles_equal_the_textbook(imm: Imm, p_d: float, draw: Draw) -> None:
    rng, sensor = np.random.default_rng([len(imm.models), int(10 * p_d)]), Position((2.0,) * imm.dimensions, imm.n)
    conditions = clutter(p_d, 1e-3)
    modes = some_modes(draw, rng, (), imm)
    book = Book(list(np.exp(modes.log_mu)), list(modes.densities.x), list(modes.densities.P), NOWHERE, NOWHERE, 0.0)
    for dt, count in ((2.0, 3), (0.4, 1), (6.0, 5), (1.0, 0 if p_d < 1.0 else 2)):
        predicted = predict_modes(modes, imm, np.array(dt))
        zs = predicted.merged.x[: imm.dimensions] + rng.normal(0.0, 6.0, (count, imm.dimensions))
        filtered = scan(predicted, zs, conditions, sensor)
        book = book_imm(book, imm, dt, zs, conditions, sensor)
        modes = filtered.modes
        np.testing.assert_allclose(np.exp(modes.log_mu), book.mu, rtol=1e-10)
        np.testing.assert_allclose(modes.densities.x, book.x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(modes.densities.P, book.P, rtol=1e-10, atol=1e-9)
        np.testing.assert_allclose(filtered.log_p_bar, np.log(book.p_bar), rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(modes.merged.x, book.merged_x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(modes.merged.P, book.merged_P, rtol=1e-10, atol=1e-9)


# Limits ---------------------------------------------------------------------------------------------------------------


def plain(
    prior: Gaussian, model: Kinematic, dts: Array, scans: list[Array], conditions: Clutter
) -> tuple[Gaussian, float]:
    """PDAF with a single model: the last density, the sum of log p_bar."""
    sensor, total = Position((2.0, 3.0), model.n), 0.0
    for dt, zs in zip(dts, scans, strict=True):
        predicted = predict(prior, model.transition(dt), model.noise(dt))
        filtered = pdaf(predicted, Plots(zs), sensor.linearise(predicted, NOWHERE), conditions)
        prior, total = filtered.density, total + float(filtered.log_p_bar)
    return prior, total


def in_modes(modes: Modes, imm: Imm, dts: Array, scans: list[Array], conditions: Clutter) -> tuple[Modes, float]:
    """The same with the IMM."""
    sensor, total = Position((2.0, 3.0), imm.n), 0.0
    for dt, zs in zip(dts, scans, strict=True):
        filtered = scan(predict_modes(modes, imm, dt), zs, conditions, sensor)
        modes, total = filtered.modes, total + float(filtered.log_p_bar)
    return modes, total


@pytest.mark.parametrize("copies", [1, 2, 4])
@pytest.mark.parametrize("model", [CV, LEFT], ids=["cv", "ct"])
@pytest.mark.parametrize("p_d", [0.6, 1.0])
def test_equal_models_are_the_plain_filter(copies: int, model: Kinematic, p_d: float, draw: Draw) -> None:
    """From any probabilities of the modes: with one, or several equal models, IMM-PDAF is the PDAF."""
    rng = np.random.default_rng(copies)
    prior, dts = draw(rng, (), 4, 5.0), np.array([1.0, 0.5, 3.0, 1.0, 2.0])
    scans = [rng.normal(0.0, 8.0, (count, 2)) for count in (2, 1, 4, 3, 1)]
    imm = Imm.of((model,) * copies, 8.0)
    modes = start(prior, imm)._replace(log_mu=np.log(rng.dirichlet(np.ones(copies))))
    density, total = plain(prior, model, dts, scans, clutter(p_d))
    ours, our_total = in_modes(modes, imm, dts, scans, clutter(p_d))
    assert our_total == pytest.approx(total, rel=1e-12)
    np.testing.assert_allclose(ours.merged.x, density.x, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(ours.merged.P, density.P, rtol=1e-12, atol=1e-12)


def test_a_target_that_never_changes_is_bayes_rule_over_the_models(draw: Draw) -> None:
    """sojourn = inf: every model filters on its own, and the evidence is the mixture of theirs."""
    rng = np.random.default_rng(5)
    prior, dts = draw(rng, (), 4, 5.0), np.array([1.0, 0.5, 3.0, 2.0])
    scans = [rng.normal(0.0, 6.0, (count, 2)) for count in (2, 0, 4, 1)]
    imm = Imm.of((CV, FAST, LEFT), np.inf)
    mu = np.array([0.5, 0.2, 0.3])
    ours, total = in_modes(start(prior, imm)._replace(log_mu=np.log(mu)), imm, dts, scans, clutter(0.7))
    alone = [plain(prior, model, dts, scans, clutter(0.7)) for model in imm.models]
    evidence = mu * np.exp([log for _, log in alone])
    assert total == pytest.approx(np.log(evidence.sum()), rel=1e-12)
    np.testing.assert_allclose(np.exp(ours.log_mu), evidence / evidence.sum(), rtol=1e-11)
    for row, (density, _) in enumerate(alone):
        np.testing.assert_allclose(ours.densities.x[row], density.x, rtol=1e-11, atol=1e-11)


def test_two_scans_are_near_the_sum_over_all_histories_of_modes() -> None:
    """p_d = 1, no clutter: p(z1) is exact; p(z1, z2) differs by the merging of densities that differ little."""
    imm, dts = Imm.of((CV, LEFT, RIGHT), 10.0), np.array([2.0, 2.0])
    prior = Gaussian(np.array([0.0, 0.0, 60.0, 0.0]), np.diag([25.0, 25.0, 9.0, 9.0]))
    zs = [np.array([[119.0, 14.0]]), np.array([[228.0, 60.0]])]
    chain = expm((np.full((3, 3), 1.0) - 3.0 * np.eye(3)) / 20.0 * 2.0)
    exact = np.zeros(2)
    for history in product(range(3), repeat=2):
        (x, P), evidence = prior, []
        for dt, z, mode in zip(dts, zs, history, strict=True):
            F, Q = imm.models[mode].transition(dt), imm.models[mode].noise(dt)
            x, P = F @ x, F @ P @ F.T + Q
            S = P[:2, :2] + np.diag([4.0, 9.0])
            evidence.append(multivariate_normal(x[:2], S).pdf(z[0]))
            K = P[:, :2] @ np.linalg.inv(S)
            x, P = x + K @ (z[0] - x[:2]), P - K @ S @ K.T
        exact += chain[history] / 3.0 * np.cumprod(evidence)
    for scans in (1, 2):
        _, total = in_modes(start(prior, imm), imm, dts[:scans], zs[:scans], clutter(1.0, 1.0))
        assert total == pytest.approx(np.log(exact[scans - 1]), abs=1e-11 if scans == 1 else 0.1)


# Weights of any size --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_mixing_keeps_the_moments_of_the_whole(shape: tuple[int, ...], draw: Draw) -> None:
    rng = np.random.default_rng(3)
    modes = some_modes(draw, rng, shape, THREE)
    mu, transition = np.exp(modes.log_mu), rng.dirichlet(np.ones(3), (*shape, 3))
    after, mixed = mix(mu, modes.densities, transition)
    np.testing.assert_allclose(after, np.vecmat(mu, transition), rtol=1e-13)
    whole, then = moments(mu, modes.densities), moments(after, mixed)
    np.testing.assert_allclose(then.x, whole.x, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(then.P, whole.P, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_mixing_equals_the_loop_for_a_chain_with_a_preferred_direction(shape: tuple[int, ...], draw: Draw) -> None:
    rng = np.random.default_rng(13)
    modes, transition = some_modes(draw, rng, shape, THREE), rng.dirichlet(np.ones(3), (*shape, 3))
    after, mixed = mix(np.exp(modes.log_mu), modes.densities, transition)
    for row in np.ndindex(shape):
        for j in range(3):
            joint = [np.exp(modes.log_mu[row][i]) * transition[row][i, j] for i in range(3)]
            x = sum((joint[i] * modes.densities.x[row][i] for i in range(3)), np.zeros(4)) / sum(joint)
            np.testing.assert_allclose(after[row][j], sum(joint), rtol=1e-13)
            np.testing.assert_allclose(mixed.x[row][j], x, rtol=1e-11, atol=1e-12)


@given(shift=st.floats(-1e5, 1e5))
@settings(max_examples=30, deadline=None)
def test_only_ratios_of_weights_matter_to_the_densities(draw: Draw, shift: float) -> None:
    modes = some_modes(draw, np.random.default_rng(4), (2,), THREE)
    transition = THREE.mode_transition(np.array(4.0))
    after, mixed = mix_log(modes.log_mu, modes.densities, transition)
    after_s, mixed_s = mix_log(modes.log_mu + shift, modes.densities, transition)
    np.testing.assert_allclose(after_s, after + shift, rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(mixed_s.x, mixed.x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(mixed_s.P, mixed.P, rtol=1e-9, atol=1e-9)
    merged, merged_s = modes.merged, merge(modes.log_mu + shift, modes.densities)
    np.testing.assert_allclose(merged_s.P, merged.P, rtol=1e-9, atol=1e-9)


def test_a_mode_below_the_smallest_number_is_not_forgotten(draw: Draw) -> None:
    """exp(-2000) is zero in floating point; the two unlikely modes still mix in their ratio."""
    modes = some_modes(draw, np.random.default_rng(5), (), THREE)
    log_mu = np.array([0.0, -2000.0, -2000.0 + np.log(3.0)])
    # Modes 1 and 2 exchange, mode 0 stays alone.
    transition = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.0, 0.5, 0.5]])
    after, mixed = mix_log(log_mu, modes.densities, transition)
    np.testing.assert_allclose(after, [0.0, -2000.0 + np.log(2.0), -2000.0 + np.log(2.0)], rtol=1e-15)
    np.testing.assert_allclose(mixed.x[1], 0.25 * modes.densities.x[1] + 0.75 * modes.densities.x[2], rtol=1e-11)
    np.testing.assert_allclose(mixed.x[0], modes.densities.x[0], rtol=1e-15)


def test_a_mode_that_cannot_be_keeps_its_density(draw: Draw) -> None:
    modes = some_modes(draw, np.random.default_rng(6), (), THREE)
    after, mixed = mix(np.array([0.0, 1.0, 0.0]), modes.densities, np.eye(3))
    np.testing.assert_array_equal(after, [0.0, 1.0, 0.0])
    np.testing.assert_allclose(mixed.x, modes.densities.x, rtol=1e-15)
    np.testing.assert_allclose(mixed.P, modes.densities.P, rtol=1e-15)


def test_an_impossible_scan_teaches_nothing_on_the_mode(draw: Draw) -> None:
    predicted = some_modes(draw, np.random.default_rng(7), (), THREE)
    filtered = scan(predicted, np.empty((0, 2)), clutter(1.0), Position((1.0, 1.0), 4))
    assert filtered.log_p_bar == -np.inf
    np.testing.assert_array_equal(filtered.modes.log_mu, predicted.log_mu)
    np.testing.assert_array_equal(filtered.modes.densities.x, predicted.densities.x)


def test_modes_that_a_scan_rules_out_are_gone(draw: Draw) -> None:
    """With p_d = 1 and a gate only the mode whose gate holds the plot goes on."""
    densities = draw(np.random.default_rng(8), (3,), 4)
    densities.x[:, 0] = [0.0, 1e4, -1e4]
    filtered = scan(
        Modes(np.log(np.full(3, 1 / 3)), densities),
        densities.x[1:2, :2],
        clutter(1.0, p_g=0.99),
        Position((1.0, 1.0), 4),
    )
    # 1 - p_d p_g is left for the others: the plot may be outside their gates.
    weights = np.exp(filtered.modes.log_mu)
    assert np.exp(filtered.log_p_bar) > 1.0 / 3.0 * 1e-3
    np.testing.assert_allclose(weights[[0, 2]] * np.exp(filtered.log_p_bar), 0.01 / 3.0, rtol=1e-12)
    np.testing.assert_allclose(weights.sum(), 1.0, rtol=1e-14)


# Batches --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("imm", FAMILIES.values(), ids=FAMILIES)
def test_a_batch_equals_the_loop(imm: Imm, shape: tuple[int, ...], draw: Draw) -> None:
    rng, sensor = np.random.default_rng(9), Position((2.0,) * imm.dimensions, imm.n)
    modes, dt = some_modes(draw, rng, shape, imm), np.asarray(rng.uniform(0.1, 5.0, shape))
    z = rng.normal(0.0, 5.0, (*shape, 4, imm.dimensions))
    valid = rng.random((*shape, 4)) < 0.7
    predicted = predict_modes(modes, imm, dt, 3.0)
    conditions = Clutter(np.asarray(rng.uniform(0.2, 0.9, shape)), np.full(shape, -7.0), 0.99)
    filtered = imm_pdaf(predicted, Plots(z, valid), sensor.linearise(predicted.densities, NOWHERE), conditions)
    assert filtered.log_p_bar.shape == shape
    for row in np.ndindex(shape):
        one = Modes(modes.log_mu[row], Gaussian(modes.densities.x[row], modes.densities.P[row]))
        one = predict_modes(one, imm, np.array(dt[row]), 3.0)
        linear = sensor.linearise(one.densities, NOWHERE)
        alone = Clutter(np.array(conditions.p_d[row]), np.array(-7.0), 0.99)
        expected = imm_pdaf(one, Plots(z[row][valid[row]]), linear, alone)
        np.testing.assert_allclose(filtered.modes.log_mu[row], expected.modes.log_mu, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(filtered.log_p_bar[row], expected.log_p_bar, rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(filtered.modes.densities.P[row], expected.modes.densities.P, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(filtered.modes.merged.x[row], expected.modes.merged.x, rtol=1e-9, atol=1e-9)


def test_one_scan_is_shared_by_all_tracks(draw: Draw) -> None:
    rng, sensor = np.random.default_rng(10), Position((2.0, 2.0), 4)
    predicted, z = some_modes(draw, rng, (5,), THREE), rng.normal(0.0, 5.0, (3, 2))
    ours = scan(predicted, z, Clutter(np.full(5, 0.8), np.full(5, -6.0), 1.0), sensor)
    for row in range(5):
        one = Modes(predicted.log_mu[row], Gaussian(predicted.densities.x[row], predicted.densities.P[row]))
        alone = scan(one, z, Clutter(np.array(0.8), np.array(-6.0), 1.0), sensor)
        np.testing.assert_allclose(ours.modes.merged.x[row], alone.modes.merged.x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(ours.log_p_bar[row], alone.log_p_bar, rtol=1e-11)


def test_the_share_of_noise_is_the_factors(draw: Draw) -> None:
    densities, dt = draw(np.random.default_rng(11), (3,), 4), np.array(2.0)
    for mode, model in enumerate(THREE.models):
        one = predict(Gaussian(densities.x[mode], densities.P[mode]), model.transition(dt), 4.0 * model.noise(dt))
        ours = predict_models(densities, THREE, dt, 4.0)
        np.testing.assert_allclose(ours.P[mode], one.P, rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(ours.x[mode], one.x, rtol=1e-13, atol=1e-13)
