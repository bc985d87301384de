"""Products of mixtures against all combinations of their terms."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import Density, Term, folded, log_normal, multiplied
from scipy.special import logsumexp

from waldnet.common.estimation.gaussian import Array, Gaussian, Product, Whitened, product, whitener
from waldnet.common.estimation.mixture_product import KEEP, multiply_mixtures

Draw: TypeAlias = Callable[..., Gaussian]


def whole(log_a: Array, density: Gaussian, keep: int = 10_000) -> Product:
    return multiply_mixtures(log_a, Whitened(density.x, *whitener(density.P)), keep)


def network(draw: Draw, tracks: int, sensors: int, terms: int, seed: int = 1) -> tuple[Array, Gaussian]:
    """Mixtures near enough to each other that every combination counts."""
    rng = np.random.default_rng([seed, tracks, sensors, terms])
    return rng.normal(0.0, 2.0, (tracks, sensors, terms)), draw(rng, (tracks, sensors, terms), 4, 2.0)


def factors(log_a: Array, density: Gaussian, track: int) -> list[list[Term]]:
    """The mixtures of a track, as the reference has them, without the terms that are none."""
    return [
        [
            Term(float(log_a[track, s, k]), Density(density.x[track, s, k], density.P[track, s, k]))
            for k in np.flatnonzero(log_a[track, s] > -np.inf)
        ]
        for s in range(log_a.shape[1])
    ]


def assert_is(ours: Product, track: int, log_c: float, density: Density, tolerance: float = 1e-9) -> None:
    assert ours.log_c[track] == pytest.approx(log_c, rel=tolerance, abs=tolerance)
    np.testing.assert_allclose(ours.density.x[track], density.x, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(ours.density.P[track], density.P, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(("sensors", "terms"), [(1, 1), (1, 3), (2, 2), (2, 5), (3, 3), (4, 3), (5, 2)])
def test_the_product_is_the_sum_over_all_combinations(sensors: int, terms: int, draw: Draw) -> None:
    log_a, density = network(draw, 3, sensors, terms)
    ours = whole(log_a, density)
    for track in range(3):
        assert_is(ours, track, *multiplied(factors(log_a, density, track)))


def test_terms_that_are_none_count_for_nothing(draw: Draw) -> None:
    log_a, density = network(draw, 4, 3, 3)
    for absent in ((0, 0, 0), (0, 1, 2), (1, 0, 1), (1, 0, 2), (2, 2, 0), (2, 2, 1), (2, 1, 1)):
        log_a[absent] = -np.inf
    for keep in (10_000, 30):
        ours = whole(log_a, density, keep)
        for track in range(4):
            assert_is(ours, track, *multiplied(factors(log_a, density, track)))


def test_with_one_term_each_it_is_the_product_of_gaussians(draw: Draw) -> None:
    log_a, density = network(draw, 3, 4, 1)
    expected = product(Gaussian(density.x[:, :, 0], density.P[:, :, 0]))
    # As it is, and among terms that are none.
    more = np.concatenate([np.full_like(log_a, -np.inf), log_a], axis=-1)
    doubled = Gaussian(*(np.repeat(part, 2, axis=2) for part in density))
    for ours in (whole(log_a, density), whole(more, doubled)):
        np.testing.assert_allclose(ours.log_c, expected.log_c + log_a[:, :, 0].sum(axis=-1), rtol=1e-10)
        np.testing.assert_allclose(ours.density.x, expected.density.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ours.density.P, expected.density.P, rtol=1e-9, atol=1e-9)


@settings(deadline=None, derandomize=True, database=None, max_examples=20)
@given(order=st.permutations(range(4)), seed=st.integers(0, 1000))
def test_the_order_of_the_sensors_does_not_matter(order: list[int], seed: int, draw: Draw) -> None:
    log_a, density = network(draw, 2, 4, 3, seed)
    one, other = whole(log_a, density), whole(log_a[:, order], Gaussian(density.x[:, order], density.P[:, order]))
    np.testing.assert_allclose(one.log_c, other.log_c, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(one.density.x, other.density.x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(one.density.P, other.density.P, rtol=1e-9, atol=1e-9)


def frugal(mixtures: list[list[Term]], keep: int) -> tuple[float, Density]:
    """The heaviest products are kept, with the weight of those that are not, from sensor to sensor."""
    kept = mixtures[0]
    for terms in mixtures[1:]:
        pairs = []
        for one in kept:
            for other in terms:
                log_c = log_normal(other.density.x - one.density.x, one.density.P + other.density.P)
                density = folded([one.density, other.density])[1]
                pairs.append(Term(one.log_g + other.log_g + log_c, density))
        pairs.sort(key=lambda term: -term.log_g)
        lost = logsumexp([term.log_g for term in pairs]) - logsumexp([term.log_g for term in pairs[:keep]])
        kept = [term._replace(log_g=float(term.log_g + lost)) for term in pairs[:keep]]
    return multiplied([kept])


@pytest.mark.parametrize("keep", [1, 2, 5])
def test_of_many_products_the_heaviest_are_kept_and_none_of_the_weight_is_lost(keep: int, draw: Draw) -> None:
    log_a, density = network(draw, 3, 4, 3)
    ours = whole(log_a, density, keep)
    for track in range(3):
        assert_is(ours, track, *frugal(factors(log_a, density, track), keep))
    # With two sensors there is nothing to follow: the integral is exact, however little is kept.
    pair = log_a[:, :2], Gaussian(density.x[:, :2], density.P[:, :2])
    np.testing.assert_allclose(whole(*pair, keep).log_c, whole(*pair).log_c, rtol=1e-12)


def test_the_products_that_are_kept_are_enough(draw: Draw) -> None:
    """Mixtures as reports have them: one term that is right and others some sigma away."""
    log_a, density = network(draw, 20, 4, 3)
    density.x[:, :, 1:] += 6.0
    usual, exact = whole(log_a, density, KEEP), whole(log_a, density)
    assert (usual.log_c != exact.log_c).any()
    np.testing.assert_allclose(usual.log_c, exact.log_c, atol=0.02)


def test_large_coordinates_cost_no_digits(draw: Draw) -> None:
    log_a, density = network(draw, 3, 3, 3)
    shift = np.array([1e7, -1e7, 3e3, -3e3])
    near, far = whole(log_a, density), whole(log_a, Gaussian(density.x + shift, density.P))
    np.testing.assert_allclose(far.log_c, near.log_c, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(far.density.x - shift, near.density.x, atol=1e-7)
    np.testing.assert_allclose(far.density.P, near.density.P, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("apart", [1e3, 1e6])
def test_mixtures_that_contradict_each_other_are_a_number(apart: float, draw: Draw) -> None:
    log_a, density = network(draw, 2, 3, 2)
    density.x[:, 1] += apart
    ours = whole(log_a, density)
    for track in range(2):
        log_c, _ = multiplied(factors(log_a, density, track))
        assert ours.log_c[track] == pytest.approx(log_c, rel=1e-8)
    assert (np.linalg.eigvalsh(ours.density.P) > 0.0).all()


def test_no_tracks_are_no_trouble() -> None:
    for terms in (1, 3):
        ours = whole(np.empty((0, 2, terms)), Gaussian(np.empty((0, 2, terms, 4)), np.empty((0, 2, terms, 4, 4))))
        assert (ours.log_c.shape, ours.density.x.shape, ours.density.P.shape) == ((0,), (0, 4), (0, 4, 4))
