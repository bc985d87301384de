"""Clusters of an unknown number of targets against brute-force enumeration of all joint histories; seeded counts."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
from enumeration import History, Problem, all_histories, joint_histories, log_likelihood
from scipy.special import logsumexp
from scipy.stats import beta

from waldnet.common.estimation.association import Plots
from waldnet.common.estimation.cluster import Cluster, ClusterTest, cluster, extract_cluster
from waldnet.common.estimation.detection import Constant, Detection, Notch
from waldnet.common.estimation.extraction import Extractor, SensorScan, candidates, extract
from waldnet.common.estimation.field_of_view import Everywhere
from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.estimation.mixture import EXACT
from waldnet.common.estimation.motion import ConstantVelocity
from waldnet.common.estimation.polar import Polar
from waldnet.common.estimation.sensing import Position, Sensor
from waldnet.common.estimation.sprt import CONFIRMED, DELETED, TENTATIVE, Thresholds, thresholds

MOTION = ConstantVelocity(2, 3.0)
NEAR = Sensor(Position((4.0, 7.0), 4), 0.8, 12.0, Everywhere(4e4, 2))
FAR = Sensor(Position((15.0, 10.0), 4), 0.5, 30.0, Everywhere(4e4, 2))
ORIGIN = np.zeros(2)
PRIOR = Gaussian(np.array([0.0, 0.0, 4.0, 1.0]), np.diag([300.0, 200.0, 36.0, 49.0]))
OTHER = Gaussian(np.array([20.0, -10.0, 0.0, 0.0]), np.diag([100.0, 100.0, 25.0, 25.0]))
EVERYTHING = ClusterTest(MOTION, Thresholds(-np.inf, np.inf), hypotheses=2**31, prune=0.0, gate_probability=1.0)


def scans_of(seed: int, counts: list[int], sensors: list[Sensor]) -> list[SensorScan]:
    rng = np.random.default_rng(seed)
    return [
        SensorScan(1.5 * k, sensor, ORIGIN, ORIGIN, Plots(rng.normal(0.0, 25.0, (count, 2))))
        for k, (count, sensor) in enumerate(zip(counts, sensors, strict=True), 1)
    ]


def problem(prior: Gaussian, scans: list[SensorScan]) -> Problem:
    dt = np.full(len(scans), 1.5)
    sensors = [scan.sensor for scan in scans]
    return Problem(
        *prior,
        list(MOTION.transition(dt)),
        list(MOTION.noise(dt)),
        [scan.plots.z for scan in scans],
        [sensor.measurement.H for sensor in sensors],  # type: ignore[attr-defined]
        [sensor.measurement.R for sensor in sensors],
        [sensor.p_d for sensor in sensors],
        [float(np.exp(sensor.log_rho_f)) for sensor in sensors],
    )


def brute(priors: list[Gaussian], scans: list[SensorScan], n: int) -> tuple[float, list[float]]:
    """log LR_n, targets numbered, each drawn from one of the priors; and the terms of the sum."""
    problems = [problem(prior, scans) for prior in priors]

    @cache
    def log_lambda(number: int, history: History) -> float:
        return log_likelihood(problems[number], history)

    terms = [
        sum(log_lambda(number, history) for number, history in zip(drawn, histories, strict=True))
        for histories in joint_histories(problems[0], n)
        for drawn in product(range(len(priors)), repeat=n)
    ]
    return float(logsumexp(terms)) - n * float(np.log(len(priors))), terms


def stacked(*densities: Gaussian) -> Gaussian:
    return Gaussian(np.stack([x for x, _ in densities]), np.stack([P for _, P in densities]))


def run(test: ClusterTest, start: Cluster, scans: list[SensorScan]) -> Cluster:
    *_, last = extract_cluster(test, start, 0.0, scans)
    return last


# ---- the likelihood ratio


@pytest.mark.parametrize(("counts", "most"), [([2, 2, 2], 2), ([3, 0, 1], 2), ([2, 3], 3)])
def test_the_ratio_is_the_sum_over_all_joint_histories(counts: list[int], most: int) -> None:
    scans = scans_of(1, counts, [NEAR, FAR, NEAR][: len(counts)])
    last = run(EVERYTHING, cluster(stacked(PRIOR), most), scans)
    expected = np.array([brute([PRIOR], scans, n)[0] for n in range(1, most + 1)])
    np.testing.assert_allclose(last.log_lr_n, expected, rtol=1e-9, atol=1e-9)
    assert last.log_lr[0] == pytest.approx(logsumexp(expected) - np.log(most), rel=1e-9, abs=1e-9)
    np.testing.assert_allclose(last.cardinality, np.exp(expected - logsumexp(expected)), rtol=1e-8)
    assert last.scans == len(counts)


def test_targets_may_come_from_any_part_of_a_mixture() -> None:
    """Two of the same part, or of different ones: as many numbered draws as there are."""
    scans = scans_of(2, [2, 2], [NEAR, NEAR])
    last = run(EVERYTHING, cluster(stacked(PRIOR, OTHER), 3), scans)
    expected = [brute([PRIOR, OTHER], scans, n)[0] for n in (1, 2, 3)]
    np.testing.assert_allclose(last.log_lr_n, expected, rtol=1e-9, atol=1e-9)


def test_of_joint_histories_that_differ_in_who_is_who_one_is_kept() -> None:
    """Up to n! of them weigh the same; the weight of all is with the one."""
    scans = scans_of(3, [2, 2], [NEAR, FAR])
    last = run(EVERYTHING, cluster(stacked(PRIOR), 3), scans)
    for n, joint in enumerate(last.joint, 1):
        unordered = {tuple(sorted(histories)) for histories in joint_histories(problem(PRIOR, scans), n)}
        assert len(joint.members) == len(unordered)
        assert len(brute([PRIOR], scans, n)[1]) > len(unordered) or n == 1
        assert (np.diff(joint.members, axis=1) >= 0).all()
    assert len(last.density.x) == len(all_histories(problem(PRIOR, scans)))


def test_one_target_at_most_is_track_extraction() -> None:
    """Eq. (16a) with n = 1 is Eq. (15)."""
    scans = scans_of(4, [3, 2, 0, 3], [NEAR, FAR, NEAR, NEAR])
    *_, alone = extract(
        Extractor(MOTION, EVERYTHING.limits, EXACT, 1.0),
        candidates(np.array([0]), Gaussian(PRIOR.x[None, None], PRIOR.P[None, None])),
        0.0,
        scans,
    )
    last = run(EVERYTHING, cluster(stacked(PRIOR), 1), scans)
    assert last.log_lr[0] == pytest.approx(alone.log_lr[0], rel=1e-9, abs=1e-9)
    np.testing.assert_allclose(np.sort(last.density.x, axis=0), np.sort(alone.x[0], axis=0), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(last.cardinality, [1.0])


@pytest.mark.parametrize("detection", [Constant(), Notch(20.0)])
def test_one_target_at_most_of_a_polar_radar_is_track_extraction(detection: Detection) -> None:
    """Plots in range and azimuth; with a clutter notch, of which a missed detection tells."""
    radar = Sensor(Polar((5.0, 0.02), 4), 0.8, 12.0, Everywhere(4e6, 2), detection)
    east = Gaussian(np.array([900.0, 0.0, 30.0, 1.0]), np.diag([100.0, 150.0, 16.0, 9.0]))
    z = [np.array([[930.0, 0.01], [925.0, -0.02]]), np.zeros((0, 2)), np.array([[990.0, 0.02 - 2.0 * np.pi]])]
    # Azimuth is counted from north.
    at = np.array([0.0, 0.5 * np.pi])
    scans = [SensorScan(1.0 + k, radar, ORIGIN, ORIGIN, Plots(plots + at)) for k, plots in enumerate(z)]
    start = candidates(np.array([0]), Gaussian(east.x[None, None], east.P[None, None]))
    *_, alone = extract(Extractor(MOTION, EVERYTHING.limits, EXACT, 1.0), start, 0.0, scans)
    last = run(EVERYTHING, cluster(stacked(east), 2), scans)
    assert last.log_lr_n[0] == pytest.approx(alone.log_lr[0], rel=1e-9, abs=1e-9)
    assert last.log_lr_n[1] != pytest.approx(2.0 * alone.log_lr[0], rel=1e-3)


def test_with_generous_limits_nothing_that_counts_is_lost() -> None:
    scans = scans_of(5, [2, 3, 2], [NEAR, FAR, NEAR])
    generous = replace(EVERYTHING, hypotheses=5000, prune=1e-9, gate_probability=1.0 - 1e-12)
    last = run(generous, cluster(stacked(PRIOR), 2), scans)
    expected = [brute([PRIOR], scans, n)[0] for n in (1, 2)]
    np.testing.assert_allclose(last.log_lr_n, expected, rtol=0.0, atol=1e-6)


def test_what_is_dropped_leaves_its_weight_to_the_others() -> None:
    scans = scans_of(6, [3], [NEAR])
    expected = [brute([PRIOR], scans, n)[0] for n in (1, 2, 3)]
    few = run(replace(EVERYTHING, hypotheses=2), cluster(stacked(PRIOR), 3), scans)
    assert [len(joint.log_lambda) for joint in few.joint] == [2, 2, 2]
    np.testing.assert_allclose(few.log_lr_n, expected, rtol=1e-9, atol=1e-9)


# ---- decisions


def test_a_confirmed_cluster_keeps_its_cardinality_and_starts_its_tracks() -> None:
    z = [np.array([[4.0 * time, time], [-10.0 + 4.0 * time, -25.0]]) for time in (1.5, 3.0, 4.5)]
    scans = [SensorScan(1.5 * k, NEAR, ORIGIN, ORIGIN, Plots(plots)) for k, plots in enumerate(z, 1)]
    free = list(extract_cluster(EVERYTHING, cluster(stacked(PRIOR), 2), 0.0, scans))
    limits = Thresholds(-50.0, 0.5 * (free[1].log_lr[0] + free[2].log_lr[0]))
    assert max(said.log_lr[0] for said in free[:2]) < limits.log_b
    said = list(extract_cluster(replace(EVERYTHING, limits=limits), cluster(stacked(PRIOR), 2), 0.0, scans))
    assert [one.status[0] for one in said] == [TENTATIVE, TENTATIVE, CONFIRMED]
    assert said[2].log_lr[0] == 0.0
    assert logsumexp(said[2].log_lr_n) == pytest.approx(np.log(2.0), abs=1e-12)
    np.testing.assert_allclose(said[2].cardinality, free[2].cardinality, rtol=1e-12)
    assert said[2].cardinality.argmax() == 1
    x = said[2].targets.x
    np.testing.assert_allclose(x[np.argsort(-x[:, 1]), :2], z[2], atol=6.0)


def test_a_cluster_of_nothing_is_deleted() -> None:
    empty = [SensorScan(1.5 * k, NEAR, ORIGIN, ORIGIN, Plots(np.zeros((0, 2)))) for k in range(1, 9)]
    said = list(
        extract_cluster(replace(EVERYTHING, limits=thresholds(0.01, 0.99)), cluster(stacked(PRIOR), 3), 0.0, empty)
    )
    assert (len(said), said[-1].status[0]) == (3, DELETED)
    misses = np.array([1.0, 2.0, 3.0]) * 3.0 * np.log(0.2)
    np.testing.assert_allclose(said[-1].log_lr_n, misses, rtol=1e-9)


def test_fewer_plots_than_targets_that_are_surely_seen() -> None:
    """p_d = 1: so many targets are impossible; with no plot at all, every number is."""
    sure = NEAR._replace(p_d=1.0)
    scan = SensorScan(1.5, sure, ORIGIN, ORIGIN, Plots(np.array([[3.0, 2.0], [12.0, -9.0]])))
    (last,) = extract_cluster(EVERYTHING, cluster(stacked(PRIOR), 3), 0.0, [scan])
    np.testing.assert_array_equal(last.cardinality > 0.0, [True, True, False])
    assert np.isfinite(last.log_lr[0])
    limits = thresholds(0.01, 0.99)
    nothing = scan._replace(time=3.0, plots=Plots(np.zeros((0, 2))))
    (last,) = extract_cluster(replace(EVERYTHING, limits=limits, hypotheses=1), last, 1.5, [nothing])
    assert (last.log_lr[0], last.status[0]) == (-np.inf, DELETED)
    np.testing.assert_array_equal(last.cardinality, 1.0 / np.full(3, 3.0))


def test_padding_is_no_plot() -> None:
    (scan,) = scans_of(9, [3], [NEAR])
    plots = Plots(np.concatenate([scan.plots.z, np.zeros((2, 2))]), np.array([True, True, True, False, False]))
    (plain,) = extract_cluster(EVERYTHING, cluster(stacked(PRIOR), 2), 0.0, [scan])
    (padded,) = extract_cluster(EVERYTHING, cluster(stacked(PRIOR), 2), 0.0, [scan._replace(plots=plots)])
    np.testing.assert_allclose(padded.log_lr_n, plain.log_lr_n, rtol=1e-12)


def test_scans_must_be_in_order() -> None:
    scans = scans_of(7, [1, 1], [NEAR, NEAR])
    with pytest.raises(ValueError, match=r"a scan at 1\.5 s comes after one at 3\.0 s"):
        list(extract_cluster(EVERYTHING, cluster(stacked(PRIOR), 1), 0.0, scans[::-1]))


# ---- counting


def group(rng: np.random.Generator, targets: int, scans: int) -> list[SensorScan]:
    """So many targets, 50 m apart or so, seen with 6 m; 8 false plots in a square of 600 m."""
    sensor = Sensor(Position((6.0, 6.0), 4), 0.9, 8.0, Everywhere(3.6e5, 2))
    x = rng.normal(0.0, [50.0, 50.0, 6.0, 6.0], (targets, 4))
    F, Q = MOTION.transition(np.array(1.0)), MOTION.noise(np.array(1.0))
    looks = []
    for k in range(1, scans + 1):
        x = x @ F.T + rng.multivariate_normal(np.zeros(4), Q, targets)
        own = (x[:, :2] + 6.0 * rng.normal(size=(targets, 2)))[rng.random(targets) < sensor.p_d]
        false = rng.uniform(-300.0, 300.0, (rng.poisson(8.0), 2))
        looks.append(SensorScan(float(k), sensor, ORIGIN, ORIGIN, Plots(rng.permutation(np.concatenate([own, false])))))
    return looks


@pytest.mark.parametrize("targets", [1, 2, 3])
def test_the_most_probable_number_is_mostly_right(targets: int) -> None:
    """30 clusters, 6 scans, up to four targets thought of: right in three of four at least, with 99 % confidence."""
    prior = Gaussian(np.zeros((1, 4)), np.diag([2500.0, 2500.0, 36.0, 36.0])[None])
    test = ClusterTest(MOTION, Thresholds(-np.inf, np.inf))
    runs, right, confirmed = 30, 0, 0
    for seed in range(runs):
        scans = group(np.random.default_rng([targets, seed]), targets, 6)
        last = run(test, cluster(prior, 4), scans)
        right += int(last.cardinality.argmax()) + 1 == targets
        confirmed += bool(last.log_lr[0] > thresholds(0.01, 0.99).log_b)
    for count in (right, confirmed):
        assert beta.ppf(0.01, count, runs - count + 1) > 0.75


def test_without_targets_the_mean_ratio_stays_one() -> None:
    """LR_n is one of normalised densities, whatever is dropped: its mean over 1500 worlds of clutter, to 4 sigma."""
    sensor = Sensor(Position((30.0, 30.0), 4), 0.4, 4.0, Everywhere(3.6e5, 2))
    prior = Gaussian(np.zeros((1, 4)), np.diag([6400.0, 6400.0, 36.0, 36.0])[None])
    test = replace(EVERYTHING, hypotheses=2)
    rng, ratios = np.random.default_rng(8), []
    for _ in range(1500):
        plots = [rng.uniform(-300.0, 300.0, (rng.poisson(4.0), 2)) for _ in range(2)]
        scans = [SensorScan(1.0 + k, sensor, ORIGIN, ORIGIN, Plots(z)) for k, z in enumerate(plots)]
        ratios.append(np.exp(run(test, cluster(prior, 2), scans).log_lr_n))
    mean, sigma = np.mean(ratios, axis=0), np.std(ratios, axis=0) / np.sqrt(len(ratios))
    assert (np.abs(mean - 1.0) < 4.0 * sigma).all()
    assert (sigma < 0.08).all()
