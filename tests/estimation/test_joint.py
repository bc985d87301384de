"""Joint association against the enumeration of all joint events, Stone Soup's JPDA, and exact limits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import datetime
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp
from scipy.stats import multivariate_normal
from stonesoup.dataassociator.probability import JPDA
from stonesoup.hypothesiser.probability import PDAHypothesiser
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel
from stonesoup.models.transition.linear import ConstantVelocity as TheirConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.numeric import Probability
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track
from stonesoup.updater.kalman import KalmanUpdater

from waldnet.common.estimation import joint as joint_module
from waldnet.common.estimation.association import Clutter, Expected, Plots, expect, normalise, update, weights_alone
from waldnet.common.estimation.gaussian import Array, Gaussian, moments
from waldnet.common.estimation.joint import Claims, joint, log_free, unclaimed
from waldnet.common.estimation.mixture import EXACT, single, step
from waldnet.common.estimation.sensing import Position

Draw: TypeAlias = Callable[..., Gaussian]

SEEDS = st.integers(0, 2**32 - 1)
PROPERTIES = settings(deadline=None, derandomize=True, database=None, max_examples=60)
SENSOR = Position((3.0, 2.0), 4)
P_D, RHO_F, P_G = 0.8, 1e-2, 0.99
NO_PLOT = -1


class Events(NamedTuple):
    """Logarithms: W with, and without, each track; without it and without plot j; of all; of all without plot j."""

    exists: Array
    without: Array
    free: Array
    total: float
    unused: Array


def events(tracks: int, plots: int) -> Iterator[tuple[int, ...]]:
    """The plot of each track, or none; no plot being that of two."""
    for event in product(range(NO_PLOT, plots), repeat=tracks):
        used = [plot for plot in event if plot != NO_PLOT]
        if len(set(used)) == len(used):
            yield event


def log_total(log_p: Array, log_r: Array, log_not: Array, banned: int | None = None) -> float:
    """Log W of tracks with weights log p*_j, shape (T, 1 + M), by its definition; one plot may be banned."""
    tracks, plots = log_p.shape[0], log_p.shape[1] - 1
    none = np.logaddexp(log_not, log_r + log_p[:, 0])
    terms = [
        sum(none[t] if j == NO_PLOT else log_r[t] + log_p[t, 1 + j] for t, j in enumerate(event))
        for event in events(tracks, plots)
        if banned not in event
    ]
    return float(logsumexp(terms))


def logs(r: Array) -> tuple[Array, Array]:
    with np.errstate(divide="ignore"):
        return np.log(r), np.log1p(-r)


def enumerated(log_p: Array, r: Array) -> Events:
    """Every W of Eq. (21)."""
    tracks, plots = log_p.shape[0], log_p.shape[1] - 1
    log_r, log_not = logs(r)
    exists, without, free = np.empty(tracks), np.empty(tracks), np.empty((tracks, plots))
    for t in range(tracks):
        surely, never = np.where(np.arange(tracks) == t, 0.0, log_r), np.where(np.arange(tracks) == t, -np.inf, log_not)
        exists[t] = log_total(log_p, surely, never)
        rest = [np.delete(part, t, axis=0) for part in (log_p, log_r, log_not)]
        without[t] = log_total(*rest)
        free[t] = [log_total(*rest, banned=j) for j in range(plots)]
    unused = np.array([log_total(log_p, log_r, log_not, banned=j) for j in range(plots)])
    return Events(exists, without, free, log_total(log_p, log_r, log_not), unused)


def weights(rng: np.random.Generator, tracks: int, plots: int, spread: float = 3.0, gated: float = 0.7) -> Array:
    """Random log p*_j; some plots are outside the gate, some tracks cannot be missed."""
    log_p = rng.normal(0.0, spread, (tracks, 1 + plots))
    log_p[:, 1:][rng.random((tracks, plots)) > gated] = -np.inf
    log_p[:, 0] = np.log1p(-rng.random(tracks))
    log_p[rng.random(tracks) < 0.2, 0] = -np.inf
    return log_p


def existences(rng: np.random.Generator, tracks: int) -> Array:
    """From 0 to 1, both included."""
    return np.clip(rng.uniform(-0.3, 1.3, tracks), 0.0, 1.0)


def of_one_component(log_p: Array, r: Array) -> tuple[Array, Array]:
    """Log nu and what is unclaimed, of tracks with one component."""
    log_nu, left, _ = joint(np.zeros((len(log_p), 1)), log_p[:, None], None, log_p.shape[1] - 1, r)
    return log_nu[:, 0], left


def claims(log_p: Array, r: Array) -> Claims:
    track, plot = np.nonzero(log_p[:, 1:] > -np.inf)
    log_r, log_not = logs(r)
    return Claims(track, plot, log_r[track] + log_p[track, 1 + plot], np.logaddexp(log_not, log_r + log_p[:, 0]))


def assert_enumerated(log_p: Array, r: Array) -> None:
    log_nu, left = of_one_component(log_p, r)
    assert np.isfinite(log_nu).all()
    assert ((left >= 0.0) & (left <= 1.0)).all()
    assert (log_nu <= 1e-12).all()
    truth = enumerated(log_p, r)
    # Where the other tracks cannot all be right, or neither any, nothing is asked.
    asked = (log_p[:, 1:] > -np.inf) & (truth.without > -np.inf)[:, None] & (truth.free > -np.inf)
    expected = truth.free - truth.without[:, None]
    np.testing.assert_allclose(log_nu[asked], expected[asked], rtol=1e-9, atol=1e-9)
    impossible = (log_p[:, 1:] > -np.inf) & (truth.without > -np.inf)[:, None] & (truth.free == -np.inf)
    assert (log_nu[impossible] < -200.0).all()
    if truth.total > -np.inf:
        np.testing.assert_allclose(left, np.exp(truth.unused - truth.total), atol=1e-12)
    # What a track makes of nu: its weight sum.
    alone = np.concatenate([log_p[:, :1], log_p[:, 1:] + log_nu], axis=1)
    sure = (truth.exists > -np.inf) & (truth.without > -np.inf)
    np.testing.assert_allclose(
        logsumexp(alone, axis=1)[sure], (truth.exists - truth.without)[sure], rtol=1e-9, atol=1e-9
    )


# Against the enumeration ----------------------------------------------------------------------------------------------


@given(SEEDS, st.integers(0, 4), st.integers(0, 4))
@PROPERTIES
def test_nu_and_the_unclaimed_are_those_of_all_joint_events(seed: int, tracks: int, plots: int) -> None:
    rng = np.random.default_rng(seed)
    assert_enumerated(weights(rng, tracks, plots), existences(rng, tracks))


@given(SEEDS, st.integers(1, 4), st.integers(1, 4))
@PROPERTIES
def test_weights_of_any_size_are_no_trouble(seed: int, tracks: int, plots: int) -> None:
    rng = np.random.default_rng(seed)
    assert_enumerated(np.minimum(weights(rng, tracks, plots, spread=300.0), 690.0), existences(rng, tracks))


def test_few_tracks_may_share_many_plots() -> None:
    rng = np.random.default_rng(5)
    assert_enumerated(weights(rng, 2, joint_module.MOST_EXACT + 4, gated=1.0), np.array([0.9, 0.6]))


def test_where_all_surely_exist_and_none_can_be_missed_too_few_plots_are_no_plots() -> None:
    log_nu, left = of_one_component(np.array([[-np.inf, 2.0], [-np.inf, 2.0]]), np.ones(2))
    assert np.isfinite(log_nu).all()
    assert (log_nu < -200.0).all()
    assert 0.0 <= left[0] <= 1.0


def test_of_tracks_that_are_no_targets_the_plots_are_false() -> None:
    rng = np.random.default_rng(7)
    log_p, r = weights(rng, 3, 4)[:, None], np.array([0.9, 0.6, 0.3])

    def false(target: list[float]) -> Array:
        return joint(np.zeros((3, 1)), log_p, None, 4, r, np.array(target)).false

    unclaimed = joint(np.zeros((3, 1)), log_p, None, 4, r).unclaimed
    np.testing.assert_allclose(false([1.0, 1.0, 1.0]), unclaimed, atol=1e-12)
    np.testing.assert_allclose(false([0.0, 0.0, 0.0]), 1.0)
    # Claims add up: what each track takes of the plots, it takes as far as it is a target.
    each = [1.0 - false(row.tolist()) for row in np.eye(3)]
    np.testing.assert_allclose(1.0 - false([0.5, 0.2, 1.0]), 0.5 * each[0] + 0.2 * each[1] + each[2], atol=1e-12)


def test_twins_that_cannot_be_missed_share_two_plots_evenly() -> None:
    log_p = np.array([[-np.inf, 5.0, 5.0], [-np.inf, 5.0, 5.0]])
    log_nu, left = of_one_component(log_p, np.ones(2))
    np.testing.assert_allclose(log_nu, np.log(0.5), atol=1e-12)
    np.testing.assert_allclose(left, 0.0, atol=1e-12)


@given(SEEDS)
@PROPERTIES
def test_components_of_a_track_speak_with_one_voice(seed: int) -> None:
    """Each with near plots of its own, numbered and padded."""
    rng = np.random.default_rng(seed)
    tracks, components, plots = 3, 2, 4
    log_p = np.stack([weights(rng, tracks, plots) for _ in range(components)], axis=1)
    log_w = np.log(rng.dirichlet(np.ones(components), tracks))
    log_w[0] = 0.0, -np.inf
    r = existences(rng, tracks)
    whole = logsumexp(log_w[..., None] + log_p, axis=1)
    log_nu, left = of_one_component(whole, r)
    number = np.argsort(rng.random((tracks, components, plots)), axis=-1)
    near = np.concatenate([log_p[..., :1], np.take_along_axis(log_p[..., 1:], number, axis=-1)], axis=-1)
    padded = np.concatenate([near, np.full((tracks, components, 1), -np.inf)], axis=-1)
    numbered = np.concatenate([number, np.zeros((tracks, components, 1), np.intp)], axis=-1)
    ours = joint(log_w, padded, numbered, plots, r)
    np.testing.assert_allclose(ours.unclaimed, left, atol=1e-12)
    alive = (log_w > -np.inf)[..., None] & (near[..., 1:] > -np.inf)
    expected = np.take_along_axis(np.broadcast_to(log_nu[:, None], number.shape), number, axis=-1)
    np.testing.assert_allclose(ours.log_nu[..., :-1][alive], expected[alive], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(ours.log_nu[..., -1], 0.0)


# What filters make of it ----------------------------------------------------------------------------------------------


class Scene(NamedTuple):
    """Three near tracks, one or two filters each, and a scan."""

    density: Gaussian
    expected: Expected
    z: Array
    r: Array


def scene(draw: Draw, seed: int, filters: int) -> Scene:
    rng = np.random.default_rng(seed)
    honest = draw(rng, (3, 1), 4, 2.0)
    density = Gaussian(np.stack([honest.x] * filters), np.stack([honest.P * k for k in (2.0, 1.0)[-filters:]]))
    linear = SENSOR.linearise(density, np.zeros(2))
    expected = expect(density, linear, Clutter(np.full((3, 1), P_D), np.array(np.log(RHO_F)), P_G))
    return Scene(density, expected, rng.normal(0.0, 4.0, (4, 2)), np.array([0.9, 0.3, 0.6]))


def with_others(scene: Scene) -> Plots:
    """The scan as each track sees it beside the others."""
    alone = weights_alone(scene.expected, Plots(scene.z))
    return Plots(scene.z, log_relative=-joint(np.zeros((3, 1)), alone, None, len(scene.z), scene.r).log_nu)


def textbook(scene: Scene, number: int) -> tuple[Array, Gaussian, float]:
    """A track that exists, joint event by joint event: probability and density of its hypotheses, log p_bar."""
    x, P = scene.density.x[-1, :, 0], scene.density.P[-1, :, 0]
    H, R = SENSOR.H, SENSOR.R
    gate = scene.expected.gate
    log_p = np.full((3, 1 + len(scene.z)), -np.inf)
    for t in range(3):
        S = H @ P[t] @ H.T + R
        log_p[t, 0] = scene.expected.log_miss[t, 0]
        for j, z in enumerate(scene.z):
            nu = z - H @ x[t]
            if nu @ np.linalg.solve(S, nu) <= gate:
                log_p[t, 1 + j] = np.log(P_D / RHO_F) + multivariate_normal(np.zeros(2), S).logpdf(nu)
    log_r, log_not = logs(np.where(np.arange(3) == number, 1.0, scene.r))
    none = np.logaddexp(log_not, log_r + log_p[:, 0])
    mine = np.full(1 + len(scene.z), -np.inf)
    for event in events(3, len(scene.z)):
        weight = sum(none[t] if j == NO_PLOT else log_r[t] + log_p[t, 1 + j] for t, j in enumerate(event))
        mine[1 + event[number]] = np.logaddexp(mine[1 + event[number]], weight)
    K = P[number] @ H.T @ np.linalg.inv(H @ P[number] @ H.T + R)
    means = np.stack([x[number], *(x[number] + K @ (z - H @ x[number]) for z in scene.z)])
    hit = P[number] - K @ H @ P[number]
    density = Gaussian(means, np.stack([P[number], *([hit] * len(scene.z))]))
    rest = [np.delete(part, number, axis=0) for part in (log_p, *logs(scene.r))]
    log_p_bar = float(logsumexp(mine)) - log_total(*rest)
    return np.exp(mine - logsumexp(mine)), density, log_p_bar


@pytest.mark.parametrize("seed", range(4))
def test_the_pdaf_of_each_track_is_the_jpda(seed: int, draw: Draw) -> None:
    case = scene(draw, seed, 1)
    ours = update(case.expected, with_others(case))
    for t in range(3):
        p, density, log_p_bar = textbook(case, t)
        expected = moments(p, density)
        assert ours.log_p_bar[t, 0] == pytest.approx(log_p_bar, rel=1e-9)
        np.testing.assert_allclose(ours.density.x[0, t, 0], expected.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ours.density.P[0, t, 0], expected.P, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_a_tight_factor_takes_over_the_joint_probabilities(seed: int, draw: Draw) -> None:
    """Eq. (13): with the probabilities of the honest filter, and nu in both weights."""
    case = scene(draw, seed, 2)
    ours = update(case.expected, with_others(case))
    H, R = SENSOR.H, SENSOR.R
    for t in range(3):
        q, density, log_q_bar = textbook(case, t)
        np.testing.assert_allclose(ours.density.x[1, t, 0], moments(q, density).x, rtol=1e-9, atol=1e-9)
        (wide, slim) = (
            multivariate_normal(H @ x[t, 0], H @ P[t, 0] @ H.T + R) for x, P in zip(*case.density, strict=True)
        )
        more = sum(q[1 + j] * (wide.logpdf(z) - slim.logpdf(z)) for j, z in enumerate(case.z))
        assert ours.log_p_bar[t, 0] == pytest.approx(log_q_bar + more, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_a_mixture_has_a_branch_for_every_joint_probability(seed: int, draw: Draw) -> None:
    case = scene(draw, seed, 1)
    prior = single(Gaussian(case.density.x[:, :, 0], case.density.P[:, :, 0]), np.zeros(3))
    ours = step(prior, case.expected, with_others(case), EXACT)
    for t in range(3):
        p, _, log_p_bar = textbook(case, t)
        there = ours.log_w[t] > -np.inf
        np.testing.assert_allclose(np.sort(np.exp(ours.log_w[t, there])), np.sort(p[p > 0.0]), rtol=1e-9)
        assert logsumexp(ours.log_g[t, there]) == pytest.approx(log_p_bar, rel=1e-9)


def test_probabilities_are_those_of_stone_soup(draw: Draw) -> None:
    case = scene(draw, 7, 1)._replace(r=np.ones(3))
    order, now = [0, 2, 1, 3], datetime(2026, 1, 1)
    model = LinearGaussian(ndim_state=4, mapping=(0, 2), noise_covar=SENSOR.R)
    # Tracks are predicted already: in no time nothing moves.
    still = KalmanPredictor(CombinedLinearGaussianTransitionModel([TheirConstantVelocity(1.0)] * 2))
    p_d, p_g = Probability(P_D), Probability(P_G)
    hypothesiser = PDAHypothesiser(still, KalmanUpdater(model), RHO_F, prob_detect=p_d, prob_gate=p_g)
    tracks = [
        Track([GaussianState(x[0][order], P[0][np.ix_(order, order)], timestamp=now)])
        for x, P in zip(case.density.x[0], case.density.P[0], strict=True)
    ]
    detections = [Detection(z, timestamp=now, measurement_model=model) for z in case.z]
    theirs = JPDA(hypothesiser).associate(set(tracks), set(detections), now)
    alone = weights_alone(case.expected, Plots(case.z))
    ours, _ = normalise(weights_alone(case.expected, with_others(case)))
    compared = 0
    for t, track in enumerate(tracks):
        for hypothesis in theirs[track]:
            j = 1 + detections.index(hypothesis.measurement) if hypothesis else 0
            assert float(hypothesis.probability) == pytest.approx(ours[t, 0, j], abs=1e-9)
            compared += j > 0
    assert compared > 6
    assert np.abs(ours - normalise(alone)[0]).max() > 0.1


# Large clusters -------------------------------------------------------------------------------------------------------


def log_table(found: Claims, log_nu: Array, tracks: int, plots: int) -> Array:
    """Log p*_j beside the others, j = 0 all that is without a plot, shape (T, 1 + M)."""
    table = np.full((tracks, 1 + plots), -np.inf)
    table[:, 0] = found.log_none
    table[found.track, 1 + found.plot] = found.log_hit + log_nu
    return table


def propagated(found: Claims, monkeypatch: pytest.MonkeyPatch) -> Array:
    """Log nu as of a cluster that is too large to be enumerated."""
    with monkeypatch.context() as patch:
        patch.setattr(joint_module, "MOST_EXACT", 0)
        return log_free(found)


@pytest.mark.parametrize("seed", range(30))
def test_belief_propagation_is_exact_on_trees(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(seed)
    tracks, plots = int(rng.integers(2, 8)), int(rng.integers(1, 8))
    # Of a random order of all tracks and plots, each is joined to one of the other kind that came before.
    linked: list[tuple[int, int]] = []
    seen: tuple[list[int], list[int]] = ([0], [0])
    kinds = rng.permutation([0] * (tracks - 1) + [1] * (plots - 1))
    linked.append((0, 0))
    for kind in kinds:
        new, old = len(seen[kind]), int(rng.choice(seen[1 - kind]))
        seen[kind].append(new)
        linked.append((new, old) if kind == 0 else (old, new))
    log_p = np.full((tracks, 1 + plots), -np.inf)
    log_p[:, 0] = np.log1p(-rng.random(tracks))
    for t, j in linked:
        log_p[t, 1 + j] = rng.normal(0.0, 4.0)
    found = claims(log_p, existences(rng, tracks))
    np.testing.assert_allclose(propagated(found, monkeypatch), log_free(found), rtol=1e-9, atol=1e-9)


def test_belief_propagation_is_near_where_rings_close(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first hundred of the tables that theory.md §9 has figures of."""
    rng = np.random.default_rng(1)
    probability, evidence = [], []
    for _ in range(100):
        tracks, plots = (int(size) for size in rng.integers(2, 7, 2))
        found = claims(weights(rng, tracks, plots, spread=2.0, gated=0.8), rng.random(tracks))
        exact, near = (
            log_table(found, log_nu, tracks, plots) for log_nu in (log_free(found), propagated(found, monkeypatch))
        )
        probability.append(
            np.abs(np.subtract(*(np.exp(p - logsumexp(p, axis=1)[:, None]) for p in (exact, near)))).max()
        )
        evidence.append(np.abs(logsumexp(exact, axis=1) - logsumexp(near, axis=1)).max())
    assert max(probability) < 0.11
    assert np.median(probability) < 0.005
    assert max(evidence) < 0.5
    assert np.median(evidence) < 0.01


def test_a_chain_of_too_many_tracks_is_solved_exactly_still(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tracks in a row, each sharing a plot with the next: a tree."""
    rng = np.random.default_rng(2)
    tracks = joint_module.MOST_EXACT + 3
    log_p = np.full((tracks, tracks), -np.inf)
    log_p[:, 0] = np.log(0.3)
    for t in range(tracks):
        log_p[t, [max(t, 1), min(t + 1, tracks - 1)]] = rng.normal(0.0, 1.0)
    found = claims(log_p, np.full(tracks, 0.7))
    ours = log_free(found)
    monkeypatch.setattr(joint_module, "MOST_EXACT", tracks)
    np.testing.assert_allclose(ours, log_free(found), rtol=1e-6, atol=1e-6)


def test_clusters_are_solved_on_their_own() -> None:
    """Of one, two, three, ... and too many tracks for an enumeration, their plots and tracks in any order."""
    rng = np.random.default_rng(3)
    sizes = [(1, 2), (2, 1), (2, 3), (3, 3), (3, 2), (4, 2), (10, 3), (11, 4), (2, 2)]
    blocks = [weights(rng, *size, gated=1.0) for size in sizes]
    tracks, plots = (sum(size[axis] for size in sizes) for axis in (0, 1))
    log_p, r = np.full((tracks, 1 + plots), -np.inf), rng.random(tracks)
    expected_nu, expected_left = np.zeros((tracks, plots)), np.ones(plots)
    t, j = 0, 0
    for (rows, columns), block in zip(sizes, blocks, strict=True):
        log_p[t : t + rows, 0], log_p[t : t + rows, 1 + j : 1 + j + columns] = block[:, 0], block[:, 1:]
        alone = of_one_component(block, r[t : t + rows])
        expected_nu[t : t + rows, j : j + columns], expected_left[j : j + columns] = alone
        t, j = t + rows, j + columns
    order, places = rng.permutation(tracks), rng.permutation(plots)
    log_nu, left = of_one_component(log_p[order][:, np.concatenate([[0], 1 + places])], r[order])
    np.testing.assert_allclose(log_nu, expected_nu[order][:, places], rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(left, expected_left[places], atol=1e-5)


# Limits ---------------------------------------------------------------------------------------------------------------


@given(SEEDS)
@PROPERTIES
def test_neither_order_of_tracks_nor_of_plots_matters(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracks, plots = (int(size) for size in rng.integers(1, 12, 2))
    log_p, r = weights(rng, tracks, plots, gated=0.3), rng.random(tracks)
    log_nu, left = of_one_component(log_p, r)
    order, places = rng.permutation(tracks), rng.permutation(plots)
    other, other_left = of_one_component(log_p[order][:, np.concatenate([[0], 1 + places])], r[order])
    np.testing.assert_allclose(other, log_nu[order][:, places], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(other_left, left[places], atol=1e-9)


def test_a_track_alone_has_every_plot_to_itself() -> None:
    rng = np.random.default_rng(4)
    log_p = np.full((20, 1 + 60), -np.inf)
    log_p[:, 0] = np.log(0.1)
    for t in range(20):
        log_p[t, 1 + 3 * t : 4 + 3 * t] = rng.normal(0.0, 5.0, 3)
    log_nu, left = of_one_component(log_p, np.full(20, 0.8))
    np.testing.assert_array_equal(log_nu, 0.0)
    share = 0.8 * np.exp(log_p[:, 1:]) / (0.2 + 0.8 * np.exp(log_p).sum(axis=1))[:, None]
    np.testing.assert_allclose(left, 1.0 - share.sum(axis=0), atol=1e-12)


def test_a_track_that_does_not_exist_takes_nothing_but_is_left_what_others_leave() -> None:
    log_p = np.log(np.array([[0.2, 3.0], [0.2, 5.0]]))
    log_nu, left = of_one_component(log_p, np.array([0.0, 0.5]))
    gone = 0.5 + 0.5 * 0.2
    np.testing.assert_allclose(np.exp(log_nu[:, 0]), [gone / (gone + 2.5), 1.0])
    np.testing.assert_allclose(left, gone / (gone + 2.5))


@pytest.mark.parametrize(("tracks", "plots"), [(0, 0), (0, 3), (3, 0)])
def test_without_tracks_or_without_plots_there_is_nothing_to_share(tracks: int, plots: int) -> None:
    log_nu, left = of_one_component(np.zeros((tracks, 1 + plots)), np.full(tracks, 0.5))
    assert log_nu.shape == (tracks, plots)
    np.testing.assert_array_equal(left, np.ones(plots))


def test_what_is_unclaimed_counts_every_pair_once() -> None:
    found = Claims(np.array([0, 1, 1]), np.array([2, 2, 0]), np.log([1.0, 2.0, 3.0]), np.log([1.0, 1.0]))
    left = unclaimed(found, np.log([0.5, 1.0, 1.0]), 4)
    np.testing.assert_allclose(left, [1.0 - 3.0 / 6.0, 1.0, 1.0 - 0.5 / 1.5 - 2.0 / 6.0, 1.0])
