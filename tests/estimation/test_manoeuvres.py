"""Targets that change their model: paths as the chain has them, and what the IMM gains on them over one model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import binomtest

from waldnet.common.estimation.association import Clutter, Plots
from waldnet.common.estimation.gaussian import Array, BoolArray, Gaussian
from waldnet.common.estimation.imm import Imm, draw_path, imm_pdaf, predict_modes, start
from waldnet.common.estimation.motion import ConstantAcceleration, ConstantVelocity, CoordinatedTurn, Motion
from waldnet.common.estimation.sensing import Position

EASTWARD = np.array([0.0, 0.0, 50.0, 0.0])


def headings(path: Array) -> Array:
    """Heading of every state [rad]."""
    return np.arctan2(path[..., 3], path[..., 2])


@pytest.mark.parametrize(
    "motion", [ConstantVelocity(2, 3.0), ConstantAcceleration(2, 0.1), CoordinatedTurn(2, 1.0, 0.2)]
)
def test_one_model_draws_interval_after_interval(motion: Motion) -> None:
    """And a list of one model the same numbers."""
    seconds, first = np.array([0.5, 0.0, 2.0, 7.0]), np.arange(1.0, motion.n + 1.0)
    rng, state, expected = np.random.default_rng(1), first, []
    for dt in seconds:
        noise = rng.multivariate_normal(np.zeros(motion.n), motion.noise(np.array(dt)), method="svd")
        state = motion.transition(np.array(dt)) @ state + noise
        expected.append(state)
    np.testing.assert_array_equal(draw_path(motion, first, seconds, np.random.default_rng(1)), expected)


def test_a_list_of_one_model_is_that_model() -> None:
    model, seconds = ConstantVelocity(2, 3.0), np.array([0.5, 2.0])
    one = draw_path(model, EASTWARD, seconds, np.random.default_rng(1))
    listed = draw_path(Imm.of((model,), 1.0), EASTWARD, seconds, np.random.default_rng(1))
    np.testing.assert_array_equal(listed, one)


@pytest.mark.parametrize("cuts", [1, 3])
def test_modes_change_as_the_chain_says(cuts: int) -> None:
    """The turn during a first and a last instant tells both modes; each share within 99.98 % of mode_transition."""
    rates, instant, runs = np.array([0.0, 0.1, -0.1]), 1e-4, 1500
    imm = Imm.of(tuple(CoordinatedTurn(2, 0.0, float(rate)) for rate in rates), 10.0)
    seconds, rng = np.array([instant, *[8.0 / cuts] * cuts, instant]), np.random.default_rng(cuts)
    paths = np.stack([draw_path(imm, EASTWARD, seconds, rng) for _ in range(runs)])
    turn = np.stack([headings(paths[:, 0]), headings(paths[:, -1]) - headings(paths[:, -2])], axis=-1) / instant
    modes = np.abs(np.angle(np.exp(1j * turn * instant))[..., None] / instant - rates).argmin(axis=-1)
    chain = imm.mode_transition(np.array(8.0 + instant))
    for i in range(3):
        begun = modes[:, 0] == i
        assert binomtest(int(begun.sum()), runs, 1 / 3).pvalue > 2e-4
        for j in range(3):
            assert binomtest(int((modes[begun, 1] == j).sum()), int(begun.sum()), chain[i, j]).pvalue > 2e-4


@pytest.mark.parametrize("intervals", [1, 5])
def test_the_turn_has_the_variance_of_a_telegraph_signal(intervals: int) -> None:
    """Correlation exp(-2 t / s) with sojourn s: Var = w^2 s (T - s (1 - exp(-2 T / s)) / 2); within 5 sigma."""
    rate, sojourn, seconds, runs = 0.02, 6.0, 30.0, 1200
    imm = Imm.of((CoordinatedTurn(2, 0.0, rate), CoordinatedTurn(2, 0.0, -rate)), sojourn)
    rng, steps = np.random.default_rng(intervals), np.full(intervals, seconds / intervals)
    turned = headings(np.stack([draw_path(imm, EASTWARD, steps, rng)[-1] for _ in range(runs)]))
    expected = rate**2 * sojourn * (seconds - sojourn / 2.0 * (1.0 - np.exp(-2.0 * seconds / sojourn)))
    assert abs(turned.mean()) < 5.0 * np.sqrt(expected / runs)
    assert abs(np.mean(turned**2) - expected) < 5.0 * np.std(turned**2) / np.sqrt(runs)


@pytest.mark.parametrize("sojourn", [0.5, 6.0, 200.0])
def test_turns_spread_the_velocity_as_their_psd_says(sojourn: float) -> None:
    """Across the velocity white noise of the psd on each axis has half of the variance: within 5 sigma."""
    speed, horizon, runs = 50.0, 4.0, 1500
    rates = (0.01, -0.01, 0.0, 0.02)
    imm = Imm.of(tuple(CoordinatedTurn(2, 0.0, rate) for rate in rates), sojourn)
    rng = np.random.default_rng(int(sojourn))
    paths = np.stack([draw_path(imm, EASTWARD, np.array([horizon]), rng)[0] for _ in range(runs)])
    across = paths[:, 3] - speed * np.mean(rates) * horizon
    expected = 2.0 * imm.turning_psd(speed, horizon) * horizon
    assert abs(np.mean(across**2) - expected) < 5.0 * np.std(across**2) / np.sqrt(runs)


def test_psd_of_turns_in_the_limits() -> None:
    """Long memory: var speed^2 / lambda; turns for ever: var speed^2 h / 2; the series joins the closed form."""
    turns = CoordinatedTurn(2, 1.0, 0.1), CoordinatedTurn(2, 1.0, -0.1)
    assert Imm.of(turns, 4.0).turning_psd(30.0, 1e9) == pytest.approx(0.01 * 900.0 / 0.5)
    assert Imm.of(turns, np.inf).turning_psd(30.0, 3.0) == pytest.approx(0.01 * 900.0 * 1.5)
    assert Imm.of(turns, 1.0).turning_psd(30.0, 5.1e-6) == pytest.approx(
        Imm.of(turns, 1.0).turning_psd(30.0, 4.9e-6) * 5.1 / 4.9, rel=1e-5
    )
    assert Imm.of((ConstantVelocity(2, 1.0), ConstantVelocity(2, 9.0)), 4.0).turning_psd(30.0, 5.0) == 0.0


class World(NamedTuple):
    """Runs of one target amid false plots.

    Attributes:
        prior: of every run, shapes (R, n), (R, n, n).
        paths: true states, shape (R, K, n).
        z: plots, shape (R, K, M, m).
        valid: false marks padding, shape (R, K, M).
    """

    prior: Gaussian
    paths: Array
    z: Array
    valid: BoolArray


DT, SIGMA, P_D, FALSE_PLOTS, SIDE = 2.0, 20.0, 0.9, 1.0, 1000.0


def world(motion: Motion, runs: int, scans: int, rng: np.random.Generator) -> World:
    """False plots fill a square around the target."""
    x0, P0 = np.array([0.0, 0.0, 60.0, 0.0]), np.diag([400.0, 400.0, 25.0, 25.0])
    steps, most = np.full(scans, DT), 12
    paths = np.stack([draw_path(motion, rng.multivariate_normal(x0, P0), steps, rng) for _ in range(runs)])
    z = paths[:, :, None, :2] + rng.uniform(-SIDE / 2, SIDE / 2, (runs, scans, most, 2))
    z[:, :, 0] = paths[..., :2] + SIGMA * rng.normal(size=(runs, scans, 2))
    counts = rng.poisson(FALSE_PLOTS, (runs, scans, 1))
    assert counts.max() < most
    valid = np.arange(most) <= counts
    valid[:, :, 0] = rng.random((runs, scans)) < P_D
    return World(Gaussian(np.tile(x0, (runs, 1)), np.tile(P0, (runs, 1, 1))), paths, z, valid)


def filtered(imm: Imm, seen: World) -> tuple[Array, Array]:
    """Root mean square position error from the tenth scan on [m] and the log LR of every run, shape (R,)."""
    modes, sensor, runs = start(seen.prior, imm), Position((SIGMA, SIGMA), 4), len(seen.paths)
    clutter = Clutter(np.full(runs, P_D), np.full(runs, np.log(FALSE_PLOTS / SIDE**2)), 0.9997)
    log_lr, squares = np.zeros(runs), []
    for k in range(seen.z.shape[1]):
        predicted = predict_modes(modes, imm, np.array(DT))
        linear = sensor.linearise(predicted.densities, np.zeros(2))
        modes, log_p_bar = imm_pdaf(predicted, Plots(seen.z[:, k], seen.valid[:, k]), linear, clutter)
        log_lr += log_p_bar
        squares.append(np.square(modes.merged.x[:, :2] - seen.paths[:, k, :2]).sum(axis=-1))
    return np.sqrt(np.mean(squares[10:], axis=0)), log_lr


def surely_positive(differences: Array) -> bool:
    """Whether the mean is above zero by four of its standard errors (99.997 %)."""
    return bool(differences.mean() > 4.0 * differences.std(ddof=1) / np.sqrt(len(differences)))


def test_the_imm_follows_manoeuvres_that_no_constant_velocity_follows() -> None:
    """Turns of 0.15 rad/s, paired over 200 runs, against CV of every psd, at 99.997 % each.

    Errors are compared as logarithms, so that the lost tracks of CV do not decide.
    """
    models = ConstantVelocity(2, 0.1), CoordinatedTurn(2, 0.1, 0.15), CoordinatedTurn(2, 0.1, -0.15)
    imm = Imm.of(models, 20.0)
    seen = world(imm, 200, 40, np.random.default_rng(1))
    error, log_lr = filtered(imm, seen)
    assert np.median(error) < 1.3 * SIGMA
    assert (error > 200.0).mean() < 0.03
    for psd in (0.1, 10.0, 30.0, 60.0, 100.0, 200.0, 400.0, 1000.0):
        error_cv, log_lr_cv = filtered(Imm.of((ConstantVelocity(2, psd),), 1.0), seen)
        assert surely_positive(np.log(error_cv / error))
        assert surely_positive(log_lr - log_lr_cv)


def test_the_nominal_model_needs_the_psd_of_turns() -> None:
    """The models' mean psd loses nearly all of 200 tracks (> 200 m); that of turns over 3 scans few."""
    turns = Imm.of((CoordinatedTurn(2, 0.1, 0.15), CoordinatedTurn(2, 0.1, -0.15), ConstantVelocity(2, 0.1)), 20.0)
    seen = world(turns, 200, 40, np.random.default_rng(1))
    lost = []
    for psd in (None, turns.turning_psd(60.0, 3.0 * DT)):
        error, _ = filtered(Imm.of((Imm.of(turns.models, 20.0, psd).nominal,), 1.0), seen)
        lost.append((error > 200.0).mean())
    assert lost[0] > 0.9
    assert lost[1] < 0.1


def test_the_imm_loses_little_where_nothing_manoeuvres() -> None:
    """A target that keeps to one model: 15 % at most over the filter that knows it, by a one-sided 4 sigma bound."""
    straight = ConstantVelocity(2, 0.1)
    seen = world(straight, 200, 40, np.random.default_rng(2))
    alone, log_lr_alone = filtered(Imm.of((straight,), 1.0), seen)
    models = straight, CoordinatedTurn(2, 0.1, 0.15), CoordinatedTurn(2, 0.1, -0.15)
    error, log_lr = filtered(Imm.of(models, 60.0), seen)
    excess = np.log(error / alone)
    assert excess.mean() + 4.0 * excess.std(ddof=1) / np.sqrt(len(excess)) < np.log(1.15)
    # The evidence is lower, as a true model alone must have it.
    assert surely_positive(log_lr_alone - log_lr)
