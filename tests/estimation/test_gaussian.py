"""Gaussian densities against quadrature, SciPy, exact fractions and the folded Eq. (8)."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from itertools import permutations
from math import lgamma, log, pi
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_triangular
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from waldnet.common.estimation.gaussian import (
    Array,
    Gaussian,
    half_log_det,
    joseph,
    log_pdf,
    log_sum_exp,
    moments,
    product,
    symmetric,
    whiten,
    whitener,
)

Draw: TypeAlias = Callable[..., Gaussian]

SHAPES = [(), (1,), (3, 1, 2)]
SEEDS = st.integers(0, 2**32 - 1)


def log_normal(at: Array, x: Array, P: Array) -> float:
    return float(multivariate_normal(x, P).logpdf(at))


def combine(x1: Array, P1: Array, x2: Array, P2: Array) -> tuple[Array, Array]:
    """Convex combination of two densities, Eq. (9)."""
    P = np.linalg.inv(np.linalg.inv(P1) + np.linalg.inv(P2))
    return P @ (np.linalg.inv(P1) @ x1 + np.linalg.inv(P2) @ x2), P


def fold(factors: Gaussian) -> tuple[float, Array, Array]:
    """Eq. (8), one sensor after the other: log c and the product."""
    x, P, log_c = factors.x[0], factors.P[0], 0.0
    for x_s, P_s in zip(factors.x[1:], factors.P[1:], strict=True):
        log_c += log_normal(x_s, x, P + P_s)
        x, P = combine(x, P, x_s, P_s)
    return log_c, x, P


def quadrature(factors: Gaussian, points: int) -> float:
    """Log integral of the product on a uniform grid, on which sums of smooth decaying functions converge at once."""
    n = factors.x.shape[-1]
    sigma = np.sqrt(np.diagonal(factors.P, axis1=-2, axis2=-1))
    low, high = (factors.x - 9.0 * sigma).max(axis=0), (factors.x + 9.0 * sigma).min(axis=0)
    axes = [np.linspace(low[i], high[i], points) for i in range(n)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    log_product = sum(multivariate_normal(x, P).logpdf(grid) for x, P in zip(*factors, strict=True))
    return float(logsumexp(log_product) + np.log((high - low) / (points - 1)).sum())


def exact_solve(A: list[list[Fraction]], B: list[list[Fraction]]) -> tuple[list[list[Fraction]], Fraction]:
    """``A^-1 B`` and det A without rounding; Gauss-Jordan for positive definite A."""
    n, rows, det = len(A), [[*a, *b] for a, b in zip(A, B, strict=True)], Fraction(1)
    for i in range(n):
        det *= rows[i][i]
        rows[i] = [value / rows[i][i] for value in rows[i]]
        for j in set(range(n)) - {i}:
            rows[j] = [value - rows[j][i] * pivot for value, pivot in zip(rows[j], rows[i], strict=True)]
    return [row[n:] for row in rows], det


def exact_log(value: Fraction) -> float:
    return log(value.numerator) - log(value.denominator)


def exact_log_c(factors: Gaussian) -> float:
    """log c by completing the square in exact fractions; only the logarithms round."""
    count, n = factors.x.shape
    information = [[Fraction(0)] * n for _ in range(n)]
    vector, square, log_dets = [Fraction(0)] * n, Fraction(0), 0.0
    for x_s, P_s in zip(*factors, strict=True):
        x = [Fraction(float(value)) for value in x_s]
        P = [[Fraction(float(value)) for value in row] for row in P_s]
        J, det = exact_solve(P, [[Fraction(int(i == j)) for j in range(n)] for i in range(n)])
        y = [sum((J[i][j] * x[j] for j in range(n)), Fraction(0)) for i in range(n)]
        information = [[a + b for a, b in zip(*pair, strict=True)] for pair in zip(information, J, strict=True)]
        vector = [a + b for a, b in zip(vector, y, strict=True)]
        square += sum((a * b for a, b in zip(x, y, strict=True)), Fraction(0))
        log_dets += exact_log(det)
    fused, det = exact_solve(information, [[value] for value in vector])
    square -= sum((a * b[0] for a, b in zip(vector, fused, strict=True)), Fraction(0))
    return -0.5 * (float(square) + log_dets + exact_log(det) + (count - 1) * n * log(2 * pi))


@pytest.mark.parametrize("n_sensors", [2, 3, 4, 5])
@pytest.mark.parametrize(("n", "points"), [(1, 20_000), (2, 700)])
def test_log_c_is_the_integral_of_the_product(n: int, points: int, n_sensors: int, draw: Draw) -> None:
    factors = draw(np.random.default_rng([n, n_sensors]), (n_sensors,), n)
    assert product(factors).log_c == pytest.approx(quadrature(factors, points), abs=1e-9)


@pytest.mark.parametrize("n_sensors", [1, 2, 3, 5, 32])
@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_product_equals_the_folded_equation_8(n: int, n_sensors: int, draw: Draw) -> None:
    factors = draw(np.random.default_rng([n, n_sensors]), (n_sensors,), n, 50.0)
    log_c, x, P = fold(factors)
    ours = product(factors)
    assert ours.log_c == pytest.approx(log_c, rel=1e-10, abs=1e-10)
    np.testing.assert_allclose(ours.density.x, x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ours.density.P, P, rtol=1e-9, atol=1e-9)


def test_product_is_c_times_its_density_everywhere(draw: Draw) -> None:
    rng = np.random.default_rng(1)
    factors = draw(rng, (3,), 4)
    at = rng.normal(size=(20, 4))
    ours = product(factors)
    left = sum(multivariate_normal(x, P).logpdf(at) for x, P in zip(*factors, strict=True))
    right = ours.log_c + multivariate_normal(ours.density.x, ours.density.P).logpdf(at)
    np.testing.assert_allclose(left, right, rtol=1e-11, atol=1e-11)


def test_product_does_not_depend_on_the_order_of_sensors(draw: Draw) -> None:
    factors = draw(np.random.default_rng(2), (4,), 4, 30.0)
    first = product(factors)
    for order in permutations(range(4)):
        other = product(Gaussian(factors.x[list(order)], factors.P[list(order)]))
        assert other.log_c == pytest.approx(first.log_c, rel=1e-12)
        np.testing.assert_allclose(other.density.x, first.density.x, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(other.density.P, first.density.P, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("offset", [1e6, -3e6])
def test_far_from_the_origin_nothing_changes(offset: float, draw: Draw) -> None:
    factors = draw(np.random.default_rng(3), (5,), 4, 20.0)
    # Rounded to 1/256 m, the far coordinates are the near ones exactly.
    near = Gaussian(np.round(factors.x * 256.0) / 256.0, factors.P)
    here, there = product(near), product(Gaussian(near.x + offset, near.P))
    assert abs(here.log_c - there.log_c) < 1e-6
    # To two units in the last place of the offset: the sum of the information is taken around a point nearby.
    assert np.abs(here.density.x + offset - there.density.x).max() <= 2.0 * np.spacing(abs(offset))
    assert np.abs(here.density.P - there.density.P).max() < 1e-6
    z = near.x[0] + 7.0
    far = Gaussian(near.x + offset, near.P)
    np.testing.assert_allclose(log_pdf(z + offset, far), log_pdf(z, near), rtol=0, atol=1e-9)


@pytest.mark.parametrize("members", [(1, 1, 1, 0), (0, 1, 1, 0), (1, 0, 1, 1), (0, 0, 1, 0)])
def test_factors_that_are_no_members_are_left_out(members: tuple[int, ...], draw: Draw) -> None:
    factors = draw(np.random.default_rng(4), (4,), 4)
    mask = np.array(members, np.bool_)
    log_c, x, P = fold(Gaussian(factors.x[mask], factors.P[mask]))
    ours = product(factors, mask)
    assert ours.log_c == pytest.approx(log_c, rel=1e-12, abs=1e-12)
    np.testing.assert_allclose(ours.density.x, x, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(ours.density.P, P, rtol=1e-10, atol=1e-10)


def test_members_are_chosen_row_by_row(draw: Draw) -> None:
    rng = np.random.default_rng(5)
    factors, members = draw(rng, (3, 2, 4), 4), rng.random((3, 2, 4)) < 0.6
    members[..., 1] = True
    ours = product(factors, members)
    for row in np.ndindex(3, 2):
        log_c, x, _ = fold(Gaussian(factors.x[row][members[row]], factors.P[row][members[row]]))
        assert ours.log_c[row] == pytest.approx(log_c, rel=1e-11, abs=1e-11)
        np.testing.assert_allclose(ours.density.x[row], x, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("sigma", [0.1, 50.0])
def test_log_c_of_very_wide_and_very_narrow_factors_is_exact(sigma: float) -> None:
    """A sensor that knows 10 cm beside sensors that know nothing yet: prior of 100 km, velocities correlated."""
    rng = np.random.default_rng(6)
    wide = 5.0 * np.diag([1e10, 1e10, 1e4, 1e4])
    F = np.eye(4) + 10.0 * np.eye(4, k=2)
    wide = F @ wide @ F.T
    gain = wide[:, :2] @ np.linalg.inv(wide[:2, :2] + sigma**2 * np.eye(2))
    shrink = np.eye(4) - gain @ np.eye(2, 4)
    narrow = shrink @ wide @ shrink.T + sigma**2 * gain @ gain.T
    P = np.array([wide, wide, symmetric(narrow), 2.0 * wide, symmetric(3.0 * narrow)])
    x = np.array([1e6, -1e6, 10.0, 5.0]) + rng.normal(size=(5, 4)) * np.array([sigma, sigma, 50.0, 50.0])
    assert product(Gaussian(x, P)).log_c == pytest.approx(exact_log_c(Gaussian(x, P)), abs=1e-6)


@given(shape=st.sampled_from(SHAPES), n=st.integers(1, 6), n_sensors=st.integers(1, 5), seed=SEEDS)
@settings(max_examples=30, deadline=None)
def test_product_of_a_batch_equals_the_loop(
    shape: tuple[int, ...], n: int, n_sensors: int, seed: int, draw: Draw
) -> None:
    factors = draw(np.random.default_rng(seed), (*shape, n_sensors), n)
    ours = product(factors)
    assert ours.log_c.shape == shape
    assert ours.density.x.shape == (*shape, n)
    assert ours.density.P.shape == (*shape, n, n)
    for row in np.ndindex(shape):
        one = product(Gaussian(factors.x[row], factors.P[row]))
        np.testing.assert_allclose(ours.log_c[row], one.log_c, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(ours.density.x[row], one.density.x, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(ours.density.P[row], one.density.P, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("n", [1, 2, 4])
def test_log_pdf_equals_scipy(n: int, shape: tuple[int, ...], draw: Draw) -> None:
    rng = np.random.default_rng([n, len(shape)])
    density, at = draw(rng, shape, n), rng.normal(size=(*shape, n))
    ours = log_pdf(at, density)
    assert ours.shape == shape
    for row in np.ndindex(shape):
        assert ours[row] == pytest.approx(log_normal(at[row], density.x[row], density.P[row]), rel=1e-12)


def test_log_pdf_broadcasts_points_against_densities(draw: Draw) -> None:
    rng = np.random.default_rng(7)
    density, at = draw(rng, (3,), 2), rng.normal(size=(5, 1, 2))
    expected = [[log_normal(point[0], x, P) for x, P in zip(*density, strict=True)] for point in at]
    np.testing.assert_allclose(log_pdf(at, density), expected, rtol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_whiten_and_half_log_det_equal_scipy(n: int, shape: tuple[int, ...], draw: Draw) -> None:
    rng = np.random.default_rng([n, len(shape)])
    P, d = draw(rng, shape, n).P, rng.normal(size=(*shape, n))
    L = np.linalg.cholesky(P)
    w, half = whiten(L, d), half_log_det(L)
    assert w.shape == (*shape, n)
    assert half.shape == shape
    for row in np.ndindex(shape):
        np.testing.assert_allclose(w[row], solve_triangular(L[row], d[row], lower=True), rtol=1e-11, atol=1e-12)
        assert half[row] == pytest.approx(0.5 * np.linalg.slogdet(P[row])[1], rel=1e-11, abs=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_whitener_is_the_inverse_of_the_cholesky_factor(n: int, shape: tuple[int, ...], draw: Draw) -> None:
    P = draw(np.random.default_rng([n, len(shape)]), shape, n).P
    W, half = whitener(P)
    assert W.shape == (*shape, n, n)
    assert half.shape == shape
    for row in np.ndindex(shape):
        expected = solve_triangular(np.linalg.cholesky(P[row]), np.eye(n), lower=True)
        np.testing.assert_allclose(W[row], expected, rtol=1e-11, atol=1e-12)
        assert half[row] == pytest.approx(0.5 * np.linalg.slogdet(P[row])[1], rel=1e-11, abs=1e-12)


def test_whitener_does_not_depend_on_the_rest_of_the_batch(draw: Draw) -> None:
    P = draw(np.random.default_rng(12), (5, 2), 4, 100.0).P
    W, half = whitener(P)  # by elimination, a few by LAPACK
    for row in np.ndindex(5, 2):
        one, one_half = whitener(P[row])
        np.testing.assert_allclose(W[row], one, rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(half[row], one_half, rtol=1e-15)


NOT_POSITIVE = [
    np.zeros((3, 3)),
    np.ones((3, 3)),
    np.diag([1.0, -1.0, 1.0]),
    np.diag([1.0, 1.0, 0.0]),
    np.array([[1.0, 1e300, 0.0], [1e300, 1.0, 1e300], [0.0, 1e300, 1.0]]),
    np.full((3, 3), np.nan),
]


@pytest.mark.parametrize("P", NOT_POSITIVE)
def test_one_matrix_that_is_not_positive_definite_is_an_error_and_no_warning(P: Array) -> None:
    for batch in (P, np.stack([np.eye(3), P])):
        with pytest.raises(np.linalg.LinAlgError):
            whitener(batch)


def test_whitener_of_nothing_is_nothing() -> None:
    W, half = whitener(np.empty((0, 4, 4)))
    assert (W.shape, half.shape) == ((0, 4, 4), (0,))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_joseph_is_the_covariance_of_any_gain(scale: float, draw: Draw) -> None:
    """Of an estimate x + K (z - H x): the error is (I - K H) e_x + K e_z."""
    rng = np.random.default_rng(13)
    P, R = draw(rng, (3,), 4, scale).P, draw(rng, (3,), 2).P
    K, H = rng.normal(size=(3, 4, 2)), rng.normal(size=(3, 2, 4))
    ours, shared = joseph(P, K, H, R), joseph(P, K, H[0], R[0])
    for row in range(3):
        for result, h, r in ((ours, H[row], R[row]), (shared, H[0], R[0])):
            A = np.eye(4) - K[row] @ h
            expected = A @ P[row] @ A.T + K[row] @ r @ K[row].T
            np.testing.assert_allclose(result[row], expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_array_equal(ours, ours.mT)


def test_whiten_broadcasts_both_ways(draw: Draw) -> None:
    rng = np.random.default_rng(8)
    L = np.linalg.cholesky(draw(rng, (3, 1), 4).P)
    d = rng.normal(size=(5, 4))
    w = whiten(L, d)
    assert w.shape == (3, 5, 4)
    np.testing.assert_allclose(np.matvec(L, w), np.broadcast_to(d, w.shape), rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("shape", SHAPES)
def test_moments_are_those_of_the_mixture(shape: tuple[int, ...], draw: Draw) -> None:
    rng = np.random.default_rng(9)
    components, weights = draw(rng, (*shape, 5), 3), rng.dirichlet(np.ones(5), size=shape)
    ours = moments(weights, components)
    assert ours.x.shape == (*shape, 3)
    for row in np.ndindex(shape):
        first, second = np.zeros(3), np.zeros((3, 3))
        for a, x, P in zip(weights[row], components.x[row], components.P[row], strict=True):
            first += a * x
            second += a * (P + np.outer(x, x))
        np.testing.assert_allclose(ours.x[row], first, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(ours.P[row], second - np.outer(first, first), rtol=1e-11, atol=1e-11)
    np.testing.assert_array_equal(ours.P, ours.P.mT)


def test_moments_far_from_the_origin_keep_their_digits() -> None:
    components = Gaussian(1e7 + np.array([[0.0], [2.0]]), np.array([[[0.25]], [[0.25]]]))
    ours = moments(np.array([0.5, 0.5]), components)
    assert ours.P[0, 0] == pytest.approx(1.25, rel=1e-12)


@pytest.mark.parametrize("scale", [1.0, 1e3, 1e300])
@pytest.mark.parametrize("shape", SHAPES)
def test_log_sum_exp_equals_scipy(shape: tuple[int, ...], scale: float) -> None:
    rng = np.random.default_rng(10)
    log_weights = scale * rng.normal(size=(*shape, 6))
    log_weights[..., 2] = -np.inf
    ours = log_sum_exp(log_weights)
    assert ours.shape == shape
    np.testing.assert_allclose(ours, logsumexp(log_weights, axis=-1), rtol=1e-14)


def test_log_sum_exp_of_nothing_is_minus_infinity() -> None:
    assert log_sum_exp(np.full(4, -np.inf)) == -np.inf
    np.testing.assert_array_equal(log_sum_exp(np.array([[-np.inf, -np.inf], [-np.inf, -1e5]])), [-np.inf, -1e5])


def test_log_sum_exp_neither_over_nor_underflows() -> None:
    # log(4!) by adding up 24 equal weights, far beyond what exp can hold.
    for shift in (-1e5, 0.0, 1e5):
        assert log_sum_exp(np.full(24, shift)) - shift == pytest.approx(lgamma(5.0), abs=1e-10)


def test_symmetric_takes_the_mean_of_both_halves() -> None:
    A = np.random.default_rng(11).normal(size=(2, 3, 3))
    ours = symmetric(A)
    np.testing.assert_array_equal(ours, ours.mT)
    np.testing.assert_allclose(ours[..., 0, 1], 0.5 * (A[..., 0, 1] + A[..., 1, 0]))
    np.testing.assert_allclose(np.einsum("kii->ki", ours), np.einsum("kii->ki", A))
