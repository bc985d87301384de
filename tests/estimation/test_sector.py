"""The sector against other fields of view, dense quadrature on a grid, samples, and what must hold anyway."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr
from scipy.stats import kstest

from waldnet.common.estimation.field_of_view import AllAround, Disc
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.sector import Sector

Draw: TypeAlias = Callable[..., Gaussian]

SEEDS = st.integers(0, 2**32 - 1)
RIGHT = 0.5 * np.pi
PLANE = [Sector(10.0, 0.0, 0.7, 1.5), Sector(10.0, 4.0, -2.0, 4.5), Sector(10.0, 2.0, 3.0, 2.0 * np.pi)]
SPACE = [
    Sector(10.0, 0.0, 0.7, 1.5, (-0.2, 0.6)),
    Sector(10.0, 4.0, -2.0, 4.5, (0.1, RIGHT)),
    Sector(10.0, 2.0, 3.0, 2.0 * np.pi, (-RIGHT, RIGHT)),
]
ALL = [*PLANE, *SPACE]


def inside(field: Sector | Disc, x: Array, P: Array) -> float:
    return float(field.probability_inside(Gaussian(x, P), np.zeros(len(x))))


def rotated(rng: np.random.Generator, sigma: Array) -> Array:
    """Covariance with standard deviations ``sigma`` along random axes."""
    axes = np.linalg.qr(rng.normal(size=(len(sigma), len(sigma))))[0]
    P: Array = axes @ np.diag(np.square(sigma)) @ axes.T
    return 0.5 * (P + P.T)


def on_a_grid(field: Sector, x: Array, P: Array) -> float:
    """Quadrature of the density itself in polar coordinates: Gauss-Legendre, 40 pieces of 12 nodes an axis.

    In space, where nothing is as narrow, ranges and elevations get by with 10 pieces, azimuths with 30.
    """

    def rule(low: float, high: float, pieces: int) -> tuple[Array, Array]:
        node, weight = np.polynomial.legendre.leggauss(12)
        edges = np.linspace(low, high, pieces + 1)
        half = 0.5 * np.diff(edges)[:, None]
        return (edges[:-1, None] + half * (1.0 + node)).ravel(), (half * weight).ravel()

    few, many = (40, 40) if field.elevation is None else (10, 30)
    r, wr = rule(field.inner, field.radius, few)
    a, wa = rule(field.direction - 0.5 * field.width, field.direction + 0.5 * field.width, many)
    W = np.linalg.inv(np.linalg.cholesky(P))
    scale = np.linalg.det(W) / (2.0 * np.pi) ** (len(x) / 2)
    total = 0.0
    for e, we in zip(*(rule(*field.elevation, few) if field.elevation else (np.zeros(1), np.ones(1))), strict=True):
        u = np.stack([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.full_like(a, np.sin(e))][: len(x)], axis=-1)
        along, across = u @ W.T, W @ x
        # |r u - x|^2 in whitened coordinates, for all ranges and azimuths.
        square = np.vecdot(along, along) * r[:, None] ** 2 - 2.0 * r[:, None] * (along @ across) + across @ across
        jacobian = r if len(x) == 2 else r**2 * np.cos(e)
        total += we * (wr * jacobian) @ np.exp(-0.5 * square) @ wa
    return float(scale * total)


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(SEEDS, st.floats(0.3, 10.0), st.sampled_from(PLANE))
def test_probability_in_2_d_is_that_of_dense_quadrature(seed: int, sigma: float, field: Sector) -> None:
    rng = np.random.default_rng(seed)
    P = rotated(rng, sigma * np.array([1.0, rng.uniform(0.3, 1.0)]))
    x = field.draw(rng, 1, np.zeros(2))[0] + sigma * rng.normal(size=2)
    assert inside(field, x, P) == pytest.approx(on_a_grid(field, x, P), abs=1e-9)


@settings(max_examples=5, deadline=None, derandomize=True, database=None)
@given(SEEDS, st.floats(1.0, 10.0), st.sampled_from(SPACE))
def test_probability_in_3_d_is_that_of_dense_quadrature(seed: int, sigma: float, field: Sector) -> None:
    rng = np.random.default_rng(seed)
    P = rotated(rng, sigma * np.array([1.0, rng.uniform(0.5, 1.0), 1.0]))
    x = field.draw(rng, 1, np.zeros(3))[0] + sigma * rng.normal(size=3)
    assert inside(field, x, P) == pytest.approx(on_a_grid(field, x, P), abs=1e-8)


@settings(max_examples=30, deadline=None, derandomize=True, database=None)
@given(SEEDS, st.floats(1e-3, 10.0), st.floats(1.0, 100.0), st.sampled_from([2, 3]))
def test_all_around_it_is_the_disc(seed: int, sigma: float, ratio: float, d: int) -> None:
    """Needles too; the ball is computed in another way. A ring is the difference of two discs."""
    rng = np.random.default_rng(seed)
    P = rotated(rng, sigma * np.array([1.0, 1.0 / ratio, 0.5])[:d])
    x = rng.normal(size=d)
    x *= (rng.choice([2.0, 10.0]) + sigma * rng.normal()) / np.linalg.norm(x)
    ring = Sector(10.0, 2.0, 1.0, 2.0 * np.pi, None if d == 2 else (-RIGHT, RIGHT))
    expected = inside(Disc(10.0, d), x, P) - inside(Disc(2.0, d), x, P)
    assert inside(ring, x, P) == pytest.approx(expected, abs=2e-8)


@pytest.mark.parametrize("sigma", [0.01, 0.1, 1.0, 10.0])
@pytest.mark.parametrize("ratio", [1.0, 100.0])
@pytest.mark.parametrize("offset", [-2.0, -0.3, 0.0, 1.0, 4.0])
def test_across_a_straight_edge_it_is_the_distribution_function(sigma: float, ratio: float, offset: float) -> None:
    """A quarter turn that begins due east, far from its corners, on either side of the edge."""
    field, rng = Sector(1e3, 0.0, 0.25 * np.pi, RIGHT), np.random.default_rng(1)
    P = rotated(rng, np.array([sigma, sigma / ratio]))
    across = np.sqrt(P[1, 1])
    x = np.array([500.0, offset * across])
    assert inside(field, x, P) == pytest.approx(float(ndtr(offset)), abs=1e-9)


@pytest.mark.parametrize("field", ALL)
def test_probability_is_the_share_of_samples_that_are_contained(draw: Draw, field: Sector) -> None:
    """Monte Carlo: 5 standard deviations."""
    rng, count, d = np.random.default_rng(9), 200_000, field.dimensions
    for sigma in (1.0, 5.0):
        P, x = rotated(rng, sigma * np.array([1.0, 0.2, 1.0])[:d]), field.draw(rng, 1, np.zeros(d))[0]
        p = inside(field, x, P)
        share = field.contains(rng.multivariate_normal(x, P, count), np.zeros(d)).mean()
        assert abs(share - p) < 5.0 * np.sqrt(max(p * (1.0 - p), 1e-6) / count)


@pytest.mark.parametrize("field", ALL)
@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2), (0,)])
def test_a_batch_equals_the_loop(draw: Draw, field: Sector, shape: tuple[int, ...]) -> None:
    rng, d = np.random.default_rng(7), field.dimensions
    positions, centers = draw(rng, shape, d, 3.0), rng.normal(size=(*shape, d))
    together = field.probability_inside(positions, centers)
    contained = field.contains(positions.x, centers)
    assert together.shape == contained.shape == shape
    for i in np.ndindex(shape):
        alone = inside(field, positions.x[i] - centers[i], positions.P[i])
        assert together[i] == pytest.approx(alone, abs=1e-12)
        assert contained[i] == field.contains(positions.x[i], centers[i])


@pytest.mark.parametrize("field", ALL)
def test_far_inside_it_is_certain_and_far_outside_impossible(field: Sector) -> None:
    d = field.dimensions
    rng = np.random.default_rng(3)
    for x in field.draw(rng, 50, np.zeros(d)):
        assert inside(field, x, 1e-26 * np.eye(d)) == 1.0
    for x in 30.0 * field.draw(rng, 20, np.zeros(d)):
        if np.linalg.norm(x) > 20.0:
            assert inside(field, x, np.eye(d)) == 0.0


@pytest.mark.parametrize("field", ALL)
def test_draw_is_uniform_inside(field: Sector) -> None:
    """Kolmogorov-Smirnov per coordinate at 99.9 %, and the volume is that of the points a cube around it holds."""
    rng, count, d = np.random.default_rng(11), 20_000, field.dimensions
    center = 100.0 * np.arange(1.0, d + 1.0)
    points = field.draw(rng, count, center)
    assert field.contains(points, center).mean() > 0.999
    offset = points - center
    r = np.linalg.norm(offset, axis=-1)
    azimuth = np.remainder(np.arctan2(offset[:, 0], offset[:, 1]) - field.direction + np.pi, 2.0 * np.pi) - np.pi
    assert kstest((r**d - field.inner**d) / (field.radius**d - field.inner**d), "uniform").pvalue > 1e-3
    assert kstest(azimuth / field.width + 0.5, "uniform").pvalue > 1e-3
    if field.elevation is not None:
        low, high = np.sin(field.elevation)
        assert kstest((offset[:, 2] / r - low) / (high - low), "uniform").pvalue > 1e-3
    cube = 20.0 * rng.uniform(-0.5, 0.5, (200_000, d))
    p = field.volume / 20.0**d
    assert abs(field.contains(cube, np.zeros(d)).mean() - p) < 5.0 * np.sqrt(p * (1.0 - p) / 200_000)


def test_the_direction_is_an_azimuth() -> None:
    east = Sector(10.0, 0.0, RIGHT, 0.2)
    assert east.contains(np.array([5.0, 0.0]), np.zeros(2))
    assert not east.contains(np.array([0.0, 5.0]), np.zeros(2))
    assert inside(east, np.array([5.0, 0.0]), 1e-4 * np.eye(2)) == 1.0
    assert Sector(10.0, 0.0, 0.0, 0.2).contains(np.array([0.0, 5.0]), np.zeros(2))


@pytest.mark.parametrize("d", [2, 3])
def test_all_around_sees_every_track_and_draws_every_direction(draw: Draw, d: int) -> None:
    field, rng = AllAround(d), np.random.default_rng(12)
    far = Gaussian(1e9 * draw(rng, (4,), d).x, draw(rng, (4,), d).P)
    np.testing.assert_array_equal(field.probability_inside(far, np.zeros(d)), 1.0)
    assert field.contains(far.x, np.zeros(d)).all()
    points = field.draw(rng, 20_000, np.full(d, 5.0)) - 5.0
    azimuth = np.arctan2(points[:, 0], points[:, 1])
    assert kstest(azimuth / (2.0 * np.pi) + 0.5, "uniform").pvalue > 1e-3
    if d == 3:
        assert kstest(0.5 + 0.5 * points[:, 2] / np.linalg.norm(points, axis=-1), "uniform").pvalue > 1e-3
    assert field.volume == np.inf
