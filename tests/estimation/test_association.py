"""PDAF and tight association against Stone Soup, a textbook loop, quadrature, exact limits; batches against loops."""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import datetime, timedelta
from fractions import Fraction
from typing import NamedTuple, TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp
from scipy.stats import chi2, multivariate_normal
from stonesoup.dataassociator.probability import PDA
from stonesoup.hypothesiser.probability import PDAHypothesiser
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel
from stonesoup.models.transition.linear import ConstantVelocity as TheirConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.numeric import Probability
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track
from stonesoup.updater.probability import PDAUpdater

from waldnet.common.estimation.association import (
    Choice,
    Clutter,
    Filtered,
    Plots,
    absorb,
    expect,
    gate_threshold,
    innovations,
    kalman,
    nearest,
    pdaf,
    update,
)
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.motion import ConstantVelocity, predict
from waldnet.common.estimation.representation import Share
from waldnet.common.estimation.sensing import Linearised, Position

Draw: TypeAlias = Callable[..., Gaussian]

SHAPES = [(), (1,), (3, 1, 2)]
SEEDS = st.integers(0, 2**32 - 1)
SENSOR = Position((3.0, 2.0), 4)
NOWHERE = np.zeros(2)


class Textbook(NamedTuple):
    """Result of the loop: x, P, log p_bar and the weights."""

    x: Array
    P: Array
    log_p_bar: float
    p: list[float]


def seen_by(density: Gaussian, sensor: Position = SENSOR) -> Linearised:
    return sensor.linearise(density, NOWHERE)


def clutter(p_d: float | Array, rho_f: float = 1e-3, p_g: float = 1.0) -> Clutter:
    return Clutter(np.asarray(p_d, dtype=np.float64), np.array(np.log(rho_f)), p_g)


def tight(
    factor: Gaussian,
    association: Gaussian,
    plots: Plots,
    sensors: tuple[Linearised, Linearised],
    clutter: Clutter,
    *choice: Choice,
) -> tuple[Filtered, Gaussian]:
    """The factor with its log p_bar (Eq. 13), and the association filter."""
    both = Gaussian(np.stack([factor.x, association.x]), np.stack([factor.P, association.P]))
    H = np.stack([np.broadcast_to(sensor.H, (*factor.x.shape[:-1], *sensor.H.shape[-2:])) for sensor in sensors])
    linear = Linearised(np.stack([sensor.z for sensor in sensors]), H, sensors[0].R)
    (x, P), log_p_bar = update(expect(both, linear, clutter), plots, *choice)
    return Filtered(Gaussian(x[0], P[0]), log_p_bar), Gaussian(x[1], P[1])


def plots(z: Array, valid: Array | None = None) -> Plots:
    return Plots(z, np.ones(z.shape[:-1], np.bool_) if valid is None else valid)


def textbook_weights(x: Array, P: Array, zs: Array, clutter: Clutter, sensor: Position = SENSOR) -> list[float]:
    """Logarithms of p*_j, Eq. (6), plot after plot."""
    H, R, p_d, rho_f = sensor.H, sensor.R, float(clutter.p_d), float(np.exp(clutter.log_rho_f))
    S = H @ P @ H.T + R
    miss = 1.0 - p_d * clutter.p_g
    weights = [np.log(miss) if miss > 0.0 else -np.inf]
    for z in zs:
        nu = z - H @ x
        inside = nu @ np.linalg.inv(S) @ nu <= chi2.ppf(clutter.p_g, len(z))
        log_n = float(multivariate_normal(np.zeros(len(z)), S).logpdf(nu))
        weights.append(np.log(p_d / rho_f) + log_n if inside and p_d > 0.0 else -np.inf)
    return [float(weight) for weight in weights]


def textbook_update(x: Array, P: Array, zs: Array, p: list[float], sensor: Position = SENSOR) -> tuple[Array, Array]:
    """Mean and covariance of the mixture of one Kalman update per plot and of the prediction: what Eq. (7) shortens."""
    H, R = sensor.H, sensor.R
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    means, covariances = [x], [P]
    for z in zs:
        means.append(x + K @ (z - H @ x))
        covariances.append((np.eye(len(x)) - K @ H) @ P @ (np.eye(len(x)) - K @ H).T + K @ R @ K.T)
    mean = sum(w * m for w, m in zip(p, means, strict=True))
    terms = zip(p, means, covariances, strict=True)
    return mean, sum(w * (C + np.outer(m - mean, m - mean)) for w, m, C in terms)


def textbook_pdaf(x: Array, P: Array, zs: Array, clutter: Clutter, sensor: Position = SENSOR) -> Textbook:
    log_p_star = textbook_weights(x, P, zs, clutter, sensor)
    log_p_bar = float(logsumexp(log_p_star))
    p = [float(np.exp(weight - log_p_bar)) for weight in log_p_star]
    return Textbook(*textbook_update(x, P, zs, p, sensor), log_p_bar, p)


def assert_same(ours: Filtered, x: Array, P: Array, log_p_bar: float) -> None:
    assert ours.log_p_bar == pytest.approx(log_p_bar, rel=1e-9, abs=1e-9)
    np.testing.assert_allclose(ours.density.x, x, rtol=1e-9, atol=1e-9 * np.abs(x).max())
    np.testing.assert_allclose(ours.density.P, P, rtol=1e-9, atol=1e-9 * np.abs(P).max())


def stone_soup(prior: Gaussian, zs: Array, clutter: Clutter, dt: float, psd: float) -> Textbook:
    """One scan of Stone Soup's PDA.

    Its weights are p*_j of Eq. (6), gate and density of false plots included (1 - p_d p_g for the miss); the
    hypothesiser normalises them by default, and PDA always does before the update, so the sum is taken in between.
    Its states alternate position and velocity, which ``order`` maps.
    """
    order, now = [0, 2, 1, 3], datetime(2026, 1, 1)
    then = now + timedelta(seconds=dt)
    model = LinearGaussian(ndim_state=4, mapping=(0, 2), noise_covar=SENSOR.R)
    updater = PDAUpdater(model)
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([TheirConstantVelocity(psd)] * 2))
    hypothesiser = PDAHypothesiser(
        predictor,
        updater,
        clutter_spatial_density=float(np.exp(clutter.log_rho_f)),
        prob_detect=Probability(float(clutter.p_d)),
        prob_gate=Probability(clutter.p_g),
        normalise=False,
    )
    start = GaussianState(prior.x[order], prior.P[np.ix_(order, order)], timestamp=now)
    track = Track([start])
    detections = {Detection(z, timestamp=then, measurement_model=model) for z in zs}
    weights = [hypothesis.probability for hypothesis in hypothesiser.hypothesise(track, detections, then)]
    associated = PDA(hypothesiser).associate({track}, detections, then)[track]
    posterior = updater.update(associated)
    x = np.asarray(posterior.state_vector, dtype=np.float64).ravel()[order]
    P = np.asarray(posterior.covar, dtype=np.float64)[np.ix_(order, order)]
    log_p_bar = float(Probability.sum(weights).log_value)
    return Textbook(x, P, log_p_bar, [float(hypothesis.probability) for hypothesis in associated])


@pytest.mark.parametrize("p_g", [1.0, 0.9])
@pytest.mark.parametrize("p_d", [0.3, 0.95])
@pytest.mark.parametrize("count", [0, 1, 5, 20])
def test_pdaf_equals_stone_soup(count: int, p_d: float, p_g: float, draw: Draw) -> None:
    rng = np.random.default_rng([count, int(10 * p_d), int(10 * p_g)])
    motion, dt = ConstantVelocity(2, 0.7), 2.5
    # Two scans, so that the second starts from a covariance that the first has spread.
    ours = theirs = draw(rng, (), 4, 3.0)
    for _ in range(2):
        predicted = Share(1.0).predict(ours, motion, np.array(dt))
        zs = predicted.x[:2] + rng.normal(0.0, 8.0, (count, 2))
        filtered = pdaf(predicted, plots(zs), seen_by(predicted), clutter(p_d, 2e-3, p_g))
        expected = stone_soup(theirs, zs, clutter(p_d, 2e-3, p_g), dt, 0.7)
        assert_same(filtered, expected.x, expected.P, expected.log_p_bar)
        ours, theirs = filtered.density, Gaussian(expected.x, expected.P)


@pytest.mark.parametrize("p_g", [1.0, 0.9])
@pytest.mark.parametrize("p_d", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("count", [1, 4, 30])
def test_pdaf_equals_the_loop_over_tracks_and_plots(count: int, p_d: float, p_g: float, draw: Draw) -> None:
    rng = np.random.default_rng([count, int(10 * p_d), int(10 * p_g)])
    tracks = draw(rng, (7,), 4, 4.0)
    zs = rng.normal(0.0, 10.0, (count, 2))
    ours = pdaf(tracks, plots(zs), seen_by(tracks), clutter(np.full(7, p_d), 1e-3, p_g))
    for row in range(7):
        x, P = tracks.x[row], tracks.P[row]
        one = textbook_pdaf(x, P, zs, clutter(p_d, 1e-3, p_g))
        density = Gaussian(ours.density.x[row], ours.density.P[row])
        assert_same(Filtered(density, ours.log_p_bar[row]), one.x, one.P, one.log_p_bar)


@pytest.mark.parametrize("p_d", [0.4, 1.0])
def test_one_scan_is_bayes_theorem(p_d: float) -> None:
    """State (position, velocity) on a line: evidence and moments of prior times Eq. (1) by quadrature."""
    x, P, sigma = np.array([1.0, -0.5]), np.array([[4.0, 1.5], [1.5, 2.0]]), 0.8
    zs, rho_f = np.array([[0.2], [2.5], [-1.0]]), 0.3
    grid = np.stack(np.meshgrid(np.linspace(-25, 27, 1041), np.linspace(-20, 19, 781), indexing="ij"), axis=-1)
    normals = [np.exp(-0.5 * (z[0] - grid[..., 0]) ** 2 / sigma**2) / np.sqrt(2 * np.pi) / sigma for z in zs]
    joint = multivariate_normal(x, P).pdf(grid) * ((1.0 - p_d) + p_d / rho_f * sum(normals)) * 0.05 * 0.05
    evidence = joint.sum()
    mean = np.einsum("ij,ijk->k", joint, grid) / evidence
    second = np.einsum("ij,ijk,ijl->kl", joint, grid, grid) / evidence
    prior, sensor = Gaussian(x, P), Position((sigma,), 2)
    ours = pdaf(prior, plots(zs), seen_by(prior, sensor), clutter(p_d, rho_f))
    assert_same(ours, mean, second - np.outer(mean, mean), np.log(evidence))


@pytest.mark.parametrize("p_g", [1.0, 0.9])
def test_no_plots_are_evidence(p_g: float, draw: Draw) -> None:
    predicted = draw(np.random.default_rng(1), (), 4)
    ours = pdaf(predicted, plots(np.empty((0, 2))), seen_by(predicted), clutter(0.7, 1e-3, p_g))
    assert ours.log_p_bar == pytest.approx(np.log(1.0 - 0.7 * p_g), rel=1e-14)
    np.testing.assert_array_equal(ours.density.x, predicted.x)
    np.testing.assert_allclose(ours.density.P, predicted.P, rtol=1e-12)


@pytest.mark.parametrize("count", [0, 3])
def test_a_blind_sensor_says_nothing(count: int, draw: Draw) -> None:
    rng = np.random.default_rng(2)
    predicted = draw(rng, (), 4)
    zs = predicted.x[:2] + rng.normal(size=(count, 2))
    ours = pdaf(predicted, plots(zs), seen_by(predicted), clutter(0.0))
    assert ours.log_p_bar == 0.0
    np.testing.assert_array_equal(ours.density.x, predicted.x)
    np.testing.assert_allclose(ours.density.P, predicted.P, rtol=1e-12)


def test_a_certain_plot_is_a_kalman_update(draw: Draw) -> None:
    rng = np.random.default_rng(3)
    predicted = draw(rng, (), 4, 5.0)
    z, H, R = predicted.x[:2] + rng.normal(size=2), SENSOR.H, SENSOR.R
    P = np.linalg.inv(np.linalg.inv(predicted.P) + H.T @ np.linalg.inv(R) @ H)
    x = P @ (np.linalg.inv(predicted.P) @ predicted.x + H.T @ np.linalg.inv(R) @ z)
    log_n = multivariate_normal(H @ predicted.x, H @ predicted.P @ H.T + R).logpdf(z)
    ours = pdaf(predicted, plots(z[None]), seen_by(predicted), clutter(1.0, 2e-4))
    assert_same(ours, x, P, float(log_n) - np.log(2e-4))


@pytest.mark.parametrize("zs", [np.empty((0, 2)), np.array([[1e3, 1e3]])])
def test_a_sensor_that_never_misses_and_sees_nothing_refutes_the_track(zs: Array, draw: Draw) -> None:
    predicted = draw(np.random.default_rng(4), (), 4)
    # With a gate a target outside it is still possible: p*_0 = 1 - p_g.
    gated = pdaf(predicted, plots(zs), seen_by(predicted), clutter(1.0, 1e-3, 0.99))
    assert gated.log_p_bar == pytest.approx(np.log(0.01), rel=1e-12)
    hidden = plots(zs, np.zeros(len(zs), np.bool_))
    ours = pdaf(predicted, hidden, seen_by(predicted), clutter(1.0))
    both, association = tight(predicted, predicted, hidden, (seen_by(predicted), seen_by(predicted)), clutter(1.0))
    for density in (gated.density, ours.density, both.density, association):
        np.testing.assert_array_equal(density.x, predicted.x)
        np.testing.assert_allclose(density.P, predicted.P, rtol=1e-12)
    assert ours.log_p_bar == both.log_p_bar == -np.inf


@pytest.mark.parametrize("padding", [0.0, 1e6, -1e100])
def test_padding_counts_for_nothing(padding: float, draw: Draw) -> None:
    rng = np.random.default_rng(5)
    tracks = draw(rng, (4,), 4, 3.0)
    scans = [rng.normal(0.0, 6.0, (count, 2)) for count in (0, 1, 3, 5)]
    z, valid = np.full((4, 5, 2), padding), np.zeros((4, 5), np.bool_)
    for row, scan in enumerate(scans):
        # Padding in front, where a code that cuts instead of masking would take it for plots.
        z[row, 5 - len(scan) :], valid[row, 5 - len(scan) :] = scan, True
    around = draw(rng, (4,), 4, 5.0)
    ours = pdaf(tracks, Plots(z, valid), seen_by(tracks), clutter(np.full(4, 0.6)))
    both, _ = tight(around, tracks, Plots(z, valid), (seen_by(around), seen_by(tracks)), clutter(np.full(4, 0.6)))
    for row, scan in enumerate(scans):
        one = textbook_pdaf(tracks.x[row], tracks.P[row], scan, clutter(0.6))
        density = Gaussian(ours.density.x[row], ours.density.P[row])
        assert_same(Filtered(density, ours.log_p_bar[row]), one.x, one.P, one.log_p_bar)
        x, P, log_p_bar = textbook_tight(Gaussian(around.x[row], around.P[row]), one.p, scan, clutter(0.6))
        density = Gaussian(both.density.x[row], both.density.P[row])
        assert_same(Filtered(density, both.log_p_bar[row]), x, P, log_p_bar)


def test_padding_may_hold_anything(draw: Draw) -> None:
    predicted = draw(np.random.default_rng(6), (), 4)
    z, valid = np.array([[0.5, 0.5], [np.nan, np.nan]]), np.array([True, False])
    ours = pdaf(predicted, Plots(z, valid), seen_by(predicted), clutter(0.6))
    one = textbook_pdaf(predicted.x, predicted.P, z[:1], clutter(0.6))
    assert_same(ours, one.x, one.P, one.log_p_bar)


@pytest.mark.parametrize("distance", [1e3, 1e6, 1e12, 1e15, 1e150])
@pytest.mark.parametrize("p_d", [0.5, 1.0])
def test_plots_absurdly_far_away_do_no_harm(p_d: float, distance: float, draw: Draw) -> None:
    predicted, wide = draw(np.random.default_rng(7), (), 4), draw(np.random.default_rng(8), (), 4, 3.0)
    zs = np.array([[0.5, 0.5], [distance, -distance]])
    one = textbook_pdaf(predicted.x, predicted.P, zs[:1], clutter(p_d))
    ours = pdaf(predicted, plots(zs), seen_by(predicted), clutter(p_d))
    assert_same(ours, one.x, one.P, one.log_p_bar)
    x, P, log_p_bar = textbook_tight(wide, one.p, zs[:1], clutter(p_d))
    both, _ = tight(wide, predicted, plots(zs), (seen_by(wide), seen_by(predicted)), clutter(p_d))
    assert_same(both, x, P, log_p_bar)


@pytest.mark.parametrize("distance", [1e3, 1e6])
def test_the_weight_of_a_far_plot_does_not_underflow(distance: float, draw: Draw) -> None:
    """p_d = 1 and the only plots are far away: log p_bar of -1e5 and less, where exp would give zero."""
    predicted = draw(np.random.default_rng(9), (), 4)
    zs = np.array([[distance, 0.0], [distance, 1.0]])
    ours = pdaf(predicted, plots(zs), seen_by(predicted), clutter(1.0))
    one = textbook_pdaf(predicted.x, predicted.P, zs, clutter(1.0))
    assert ours.log_p_bar < -1e4
    assert ours.log_p_bar == pytest.approx(one.log_p_bar, rel=1e-12)
    np.testing.assert_allclose(ours.density.x, one.x, rtol=1e-9)


def test_the_weight_of_an_exact_plot_does_not_overflow() -> None:
    """1000 plots right on the target among hardly any false ones: p_bar = 1e305 and more."""
    predicted = Gaussian(np.zeros(4), 1e-8 * np.eye(4))
    sharp = Position((1e-4, 1e-4), 4)
    linear = Linearised(predicted.x[:2], sharp.H, sharp.R)
    zs = np.zeros((1000, 2))
    ours = pdaf(predicted, plots(zs), linear, Clutter(np.array(0.5), np.array(-690.0), 1.0))
    expected = np.log(1000.0) + np.log(0.5) + 690.0 - np.log(2.0 * np.pi * 2e-8)
    assert ours.log_p_bar == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("p_g", "m"), [(0.5, 1), (0.9, 2), (0.9997, 2), (0.99, 3), (1.0, 2)])
def test_the_gate_holds_the_target_with_its_probability(p_g: float, m: int) -> None:
    assert chi2.cdf(gate_threshold(p_g, m), m) == pytest.approx(p_g, rel=1e-12)


def test_a_plot_just_inside_the_gate_counts_and_one_just_outside_does_not() -> None:
    predicted = Gaussian(np.array([10.0, 20.0, 0.0, 0.0]), np.diag([16.0, 5.0, 1.0, 1.0]))
    edge = np.sqrt(chi2.ppf(0.9, 2))
    # S = diag(16 + 9, 5 + 4).
    for direction, sigma in ((np.array([1.0, 0.0]), 5.0), (np.array([0.0, 1.0]), 3.0)):
        for factor, counts in ((1.0 - 1e-9, True), (1.0 + 1e-9, False)):
            z = predicted.x[:2] + factor * edge * sigma * direction
            ours = pdaf(predicted, plots(z[None]), seen_by(predicted), clutter(0.8, 1e-3, 0.9))
            assert (ours.log_p_bar != np.log(1.0 - 0.8 * 0.9)) == counts


def textbook_tight(factor: Gaussian, q: list[float], zs: Array, clutter: Clutter) -> tuple[Array, Array, float]:
    """The factor with weights q, Eq. (7), and Eq. (13) term by term; every plot of q in the gate."""
    ungated = clutter._replace(p_g=1.0)
    log_p_star = textbook_weights(factor.x, factor.P, zs, ungated)
    miss = 1.0 - float(clutter.p_d) * clutter.p_g
    log_p_star[0] = float(np.log(miss)) if miss > 0.0 else -np.inf
    total = 0.0
    for q_j, log_p_j in zip(q, log_p_star, strict=True):
        if q_j > 0.0:
            total += q_j * (log_p_j - np.log(q_j))
    return *textbook_update(factor.x, factor.P, zs, q), total


@pytest.mark.parametrize("p_g", [1.0, 0.9])
@pytest.mark.parametrize("p_d", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("count", [1, 6])
def test_tight_equals_the_loop(count: int, p_d: float, p_g: float, draw: Draw) -> None:
    rng = np.random.default_rng([count, int(10 * p_d), int(10 * p_g)])
    factors, associations = draw(rng, (6,), 4, 8.0), draw(rng, (6,), 4, 3.0)
    zs = rng.normal(0.0, 5.0, (count, 2))
    setting = clutter(np.full(6, p_d), 1e-3, p_g)
    ours, after = tight(factors, associations, plots(zs), (seen_by(factors), seen_by(associations)), setting)
    for row in range(6):
        setting = clutter(p_d, 1e-3, p_g)
        one = textbook_pdaf(associations.x[row], associations.P[row], zs, setting)
        x, P, log_p_bar = textbook_tight(Gaussian(factors.x[row], factors.P[row]), one.p, zs, setting)
        density = Gaussian(ours.density.x[row], ours.density.P[row])
        assert_same(Filtered(density, ours.log_p_bar[row]), x, P, log_p_bar)
        np.testing.assert_allclose(after.x[row], one.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(after.P[row], one.P, rtol=1e-9, atol=1e-9)


@given(count=st.integers(0, 8), p_d=st.sampled_from([0.0, 0.2, 0.9, 1.0]), p_g=st.sampled_from([1.0, 0.9]), seed=SEEDS)
@settings(max_examples=60, deadline=None)
def test_tight_with_its_own_weights_is_equation_6(count: int, p_d: float, p_g: float, seed: int, draw: Draw) -> None:
    rng = np.random.default_rng(seed)
    factor = draw(rng, (3,), 4, 4.0)
    scan, setting = plots(rng.normal(0.0, 6.0, (count, 2))), clutter(np.full(3, p_d), 1e-3, p_g)
    plain = pdaf(factor, scan, seen_by(factor), setting)
    ours, association = tight(factor, factor, scan, (seen_by(factor), seen_by(factor)), setting)
    np.testing.assert_allclose(ours.log_p_bar, plain.log_p_bar, rtol=1e-12, atol=1e-12)
    for density in (ours.density, association):
        np.testing.assert_allclose(density.x, plain.density.x, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(density.P, plain.density.P, rtol=1e-12, atol=1e-12)


def test_tight_never_claims_more_than_the_factor_sees(draw: Draw) -> None:
    """Jensen: for fixed weights q, Eq. (13) lies below the log sum of Eq. (6)."""
    rng = np.random.default_rng(10)
    factors, associations = draw(rng, (200,), 4, 5.0), draw(rng, (200,), 4, 2.0)
    scan, setting = plots(rng.normal(0.0, 5.0, (6, 2))), clutter(np.full(200, 0.6))
    ours, _ = tight(factors, associations, scan, (seen_by(factors), seen_by(associations)), setting)
    plain = pdaf(factors, scan, seen_by(factors), setting)
    assert (ours.log_p_bar <= plain.log_p_bar + 1e-12).all()
    assert (ours.log_p_bar < plain.log_p_bar - 0.01).mean() > 0.9


@given(shape=st.sampled_from(SHAPES), count=st.integers(0, 5), p_g=st.sampled_from([1.0, 0.9]), seed=SEEDS)
@settings(max_examples=40, deadline=None)
def test_a_batch_equals_the_loop(shape: tuple[int, ...], count: int, p_g: float, seed: int, draw: Draw) -> None:
    rng = np.random.default_rng(seed)
    factor, association = draw(rng, shape, 4, 5.0), draw(rng, shape, 4, 3.0)
    z, valid = rng.normal(0.0, 6.0, (*shape, count, 2)), rng.random((*shape, count)) < 0.8
    p_d, log_rho_f = np.asarray(rng.choice([0.0, 0.4, 1.0], size=shape)), np.asarray(rng.normal(-6.0, 1.0, size=shape))
    linear = seen_by(factor), seen_by(association)
    ours, after = tight(factor, association, Plots(z, valid), linear, Clutter(p_d, log_rho_f, p_g))
    plain = pdaf(factor, Plots(z, valid), linear[0], Clutter(p_d, log_rho_f, p_g))
    assert ours.log_p_bar.shape == plain.log_p_bar.shape == shape
    assert ours.density.P.shape == after.P.shape == (*shape, 4, 4)
    for row in np.ndindex(shape):
        here, there = Gaussian(factor.x[row], factor.P[row]), Gaussian(association.x[row], association.P[row])
        scan, setting = Plots(z[row], valid[row]), Clutter(np.array(p_d[row]), np.array(log_rho_f[row]), p_g)
        one, one_after = tight(here, there, scan, (seen_by(here), seen_by(there)), setting)
        alone = pdaf(here, scan, seen_by(here), setting)
        for batch, single in ((ours, one), (plain, alone)):
            np.testing.assert_allclose(batch.log_p_bar[row], single.log_p_bar, rtol=1e-11, atol=1e-11)
            np.testing.assert_allclose(batch.density.x[row], single.density.x, rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(batch.density.P[row], single.density.P, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(after.x[row], one_after.x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(after.P[row], one_after.P, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("sigma", [50.0, 1.0, 0.1])
def test_a_sharp_plot_keeps_the_digits_of_a_wide_prior(sigma: float) -> None:
    """A prior of 100 km, its velocity correlated, seen once: the information form in exact fractions."""
    P = np.array([[1.1e10, 1e9], [1e9, 1e8]])
    a, b, d = (Fraction(value) for value in (1.1e10, 1e9, 1e8))
    det, r = a * d - b * b, Fraction(sigma) ** 2
    J = d / det + 1 / r, -b / det, a / det
    exact_det = J[0] * J[2] - J[1] ** 2
    exact = np.array([[float(J[2] / exact_det), float(-J[1] / exact_det)], [0.0, float(J[0] / exact_det)]])
    exact[1, 0] = exact[0, 1]
    predicted, sensor = Gaussian(np.zeros(2), P), Position((sigma,), 2)
    ours = pdaf(predicted, plots(np.array([[7.0]])), seen_by(predicted, sensor), clutter(1.0))
    scale = np.sqrt(np.diagonal(exact))
    np.testing.assert_allclose(
        ours.density.P / np.outer(scale, scale), exact / np.outer(scale, scale), rtol=0, atol=1e-6
    )


#: Prior sigma, plot sigma, psd, p_d, dt, plots per scan, share: the corners, and a few mixtures.
HARSH = np.array(
    [
        (1e5, 0.1, 0.0, 1.0, 1.0, 1, 1.0),
        (1e5, 0.1, 0.0, 1.0, 1.0, 1, 32.0),
        (1e5, 0.1, 0.0, 0.2, 1.0, 15, 1.0),
        (1e5, 0.1, 0.0, 0.2, 1.0, 15, 32.0),
        (1e5, 0.1, 10.0, 1.0, 1e-3, 1, 32.0),
        (1e5, 0.1, 10.0, 0.2, 1e-3, 15, 32.0),
        (1e5, 0.1, 0.0, 1.0, 1e-3, 15, 1.0),
        (1e5, 0.1, 10.0, 1.0, 300.0, 1, 1.0),
        (1e5, 0.1, 10.0, 0.2, 300.0, 15, 32.0),
        (1e5, 0.1, 0.0, 1.0, 300.0, 1, 1.0),
        (1e5, 50.0, 1e3, 1.0, 2.0, 15, 4.0),
        (1e2, 50.0, 0.0, 0.2, 2.0, 15, 4.0),
        (1e2, 1e3, 1e-6, 1.0, 1e-3, 1, 4.0),
        (1e2, 50.0, 10.0, 0.9, 2.0, 5, 4.0),
    ]
)
CHUNK = 1000


def test_covariances_stay_symmetric_and_positive_definite() -> None:
    """Many steps of all harsh settings at once: 10^5 with WALDNET_EXPLORE=1."""
    sigma0, sigma, psd, p_d, dt, counts, share = HARSH.T
    rng, rows = np.random.default_rng(11), len(HARSH)
    P0 = (share * np.stack([sigma0**2, sigma0**2, np.full(rows, 1e4), np.full(rows, 1e4)])).T
    density = Gaussian(np.zeros((rows, 4)), P0[:, :, None] * np.eye(4))
    F = ConstantVelocity(2, 1.0).transition(dt)
    Q = (share * psd)[:, None, None] * ConstantVelocity(2, 1.0).noise(dt)
    R = (sigma**2)[:, None, None] * np.eye(2)
    setting, valid = Clutter(p_d, np.full(rows, np.log(1e-4)), 1.0), np.arange(15) < counts[:, None]
    for _ in range(100 if os.environ.get("WALDNET_EXPLORE") else 25):
        # The first plot is the target's, the others lie within a few sigmas of where it is believed to be.
        offsets = rng.normal(size=(CHUNK, rows, 15, 2)) * sigma[:, None, None]
        offsets[:, :, 1:] *= 5.0
        P = np.empty((CHUNK, rows, 4, 4))
        for step, offset in enumerate(offsets):
            predicted = predict(density, F, Q)
            z = predicted.x[:, None, :2] + offset
            linear = Linearised(predicted.x[:, :2], np.eye(2, 4), R)
            density = pdaf(predicted, Plots(z, valid), linear, setting).density
            P[step] = density.P
        np.testing.assert_array_equal(P, P.mT)
        scale = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
        assert np.linalg.eigvalsh(P / (scale[..., :, None] * scale[..., None, :])).min() > 0.0
    assert np.isfinite(density.x).all()


def test_absorbing_no_plot_leaves_everything(draw: Draw) -> None:
    predicted = draw(np.random.default_rng(12), (5,), 4)
    expected = expect(predicted, seen_by(predicted), clutter(0.5))
    ours = absorb(expected, np.zeros((5, 3, 2)), np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)))
    np.testing.assert_array_equal(ours.x, predicted.x)
    np.testing.assert_allclose(ours.P, predicted.P, rtol=1e-12)


# Other choices --------------------------------------------------------------------------------------------------------


def heaviest(log_p_star: list[float]) -> list[float]:
    """Nearest neighbour: all weight on the heaviest hypothesis; if none is possible, on the missed detection."""
    best = max(range(len(log_p_star)), key=lambda j: log_p_star[j])
    return [float(j == best) for j in range(len(log_p_star))]


def closest(log_p_star: list[float]) -> list[float]:
    """Kalman with a gate: the missed detection only where no plot is in the gate."""
    hits = [weight if j else -np.inf for j, weight in enumerate(log_p_star)]
    return heaviest(hits if max(hits) > -np.inf else [0.0, *hits[1:]])


CHOICES = pytest.mark.parametrize(("choice", "weights"), [(nearest, heaviest), (kalman, closest)], ids=["nn", "kf"])


@CHOICES
@pytest.mark.parametrize("p_g", [1.0, 0.9, 0.3])
@pytest.mark.parametrize("p_d", [0.0, 0.3, 0.95, 1.0])
@pytest.mark.parametrize("count", [0, 1, 6])
def test_other_choices_equal_the_loop(
    count: int, p_d: float, p_g: float, choice: Choice, weights: Callable[[list[float]], list[float]], draw: Draw
) -> None:
    """Two filters: the association filter chooses, the factor is filtered with its choice, Eq. (13) gives log p_bar."""
    rng = np.random.default_rng([count, int(10 * p_d), int(10 * p_g)])
    factors, associations = draw(rng, (12,), 4, 8.0), draw(rng, (12,), 4, 3.0)
    zs, setting = rng.normal(0.0, 5.0, (count, 2)), clutter(np.full(12, p_d), 1e-3, p_g)
    ours, after = tight(factors, associations, plots(zs), (seen_by(factors), seen_by(associations)), setting, choice)
    for row in range(12):
        one = clutter(p_d, 1e-3, p_g)
        log_p_star = textbook_weights(associations.x[row], associations.P[row], zs, one)
        q = weights(log_p_star)
        possible = log_p_star[q.index(1.0)] > -np.inf
        x, P, log_p_bar = textbook_tight(Gaussian(factors.x[row], factors.P[row]), q, zs, one)
        density = Gaussian(ours.density.x[row], ours.density.P[row])
        assert_same(Filtered(density, ours.log_p_bar[row]), x, P, log_p_bar if possible else -np.inf)
        x, P = textbook_update(associations.x[row], associations.P[row], zs, q)
        np.testing.assert_allclose(after.x[row], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(after.P[row], P, rtol=1e-9, atol=1e-9)


def test_the_choices_differ(draw: Draw) -> None:
    """A plot at the edge of the gate: nearest neighbour takes it for false, Kalman for the target's."""
    predicted = Gaussian(np.zeros(4), np.diag([7.0, 12.0, 1.0, 1.0]))
    z, both = np.array([[11.0, 0.0]]), Gaussian(np.zeros((1, 4)), np.diag([7.0, 12.0, 1.0, 1.0])[None])
    expected = expect(both, seen_by(predicted)._replace(z=np.zeros((1, 2))), clutter(0.5, 1e-2, 0.9997))
    chosen = {choice: update(expected, plots(z), choice) for choice in (nearest, kalman)}
    np.testing.assert_array_equal(chosen[nearest].density.x[0], predicted.x)
    assert chosen[nearest].log_p_bar == pytest.approx(np.log(1.0 - 0.5 * 0.9997))
    np.testing.assert_allclose(chosen[kalman].density.x[0], [11.0 * 7.0 / 16.0, 0.0, 0.0, 0.0], atol=1e-12)


# Plots that are not alike, plots that are angles ----------------------------------------------------------------------


@pytest.mark.parametrize("two", [False, True])
def test_each_plot_is_weighed_with_the_density_of_false_plots_where_it_lies(*, two: bool, draw: Draw) -> None:
    rng = np.random.default_rng(13)
    wide, honest = draw(rng, (5,), 4, 6.0), draw(rng, (5,), 4, 3.0)
    zs, relative = rng.normal(0.0, 5.0, (4, 2)), np.array([0.0, 2.0, -1.5, 0.7])
    setting, scan = clutter(np.full(5, 0.6), 1e-3), Plots(zs, None, relative)
    linear = seen_by(wide), seen_by(honest)
    ours = tight(wide, honest, scan, linear, setting)[0] if two else pdaf(honest, scan, linear[1], setting)
    for row in range(5):
        log_p_star = textbook_weights(honest.x[row], honest.P[row], zs, clutter(0.6))
        log_p_star = [log_p_star[0], *(weight - log for weight, log in zip(log_p_star[1:], relative, strict=True))]
        total = float(logsumexp(log_p_star))
        q = [float(np.exp(weight - total)) for weight in log_p_star]
        if two:
            x, P, log_p_bar = textbook_tight(Gaussian(wide.x[row], wide.P[row]), q, zs, clutter(0.6))
            log_p_bar -= float(np.dot(q[1:], relative))
        else:
            (x, P), log_p_bar = textbook_update(honest.x[row], honest.P[row], zs, q), total
        density = Gaussian(ours.density.x[row], ours.density.P[row])
        assert_same(Filtered(density, ours.log_p_bar[row]), x, P, log_p_bar)


@pytest.mark.parametrize("shared", [False, True])
def test_of_many_plots_each_keeps_its_density_of_false_plots(*, shared: bool, draw: Draw) -> None:
    """So many that each track looks only at those it can reach."""
    rng = np.random.default_rng(14)
    tracks = draw(rng, (6,), 4, 3.0)
    zs, relative = rng.uniform(-2000.0, 2000.0, (4000, 2)), rng.normal(0.0, 2.0, 4000)
    zs[:40] = rng.normal(0.0, 6.0, (40, 2))
    order = rng.permutation(4000)
    zs, relative = zs[order], relative[order]
    close = (np.abs(zs) < 100.0).all(axis=-1)
    near = zs[close]
    scan = Plots(zs, None, relative) if shared else Plots(zs[None], None, relative[None])
    ours = pdaf(tracks, scan, seen_by(tracks), clutter(np.full(6, 0.6), 1e-3, 0.99))
    for row in range(6):
        setting = clutter(0.6, 1e-3, 0.99)
        log_p_star = np.array(textbook_weights(tracks.x[row], tracks.P[row], near, setting)) - [0.0, *relative[close]]
        log_p_bar = float(logsumexp(log_p_star))
        x, P = textbook_update(tracks.x[row], tracks.P[row], near, [float(p) for p in np.exp(log_p_star - log_p_bar)])
        density = Gaussian(ours.density.x[row], ours.density.P[row])
        assert_same(Filtered(density, ours.log_p_bar[row]), x, P, log_p_bar)


def test_angles_differ_around_the_circle() -> None:
    z = np.array([[3.0, 3.1], [3.0, -3.1], [3.0, 7.0], [-4.0, np.pi]])
    expected = np.array([1.0, -3.1])
    straight, around = innovations(z, expected, ()), innovations(z, expected, (1,))
    np.testing.assert_allclose(straight, z - expected)
    np.testing.assert_allclose(around[:, 0], [2.0, 2.0, 2.0, -5.0])
    np.testing.assert_allclose(around[:, 1], [6.2 - 2 * np.pi, 0.0, 10.1 - 4 * np.pi, np.pi + 3.1 - 2 * np.pi])
    assert (np.abs(around[:, 1]) <= np.pi).all()
    np.testing.assert_array_equal(z[0], [3.0, 3.1])


@pytest.mark.parametrize("bearing", [np.pi - 0.01, -np.pi + 0.01, 0.3])
def test_plots_on_both_sides_of_pi_are_near_each_other(bearing: float) -> None:
    """Range and bearing: what is seen is the same wherever north lies."""
    H, R = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]), np.diag([100.0, 4e-4])
    predicted = Gaussian(np.array([1000.0, bearing, 5.0, 0.0]), np.diag([400.0, 1e-4, 4.0, 1e-6]))
    z = np.array([[1010.0, bearing + 0.02], [990.0, bearing - 0.02], [1000.0, bearing + 3.0]])
    wrapped = np.stack([z[:, 0], np.remainder(z[:, 1] + np.pi, 2 * np.pi) - np.pi], axis=-1)
    linear = Linearised(predicted.x[:2], H, R)
    around = pdaf(predicted, Plots(wrapped), linear._replace(angular=(1,)), clutter(0.9, 1e-3, 0.999))
    straight = pdaf(predicted, Plots(z), linear, clutter(0.9, 1e-3, 0.999))
    assert_same(around, straight.density.x, straight.density.P, float(straight.log_p_bar))
    if bearing != 0.3:
        assert pdaf(predicted, Plots(wrapped), linear, clutter(0.9, 1e-3, 0.999)).log_p_bar < straight.log_p_bar - 0.1
