"""Sigma points against dense quadrature and a million samples, and what they are for: where the EKF is poor."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest

from waldnet.common.estimation.association import Clutter, Plots, pdaf
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.polar import Bearing, Polar, PolarDoppler
from waldnet.common.estimation.quadrature import sigma_points
from waldnet.common.estimation.sensing import Linearised, Measurement, Position
from waldnet.common.estimation.sigma_points import SigmaPoint, circular_mean

Draw: TypeAlias = Callable[..., Gaussian]

NOWHERE = np.zeros(2)
POLAR, DOPPLER = Polar((10.0, 0.02), 4), PolarDoppler((10.0, 0.02, 1.0), 4, 300.0)
BEARING = Bearing((0.01,), 4, 2.0 * np.pi)
KINDS: list[Measurement] = [POLAR, DOPPLER, BEARING]
NAMES = ["polar", "doppler", "bearing"]


@pytest.mark.parametrize(("curved", "straight"), [(1, 0), (2, 0), (3, 0), (2, 2), (3, 3)])
def test_sigma_points_have_the_moments_of_a_normal_density(curved: int, straight: int) -> None:
    xi, w = sigma_points(curved, straight)
    assert (w > 0.0).all()
    assert w.sum() == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(w @ xi, 0.0, atol=1e-14)
    np.testing.assert_allclose((w[:, None] * xi).T @ xi, np.eye(curved + straight), atol=1e-14)
    fourth = np.einsum("k,ki,kj->ij", w, xi[:, :curved] ** 2, xi**2)
    expected = 1.0 + 2.0 * np.eye(curved, curved + straight)
    np.testing.assert_allclose(fourth, expected, rtol=1e-14)


def test_a_linear_measurement_is_itself(draw: Draw) -> None:
    position = Position((3.0, 2.0), 4)
    track = draw(np.random.default_rng(1), (3, 2), 4, 5.0)
    ours, exact = SigmaPoint(position, 2, doppler=True).linearise(track, NOWHERE), position.linearise(track, NOWHERE)
    np.testing.assert_allclose(ours.z, exact.z, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(ours.H, np.broadcast_to(exact.H, ours.H.shape), atol=1e-12)
    np.testing.assert_allclose(ours.R, np.broadcast_to(exact.R, ours.R.shape), atol=1e-12)


def by_points(measurement: Measurement) -> SigmaPoint:
    return SigmaPoint(measurement, 2, isinstance(measurement, PolarDoppler))


def moments(measurement: Measurement, track: Gaussian, nodes: int = 24) -> tuple[Array, Array, Array]:
    """Mean of the plot, its covariance with the state and its own, without noise, by a dense product rule."""
    node, weight = np.polynomial.hermite_e.hermegauss(nodes)
    w = np.stack(np.meshgrid(*[weight / weight.sum()] * 4, indexing="ij")).prod(axis=0).ravel()
    xi = np.stack(np.meshgrid(*[node] * 4, indexing="ij"), axis=-1).reshape(-1, 4)
    x = track.x + xi @ np.linalg.cholesky(track.P).T
    reference = measurement.observe(track.x, NOWHERE)
    d = measurement.observe(x, NOWHERE) - reference
    for i in measurement.angular:
        d[:, i] = (d[:, i] + np.pi) % (2.0 * np.pi) - np.pi
    mean = w @ d
    C = (w[:, None] * (d - mean)).T @ (x - track.x)
    return reference + mean, C, (w[:, None] * (d - mean)).T @ (d - mean)


@pytest.mark.parametrize("measurement", KINDS, ids=NAMES)
@pytest.mark.parametrize(("distance", "tolerance"), [(5000.0, 1e-5), (1000.0, 1e-3), (500.0, 0.015)])
def test_moments_are_those_of_dense_quadrature(
    draw: Draw, measurement: Measurement, distance: float, tolerance: float
) -> None:
    """Position known to 150 m, correlated with velocity: errors in standard deviations, which grow as it comes near."""
    A = np.diag([150.0, 150.0, 15.0, 15.0])
    C = draw(np.random.default_rng(2), (), 4).P
    C = C / np.sqrt(np.diag(C)[:, None] * np.diag(C))
    track = Gaussian(np.array([0.6 * distance, 0.8 * distance, 100.0, -30.0]), A @ (0.5 * C + 0.5 * np.eye(4)) @ A)
    linear = by_points(measurement).linearise(track, NOWHERE)
    z, cross, S = moments(measurement, track)
    sigma, sigma_x = np.sqrt(np.diag(S)), np.sqrt(np.diag(track.P))
    assert (np.abs(linear.z - z) / sigma).max() < tolerance
    assert np.abs((linear.H @ track.P - cross) / (sigma[:, None] * sigma_x)).max() < tolerance
    ours = linear.H @ track.P @ linear.H.T + linear.R - measurement.R
    assert np.abs((ours - S) / (sigma[:, None] * sigma)).max() < 3.0 * tolerance


def test_angles_are_averaged_around_the_circle() -> None:
    assert circular_mean(np.array([0.1, 2.0 * np.pi - 0.3]), np.array([0.5, 0.5])) == pytest.approx(-0.1)
    north = Gaussian(np.array([0.0, 1000.0, 0.0, 0.0]), np.diag([1e4, 1e4, 1.0, 1.0]))
    linear = by_points(BEARING).linearise(north, NOWHERE)
    assert np.sin(linear.z[0]) == pytest.approx(0.0, abs=1e-12)
    assert linear.H[0, 0] == pytest.approx(1e-3, rel=0.02)
    assert linear.R[0, 0] < 1e-3


def consistency(linearise: Callable[[Gaussian, Array], Linearised], sensor: Measurement, stands: list[Array]) -> Array:
    """Normalised squared errors of the position after one plot from each stand, 3000 seeded targets; should be 2."""
    rng, count = np.random.default_rng(5), 3000
    x0, P0 = np.array([400.0, 300.0, 0.0, 0.0]), np.diag([150.0, 150.0, 20.0, 20.0]) ** 2
    truth = rng.multivariate_normal(x0, P0, count)
    track = Gaussian(np.tile(x0, (count, 1)), np.tile(P0, (count, 1, 1)))
    for stand in stands:
        z = sensor.observe(truth, stand) + rng.multivariate_normal(np.zeros(sensor.m), sensor.R, count)
        certain = Clutter(np.ones(count), np.array(0.0), 1.0)
        track = pdaf(track, Plots(z[:, None]), linearise(track, stand), certain).density
    error = (truth - track.x)[:, :2]
    return np.asarray(np.vecdot(error, np.linalg.solve(track.P[:, :2, :2], error[..., None])[..., 0]))


@pytest.mark.parametrize(
    ("measurement", "stands"),
    [(POLAR, [NOWHERE]), (DOPPLER, [NOWHERE]), (BEARING, [NOWHERE, np.array([800.0, 0.0])])],
    ids=NAMES,
)
def test_at_short_range_sigma_points_are_consistent_where_the_ekf_is_not(
    measurement: Measurement, stands: list[Array]
) -> None:
    """500 m away, known to 150 m: mean NEES, whose right value is 2, to five standard deviations of its mean.

    Measured: EKF 44, 51, 218 (polar, Doppler, two bearings), sigma points 2.2, 2.4, 2.2.
    """
    ekf = consistency(measurement.linearise, measurement, stands)
    ours = consistency(by_points(measurement).linearise, measurement, stands)
    for values, low, high in ((ekf, 20.0, np.inf), (ours, 0.5, 5.0)):
        margin = 5.0 * values.std() / np.sqrt(len(values))
        assert low < values.mean() - margin
        assert values.mean() + margin < high
