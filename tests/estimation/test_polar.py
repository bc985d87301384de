"""Polar, Doppler and bearing sensors against numerical differentiation, Stone Soup, a textbook loop, Monte Carlo."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal
from stonesoup.dataassociator.probability import PDA
from stonesoup.hypothesiser.probability import PDAHypothesiser
from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel
from stonesoup.models.transition.linear import ConstantVelocity as TheirConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.angle import Bearing as TheirBearing
from stonesoup.types.array import StateVector
from stonesoup.types.detection import Detection
from stonesoup.types.numeric import Probability
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track
from stonesoup.updater.kalman import ExtendedKalmanUpdater
from stonesoup.updater.probability import PDAUpdater

from waldnet.common.estimation.association import Clutter, Plots, pdaf
from waldnet.common.estimation.detection import Notch
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.polar import Bearing, Polar, PolarDoppler
from waldnet.common.estimation.sensing import Linearised, Measurement, Position
from waldnet.common.estimation.sight import to_cartesian, to_polar
from waldnet.common.estimation.sigma_points import SigmaPoint

Draw: TypeAlias = Callable[..., Gaussian]

SHAPES = [(), (1,), (3, 1, 2)]
SEEDS = st.integers(0, 2**32 - 1)
PLANE = [Polar((20.0, 0.01), 4), PolarDoppler((20.0, 0.01, 1.0), 4, 300.0), Bearing((0.01,), 4, 2.0 * np.pi)]
SPACE = [
    Polar((20.0, 0.01, 0.02), 6),
    PolarDoppler((20.0, 0.01, 0.02, 1.0), 6, 300.0),
    Bearing((0.01, 0.02), 6, 4.0 * np.pi),
]
KINDS = [*PLANE, *SPACE]
SIGMA_POINT = [SigmaPoint(m, d, isinstance(m, PolarDoppler)) for d, kinds in ((2, PLANE), (3, SPACE)) for m in kinds]


def name(measurement: Measurement) -> str:
    inner = measurement.measurement if isinstance(measurement, SigmaPoint) else measurement
    return f"{type(measurement).__name__}-{type(inner).__name__}-{inner.m}"


def size(measurement: Measurement) -> int:
    inner = measurement.measurement if isinstance(measurement, SigmaPoint) else measurement
    assert isinstance(inner, Polar | PolarDoppler | Bearing)
    return inner.n


def differences(first: Array, second: Array, measurement: Measurement) -> Array:
    """Differences of plots, angles the short way."""
    d = first - second
    for i in measurement.angular:
        d[..., i] = (d[..., i] + np.pi) % (2.0 * np.pi) - np.pi
    return d


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("measurement", KINDS, ids=name)
def test_jacobians_are_the_slopes(draw: Draw, measurement: Measurement, shape: tuple[int, ...]) -> None:
    """Central differences, at targets a few km away all around."""
    rng = np.random.default_rng(1)
    n = size(measurement)
    tracks = Gaussian(draw(rng, shape, n).x * 3000.0, draw(rng, shape, n, 10.0).P)
    origin = rng.normal(0.0, 500.0, n // 2)
    linear = measurement.linearise(tracks, origin)
    assert linear.H.shape == (*shape, measurement.m, n)
    for i in range(n):
        step = np.zeros(n)
        step[i] = 0.01
        ahead, behind = measurement.observe(tracks.x + step, origin), measurement.observe(tracks.x - step, origin)
        slope = differences(ahead, behind, measurement) / 0.02
        np.testing.assert_allclose(linear.H[..., i], slope, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(linear.z, measurement.observe(tracks.x, origin), rtol=1e-12)
    np.testing.assert_allclose(linear.R, np.broadcast_to(measurement.R, linear.R.shape))
    assert linear.angular == measurement.angular


@pytest.mark.parametrize("measurement", [*KINDS, *SIGMA_POINT], ids=name)
def test_a_batch_equals_the_loop(draw: Draw, measurement: Measurement) -> None:
    rng = np.random.default_rng(2)
    n = size(measurement)
    x, P = draw(rng, (3, 1, 2), n, 100.0)
    together = measurement.linearise(Gaussian(x, P), np.zeros(n // 2))
    for i in np.ndindex(3, 1, 2):
        alone = measurement.linearise(Gaussian(x[i], P[i]), np.zeros(n // 2))
        for ours, theirs in zip((together.z, together.H, together.R), (alone.z, alone.H, alone.R), strict=True):
            np.testing.assert_allclose(ours[i], theirs, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("offset", "azimuth"),
    [((0.0, 1.0), 0.0), ((1.0, 0.0), 0.5 * np.pi), ((0.0, -1.0), np.pi), ((-1.0, 0.0), 1.5 * np.pi)],
)
def test_azimuth_counts_clockwise_from_north(offset: tuple[float, float], azimuth: float) -> None:
    x = np.array([*offset, 0.0, 0.0])
    assert PLANE[0].observe(x, np.zeros(2)) == pytest.approx([1.0, azimuth])
    assert PLANE[2].observe(x, np.zeros(2)) == pytest.approx([azimuth])
    high = np.array([*offset, 1.0, 0.0, 0.0, 0.0])
    assert SPACE[0].observe(high, np.zeros(3)) == pytest.approx([np.sqrt(2.0), azimuth, 0.25 * np.pi])
    assert SPACE[2].observe(high, np.zeros(3)) == pytest.approx([azimuth, 0.25 * np.pi])


def test_range_rate_is_positive_for_a_target_that_recedes() -> None:
    assert PLANE[1].observe(np.array([1000.0, 0.0, 30.0, 40.0]), np.zeros(2))[2] == pytest.approx(30.0)
    assert PLANE[1].observe(np.array([0.0, 1000.0, 30.0, -40.0]), np.zeros(2))[2] == pytest.approx(-40.0)
    assert SPACE[1].observe(np.array([0.0, 0.0, 500.0, 3.0, 4.0, 5.0]), np.zeros(3))[3] == pytest.approx(5.0)


@settings(max_examples=50, deadline=None, derandomize=True, database=None)
@given(SEEDS, st.sampled_from([2, 3]))
def test_polar_coordinates_lead_back(seed: int, d: int) -> None:
    points = np.random.default_rng(seed).normal(0.0, 100.0, (5, d))
    np.testing.assert_allclose(to_cartesian(to_polar(points)), points, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("measurement", KINDS, ids=name)
def test_plots_are_located_and_folded(draw: Draw, measurement: Measurement) -> None:
    n = size(measurement)
    d = n // 2
    x, origin = draw(np.random.default_rng(3), (6,), n, 100.0).x, np.full(d, 7.0)
    z = measurement.observe(x, origin)
    np.testing.assert_allclose(measurement.fold(z), z, rtol=1e-9, atol=1e-9)
    offset, place = x[:, :d] - origin, measurement.locate(z, origin) - origin
    if isinstance(measurement, Bearing):
        offset = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    np.testing.assert_allclose(place, offset, rtol=1e-9)


def test_noise_beyond_the_range_of_a_number_is_folded_back() -> None:
    np.testing.assert_allclose(PLANE[0].fold(np.array([-3.0, 0.1])), [3.0, 0.1 + np.pi])
    np.testing.assert_allclose(PLANE[2].fold(np.array([-0.1])), [2.0 * np.pi - 0.1])
    np.testing.assert_allclose(SPACE[2].fold(np.array([0.1, 0.5 * np.pi + 0.2])), [np.pi + 0.1, 0.5 * np.pi - 0.2])
    np.testing.assert_allclose(PLANE[1].fold(np.array([-3.0, 0.1, -8.0])), [3.0, 0.1 + np.pi, -8.0])


# Where no line fits ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spread", [0.0, 1e-9, 1.0, 1e4])
@pytest.mark.parametrize("measurement", [*KINDS, *SIGMA_POINT], ids=name)
@pytest.mark.parametrize("where", ["here", "zenith", "near"])
def test_a_target_at_the_sensor_or_above_it_gives_numbers(measurement: Measurement, where: str, spread: float) -> None:
    n = size(measurement)
    x = np.zeros(n)
    x[n // 2 :] = 10.0
    if where == "near":
        x[0] = 1e-7
    elif where == "zenith" and n == 6:
        x[2] = 500.0
    if isinstance(measurement, SigmaPoint) and spread == 0.0:
        spread = 1e-12
    with np.errstate(all="raise", under="ignore"):
        track = Gaussian(x, spread**2 * np.eye(n) + 1e-30 * np.eye(n))
        linear = measurement.linearise(track, np.zeros(n // 2))
    assert all(np.isfinite(part).all() for part in (linear.z, linear.H, linear.R))
    assert (np.linalg.eigvalsh(linear.R) > 0.0).all()


@pytest.mark.parametrize("measurement", [*KINDS, *SIGMA_POINT], ids=name)
def test_close_by_a_plot_says_little_about_the_position(measurement: Measurement) -> None:
    """A track at the sensor, 100 m wide: an angle tells next to nothing, and a range not the side."""
    n = size(measurement)
    d = n // 2
    track = Gaussian(np.full(n, 1e-3), np.diag([1e4] * d + [100.0] * d))
    linear = measurement.linearise(track, np.zeros(d))
    z = measurement.observe(np.array([60.0, 50.0, 40.0][:d] + [10.0] * d), np.zeros(d))
    after = pdaf(track, Plots(z[None]), linear, Clutter(np.array(1.0), np.array(0.0), 1.0)).density
    sigma = np.sqrt(np.linalg.eigvalsh(after.P[:d, :d]))
    assert sigma[0] > 30.0
    assert np.linalg.norm(after.x[:d]) < 150.0


def test_beyond_one_standard_deviation_it_is_the_plain_ekf() -> None:
    track = Gaussian(np.array([100.0, 0.0, 5.0, 5.0]), np.diag([4900.0, 5000.0, 100.0, 100.0]))
    linear = PLANE[1].linearise(track, np.zeros(2))
    np.testing.assert_array_equal(linear.R, PLANE[1].R)


# Association ----------------------------------------------------------------------------------------------------------


def soup(prior: Gaussian, zs: Array, sensor: Polar, stand: Array, p_d: float, rho_f: float) -> tuple[Array, Array]:
    """One scan of Stone Soup's PDA with its extended Kalman filter.

    Its bearing is counter-clockwise from the first mapped axis: with north mapped first that is clockwise from north.
    """
    order, now = [0, 2, 1, 3], datetime(2026, 1, 1)
    noise = np.diag([sensor.sigma[1] ** 2, sensor.sigma[0] ** 2])
    model = CartesianToBearingRange(4, mapping=(2, 0), noise_covar=noise, translation_offset=stand[::-1, None])
    updater = PDAUpdater(model)
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([TheirConstantVelocity(1.0)] * 2))
    hypothesiser = PDAHypothesiser(
        predictor,
        ExtendedKalmanUpdater(model),
        clutter_spatial_density=rho_f,
        prob_detect=Probability(p_d),
        prob_gate=1.0,
    )
    track = Track([GaussianState(prior.x[order], prior.P[np.ix_(order, order)], timestamp=now)])
    detections = {
        Detection(StateVector([TheirBearing(z[1]), z[0]]), timestamp=now, measurement_model=model) for z in zs
    }
    associated = PDA(hypothesiser).associate({track}, detections, now)[track]
    posterior = updater.update(associated)
    x = np.asarray(posterior.state_vector, dtype=np.float64).ravel()[order]
    return x, np.asarray(posterior.covar, dtype=np.float64)[np.ix_(order, order)]


@pytest.mark.parametrize("place", [[4000.0, 3000.0], [-50.0, -5000.0], [-2000.0, 1e-3]])
@pytest.mark.parametrize("count", [0, 1, 6])
def test_pdaf_equals_stone_soup(draw: Draw, count: int, place: list[float]) -> None:
    """Due south of the sensor too, where Stone Soup's angles jump from pi to -pi."""
    rng = np.random.default_rng(count)
    sensor, stand = Polar((20.0, 0.02), 4), np.array([500.0, -700.0])
    track = Gaussian(np.array([*(stand + place), 30.0, -20.0]), draw(rng, (), 4, 40.0).P)
    zs = sensor.observe(track.x, stand) + rng.normal(size=(count, 2)) * [60.0, 0.04]
    linear = sensor.linearise(track, stand)
    ours = pdaf(track, Plots(zs), linear, Clutter(np.array(0.7), np.array(np.log(1e-3)), 1.0)).density
    x, P = soup(track, zs, sensor, stand, 0.7, 1e-3)
    # Stone Soup differentiates numerically.
    np.testing.assert_allclose(ours.x, x, rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(ours.P, P, rtol=1e-4, atol=1e-1)


@pytest.mark.parametrize("measurement", [*KINDS, *SIGMA_POINT], ids=name)
def test_pdaf_with_uneven_false_plots_equals_the_textbook(draw: Draw, measurement: Measurement) -> None:
    """Eq. (6) and (7) by loops, with the density of false plots at every plot, across north where azimuth jumps."""
    rng = np.random.default_rng(4)
    n = size(measurement)
    track = Gaussian(np.array([1.0, 3000.0, 900.0][: n // 2] + [30.0] * (n // 2)), draw(rng, (), n, 40.0).P)
    linear = measurement.linearise(track, np.zeros(n // 2))
    zs = measurement.fold(linear.z + rng.normal(size=(5, measurement.m)) * 2.0 * np.sqrt(np.diag(measurement.R)))
    relative = measurement.log_stretch(zs)
    clutter = Clutter(np.array(0.6), np.array(-9.0), 1.0)
    ours = pdaf(track, Plots(zs, log_relative=relative), linear, clutter)
    p = textbook_weights(track, linear, zs, np.zeros(5) if relative is None else relative, measurement)
    assert ours.log_p_bar == pytest.approx(np.log(p.sum()), rel=1e-9)
    K = track.P @ linear.H.T @ np.linalg.inv(linear.H @ track.P @ linear.H.T + linear.R)
    nu = p[1:] / p.sum() @ differences(zs, linear.z, measurement)
    np.testing.assert_allclose(ours.density.x, track.x + K @ nu, rtol=1e-9)


def textbook_weights(
    track: Gaussian, linear: Linearised, zs: Array, relative: Array, measurement: Measurement
) -> Array:
    """p*_j of Eq. (6), plot after plot; p_d 0.6, false plots of density exp(-9 + relative)."""
    S = linear.H @ track.P @ linear.H.T + linear.R
    pdf = multivariate_normal(np.zeros(len(S)), S).pdf
    nu = differences(zs, linear.z, measurement)
    return np.array([0.4, *(0.6 / np.exp(-9.0 + r) * pdf(v) for r, v in zip(relative, nu, strict=True))])


def test_a_plot_across_north_is_near() -> None:
    track = Gaussian(np.array([-10.0, 5000.0, 0.0, 0.0]), np.diag([100.0, 100.0, 1.0, 1.0]))
    z = PLANE[0].observe(np.array([10.0, 5000.0, 0.0, 0.0]), np.zeros(2))
    after = pdaf(
        track, Plots(z[None]), PLANE[0].linearise(track, np.zeros(2)), Clutter(np.array(1.0), np.array(0.0), 1.0)
    )
    assert -10.0 < after.density.x[0] < 10.0
    assert after.log_p_bar > -10.0


# Density of false plots -----------------------------------------------------------------------------------------------


def test_a_position_is_what_it_was() -> None:
    position = Position((1.0, 2.0), 4)
    assert position.log_stretch(np.zeros((3, 2))) is None
    assert position.space(12.0) == 12.0
    assert position.angular == ()


@settings(max_examples=50, deadline=None, derandomize=True, database=None)
@given(SEEDS)
def test_the_stretch_is_the_determinant_of_the_way_back(seed: int) -> None:
    """Volume per unit of plot space, by central differences of the conversion to positions."""
    rng = np.random.default_rng(seed)
    for polar in (PLANE[0], SPACE[0]):
        z = np.array([rng.uniform(100.0, 1e4), rng.uniform(0.0, 6.0), rng.uniform(-1.4, 1.4)][: polar.m])
        steps = np.diag([0.01, 1e-5, 1e-5][: polar.m])
        J = (to_cartesian(z + steps) - to_cartesian(z - steps)) / (2.0 * np.diag(steps)[:, None])
        stretch = polar.log_stretch(z)
        assert stretch is not None
        assert stretch == pytest.approx(np.log(abs(np.linalg.det(J))), abs=1e-6)


def test_close_by_and_in_the_zenith_the_stretch_is_that_of_the_noise() -> None:
    assert PLANE[0].log_stretch(np.array([0.0, 0.0])) == pytest.approx(np.log(20.0))
    assert SPACE[2].log_stretch(np.array([0.0, 0.5 * np.pi])) == pytest.approx(np.log(np.sin(0.02)))


def test_a_notch_covers_half_of_the_targets_at_its_mdv() -> None:
    assert Notch(3.0).share(np.array([1000.0, 0.0, 3.0, 50.0]), np.zeros(2)) == pytest.approx(0.5)
