"""The clutter notch against quadrature of Bayes' theorem: weights, moments, evidence; and what must hold anyway."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from waldnet.common.estimation.association import Clutter, Expected, Filtered, Plots, expect, kalman, nearest, update
from waldnet.common.estimation.detection import Notch
from waldnet.common.estimation.field_of_view import Everywhere
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.notch import Hypotheses, filtered, hypotheses
from waldnet.common.estimation.sensing import Position, Sensor

Draw: TypeAlias = Callable[..., Gaussian]

SHAPES = [(), (1,), (3, 1, 2)]
SEEDS = st.integers(0, 2**32 - 1)
SENSOR = Position((3.0, 2.0), 4)
NOTCH = Notch(4.0)
#: So far away that the line of sight is the same for all of a track: n_c is linear, as the filter takes it to be.
FAR = np.array([1e12, 0.0])
P_D, RHO_F = 0.8, 1e-3


class Truth(NamedTuple):
    """Weights, evidence and moments by quadrature, of every hypothesis and of all together."""

    log_p_star: Array
    x: Array
    P: Array
    log_p_bar: float
    mean: Array
    covariance: Array


def expected(tracks: Gaussian, p_d: float | Array = P_D, p_g: float = 1.0) -> Expected:
    """One or two filters per track, seen by the radar without its notch."""
    p_d = np.broadcast_to(np.asarray(p_d, dtype=np.float64), tracks.x.shape[1:-1])
    return expect(tracks, SENSOR.linearise(tracks, FAR), Clutter(p_d, np.array(np.log(RHO_F)), p_g))


def one(track: Gaussian) -> Gaussian:
    """A single filter, its axis put in front."""
    return Gaussian(track.x[None], track.P[None])


def by_quadrature(track: Gaussian, zs: Array, p_d: float, notch: Notch) -> Truth:
    """Prior times Eq. (1) with p_d(x), by a product rule of 28 points an axis over the four numbers of the state."""
    node, weight = np.polynomial.hermite_e.hermegauss(28)
    w = np.stack(np.meshgrid(*[weight / weight.sum()] * 4, indexing="ij")).prod(axis=0).ravel()
    xi = np.stack(np.meshgrid(*[node] * 4, indexing="ij"), axis=-1).reshape(-1, 4)
    log_p_star, means, covariances, joints = [], [], [], []
    for j, z in enumerate([None, *zs]):
        # For a plot, the Gaussian after it carries the quadrature, so that the rest of the integrand is smooth.
        density, scale = (track, 1.0) if z is None else conditioned(track, z)
        x = density.x + xi @ np.linalg.cholesky(density.P).T
        n_c = -x[:, 2]
        seen = p_d * (1.0 - np.exp(-np.log(2.0) * (n_c / notch.mdv) ** 2))
        share = w * (1.0 - seen if j == 0 else seen / RHO_F * scale)
        total = share.sum()
        mean = share @ x / total
        log_p_star.append(np.log(total))
        means.append(mean)
        covariances.append((share[:, None] * (x - mean)).T @ (x - mean) / total)
        joints.append(total)
    p = np.array(joints) / sum(joints)
    mean = p @ np.array(means)
    spread = np.array(means) - mean
    covariance = np.einsum("j,jkl->kl", p, np.array(covariances)) + np.einsum("j,jk,jl->kl", p, spread, spread)
    return Truth(np.array(log_p_star), np.array(means), np.array(covariances), np.log(sum(joints)), mean, covariance)


def conditioned(track: Gaussian, z: Array) -> tuple[Gaussian, float]:
    """The density after a plot, and the density of the plot."""
    H, R = SENSOR.H, SENSOR.R
    S = H @ track.P @ H.T + R
    K = track.P @ H.T @ np.linalg.inv(S)
    nu = z - H @ track.x
    scale = np.exp(-0.5 * nu @ np.linalg.inv(S) @ nu) / np.sqrt(np.linalg.det(2.0 * np.pi * S))
    return Gaussian(track.x + K @ nu, (np.eye(4) - K @ H) @ track.P), float(scale)


def crossing(draw: Draw, seed: int, speed: float) -> Gaussian:
    """A track near the origin whose radial speed is about ``speed``."""
    track = draw(np.random.default_rng(seed), (), 4, 2.0)
    return Gaussian(np.array([1.0, -2.0, -speed, 5.0]), track.P)


@pytest.mark.parametrize("speed", [0.0, 2.0, -6.0, 12.0])
@pytest.mark.parametrize("p_d", [0.3, 1.0])
def test_every_hypothesis_is_bayes_theorem(draw: Draw, p_d: float, speed: float) -> None:
    track = crossing(draw, 1, speed)
    zs = np.array([[2.0, -1.0], [-3.0, 2.0]])
    truth = by_quadrature(track, zs, p_d, NOTCH)
    found = hypotheses(expected(one(track), p_d), Plots(zs), NOTCH, FAR)
    # Outside the notch and with p_d = 1 a miss has little weight, and quadrature fewer digits for it.
    tolerance = 1e-7 if speed < 10.0 or p_d < 1.0 else 1e-4
    np.testing.assert_allclose(found.log_p_star[0], truth.log_p_star, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(found.density.x[0], truth.x, rtol=0.0, atol=10.0 * tolerance)
    np.testing.assert_allclose(found.density.P[0], truth.P, rtol=0.0, atol=100.0 * tolerance)
    merged = filtered(found)
    assert merged.log_p_bar == pytest.approx(truth.log_p_bar, abs=1e-7)
    np.testing.assert_allclose(merged.density.x[0], truth.mean, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(merged.density.P[0], truth.covariance, rtol=0.0, atol=1e-5)


def test_a_miss_sharpens_the_radial_speed_and_nothing_else() -> None:
    """A target that may cross: the miss says that it does."""
    track = one(Gaussian(np.array([0.0, 0.0, 3.0, 20.0]), np.diag([1e4, 1e4, 100.0, 100.0])))
    missed = filtered(hypotheses(expected(track, 0.95), Plots(np.empty((0, 2))), NOTCH, FAR))
    before, after = np.sqrt(np.diag(track.P[0])), np.sqrt(np.diag(missed.density.P[0]))
    assert after[2] < 0.7 * before[2]
    np.testing.assert_allclose(after[[0, 1, 3]], before[[0, 1, 3]], rtol=1e-9)
    assert abs(missed.density.x[0, 2]) < abs(track.x[0, 2])


def test_two_radars_from_different_sides_sharpen_the_whole_velocity() -> None:
    """One that cannot be seen from two sides stands still."""
    P = np.diag([1e4, 1e4, 100.0, 100.0])
    track = one(Gaussian(np.array([0.0, 0.0, 3.0, 4.0]), P))
    for stand in (FAR, FAR[::-1]):
        track = filtered(hypotheses(expected(track, 0.95), Plots(np.empty((0, 2))), NOTCH, stand)).density
    sigma = np.sqrt(np.diag(track.P[0]))
    assert (sigma[2:] < 7.0).all()
    np.testing.assert_allclose(sigma[:2], 100.0, rtol=1e-6)


def test_a_plot_says_that_the_target_does_not_cross(draw: Draw) -> None:
    track = one(Gaussian(np.array([0.0, 0.0, 3.0, 20.0]), np.diag([1e4, 1e4, 9.0, 100.0])))
    found = hypotheses(expected(track), Plots(np.zeros((1, 2))), NOTCH, FAR)
    assert found.density.x[0, 1, 2] > 4.0
    assert found.density.P[0, 1, 2, 2] > 0.0


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(SEEDS, st.floats(1e-8, 1e8), st.floats(-50.0, 50.0), st.floats(0.0, 1.0))
def test_covariances_stay_positive_definite(draw: Draw, seed: int, spread: float, speed: float, p_d: float) -> None:
    """From states known to a hair to states of which nothing is known, in the middle of the notch and far from it."""
    rng = np.random.default_rng(seed)
    track = Gaussian(np.array([1.0, -2.0, speed, 5.0]), draw(rng, (), 4).P * spread)
    found = hypotheses(expected(one(track), p_d), Plots(rng.normal(size=(3, 2))), NOTCH, FAR)
    assert np.isfinite(found.density.x).all()
    D = np.sqrt(np.diagonal(found.density.P, axis1=-2, axis2=-1))
    assert (np.linalg.eigvalsh(found.density.P / (D[..., :, None] * D[..., None, :])) > 0.0).all()
    # Either sign of the mixture: a plot may spread the radial speed into two humps, and never narrows it much.
    ratio = found.density.P[0, 1:, 2, 2] / expected(one(track), p_d).P_hit[0, 2, 2]
    assert (ratio > 0.5).all()


def test_the_middle_of_the_notch_and_a_state_known_exactly_do_no_harm() -> None:
    still = one(Gaussian(np.zeros(4), np.diag([1e4, 1e4, 0.0, 0.0])))
    found = hypotheses(expected(still, 1.0), Plots(np.zeros((1, 2))), NOTCH, FAR)
    assert found.log_p_star[0, 0] == pytest.approx(0.0, abs=1e-12)
    assert found.log_p_star[0, 1] < -50.0
    assert np.isfinite(found.density.x).all()
    assert np.isfinite(found.density.P).all()


@pytest.mark.parametrize("choose", [None, nearest, kalman])
def test_without_a_notch_it_is_the_update(draw: Draw, choose: Callable[..., tuple[Array, Array]] | None) -> None:
    """An infinitely narrow notch covers nobody; two filters, as tight association has them."""
    rng = np.random.default_rng(3)
    tracks = Gaussian(np.stack([draw(rng, (5,), 4).x] * 2), np.stack([draw(rng, (5,), 4, 3.0).P, draw(rng, (5,), 4).P]))
    scan, options = Plots(rng.normal(0.0, 4.0, (6, 2))), () if choose is None else (choose,)
    seen = expected(tracks, np.full(5, P_D), 0.99)
    plain = update(seen, scan, *options)
    ours = filtered(hypotheses(seen, scan, Notch(1e-9), FAR), *options)
    np.testing.assert_allclose(ours.log_p_bar, plain.log_p_bar, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(ours.density.x, plain.density.x, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(ours.density.P, plain.density.P, rtol=0.0, atol=1e-6)


def test_the_mean_probability_is_that_of_the_weights(draw: Draw) -> None:
    """1 - p*_0 with the notch is what the sensor says of itself: its network's p_bar and this filter's agree."""
    tracks = one(draw(np.random.default_rng(7), (), 4))
    sensor = Sensor(SENSOR, P_D, 1.0, Everywhere(1e3, 2), NOTCH)
    p_d = sensor.detection_probability(Gaussian(tracks.x[0], tracks.P[0]), FAR)
    found = hypotheses(expected(tracks), Plots(np.empty((0, 2))), NOTCH, FAR)
    assert 1.0 - np.exp(found.log_p_star[0, 0]) == pytest.approx(float(p_d), rel=1e-12)


def test_tight_association_is_equation_13(draw: Draw) -> None:
    rng = np.random.default_rng(4)
    tracks = Gaussian(rng.normal(size=(2, 4)), np.stack([draw(rng, (), 4, 3.0).P, draw(rng, (), 4).P]))
    zs = rng.normal(0.0, 2.0, (3, 2))
    both = hypotheses(expected(tracks), Plots(zs), NOTCH, FAR)
    q = np.exp(both.log_p_star[1]) / np.exp(both.log_p_star[1]).sum()
    ours = filtered(both)
    assert ours.log_p_bar == pytest.approx(float(q @ (both.log_p_star[0] - np.log(q))), rel=1e-12)
    np.testing.assert_allclose(ours.density.x, np.einsum("j,fjk->fk", q, both.density.x), rtol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_batch_equals_the_loop(draw: Draw, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(5)
    x, P = draw(rng, (2, *shape), 4, 2.0)
    p_d = rng.uniform(0.0, 1.0, shape)
    z, valid = rng.normal(size=(*shape, 4, 2)), rng.random((*shape, 4)) < 0.7
    z[~valid] = np.nan
    relative = rng.normal(size=(*shape, 4))
    together = hypotheses(expected(Gaussian(x, P), p_d, 0.95), Plots(z, valid, relative), NOTCH, FAR)
    merged = filtered(together)
    for i in np.ndindex(shape):
        here = (slice(None), *i)
        seen = expected(Gaussian(x[here], P[here]), p_d[i], 0.95)
        alone = hypotheses(seen, Plots(z[i], valid[i], relative[i]), NOTCH, FAR)
        assert same(Hypotheses(together.log_p_star[here], cut(together.density, here)), alone)
        mine = filtered(alone)
        assert same(Filtered(cut(merged.density, here), merged.log_p_bar[i]), mine)


def cut(density: Gaussian, where: tuple[slice | int, ...]) -> Gaussian:
    return Gaussian(density.x[where], density.P[where])


def same(first: Hypotheses | Filtered, second: Hypotheses | Filtered) -> bool:
    """Whether numbers agree to rounding; infinities are equal to themselves."""
    flat = [
        [v for part in result for v in (part if isinstance(part, Gaussian) else (part,))] for result in (first, second)
    ]
    return all(np.allclose(a, b, rtol=1e-9, atol=1e-9) for a, b in zip(*flat, strict=True))
