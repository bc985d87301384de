"""Mixtures against the enumeration of all histories, against the filters that are their limits, and their reduction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import Density, History, Seer, aged, branched, mean_of, merged
from scipy.special import logsumexp

from waldnet.common.estimation.association import Choice, Clutter, Expected, Plots, expect, nearest, normalise, update
from waldnet.common.estimation.gaussian import Array, Gaussian, moments
from waldnet.common.estimation.mixture import EXACT, Mixture, Reduction, reduced, single, step, terms
from waldnet.common.estimation.motion import ConstantVelocity
from waldnet.common.estimation.representation import Share
from waldnet.common.estimation.sensing import Position

Draw: TypeAlias = Callable[..., Gaussian]

SENSOR = Position((3.0, 2.0), 4)
PSD, DT, SHARES = 0.5, 1.5, (Share(4.0), Share(1.0))
MOTION = ConstantVelocity(2, PSD)
PROPERTIES = settings(deadline=None, derandomize=True, database=None, max_examples=40)


def seer(p_d: float, rho_f: float) -> Seer:
    return Seer(SENSOR.sigma, p_d, rho_f)


def begun(honest: Gaussian, shares: Sequence[Share] = SHARES) -> Mixture:
    """Tracks with one component; their filters have these shares of the prior."""
    filters = [share.start(honest) for share in shares]
    density = Gaussian(*(np.stack(arrays) for arrays in zip(*filters, strict=True)))
    return single(density, np.zeros(len(honest.x)))


def moved(mixture: Mixture, shares: Sequence[Share] = SHARES, dt: float = DT) -> Mixture:
    """After ``dt`` seconds."""
    filters = [
        share.predict(Gaussian(mixture.density.x[i], mixture.density.P[i]), MOTION, np.array(dt))
        for i, share in enumerate(shares)
    ]
    return mixture._replace(density=Gaussian(*(np.stack(arrays) for arrays in zip(*filters, strict=True))))


def seen(mixture: Mixture, p_d: float, rho_f: float, p_g: float = 1.0) -> Expected:
    """The components as the sensor will see them."""
    linear = SENSOR.linearise(mixture.density, np.zeros(2))
    return expect(mixture.density, linear, Clutter(np.full(mixture.log_w.shape, p_d), np.array(np.log(rho_f)), p_g))


def ragged(scans: Sequence[Array]) -> Plots:
    """Scans of the tracks, each its own, padded with what must not count."""
    most = max(map(len, scans))
    z, valid = np.full((len(scans), 1, most, 2), np.nan), np.zeros((len(scans), 1, most), np.bool_)
    for row, scan in enumerate(scans):
        # In front of the plots, where a code that cuts instead of masking would take it for them.
        z[row, 0, most - len(scan) :], valid[row, 0, most - len(scan) :] = scan, True
    return Plots(z, valid)


def scan(mixture: Mixture, plots: Plots, reduction: Reduction, p_d: float = 0.7, p_g: float = 1.0) -> Mixture:
    """Predict and branch."""
    predicted = moved(mixture, SHARES[-len(mixture.density.x) :])
    return step(predicted, seen(predicted, p_d, 1e-3, p_g), plots, reduction)


def component(mixture: Mixture, track: int, number: int) -> History:
    """One component, as the reference has it."""
    (x, P), at = mixture.density, (track, number)
    return History(
        float(mixture.log_w[at]),
        float(mixture.log_g[at]),
        Density(x[-1][at], P[-1][at]),
        Density(x[0][at], P[0][at]),
    )


def components(mixture: Mixture, track: int) -> list[History]:
    """Those that there are, the heaviest first."""
    there = [component(mixture, track, int(i)) for i in np.flatnonzero(mixture.log_w[track] > -np.inf)]
    return sorted(there, key=lambda history: -history.log_w)


def normalised(histories: Sequence[History]) -> list[History]:
    """With honest weights of sum one, the heaviest first."""
    total = float(logsumexp([history.log_w for history in histories]))
    return sorted((h._replace(log_w=h.log_w - total) for h in histories), key=lambda history: -history.log_w)


def assert_same(ours: Sequence[History], expected: Sequence[History], tolerance: float = 1e-9) -> None:
    assert len(ours) == len(expected)
    for one, other in zip(ours, expected, strict=True):
        assert (one.log_w, one.log_g) == pytest.approx((other.log_w, other.log_g), rel=tolerance, abs=tolerance)
        for density, there in ((one.honest, other.honest), (one.factor, other.factor)):
            np.testing.assert_allclose(density.x, there.x, rtol=tolerance, atol=tolerance)
            np.testing.assert_allclose(density.P, there.P, rtol=tolerance, atol=tolerance * np.abs(there.P).max())


def assert_same_mixture(ours: Mixture, expected: Mixture, tolerance: float = 1e-9) -> None:
    assert len(ours.log_w) == len(expected.log_w)
    for track in range(len(ours.log_w)):
        assert_same(components(ours, track), components(expected, track), tolerance)


#: Plots of three tracks in four scans; the second scan has none at all.
COUNTS = [(2, 0, 1), (0, 0, 0), (3, 1, 0), (1, 2, 2)]


def story(draw: Draw, seed: int = 1) -> tuple[Gaussian, list[list[Array]]]:
    """Priors of three tracks and their ragged scans, plots near enough that every history counts."""
    rng = np.random.default_rng(seed)
    honest = draw(rng, (3,), 4, 3.0)
    return honest, [[honest.x[t, :2] + rng.normal(0.0, 6.0, (n, 2)) for t, n in enumerate(row)] for row in COUNTS]


def histories(prior: Gaussian, track: int, scans: Sequence[Sequence[Array]], p_d: float = 0.7) -> list[History]:
    """All histories of a track (Eq. 15, 17), normalised."""
    x, P = prior.x[track], prior.P[track]
    alive = [History(0.0, 0.0, Density(x, P), Density(x, SHARES[0].multiplicity * P))]
    for plots in scans:
        alive = branched(aged(alive, DT, PSD, SHARES[0].multiplicity), plots[track], seer(p_d, 1e-3))
    return normalised(alive)


# Against the enumeration ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2])
def test_with_nothing_dropped_or_combined_there_is_a_component_for_every_history(seed: int, draw: Draw) -> None:
    prior, scans = story(draw, seed)
    mixture = begun(prior)
    for plots in scans:
        mixture = scan(mixture, ragged(plots), EXACT)
    for track, count in enumerate((3 * 1 * 4 * 2, 1 * 1 * 2 * 3, 2 * 1 * 1 * 3)):
        assert len(components(mixture, track)) == count
        assert_same(components(mixture, track), histories(prior, track, scans))


def test_the_evidence_of_a_single_filter_is_the_likelihood_ratio(draw: Draw) -> None:
    prior, scans = story(draw)
    mixture = begun(prior, SHARES[1:])
    for plots in scans:
        mixture = scan(mixture, ragged(plots), EXACT)
    for track in range(3):
        x, P = prior.x[track], prior.P[track]
        alive = [History(0.0, 0.0, Density(x, P), Density(x, P))]
        for plots in scans:
            alive = branched(aged(alive, DT, PSD, 1.0), plots[track], seer(0.7, 1e-3))
        log_lr = logsumexp([history.log_w for history in alive])
        assert logsumexp(mixture.log_g[track]) == pytest.approx(log_lr, rel=1e-12)


def test_a_generous_multi_hypothesis_tracker_is_nearly_exact(draw: Draw) -> None:
    prior, scans = story(draw)
    mixture = begun(prior)
    for plots in scans:
        mixture = scan(mixture, ragged(plots), Reduction(components=1000, prune=1e-12, combine=1e-12))
    for track in range(3):
        exact, ours = histories(prior, track, scans), components(mixture, track)
        assert logsumexp([h.log_g for h in ours]) == pytest.approx(logsumexp([h.log_g for h in exact]), abs=1e-6)
        for field in ("honest", "factor"):
            one, other = (
                mean_of([h.log_w for h in every], [getattr(h, field) for h in every]) for every in (ours, exact)
            )
            np.testing.assert_allclose(one.x, other.x, rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(one.P, other.P, rtol=1e-6, atol=1e-6 * np.abs(other.P).max())


# Limits ---------------------------------------------------------------------------------------------------------------


def plain(mixture: Mixture, plots: Plots, choice: Choice, p_d: float, p_g: float) -> Mixture:
    """A scan with the single Gaussian of ``association``."""
    predicted = moved(mixture, SHARES[-len(mixture.density.x) :])
    density, log_p_bar = update(seen(predicted, p_d, 1e-3, p_g), plots, choice)
    return Mixture(predicted.log_w, predicted.log_g + log_p_bar, density)


LIMITS = {
    "combine all: PDAF": (Reduction(15, 0.0, np.inf), normalise),
    "prune all but one: nearest neighbour": (Reduction(15, 1.0 - 1e-12, 0.0), nearest),
    "only one, no rest: nearest neighbour": (Reduction(1, 0.0, 0.0, rest=False), nearest),
    "only one, the rest in it: PDAF": (Reduction(1, 0.0, 0.0), normalise),
}


@pytest.mark.parametrize("shares", [SHARES, SHARES[1:]], ids=["two filters", "one filter"])
@pytest.mark.parametrize("p_g", [1.0, 0.9])
@pytest.mark.parametrize(("reduction", "choice"), LIMITS.values(), ids=LIMITS.keys())
def test_a_limit_is_the_filter_it_should_be(
    reduction: Reduction, choice: Choice, p_g: float, shares: Sequence[Share], draw: Draw
) -> None:
    prior, scans = story(draw)
    mixture = expected = begun(prior, shares)
    for plots in scans:
        mixture = scan(mixture, ragged(plots), reduction, p_g=p_g)
        expected = plain(expected, ragged(plots), choice, 0.7, p_g)
        assert_same_mixture(mixture, expected, 1e-10)


def test_a_certain_plot_is_a_kalman_update(draw: Draw) -> None:
    prior, _ = story(draw)
    z = prior.x[:, :2] + 1.0
    mixture = scan(begun(prior), ragged(list(z[:, None])), Reduction(), p_d=1.0)
    for track in range(3):
        (only,) = components(mixture, track)
        assert_same([only], histories(prior, track, [list(z[:, None])], 1.0), 1e-12)


# Batches and plots ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reduction", [EXACT, Reduction(3, 1e-3, 0.5), Reduction(3, 1e-3, 0.5, rest=False)])
def test_a_batch_of_tracks_equals_one_by_one(reduction: Reduction, draw: Draw) -> None:
    prior, scans = story(draw)
    mixture, alone = begun(prior), [begun(Gaussian(prior.x[[t]], prior.P[[t]])) for t in range(3)]
    for plots in scans:
        mixture = scan(mixture, ragged(plots), reduction)
        alone = [scan(one, ragged(plots[t : t + 1]), reduction) for t, one in enumerate(alone)]
    for track in range(3):
        assert_same(components(mixture, track), components(alone[track], 0), 1e-12)


@pytest.mark.parametrize("p_g", [1.0, 0.99])
def test_plots_that_all_share_are_as_good_as_everyones_own(p_g: float, draw: Draw) -> None:
    prior, scans = story(draw)
    shared = own = begun(prior)
    for plots in scans:
        z = np.concatenate(plots)
        shared = scan(shared, Plots(z), Reduction(), p_g=p_g)
        own = scan(own, Plots(np.repeat(z[None, None], 3, axis=0)), Reduction(), p_g=p_g)
    assert_same_mixture(shared, own, 1e-12)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("padded", [True, False])
def test_of_many_plots_those_outside_the_gates_change_nothing(shared: bool, padded: bool, draw: Draw) -> None:
    """Enough pairs that each track looks only at the plots it can reach."""
    prior, scans = story(draw)
    rng = np.random.default_rng(5)
    far = rng.uniform(1e4, 2e4, (3000, 2))
    few = many = begun(prior)
    for plots in scans[::2]:
        near = np.concatenate(plots)
        mixed = rng.permutation(np.concatenate([near, far]))
        z = [array if shared else np.repeat(array[None, None], 3, axis=0) for array in (near, mixed)]
        valid = [np.ones(array.shape[:-1], np.bool_) if padded else None for array in z]
        few = scan(few, Plots(z[0], valid[0]), Reduction(), p_g=0.99)
        many = scan(many, Plots(z[1], valid[1]), Reduction(), p_g=0.99)
    assert few.log_w.shape[1] > 1
    assert_same_mixture(many, few, 1e-12)


def test_false_plots_may_be_denser_in_one_place_than_in_another(draw: Draw) -> None:
    """A plot where false ones are e times as dense counts as one of a sensor with e times as many."""
    prior, _ = story(draw)
    predicted, z = moved(begun(prior)), prior.x[:, None, None, :2] + 1.0
    relative = np.array([0.0, 1.0, -2.0])[:, None, None]
    ours = step(predicted, seen(predicted, 0.7, 1e-3), Plots(z, None, relative), EXACT)
    for track, log_factor in enumerate(relative.ravel()):
        expected = step(predicted, seen(predicted, 0.7, 1e-3 * np.exp(log_factor)), Plots(z), EXACT)
        assert_same(components(ours, track), components(expected, track), 1e-12)


def test_no_tracks_are_no_trouble() -> None:
    nothing = begun(Gaussian(np.empty((0, 4)), np.empty((0, 4, 4))))
    for plots in (Plots(np.zeros((3, 2))), Plots(np.empty((0, 2))), Plots(np.empty((0, 1, 5, 2)))):
        mixture = scan(nothing, plots, Reduction())
        assert mixture.log_w.shape[0] == 0
        assert (mixture.density.x.shape[:2], mixture.density.x.shape[3]) == ((2, 0), 4)
        assert len(terms(mixture, 3).log_w) == 0


# What cannot be -------------------------------------------------------------------------------------------------------


def test_a_scan_that_cannot_be_takes_all_evidence_and_leaves_the_weights(draw: Draw) -> None:
    prior, scans = story(draw)
    mixture = scan(begun(prior), ragged(scans[0]), EXACT)
    none: list[Array] = [np.empty((0, 2))] * 3
    # The second track sees a plot where it expects one; the others see nothing although they cannot be missed.
    plots = [none[0], moved(mixture).density.x[-1, 1, 0, None, :2], none[2]]
    after = scan(mixture, ragged(plots), EXACT, p_d=1.0)
    predicted = moved(mixture)
    for track in (0, 2):
        expected = [history._replace(log_g=-np.inf) for history in components(predicted, track)]
        assert_same(components(after, track), expected, 1e-12)
    assert np.isfinite(components(after, 1)[0].log_g)
    later = terms(scan(after, ragged(scans[2]), Reduction(5, 1e-4, 0.5)), 3)
    for track in (0, 2):
        assert {history.log_g for history in components(later, track)} == {-np.inf}
    assert np.isfinite(later.density.x).all()
    assert np.isfinite(components(later, 1)[0].log_g)


def test_what_cannot_be_is_no_number_less_where_weights_underflow(draw: Draw) -> None:
    """Nothing is pruned, so that a share of zero meets evidence of minus infinity."""
    prior, _ = story(draw)
    x, P = (np.repeat(part[None, :, None], 2, axis=2) for part in prior)
    log_w = np.array([[0.0, -2000.0]] * 3)
    mixture = Mixture(log_w, np.full((3, 2), -np.inf), Gaussian(x, P))
    assert np.array_equal(terms(mixture, 1).log_g, np.full((3, 1), -np.inf))


# Reduction ------------------------------------------------------------------------------------------------------------


def crowd(draw: Draw, count: int = 7, seed: int = 3) -> Mixture:
    """Two tracks of ``count`` components; the second one lacks some in between."""
    rng = np.random.default_rng(seed)
    density = draw(rng, (2, 2, count), 4, 2.0)
    log_w, log_g = rng.normal(0.0, 2.0, (2, count)), rng.normal(0.0, 3.0, (2, count))
    log_w[1, [1, 4]] = log_g[1, [1, 4]] = -np.inf
    return Mixture(log_w - logsumexp(log_w, axis=1, keepdims=True), log_g, density)


def test_combining_all_is_the_direct_formula(draw: Draw) -> None:
    mixture = crowd(draw)
    for reduction in (Reduction(9, 0.0, np.inf), Reduction(1, 0.0, 0.0)):
        one = reduced(mixture, reduction)
        for track in range(2):
            assert_same(components(one, track), [merged(components(mixture, track))], 1e-10)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 6, 7, 20])
def test_a_report_has_the_heaviest_terms_and_the_rest_in_one(count: int, draw: Draw) -> None:
    mixture = crowd(draw)
    told = terms(mixture, count)
    assert told.log_w.shape[1] <= count
    for track in range(2):
        every, ours = components(mixture, track), components(told, track)
        # Of the last column, whatever its weight: it is made of all that is left.
        kept, rest = every[: count - 1], every[count - 1 :]
        assert_same(ours, normalised([*kept, merged(rest)] if rest else kept), 1e-10)
        whole, again = merged(every), merged(ours)
        np.testing.assert_allclose(again.honest.x, whole.honest.x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(again.honest.P, whole.honest.P, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(again.factor.x, whole.factor.x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(again.factor.P, whole.factor.P, rtol=1e-10, atol=1e-10)
        assert again.log_g == pytest.approx(whole.log_g, rel=1e-10)


def pruned(every: list[History], share: float) -> list[History]:
    return [history for history in every if history.log_w >= every[0].log_w + np.log(share)]


def locally_combined(every: list[History], nearer: float, most: int) -> list[History]:
    """theory.md §9: around the heaviest, then around the next heaviest that is left; the last takes all others."""
    left = list(every)
    result: list[History] = []
    while left:
        first = left[0].honest

        def distance(history: History, first: Density = first) -> float:
            d = history.honest.x - first.x
            return float(d @ np.linalg.solve(history.honest.P + first.P, d))

        near = [history for history in left if len(result) == most - 1 or distance(history) < nearer]
        near = near if left[0] in near else [left[0], *near]
        result.append(merged(near))
        left = [history for history in left if not any(history is other for other in near)]
    return result


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("reduction", [Reduction(20, 0.02, 2.0), Reduction(20, 0.0, 4.0), Reduction(3, 0.0, 1.0)])
def test_local_combining_starts_at_the_heaviest(seed: int, reduction: Reduction, draw: Draw) -> None:
    mixture = crowd(draw, 12, seed)
    ours = reduced(mixture, reduction)
    for track in range(2):
        every = components(mixture, track)
        kept = pruned(every, reduction.prune) if reduction.prune else every
        expected = normalised(locally_combined(kept, reduction.combine, reduction.components))
        assert len(expected) < len(every)
        assert_same(components(ours, track), expected, 1e-10)


def test_large_coordinates_cost_no_digits(draw: Draw) -> None:
    prior, scans = story(draw)
    shift = np.array([1e7, -1e7, 0.0, 0.0])
    near, far = begun(prior), begun(Gaussian(prior.x + shift, prior.P))
    for plots in scans:
        near = scan(near, ragged(plots), Reduction(4, 1e-3, 1.0))
        far = scan(far, ragged([z + shift[:2] for z in plots]), Reduction(4, 1e-3, 1.0))
    back = far._replace(density=Gaussian(far.density.x - shift, far.density.P))
    assert_same_mixture(back, near, 2e-7)
    one, other = terms(back, 2), terms(near, 2)
    assert_same_mixture(one, other, 2e-7)


@PROPERTIES
@given(
    seed=st.integers(0, 2**32 - 1),
    counts=st.lists(st.lists(st.integers(0, 4), min_size=2, max_size=2), min_size=1, max_size=3),
    p_d=st.sampled_from([0.0, 0.3, 0.9, 1.0]),
    p_g=st.sampled_from([0.9, 1.0]),
    reduction=st.builds(
        Reduction, st.integers(1, 6), st.sampled_from([0.0, 1e-4, 0.1]), st.sampled_from([0.0, 0.5, 5.0]), st.booleans()
    ),
)
def test_a_mixture_stays_one(
    seed: int, counts: list[list[int]], p_d: float, p_g: float, reduction: Reduction, draw: Draw
) -> None:
    rng = np.random.default_rng(seed)
    mixture = turned = begun(draw(rng, (2,), 4, 3.0))
    for row in counts:
        plots = [rng.normal(0.0, 8.0, (count, 2)) for count in row]
        mixture = scan(mixture, ragged(plots), reduction, p_d, p_g)
        turned = scan(turned, ragged([z[::-1] for z in plots]), reduction, p_d, p_g)
        np.testing.assert_allclose(np.exp(mixture.log_w).sum(axis=-1), 1.0, rtol=1e-12)
        assert mixture.log_w.shape[1] <= reduction.components
        assert (np.linalg.eigvalsh(mixture.density.P) > 0.0).all()
        assert not np.isnan(mixture.log_g).any()
        assert np.array_equal(mixture.density.P, mixture.density.P.mT)
    # In which order the plots of a scan stand says nothing.
    assert_same_mixture(turned, mixture, 1e-8)
    told = terms(mixture, 2)
    whole, again = (moments(np.exp(m.log_w), Gaussian(m.density.x[0], m.density.P[0])) for m in (mixture, told))
    np.testing.assert_allclose(again.x, whole.x, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(again.P, whole.P, rtol=1e-8, atol=1e-7)
