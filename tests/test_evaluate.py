"""The measures of ``waldnet evaluate``: beside brute force, Stone Soup, and runs whose faults are known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from itertools import combinations, permutations

import numpy as np
import pytest
from stonesoup.metricgenerator.ospametric import GOSPAMetric, OSPAMetric
from stonesoup.types.state import State

from waldnet.common.estimation.gaussian import Array
from waldnet.evaluation.evaluation import Evaluation, Rules, judge
from waldnet.evaluation.ospa import gospa_over_time, match, ospa2_over_time
from waldnet.evaluation.paths import Paths, distances, judged_times, sampled, targets_at
from waldnet.evaluation.runs import Run
from waldnet.scenarios.truth import Whereabouts
from waldnet.studies.gospa import gospa

C = 10.0


def random_paths(rng: np.random.Generator, count: int, times: int) -> Paths:
    """Random positions, some of them missing."""
    positions = rng.uniform(0.0, 16.0, (count, times, 2))
    positions[rng.random((count, times)) < 0.3] = np.nan
    return Paths(np.arange(count), positions)


SIZES = [(3, 4), (4, 2), (3, 3), (1, 1), (0, 2), (2, 0), (0, 0)]


def partial_matches(rows: int, columns: int) -> Iterator[list[tuple[int, int]]]:
    """All ways to pair some rows with some columns."""
    for size in range(min(rows, columns) + 1):
        for chosen in combinations(range(rows), size):
            for partners in permutations(range(columns), size):
                yield list(zip(chosen, partners, strict=True))


def brute_gospa(X: Array, Y: Array, p: float) -> Array:
    """Localisation, missed, false to the p, of the best of all partial matches."""
    best = np.full(3, np.inf)
    for pairs in partial_matches(len(X), len(Y)):
        near = sum(float(np.hypot(*(X[i] - Y[j]))) ** p for i, j in pairs)
        parts = np.array([near, C**p / 2 * (len(X) - len(pairs)), C**p / 2 * (len(Y) - len(pairs))])
        best = min(best, parts, key=np.sum)
    return best


@pytest.mark.parametrize("p", [1.0, 2.0])
@pytest.mark.parametrize("sizes", SIZES)
def test_gospa_is_that_of_brute_force(sizes: tuple[int, int], p: float) -> None:
    rng = np.random.default_rng(1)
    targets, tracks = (random_paths(rng, count, 12) for count in sizes)
    found = gospa_over_time(targets, tracks, C, p)
    for k in range(12):
        X, Y = (paths.positions[paths.there[:, k], k] for paths in (targets, tracks))
        localisation, missed, false = brute_gospa(X, Y, p)
        parts = [found.localisation[k], found.missed[k], found.false[k]]
        np.testing.assert_allclose(parts, np.array([localisation, missed, false]) ** (1.0 / p), atol=1e-12)
        np.testing.assert_allclose(found.total[k], (localisation + missed + false) ** (1.0 / p), atol=1e-12)
        np.testing.assert_allclose(found.total[k], gospa(X, Y, C, p), atol=1e-12)


def brute_ospa2(targets: Paths, tracks: Paths, window: Sequence[int], p: float) -> Array:
    """Total, localisation and cardinality, to the p, from the definition and all permutations."""

    def apart(f: Array, g: Array) -> float:
        costs = []
        for k in window:
            there = np.isfinite([f[k, 0], g[k, 0]])
            if there.any():
                costs.append(min(float(np.hypot(*(f[k] - g[k]))), C) if there.all() else C)
        return sum(costs) / len(costs)

    fewer, more = sorted(
        ([f for f in paths.positions if np.isfinite(f[list(window)]).any()] for paths in (targets, tracks)), key=len
    )
    if not more:
        return np.zeros(3)
    ways = permutations(range(len(more)), len(fewer))
    sums = [sum(apart(f, more[j]) ** p for f, j in zip(fewer, way, strict=True)) for way in ways]
    localisation, cardinality = min(sums) / len(more), C**p * (len(more) - len(fewer)) / len(more)
    return np.array([localisation + cardinality, localisation, cardinality])


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("p", [1.0, 2.0])
@pytest.mark.parametrize("sizes", SIZES)
def test_ospa2_is_that_of_brute_force(sizes: tuple[int, int], p: float, even: bool) -> None:
    rng = np.random.default_rng(2)
    targets, tracks = (random_paths(rng, count, 12) for count in sizes)
    times_s = np.arange(12.0) if even else np.cumsum(rng.uniform(0.2, 2.0, 12))
    found = ospa2_over_time(targets, tracks, times_s, 3.0, C, p)
    for k, now_s in enumerate(times_s):
        window = [other for other in range(k + 1) if times_s[other] > now_s - 3.0]
        expected = brute_ospa2(targets, tracks, window, p) ** (1.0 / p)
        np.testing.assert_allclose([part[k] for part in found], expected, atol=1e-9)


def states(points: Array) -> list[State]:
    return [State(point[:, None], timestamp=datetime(2021, 5, 4, tzinfo=UTC)) for point in points]


def test_gospa_and_its_parts_are_those_of_stone_soup() -> None:
    rng = np.random.default_rng(3)
    theirs = GOSPAMetric(p=2, c=C)
    for _ in range(10):
        X, Y = rng.uniform(0.0, 16.0, (3, 2)), rng.uniform(0.0, 16.0, (4, 2))
        metric, _assignment = theirs.compute_gospa_metric(states(Y), states(X))
        found = gospa_over_time(Paths(np.arange(3), X[:, None]), Paths(np.arange(4), Y[:, None]), C, 2.0)
        np.testing.assert_allclose(found.total[0], metric.value["distance"])
        squares = [found.localisation[0] ** 2, found.missed[0] ** 2, found.false[0] ** 2]
        expected = [float(metric.value[name]) for name in ("localisation", "missed", "false")]
        np.testing.assert_allclose(squares, expected, atol=1e-9)


def test_ospa2_of_a_window_with_one_time_is_stone_soups_ospa() -> None:
    """Of order 1: of others theirs takes the pairs with the smallest sum of distances, not of their powers."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        X, Y = rng.uniform(0.0, 16.0, (3, 2)), rng.uniform(0.0, 16.0, (4, 2))
        metric = OSPAMetric(p=1, c=C).compute_OSPA_distance(states(Y), states(X))
        paths = Paths(np.arange(3), X[:, None]), Paths(np.arange(4), Y[:, None])
        np.testing.assert_allclose(ospa2_over_time(*paths, np.zeros(1), 1.0, C, 1.0).total[0], metric.value)


def test_a_pair_at_the_cutoff_is_none() -> None:
    assert match(np.array([[C]]), C, 2.0)[0].size == 0
    assert match(np.array([[np.nextafter(C, 0.0)]]), C, 2.0)[0].tolist() == [0]


def on_line(*north: float | None) -> Array:
    """One path over the times 0, 1, 2, ...: at 0 east and so far north; None where it is not there."""
    return np.array([[np.nan, np.nan] if y is None else [0.0, y] for y in north])


def judged(targets: dict[int, Array], tracks: dict[int, Array], rules: Rules | None = None) -> Evaluation:
    """Evaluate tracks whose measurement times are 0, 1, 2, ...; paths as of ``on_line``."""
    times_s = np.arange(len(next(iter({**targets, **tracks}.values()))), dtype=float)
    ids = np.array(list(tracks), dtype=np.int64)
    run = Run("run", times_s, ids, np.array(list(tracks.values())).reshape(len(ids), len(times_s), 2), None)
    truth = {
        number: Whereabouts(times_s[np.isfinite(path[:, 0])], path[np.isfinite(path[:, 0])])
        for number, path in targets.items()
    }
    rules = rules or Rules(cutoff_m=C)
    at_s = judged_times(truth, [run])
    return judge(run, targets_at(truth, at_s, rules.gap_s, 2), at_s, rules)


def test_a_target_that_is_lost_and_found_again_has_a_break() -> None:
    track = on_line(None, None, 1.0, 1.0, None, 1.0, None, None, None, None)
    after = on_line(None, None, None, None, None, None, None, 2.0, 2.0, 2.0)
    found = judged({1: on_line(*10 * [0.0])}, {5: track, 6: after})
    (fate,) = found.fates
    assert (fate.first_s, fate.last_s) == (0.0, 9.0)
    assert (fate.confirmed_after_s, fate.confirmed_after_scans) == (2.0, 3)
    assert (fate.breaks, fate.swaps, fate.ids) == (2, 0, (5, 6))
    assert fate.held_share == pytest.approx(0.6)
    assert fate.rmse_m == pytest.approx(np.sqrt((3 * 1.0 + 3 * 4.0) / 6))
    summary = found.summary()
    assert (summary["false_tracks"], summary["duplicates"], summary["confirmed_tracks"]) == (0, 0, 2)
    assert (summary["breaks"], summary["confirmed_targets"], summary["rmse_m"]) == (2, 1, fate.rmse_m)


def test_a_track_of_another_id_without_a_gap_is_no_break() -> None:
    found = judged({1: on_line(*4 * [0.0])}, {5: on_line(0.0, 0.0, None, None), 6: on_line(None, None, 0.0, 0.0)})
    assert (found.fates[0].breaks, found.fates[0].ids) == (0, (5, 6))


def test_a_target_that_is_not_there_for_a_while_has_no_break() -> None:
    """A gap in its truth that is longer than the limit; the track of it is near no target meanwhile."""
    truth, track = on_line(0.0, 0.0, None, None, None, 0.0, 0.0), on_line(*7 * [0.0])
    found = judged({1: truth}, {5: track}, Rules(cutoff_m=C, gap_s=3.9))
    assert (found.fates[0].breaks, found.fates[0].held_share) == (0, 1.0)
    assert found.idle.false[0].tolist() == [False, False, True, True, True, False, False]
    assert found.summary()["false_tracks"] == 0
    assert not judged({1: truth}, {5: track}, Rules(cutoff_m=C, gap_s=4.0)).idle.false.any()


def test_a_track_that_goes_over_to_another_target_is_a_swap() -> None:
    targets = {1: on_line(*7 * [0.0]), 2: on_line(*7 * [50.0])}
    tracks = {5: on_line(0.0, 0.0, 25.0, 50.0, 50.0, 0.0, 50.0), 6: on_line(*4 * [None], 0.0, None, None)}
    found = judged(targets, tracks)
    assert [fate.swaps for fate in found.fates] == [1, 2]
    assert [fate.ids for fate in found.fates] == [(5, 6), (5,)]
    assert found.idle.false[0].tolist() == [False, False, True, False, False, False, False]


def test_two_targets_that_cross_keep_their_tracks_while_they_are_close_enough() -> None:
    """The optimal assignment of the moment would exchange them."""
    a, b = on_line(-6.0, -2.0, 2.0, 6.0), on_line(6.0, 2.0, -2.0, -6.0)
    behind = on_line(-6.0, -4.0, -1.0, 3.0), on_line(6.0, 4.0, 1.0, -3.0)
    found = judged({1: a, 2: b}, {5: behind[0], 6: behind[1]})
    assert match(distances(found.targets, found.tracks, 2), C, 2.0)[1].tolist() == [1, 0]
    assert [fate.ids for fate in found.fates] == [(5,), (6,)]
    assert found.summary()["swaps"] == 0


def test_duplicates_and_false_tracks_are_told_apart() -> None:
    tracks = {
        5: on_line(*7 * [0.0]),
        6: on_line(None, None, 3.0, 3.0, None, None, None),  # near what 5 holds
        7: on_line(*7 * [500.0]),
        8: on_line(None, 500.0, None, 3.0, None, None, None),  # comes near
        9: on_line(900.0, None, None, None, None, None, None),
    }
    found = judged({1: on_line(*7 * [0.0])}, tracks)
    assert found.idle.false_tracks.tolist() == [7, 9]
    assert found.idle.duplicates.tolist() == [6, 8]
    summary = found.summary()
    assert (summary["false_tracks"], summary["duplicates"]) == (2, 2)
    assert summary["false_tracks_per_minute"] == pytest.approx(2 / 0.1)
    assert summary["false_mean"] == pytest.approx((7 + 1 + 1) / 7)
    assert summary["duplicate_mean"] == pytest.approx(3 / 7)


def test_a_run_without_any_track_misses_everything() -> None:
    found = judged({1: on_line(*4 * [0.0]), 2: on_line(*4 * [50.0])}, {})
    assert [(fate.confirmed_after_s, fate.held_share, fate.ids) for fate in found.fates] == 2 * [(None, 0.0, ())]
    np.testing.assert_allclose(found.gospa.total, C)  # sqrt(2 c^2 / 2)
    np.testing.assert_allclose(found.ospa2.total, C)
    summary = found.summary()
    assert (summary["rmse_m"], summary["confirmed_after_s"], summary["held_share"]) == (None, None, 0.0)


def test_without_any_target_all_tracks_are_false() -> None:
    found = judged({}, {5: on_line(0.0, 0.0, None), 6: on_line(None, 9.0, 9.0)})
    assert found.idle.false_tracks.tolist() == [5, 6]
    assert found.summary()["held_share"] is None
    np.testing.assert_allclose(found.gospa.false, np.sqrt([C**2 / 2, C**2, C**2 / 2]))


def test_sampled_knows_nothing_outside_in_gaps_and_beside_a_nan() -> None:
    times_s, values = np.array([0.0, 1.0, 4.0, 5.0, 6.0]), np.array([0.0, 10.0, 40.0, np.nan, 60.0])[:, None]
    at_s = np.array([-0.1, 0.0, 0.25, 1.0, 2.0, 4.0, 4.5, 5.0, 5.5, 6.0, 6.1])
    nan = np.nan
    found = sampled(times_s, values, at_s, 2.0)[:, 0]
    np.testing.assert_allclose(found, [nan, 0.0, 2.5, 10.0, nan, 40.0, nan, nan, nan, 60.0, nan])
    assert sampled(times_s, values, np.array([2.0]), 3.0) == pytest.approx(20.0)


def run_at(times_s: Sequence[float], span_s: tuple[float, float] | None) -> Run:
    return Run("run", np.array(times_s), np.empty(0, np.int64), np.empty((0, len(times_s), 2)), span_s)


TRUTH = {1: Whereabouts(np.arange(0.0, 10.0), np.zeros((10, 2)))}


@pytest.mark.parametrize(
    ("runs", "times_s"),
    [
        ([run_at([3.5, 4.5, 99.0], (3.5, 99.0))], [3.5, 4.5]),
        ([run_at([3.5, 4.5], (1.0, 4.5))], [1.0, 2.0, 3.0, 3.5, 4.5]),
        ([run_at([], None)], list(range(10))),
        ([run_at([], (2.0, 4.0))], [2.0, 3.0, 4.0]),
        ([run_at([3.0, 4.0], (3.0, 4.0)), run_at([3.5, 6.0], (3.5, 6.0))], [3.0, 3.5, 4.0, 6.0]),
    ],
)
def test_times_are_those_of_the_runs_and_before_their_tracks_those_of_the_truth(
    runs: list[Run], times_s: list[float]
) -> None:
    assert judged_times(TRUTH, runs).tolist() == times_s


def test_a_track_is_between_its_own_times_where_another_run_has_been_measured() -> None:
    positions = np.array([[[0.0, 0.0], [0.0, 2.0], [np.nan, np.nan]]])
    run = Run("run", np.array([0.0, 1.0, 2.0]), np.array([5]), positions, None)
    at_s = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
    found = judge(run, targets_at(TRUTH, at_s, 5.0, 2), at_s, Rules())
    assert found.tracks.there[0].tolist() == [True, True, True, False, False]
    assert found.holding.error_m[0, :3].tolist() == [0.0, 1.0, 2.0]
    assert found.fates[0].confirmed_after_scans == 1
