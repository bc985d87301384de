"""Fields of view against SciPy's distribution functions, quadrature in other coordinates, and what must hold anyway."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr
from scipy.stats import kstest, multivariate_normal, ncx2, norm

from waldnet.common.estimation.field_of_view import Box, Disc, Everywhere, FieldOfView
from waldnet.common.estimation.gaussian import Array, Gaussian

Field: TypeAlias = Everywhere | Box | Disc
Draw: TypeAlias = Callable[..., Gaussian]

SHAPES = [(), (1,), (3, 1, 2)]
SEEDS = st.integers(0, 2**32 - 1)
DIMENSIONS = st.sampled_from([2, 3])
FIELDS = [Everywhere(20.0, 2), Box((4.0, 6.0)), Disc(2.5, 2), Everywhere(60.0, 3), Box((4.0, 6.0, 3.0)), Disc(2.5, 3)]
SHAPED = [field for field in FIELDS if not isinstance(field, Everywhere)]


def dimensions(field: Field) -> int:
    return len(field.size) if isinstance(field, Box) else field.dimensions


def inside(field: FieldOfView, x: Array, P: Array, center: Array | None = None) -> float:
    """Probability for one position."""
    return float(field.probability_inside(Gaussian(x, P), np.zeros(len(x)) if center is None else center))


def rotated(rng: np.random.Generator, sigma: Array) -> Array:
    """Covariance with standard deviations ``sigma`` along random axes."""
    axes = np.linalg.qr(rng.normal(size=(len(sigma), len(sigma))))[0]
    P: Array = axes @ np.diag(np.square(sigma)) @ axes.T
    return 0.5 * (P + P.T)


def rectangle(size: tuple[float, ...], x: Array, P: Array) -> float:
    """SciPy's probability of a rectangle: exact in 2-D, to 1e-5 by a randomised rule in 3-D."""
    half, rng = 0.5 * np.array(size), np.random.default_rng(0)
    probability = multivariate_normal.cdf(
        half, x, P, allow_singular=True, maxpts=100_000, abseps=1e-5, lower_limit=-half, rng=rng
    )
    return float(probability)


def nested(size: tuple[float, ...], x: Array, P: Array, nodes: int = 100) -> float:
    """Probability of a box: Gauss-Legendre over the first axes one by one, the last in closed form."""
    L = np.linalg.cholesky(P)
    w, weight = np.empty((1, 0)), np.ones(1)
    node, node_weight = np.polynomial.legendre.leggauss(nodes)
    for i, side in enumerate(size):
        mean = x[i] + w @ L[i, :i]
        low, high = (np.clip((end - mean) / L[i, i], -9.0, 9.0) for end in (-0.5 * side, 0.5 * side))
        if i == len(size) - 1:
            return float(weight @ (ndtr(high) - ndtr(low)))
        half = 0.5 * (high - low)[:, None]
        u = low[:, None] + half * (1.0 + node)
        weight = (weight[:, None] * half * node_weight * np.exp(-0.5 * u * u) / np.sqrt(2.0 * np.pi)).ravel()
        w = np.column_stack([np.repeat(w, nodes, axis=0), u.ravel()])
    raise AssertionError("a box without sides")


def polar(radius: float, x: Array, P: Array) -> float:
    """Probability of a disc or ball by quadrature of the density in polar or spherical coordinates."""
    node, weight = np.polynomial.legendre.leggauss(80)
    r, r_weight = 0.5 * radius * (1.0 + node), 0.5 * radius * weight
    phi = np.arange(160) * (2.0 * np.pi / 160)
    ring = np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    direction, direction_weight = ring, np.full(160, 2.0 * np.pi / 160)
    if len(x) == 3:
        flat = np.broadcast_to(np.sqrt(1.0 - node**2)[:, None, None] * ring, (80, 160, 2))
        height = np.broadcast_to(node[:, None, None], (80, 160, 1))
        direction = np.concatenate([flat, height], axis=-1).reshape(-1, 3)
        direction_weight = np.repeat(weight, 160) * (2.0 * np.pi / 160)
    whitener = np.linalg.inv(np.linalg.cholesky(P))
    w = r[:, None, None] * (direction @ whitener.T) - whitener @ x
    density = np.exp(-0.5 * np.vecdot(w, w)) / (2.0 * np.pi) ** (len(x) / 2) * np.linalg.det(whitener)
    return float((r_weight * r ** (len(x) - 1)) @ density @ direction_weight)


@settings(max_examples=100, deadline=None)
@given(seed=SEEDS, sigma=st.floats(0.01, 100.0), ratio=st.floats(1.0, 100.0))
def test_rectangle_agrees_with_scipy(seed: int, sigma: float, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    size = tuple(rng.uniform(1.0, 4.0, 2))
    P = rotated(rng, np.array([sigma, sigma / ratio]))
    x = rng.uniform(-1.0, 1.0, 2) * (np.array(size) + np.sqrt(np.diag(P)))
    assert inside(Box(size), x, P) == pytest.approx(rectangle(size, x, P), abs=1e-12)


@pytest.mark.parametrize("rho", [-1.0 + 1e-12, -0.999, -0.95, -0.3, 0.0, 1e-15, 0.5, 0.95, 0.999, 1.0 - 1e-12])
@pytest.mark.parametrize("x", [[0.0, 0.0], [1.0, 1.0], [-1.0, 1.0], [1.0, 0.0], [1.0 - 1e-9, -2.0], [3.0, 2.0]])
def test_rectangle_on_its_special_lines(x: list[float], rho: float) -> None:
    """Means on an edge, a corner or an axis of symmetry, where formulas of two arguments like to divide by zero."""
    P = np.array([[1.0, rho], [rho, 1.0]])
    expected = rectangle((2.0, 2.0), np.array(x), P)
    assert inside(Box((2.0, 2.0)), np.array(x), P) == pytest.approx(expected, abs=1e-9)


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, sigma=st.floats(0.1, 10.0), ratio=st.floats(1.0, 5.0))
def test_cuboid_agrees_with_nested_quadrature(seed: int, sigma: float, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    size = tuple(rng.uniform(1.0, 4.0, 3))
    P = rotated(rng, np.geomspace(sigma, sigma / ratio, 3))
    x = rng.uniform(-0.5, 0.5, 3) * (np.array(size) + np.sqrt(np.diag(P)))
    assert inside(Box(size), x, P) == pytest.approx(nested(size, x, P), abs=1e-9)


def test_cuboid_agrees_with_scipy(draw: Draw) -> None:
    rng = np.random.default_rng(2)
    box = Box((3.0, 2.0, 4.0))
    positions = draw(rng, (20,), 3)
    found = box.probability_inside(positions, np.zeros(3))
    expected = [rectangle(box.size, x, P) for x, P in zip(*positions, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=3e-5)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_cuboid_is_rectangle_times_interval_where_one_axis_is_independent(draw: Draw, axis: int) -> None:
    rng = np.random.default_rng(3)
    plane = draw(rng, (), 2)
    others = [i for i in range(3) if i != axis]
    size, x, P = np.array([3.0, 2.0, 4.0]), np.full(3, 1.3), np.eye(3)
    x[others], P[np.ix_(others, others)] = plane
    expected = rectangle(tuple(size[others]), *plane) * rectangle((size[axis],), x[[axis]], P[[axis]][:, [axis]])
    assert inside(Box(tuple(size)), x, P) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("ratio", [1e2, 1e3])
@pytest.mark.parametrize("thin", [1, 2])
def test_cuboid_of_cigars_and_pancakes_does_not_depend_on_the_order_of_axes(ratio: float, thin: int) -> None:
    rng = np.random.default_rng(4)
    box, sigma = Box((1.0, 1.2, 0.9)), np.array([1.0, 1.0, 1.0])
    sigma[-thin:] /= ratio
    for scale in (0.3, 3.0):
        P, x = rotated(rng, scale * sigma), rng.uniform(-0.5, 0.5, 3)
        expected = inside(box, x, P)
        for order in ([1, 2, 0], [2, 0, 1], [1, 0, 2]):
            turned = Box(tuple(np.array(box.size)[order]))
            assert inside(turned, x[order], P[np.ix_(order, order)]) == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("seed", [2, 8, 10, 12, 111, 112, 127])
@pytest.mark.parametrize("side", [1.0, 4.0])
def test_a_thin_cigar_through_a_cuboid_is_not_overlooked(side: float, seed: int) -> None:
    """Thinner than any spacing of quadrature nodes: what counts is how much of its axis lies inside."""
    rng = np.random.default_rng(seed)
    axis = rng.uniform(0.05, 1.0, 3)
    axis /= np.linalg.norm(axis)
    P = 9.0 * np.outer(axis, axis) + 1e-8 * np.eye(3)
    x = rng.uniform(-6.0, 6.0) * axis + 0.3 * rng.normal(size=3)
    ends = np.sort((side * np.array([[-0.5], [0.5]]) - x) / axis, axis=0)
    enters, leaves = ends[0].max(), ends[1].min()
    expected = norm.cdf(max(enters, leaves) / 3.0) - norm.cdf(enters / 3.0)
    assert inside(Box((side, side, side)), x, P) == pytest.approx(expected, abs=1e-6)


@settings(max_examples=50, deadline=None)
@given(seed=SEEDS, sigma=st.floats(0.3, 10.0), ratio=st.floats(1.0, 3.0))
def test_disc_agrees_with_polar_quadrature(seed: int, sigma: float, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    P, x = rotated(rng, np.array([sigma, sigma / ratio])), rng.normal(size=2)
    assert inside(Disc(1.2, 2), x, P) == pytest.approx(polar(1.2, x, P), abs=1e-8)


@pytest.mark.parametrize("seed", range(6))
def test_ball_agrees_with_spherical_quadrature(seed: int) -> None:
    rng = np.random.default_rng(seed)
    P, x = rotated(rng, np.array([2.0, 0.7, 0.3])), rng.normal(size=3)
    assert inside(Disc(1.2, 3), x, P) == pytest.approx(polar(1.2, x, P), abs=1e-8)


@settings(max_examples=100, deadline=None)
@given(seed=SEEDS, dimensions=DIMENSIONS, log_sigma=st.floats(-4.0, 1.0), sigmas_outside=st.floats(-8.0, 8.0))
def test_disc_and_ball_agree_with_noncentral_chi_square(
    seed: int, dimensions: int, log_sigma: float, sigmas_outside: float
) -> None:
    sigma = 10.0**log_sigma
    direction = np.random.default_rng(seed).normal(size=dimensions)
    distance = max(0.0, 1.0 + sigmas_outside * sigma)
    x, P = distance * direction / np.linalg.norm(direction), sigma**2 * np.eye(dimensions)
    expected = ncx2.cdf(sigma**-2, dimensions, (distance / sigma) ** 2)
    assert inside(Disc(1.0, dimensions), x, P) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("angle", np.linspace(0.0, np.pi / 2, 7))
def test_disc_with_a_thin_ellipse_on_its_edge(angle: float) -> None:
    """A needle: what counts is how much of its axis lies on the chord."""
    needle = np.array([np.cos(angle), np.sin(angle)])
    P = 0.3**2 * np.outer(needle, needle) + 1e-12 * np.eye(2)
    x = np.array([0.8, 0.0])
    middle, half = -x @ needle, np.sqrt(1.0 - x @ x + (x @ needle) ** 2)
    expected = norm.cdf((middle + half) / 0.3) - norm.cdf((middle - half) / 0.3)
    assert inside(Disc(1.0, 2), x, P) == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("field", SHAPED)
def test_certainty_is_exact(field: Field) -> None:
    d = dimensions(field)
    center = np.full(d, 7e3)
    P = rotated(np.random.default_rng(5), np.geomspace(0.1, 0.01, d))
    along = np.eye(d)[0]
    edge = 2.0 if isinstance(field, Box) else 2.5
    assert inside(field, center, P, center) == 1.0
    assert inside(field, center + (edge - 0.86) * along, P, center) == 1.0
    assert inside(field, center + (edge + 0.86) * along, P, center) == 0.0
    assert inside(field, center + 1e6 * along, P, center) == 0.0
    assert 0.0 < inside(field, center + (edge - 0.1) * along, P, center) < 1.0


@pytest.mark.parametrize("field", SHAPED)
@pytest.mark.parametrize("sigma", [1e-9, 1e-4, 1e9])
def test_extreme_sizes_stay_probabilities(field: Field, sigma: float) -> None:
    rng = np.random.default_rng(6)
    d = dimensions(field)
    for ratio in (1.0, 1e-6):
        P = rotated(rng, sigma * np.geomspace(1.0, ratio, d))
        edge = 2.0 if isinstance(field, Box) else 2.5
        for distance in (0.0, edge - sigma, edge, edge + sigma, 1e6):
            assert 0.0 <= inside(field, distance * np.eye(d)[0], P) <= 1.0


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("field", FIELDS)
def test_batch_equals_loop(draw: Draw, field: Field, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(7)
    d = dimensions(field)
    positions, centers = draw(rng, shape, d), rng.normal(size=(*shape, d))
    found = field.probability_inside(positions, centers)
    contains = field.contains(positions.x, centers)
    assert found.shape == contains.shape == shape
    assert found.dtype == np.float64
    assert contains.dtype == np.bool_
    for i in np.ndindex(*shape):
        expected = inside(field, positions.x[i], positions.P[i], centers[i])
        assert found[i] == pytest.approx(expected, abs=1e-14)
        assert contains[i] == field.contains(positions.x[i], centers[i])


@pytest.mark.parametrize("field", FIELDS)
def test_centers_and_positions_broadcast(draw: Draw, field: Field) -> None:
    rng = np.random.default_rng(8)
    d = dimensions(field)
    positions, centers = draw(rng, (4,), d), rng.normal(size=(3, 1, d))
    found = field.probability_inside(positions, centers)
    assert found.shape == field.contains(positions.x, centers).shape == (3, 4)
    for i, center in enumerate(centers[:, 0]):
        np.testing.assert_allclose(found[i], field.probability_inside(positions, center), rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("field", SHAPED)
def test_no_tracks_no_probabilities(field: Field) -> None:
    d = dimensions(field)
    assert field.probability_inside(Gaussian(np.empty((0, d)), np.empty((0, d, d))), np.zeros(d)).shape == (0,)


@settings(max_examples=15, deadline=None)
@given(seed=SEEDS, dimensions=DIMENSIONS)
def test_probability_grows_with_the_field(draw: Draw, seed: int, dimensions: int) -> None:
    position = draw(np.random.default_rng(seed), (), dimensions)
    sizes = np.geomspace(0.3, 30.0, 8)
    for fields in ([Disc(r, dimensions) for r in sizes], [Box((r,) * dimensions) for r in sizes]):
        probabilities = [inside(field, *position) for field in fields]
        assert np.all(np.diff(probabilities) >= -1e-10)
        assert probabilities[0] < 0.5 < probabilities[-1]


@settings(max_examples=15, deadline=None)
@given(seed=SEEDS, dimensions=DIMENSIONS)
def test_the_square_around_a_disc_holds_more_than_the_one_within(draw: Draw, seed: int, dimensions: int) -> None:
    position = draw(np.random.default_rng(seed), (), dimensions)
    around, within = Box((3.0,) * dimensions), Box((3.0 / np.sqrt(dimensions),) * dimensions)
    disc = inside(Disc(1.5, dimensions), *position)
    assert inside(within, *position) - 1e-10 <= disc <= inside(around, *position) + 1e-10


@settings(max_examples=15, deadline=None)
@given(seed=SEEDS, field=st.sampled_from(FIELDS))
def test_translation_changes_nothing(draw: Draw, seed: int, field: Field) -> None:
    rng = np.random.default_rng(seed)
    d = dimensions(field)
    position, center, shift = draw(rng, (), d), rng.normal(size=d), rng.uniform(-1e4, 1e4, d)
    moved = inside(field, position.x + shift, position.P, center + shift)
    assert moved == pytest.approx(inside(field, *position, center), abs=1e-10)


@pytest.mark.parametrize("field", SHAPED)
def test_probability_is_the_share_of_samples_that_are_contained(draw: Draw, field: Field) -> None:
    """Monte Carlo: 5 standard deviations, so a correct code fails once in two million seeds."""
    rng = np.random.default_rng(9)
    d = dimensions(field)
    (x, P), center, count = draw(rng, (), d), rng.normal(size=d), 100_000
    p = inside(field, x, P, center)
    share = field.contains(rng.multivariate_normal(x, P, count), center).mean()
    assert abs(share - p) < 5.0 * np.sqrt(p * (1.0 - p) / count)


@pytest.mark.parametrize("field", FIELDS)
def test_everywhere_sees_everything_and_the_others_only_their_volume(field: Field) -> None:
    """Points uniform in a large cube: the share contained is the ratio of volumes, to 5 standard deviations."""
    rng = np.random.default_rng(10)
    d, count, side = dimensions(field), 100_000, 7.0
    center = rng.normal(size=d)
    share = field.contains(center + side * rng.uniform(-0.5, 0.5, (count, d)), center).mean()
    if isinstance(field, Everywhere):
        assert share == 1.0
        assert inside(field, np.full(d, 1e9), np.eye(d)) == 1.0
    else:
        p = field.volume / side**d
        assert abs(share - p) < 5.0 * np.sqrt(p * (1.0 - p) / count)


@pytest.mark.parametrize(
    ("field", "volume"),
    [
        (Everywhere(20.0, 2), 20.0),
        (Box((4.0, 6.0)), 24.0),
        (Box((4.0, 6.0, 0.5)), 12.0),
        (Disc(2.0, 2), 4.0 * np.pi),
        (Disc(3.0, 3), 36.0 * np.pi),
    ],
)
def test_volume(field: FieldOfView, volume: float) -> None:
    assert field.volume == pytest.approx(volume, rel=1e-15)


def test_the_edge_is_inside() -> None:
    assert Box((4.0, 6.0)).contains(np.array([2.0, -3.0]), np.zeros(2))
    assert not Box((4.0, 6.0)).contains(np.array([2.0 + 1e-9, 0.0]), np.zeros(2))
    assert Disc(5.0, 2).contains(np.array([3.0, 4.0]), np.zeros(2))
    assert not Disc(5.0, 2).contains(np.array([3.0, 4.0 + 1e-9]), np.zeros(2))


def uniform_coordinates(field: Field, offset: Array) -> Array:
    """Coordinates of points relative to the center in which a uniform density is uniform on [0, 1]."""
    if isinstance(field, Disc):
        r = np.linalg.norm(offset, axis=-1)
        azimuth = np.arctan2(offset[:, 1], offset[:, 0]) / (2.0 * np.pi) + 0.5
        height = [0.5 + 0.5 * offset[:, 2] / r] if field.dimensions == 3 else []
        return np.stack([(r / field.radius) ** field.dimensions, azimuth, *height])
    d = dimensions(field)
    size = field.size if isinstance(field, Box) else (field.volume ** (1.0 / d),) * d
    unit: Array = offset / np.array(size) + 0.5
    return unit.T


@pytest.mark.parametrize("field", FIELDS)
def test_draw_is_uniform_inside(field: Field) -> None:
    """Kolmogorov-Smirnov per coordinate at 99.9 % and no correlation between them beyond 5 standard deviations."""
    count, d = 20_000, dimensions(field)
    center = 100.0 * np.arange(1.0, d + 1.0)
    points = field.draw(np.random.default_rng(11), count, center)
    assert points.shape == (count, d)
    assert field.contains(points, center).all()
    coordinates = uniform_coordinates(field, points - center)
    assert all(kstest(coordinate, "uniform").pvalue > 1e-3 for coordinate in coordinates)
    assert np.abs(np.corrcoef(coordinates) - np.eye(d)).max() < 5.0 / np.sqrt(count)


@pytest.mark.parametrize("field", FIELDS)
def test_draw_repeats_with_its_seed_and_draws_nothing_on_request(field: Field) -> None:
    center = np.zeros(dimensions(field))
    first, second = (field.draw(np.random.default_rng(12), 5, center) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert field.draw(np.random.default_rng(12), 0, center).shape == (0, len(center))
