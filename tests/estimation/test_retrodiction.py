"""Retrodiction against a batch least-squares solution and against brute-force enumeration of all histories."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
from enumeration import Problem, all_histories, least_squares, log_likelihood
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp

from waldnet.common.estimation.association import Clutter, Plots, expect
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.mixture import EXACT, Mixture, Reduction, single, step, step_traced
from waldnet.common.estimation.motion import ConstantVelocity, predict
from waldnet.common.estimation.retrodiction import Generation, backward, descendants, generation, histories, smooth
from waldnet.common.estimation.sensing import Position

Draw: TypeAlias = Callable[..., Gaussian]

SHAPES = [(), (1,), (3, 1, 2)]
MOTION = ConstantVelocity(2, 3.0)
SENSOR = Position((4.0, 7.0), 4)
P_D, RHO_F = 0.8, 1e-3


def problem(rng: np.random.Generator, scans: list[int], at: float = 0.0) -> Problem:
    """A target drawn from the prior, and as many plots of each scan, one of them its own."""
    intervals = rng.uniform(0.5, 3.0, len(scans))
    F, Q = list(MOTION.transition(intervals)), list(MOTION.noise(intervals))
    prior = Gaussian(np.array([at, -at, 6.0, -4.0]), np.diag([900.0, 400.0, 64.0, 100.0]))
    state = rng.multivariate_normal(*prior)
    plots = []
    for k, count in enumerate(scans):
        state = F[k] @ state + rng.multivariate_normal(np.zeros(4), Q[k])
        z = state[:2] + rng.normal(0.0, 25.0, (count, 2))
        z[:1] = state[:2] + rng.normal(size=(min(count, 1), 2)) * SENSOR.sigma
        plots.append(rng.permutation(z))
    known = len(scans)
    return Problem(*prior, F, Q, plots, known * [SENSOR.H], known * [SENSOR.R], known * [P_D], known * [RHO_F])


def filtered(problems: list[Problem], reduction: Reduction) -> tuple[Mixture, list[Generation]]:
    """All problems at once, each a track; they have the same number of plots."""
    mixture = single(
        Gaussian(np.stack([p.x for p in problems])[None], np.stack([p.P for p in problems])[None]),
        np.zeros(len(problems)),
    )
    generations = []
    for k in range(len(problems[0].scans)):
        F, Q = (
            np.stack([matrices[k] for matrices in each]) for each in ([p.F for p in problems], [p.Q for p in problems])
        )
        density = predict(mixture.density, F[:, None], Q[:, None])
        clutter = Clutter(np.full(mixture.log_w.shape, P_D), np.array(np.log(RHO_F)), 1.0)
        expected = expect(density, SENSOR.linearise(density, np.zeros(2)), clutter)
        plots = Plots(np.stack([p.scans[k] for p in problems])[:, None])
        mixture, ancestry = step_traced(mixture._replace(density=density), expected, plots, reduction)
        generations.append(generation(mixture, ancestry, F, Q))
    return mixture, generations


def posterior(problem: Problem) -> tuple[Array, Array, Array]:
    """Brute force: weights, smoothed states, covariances of all histories, shapes (H,), (H, K, n), (H, K, n, n)."""
    every = all_histories(problem)
    log_w = np.array([log_likelihood(problem, history) for history in every])
    x, P = zip(*(least_squares(problem, history) for history in every), strict=True)
    return np.exp(log_w - logsumexp(log_w)), np.stack(x), np.stack(P)


def mixed(w: Array, x: Array, P: Array) -> tuple[Array, Array]:
    mean = w @ x
    d = x - mean
    return mean, np.einsum("h,hij->ij", w, P) + np.einsum("h,hi,hj->ij", w, d, d)


def close(ours: Array, theirs: Array, rtol: float = 1e-9) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=rtol, atol=rtol * np.abs(theirs).max())


# ---- single Gaussians


@pytest.mark.parametrize("at", [0.0, 3e5])
def test_smoothing_is_a_batch_least_squares_solution(at: float) -> None:
    """Without clutter; also with misses, and far from the origin."""
    this = problem(np.random.default_rng(1), [1, 1, 0, 1, 1, 0, 0, 1], at)
    density, means, covariances = Gaussian(this.x, this.P), [], []
    for k, plots in enumerate(this.scans):
        density = predict(density, this.F[k], this.Q[k])
        for z in plots:
            K = density.P @ SENSOR.H.T @ np.linalg.inv(SENSOR.H @ density.P @ SENSOR.H.T + SENSOR.R)
            density = Gaussian(density.x + K @ (z - SENSOR.H @ density.x), density.P - K @ SENSOR.H @ density.P)
        means.append(density.x)
        covariances.append(density.P)
    intervals = np.array([F[0, 2] for F in this.F[1:]])
    ours = smooth(Gaussian(np.stack(means), np.stack(covariances)), MOTION, intervals)
    x, P = least_squares(this, tuple(len(plots) - 1 for plots in this.scans))
    np.testing.assert_allclose(ours.x, x, rtol=0.0, atol=1e-9 * max(1.0, np.abs(x).max()))
    close(ours.P, P)


def test_a_step_back_is_the_textbook_one(draw: Draw) -> None:
    rng = np.random.default_rng(2)
    (x, P), later = draw(rng, (), 4), draw(rng, (), 4)
    F, Q = MOTION.transition(np.array(1.7)), MOTION.noise(np.array(1.7))
    ours = backward(Gaussian(x, P), F, Q, later)
    ahead = F @ P @ F.T + Q
    G = P @ F.T @ np.linalg.inv(ahead)
    close(ours.x, x + G @ (later.x - F @ x))
    close(ours.P, P + G @ (later.P - ahead) @ G.T)


def test_nothing_later_known_leaves_the_filtered_density(draw: Draw) -> None:
    density = draw(np.random.default_rng(3), (), 4)
    F, Q = MOTION.transition(np.array(2.0)), MOTION.noise(np.array(2.0))
    back = backward(density, F, Q, predict(density, F, Q))
    close(back.x, density.x)
    close(back.P, density.P)


def test_a_covariance_stays_positive_where_the_textbook_loses_it() -> None:
    """Both positions and the last velocity are known: the first one is, to q dt / 4, from the equations by hand."""
    density, dt, psd = Gaussian(np.zeros(4), np.diag([1e-8, 1e-8, 1e6, 1e6])), 10.0, 3e-3
    motion = ConstantVelocity(2, psd)
    F, Q = motion.transition(np.array(dt)), motion.noise(np.array(dt))
    later = Gaussian(np.zeros(4), 1e-8 * np.eye(4))
    P = backward(density, F, Q, later).P
    np.testing.assert_allclose(np.diag(P), [1e-8, 1e-8, psd * dt / 4.0, psd * dt / 4.0], rtol=1e-5)
    ahead = F @ density.P @ F.T + Q
    G = density.P @ F.T @ np.linalg.inv(ahead)
    assert (density.P + G @ (later.P - ahead) @ G.T)[2, 2] < 0.0


def test_as_many_intervals_as_gaps(draw: Draw) -> None:
    with pytest.raises(ValueError, match="3 intervals, 3 times: one interval fewer"):
        smooth(draw(np.random.default_rng(4), (3,), 4), MOTION, np.ones(3))


@given(shape=st.sampled_from(SHAPES), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_a_batch_equals_the_loop(shape: tuple[int, ...], seed: int, draw: Draw) -> None:
    rng = np.random.default_rng(seed)
    density, intervals = draw(rng, (5, *shape), 4), rng.uniform(0.1, 5.0, (4, *shape))
    ours = smooth(density, MOTION, intervals)
    assert ours.x.shape == density.x.shape
    assert ours.P.shape == density.P.shape
    for row in np.ndindex(shape):
        at = (slice(None), *row)
        alone = smooth(Gaussian(density.x[at], density.P[at]), MOTION, intervals[at])
        close(ours.x[at], alone.x, 1e-10)
        close(ours.P[at], alone.P, 1e-10)


# ---- mixtures


SCANS = [2, 3, 0, 2]


@pytest.fixture(scope="module")
def two() -> list[Problem]:
    return [problem(np.random.default_rng(seed), SCANS) for seed in (11, 12)]


def test_histories_are_those_of_brute_force(two: list[Problem]) -> None:
    """Every history with its weight and its smoothed densities; two tracks at once."""
    _, generations = filtered(two, EXACT)
    ours = histories(generations)
    for track, this in enumerate(two):
        w, x, P = posterior(this)
        mine = [np.flatnonzero(then.track == track) for then in ours]
        # Histories in the same order, that of the smoothed last mean.
        order = np.lexsort(np.round(x[:, -1], 6).T)
        for k, (then, rows) in enumerate(zip(ours, mine, strict=True)):
            assert len(rows) == len(w) == 36
            sort = rows[np.lexsort(np.round(ours[-1].density.x[mine[-1]], 6).T)]
            np.testing.assert_allclose(np.exp(then.log_w[sort]), w[order], rtol=1e-8, atol=1e-12)
            close(then.density.x[sort], x[order, k])
            close(then.density.P[sort], P[order, k], 1e-8)


def test_the_descendants_sum_has_the_moments_of_all_histories(two: list[Problem]) -> None:
    """With nothing combined: mean and covariance of the whole mixture, and of every component."""
    _, generations = filtered(two, EXACT)
    exact = histories(generations)
    for k, then in enumerate(descendants(generations)):
        np.testing.assert_allclose(np.exp(then.log_w).sum(axis=-1), 1.0, rtol=1e-12)
        for track, this in enumerate(two):
            w, x, P = posterior(this)
            whole = mixed(np.exp(then.log_w[track]), then.density.x[track], then.density.P[track])
            for one, other in zip(whole, mixed(w, x[:, k], P[:, k]), strict=True):
                close(one, other, 1e-8)
            for component in np.flatnonzero(then.log_w[track] > -np.inf):
                rows = (exact[k].track == track) & (exact[k].component == component)
                own = np.exp(exact[k].log_w[rows])
                assert np.exp(then.log_w[track, component]) == pytest.approx(own.sum(), rel=1e-9)
                mean, covariance = mixed(own / own.sum(), *(part[rows] for part in exact[k].density))
                close(then.density.x[track, component], mean)
                close(then.density.P[track, component], covariance, 1e-8)


@pytest.fixture(scope="module")
def astray() -> Problem:
    """A plot far off is the weaker explanation, until the next scans go on from it."""
    near, far = np.array([25.0, -20.0]), np.array([-45.0, 25.0])
    scans = [np.stack([near, far]), *(far[None] + k * np.array([5.0, -4.0]) for k in range(1, 5))]
    return problem(np.random.default_rng(13), 5 * [1])._replace(scans=scans)


def test_strong_sons_strengthen_weak_fathers(astray: Problem) -> None:
    mixture, generations = filtered([astray], EXACT)
    first, *_, last = generations
    fathers = descendants(generations)
    near, far = (first.ancestry.component[first.ancestry.plot == j].item() for j in (0, 1))
    gain = np.exp(fathers[0].log_w - first.log_w)[0]
    assert np.exp(first.log_w[0, far]) < 0.5 * np.exp(first.log_w[0, near])
    assert gain[near] < 0.5 < 2.0 < gain[far]
    w, _, _ = posterior(astray)
    own = np.array([history[0] == 1 for history in all_histories(astray)])
    assert np.exp(fathers[0].log_w[0, far]) == pytest.approx(w[own].sum(), rel=1e-9)
    np.testing.assert_array_equal(fathers[-1].log_w, last.log_w)
    np.testing.assert_array_equal(fathers[-1].log_w, mixture.log_w)


def test_where_all_sons_have_died_so_has_the_father(astray: Problem) -> None:
    _, generations = filtered([astray], Reduction(components=3, prune=0.0, combine=0.0, rest=False))
    line = set(np.flatnonzero(generations[-1].log_w[0] > -np.inf))
    for now in generations[:0:-1]:
        line = {int(p) for c, p in zip(now.ancestry.component, now.ancestry.parent, strict=True) if c in line}
    fathers, alive = descendants(generations)[0], np.flatnonzero(generations[0].log_w[0] > -np.inf)
    assert set(np.flatnonzero(fathers.log_w[0] > -np.inf)) == line < set(alive)
    assert set(histories(generations)[0].component) == line
    dead = sorted(set(alive) - line)
    np.testing.assert_array_equal(fathers.density.x[0, dead], generations[0].density.x[0, dead])


def test_combined_components_keep_close_to_brute_force(two: list[Problem]) -> None:
    """Both ways; combining is an approximation, and a filtered density is far from a smoothed one."""
    _, generations = filtered(two, Reduction(components=8, prune=1e-6, combine=0.2))
    assert any((now.ancestry.log_share < 0.0).any() for now in generations)
    exact, fathers = histories(generations), descendants(generations)
    for k in range(len(SCANS) - 1):
        for track, this in enumerate(two):
            w, x, P = posterior(this)
            mean, covariance = mixed(w, x[:, k], P[:, k])
            sigma = np.sqrt(np.diag(covariance))
            rows = exact[k].track == track
            for ours in (
                mixed(np.exp(exact[k].log_w[rows]), *(part[rows] for part in exact[k].density)),
                mixed(np.exp(fathers[k].log_w[track]), fathers[k].density.x[track], fathers[k].density.P[track]),
            ):
                assert (np.abs(ours[0] - mean) < 0.2 * sigma).all()
                np.testing.assert_allclose(np.sqrt(np.diag(ours[1])), sigma, rtol=0.2)


# ---- ancestry


@pytest.mark.parametrize("reduction", [EXACT, Reduction(), Reduction(5, 1e-2, 1.0, rest=False), Reduction(4, 0.0, 0.0)])
def test_a_traced_step_is_the_step(two: list[Problem], reduction: Reduction) -> None:
    """The same mixtures to the bit; shares sum to one; who was not combined is his own branch."""
    mixture, _ = filtered(two, EXACT)
    F, Q = two[0].F[0], two[0].Q[0]
    prior = mixture._replace(density=predict(mixture.density, F, Q))
    clutter = Clutter(np.full(mixture.log_w.shape, P_D), np.array(np.log(RHO_F)), 0.99)
    expected = expect(prior.density, SENSOR.linearise(prior.density, np.zeros(2)), clutter)
    plots = Plots(two[0].scans[1])
    plain = step(prior, expected, plots, reduction)
    traced, of = step_traced(prior, expected, plots, reduction)
    for one, other in zip((*plain[:2], *plain.density), (*traced[:2], *traced.density), strict=True):
        np.testing.assert_array_equal(one, other)
    shares = np.zeros(traced.log_w.shape)
    np.add.at(shares, (of.track, of.component), np.exp(of.log_share))
    np.testing.assert_allclose(shares, traced.log_w > -np.inf, rtol=1e-12)
    sole = of.log_share == 0.0
    assert sole.any()
    for track, component, parent, plot in zip(*(part[sole] for part in of[:4]), strict=True):
        mean, W = expected.density.x[0, track, parent], expected.W[0, track, parent]
        if plot >= 0:
            nu = plots.z[plot] - expected.z[0, track, parent]
            mean = mean + W @ (expected.whitener[0, track, parent] @ nu)
        close(traced.density.x[0, track, component], mean)
