"""Track extraction by sub-tracks against brute-force enumeration of all histories; its decisions over seeded runs."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from enumeration import History, Problem, all_histories, log_likelihood
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp
from scipy.stats import binom, multivariate_normal

from waldnet.common.estimation.association import Plots
from waldnet.common.estimation.detection import Constant, Detection, Notch
from waldnet.common.estimation.extraction import Candidates, Extractor, SensorScan, candidates, extract, seeds, together
from waldnet.common.estimation.field_of_view import Everywhere
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.mixture import EXACT, Reduction
from waldnet.common.estimation.motion import ConstantVelocity
from waldnet.common.estimation.polar import Polar
from waldnet.common.estimation.sensing import Position, Sensor
from waldnet.common.estimation.sprt import CONFIRMED, DELETED, TENTATIVE, Thresholds, thresholds

MOTION = ConstantVelocity(2, 3.0)
AREA = 4e4
NEAR = Sensor(Position((4.0, 7.0), 4), 0.8, 12.0, Everywhere(AREA, 2))
FAR = Sensor(Position((15.0, 10.0), 4), 0.5, 30.0, Everywhere(AREA, 2))
NEVER = Thresholds(-np.inf, np.inf)
EVERYTHING = Extractor(MOTION, NEVER, EXACT, gate_probability=1.0)
ORIGIN = np.zeros(2)


def scan_of(sensor: Sensor, time: float, z: Array) -> SensorScan:
    return SensorScan(time, sensor, ORIGIN, ORIGIN, Plots(z))


def problem(prior: Gaussian, scans: list[SensorScan], start: float = 0.0) -> Problem:
    """The same for brute force."""
    dt = np.diff([start, *(scan.time for scan in scans)])
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


def brute(prior: Gaussian, scans: list[SensorScan], start: float = 0.0) -> float:
    """Eq. (15)."""
    this = problem(prior, scans, start)
    return float(logsumexp([log_likelihood(this, history) for history in all_histories(this)]))


def cluttered(
    rng: np.random.Generator, sensors: list[Sensor], times: list[float], counts: list[int]
) -> list[SensorScan]:
    """Plots around a target that starts at the origin with 5 m/s."""
    scans = []
    for sensor, time, count in zip(sensors, times, counts, strict=True):
        z = np.array([5.0 * time, 0.0]) + rng.normal(0.0, 20.0, (count, 2))
        scans.append(scan_of(sensor, time, z))
    return scans


PRIOR = Gaussian(np.array([0.0, 0.0, 4.0, 1.0]), np.diag([300.0, 200.0, 36.0, 49.0]))


def one(density: Gaussian, number: int = 7) -> Candidates:
    return candidates(np.array([number]), Gaussian(density.x[None, None], density.P[None, None]))


# ---- the likelihood ratio


def test_the_ratio_is_the_sum_over_all_histories() -> None:
    """One sensor, an empty scan among them."""
    scans = cluttered(np.random.default_rng(1), 4 * [NEAR], [1.0, 2.5, 4.0, 4.5], [2, 3, 0, 2])
    ours = list(extract(EVERYTHING, one(PRIOR), 0.0, scans))
    assert [len(candidate.log_lr) for candidate in ours] == 4 * [1]
    for k, candidate in enumerate(ours):
        assert candidate.log_lr[0] == pytest.approx(brute(PRIOR, scans[: k + 1]), rel=1e-9, abs=1e-9)
        assert candidate.scans[0] == k + 1


def test_centralised_the_scans_of_all_sensors_are_taken_in_turn() -> None:
    """Also two at the same time, in either order."""
    scans = cluttered(np.random.default_rng(2), [NEAR, FAR, FAR, NEAR], [1.0, 1.0, 2.0, 3.5], [2, 2, 1, 2])
    swapped = [scans[1], scans[0], *scans[2:]]
    expected = brute(PRIOR, scans)
    for order in (scans, swapped):
        *_, last = extract(EVERYTHING, one(PRIOR), 0.0, order)
        assert last.log_lr[0] == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_with_generous_limits_nothing_that_counts_is_lost() -> None:
    scans = cluttered(np.random.default_rng(3), [NEAR, FAR, NEAR, FAR], [1.0, 1.5, 3.0, 4.0], [2, 3, 2, 2])
    generous = replace(EVERYTHING, reduction=Reduction(200, 1e-9, 1e-6), gate_probability=1.0 - 1e-12)
    *_, last = extract(generous, one(PRIOR), 0.0, scans)
    assert last.log_lr[0] == pytest.approx(brute(PRIOR, scans), abs=1e-6)


def test_the_plots_of_a_scan_are_sub_tracks_of_one_candidate() -> None:
    """Which of them shows the target is open: LR is the mean of theirs. Or each is a candidate, with its own LR."""
    first = np.array([[0.0, 3.0], [-30.0, 10.0], [5.0, -25.0]])
    density = seeds(Gaussian(first, np.stack(3 * [NEAR.measurement.R])), 8.0)
    scans = cluttered(np.random.default_rng(4), [NEAR, FAR, NEAR], [1.5, 2.0, 3.0], [2, 2, 1])
    alone = np.array([brute(Gaussian(*own), scans, 0.5) for own in zip(*density, strict=True)])
    single = candidates(np.array([4]), Gaussian(density.x[None], density.P[None]))
    apart = candidates(np.array([1, 5, 6]), Gaussian(density.x[:, None], density.P[:, None]))
    *_, last = extract(EVERYTHING, single, 0.5, scans)
    assert last.log_lr[0] == pytest.approx(logsumexp(alone) - np.log(3.0), rel=1e-9, abs=1e-9)
    *_, last = extract(EVERYTHING, apart, 0.5, scans)
    np.testing.assert_allclose(last.log_lr, alone, rtol=1e-9, atol=1e-9)
    assert last.ids.tolist() == [1, 5, 6]


def test_a_seed_is_the_plot_and_any_velocity() -> None:
    R = np.array([[9.0, 2.0], [2.0, 4.0]])
    x, P = seeds(Gaussian(np.array([[[3.0, 4.0]]]), R[None, None]), 30.0)
    np.testing.assert_array_equal(x, [[[3.0, 4.0, 0.0, 0.0]]])
    np.testing.assert_array_equal(P[0, 0], np.block([[R, np.zeros((2, 2))], [np.zeros((2, 2)), 900.0 * np.eye(2)]]))


# ---- other sensors


def radar(detection: Detection) -> Sensor:
    return Sensor(Polar((5.0, 0.02), 4), 0.8, 12.0, Everywhere(4e6, 2), detection)


EAST = Gaussian(np.array([900.0, 0.0, 30.0, 1.0]), np.diag([100.0, 150.0, 16.0, 9.0]))


def test_false_plots_of_a_polar_sensor_are_as_dense_as_their_range_says() -> None:
    """Uniform in the plane, so in range and azimuth their density grows with range; azimuth goes round the circle."""
    z = np.array([[905.0, 0.5 * np.pi + 0.01 - 2.0 * np.pi]])
    (ours,) = extract(EVERYTHING, one(EAST), 0.0, [scan_of(radar(Constant()), 0.0, z)])
    S = np.diag([100.0 + 25.0, 150.0 / 900.0**2 + 0.02**2])
    log_hit = multivariate_normal([900.0, 0.0], S).logpdf([905.0, 0.01])
    expected = np.log(0.2 + 0.8 * np.exp(log_hit) / (12.0 / 4e6 * 905.0))
    assert ours.log_lr[0] == pytest.approx(expected, rel=1e-9)


def test_who_is_not_seen_by_a_radar_with_a_clutter_notch_may_be_slow() -> None:
    """Against the integral over the radial speed, here the velocity to the east."""
    notch = Notch(20.0)
    (ours,) = extract(EVERYTHING, one(EAST), 0.0, [scan_of(radar(notch), 0.0, np.zeros((0, 2)))])
    speed = np.linspace(30.0 - 40.0, 30.0 + 40.0, 20001)
    unseen = (1.0 - 0.8 * (1.0 - 2.0 ** -np.square(speed / 20.0))) * np.exp(-0.5 * np.square(speed - 30.0) / 16.0)
    assert np.exp(ours.log_lr[0]) == pytest.approx(np.trapezoid(unseen, speed) / np.sqrt(2.0 * np.pi * 16.0), rel=1e-4)
    mean = np.trapezoid(unseen * speed, speed) / np.trapezoid(unseen, speed)
    assert ours.x[0, 0, 2] == pytest.approx(mean, rel=1e-4)


# ---- decisions


def posterior(history: list[tuple[float, History]]) -> Array:
    log_w = np.array([log for log, _ in history])
    return np.exp(log_w - logsumexp(log_w))


def test_who_is_confirmed_goes_on_as_the_mixture_of_its_sub_tracks() -> None:
    """With weights lambda_j / sum lambda; from then on LR is that of the later data alone."""
    z = [np.array([[4.0 * time, time], [60.0, -50.0]]) for time in (1.0, 2.0, 3.0)]
    scans = [scan_of(NEAR, 1.0 + k, plots) for k, plots in enumerate([*z, np.zeros((0, 2))])]
    total = [brute(PRIOR, scans[: k + 1]) for k in range(4)]
    limits = Thresholds(-50.0, 0.5 * (total[1] + total[2]))
    assert max(0.0, *total[:2]) < limits.log_b < total[2]
    first, second, third, fourth = extract(replace(EVERYTHING, limits=limits), one(PRIOR), 0.0, scans)
    assert (first.status, second.status, third.status) == (TENTATIVE, TENTATIVE, CONFIRMED)
    assert third.log_lr[0] == 0.0
    this = problem(PRIOR, scans[:3])
    weights = posterior([(log_likelihood(this, history), history) for history in all_histories(this)])
    np.testing.assert_allclose(np.sort(np.exp(third.log_lambda[0])), np.sort(weights), rtol=1e-9)
    assert fourth.log_lr[0] == pytest.approx(total[3] - total[2], abs=1e-9)


def test_who_is_deleted_is_said_once_and_left_out() -> None:
    away = Gaussian(PRIOR.x + np.array([1e4, 0.0, 0.0, 0.0]), PRIOR.P)
    start = together(one(PRIOR, 1), one(away, 2))
    scans = cluttered(np.random.default_rng(6), 3 * [NEAR], [1.0, 2.0, 3.0], [2, 2, 2])
    limits = Thresholds(2.5 * np.log(0.2), 1e3)
    ids = [
        (said.ids.tolist(), said.status.tolist())
        for said in extract(replace(EVERYTHING, limits=limits), start, 0.0, scans)
    ]
    assert ids == [([1, 2], [0, 0]), ([1, 2], [0, 0]), ([1, 2], [0, DELETED])]
    *_, last = extract(replace(EVERYTHING, limits=limits), one(away), 0.0, [*scans, *scans])
    assert (last.scans[0], last.status[0]) == (3, DELETED)
    assert len(EVERYTHING.step(last, scans[0]).ids) == 0


def test_scans_must_be_in_order() -> None:
    scans = cluttered(np.random.default_rng(7), 2 * [NEAR], [2.0, 1.0], [1, 1])
    with pytest.raises(ValueError, match=r"a scan at 1\.0 s comes after one at 2\.0 s"):
        list(extract(EVERYTHING, one(PRIOR), 0.0, scans))


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_candidates_together_are_the_candidates_apart(seed: int) -> None:
    """With other numbers of sub-tracks, deletions and confirmations in between."""
    rng = np.random.default_rng(seed)
    extractor = Extractor(MOTION, Thresholds(-2.0, 3.0), Reduction())
    priors = [
        candidates(
            np.array([number]),
            seeds(
                Gaussian(rng.normal(0.0, 40.0, (1, count, 2)), np.broadcast_to(50.0 * np.eye(2), (1, count, 2, 2))), 9.0
            ),
        )
        for number, count in enumerate((1, 3, 2))
    ]
    scans = cluttered(rng, [NEAR, FAR, NEAR], [1.0, 2.0, 3.0], [2, 3, 2])
    apart = {}
    for prior in priors:
        for said in extract(extractor, prior, 0.0, scans):
            apart[int(said.ids[0]), int(said.scans[0])] = (said.log_lr[0], said.status[0])
    both = {}
    start = together(together(*priors[:2]), priors[2])
    np.testing.assert_allclose(np.exp(start.log_lambda), [[1, 0, 0], [1 / 3, 1 / 3, 1 / 3], [1 / 2, 1 / 2, 0]])
    for said in extract(extractor, start, 0.0, scans):
        for row, number in enumerate(said.ids):
            both[int(number), int(said.scans[row])] = (said.log_lr[row], said.status[row])
    assert both.keys() == apart.keys()
    for key, (log_lr, status) in both.items():
        assert log_lr == pytest.approx(apart[key][0], rel=1e-9, abs=1e-9)
        assert status == apart[key][1]


# ---- over seeded runs


class Runs(NamedTuple):
    """As many worlds, each with one candidate: the plots of its first scan."""

    start: Candidates
    scans: list[SensorScan]
    truth: Array


def runs(count: int, scans: int, *, target: bool) -> Runs:
    """A square of 1 km with 5 false plots per scan of 2 s."""
    rng = np.random.default_rng(99)
    side, sensor = 1000.0, Sensor(Position((10.0, 10.0), 4), 0.9, 5.0, Everywhere(1e6, 2))
    x = np.concatenate([rng.uniform(-0.3 * side, 0.3 * side, (count, 2)), rng.normal(0.0, 8.0, (count, 2))], axis=-1)
    F, Q = MOTION.transition(np.array(2.0)), MOTION.noise(np.array(2.0))
    looks = []
    for k in range(scans + 1):
        false = rng.poisson(5.0, count)
        z = rng.uniform(-0.5 * side, 0.5 * side, (count, 1 + int(false.max()), 2))
        valid = np.arange(z.shape[1]) <= false[:, None]
        z[:, 0] = x[:, :2] + rng.normal(0.0, 10.0, (count, 2))
        valid[:, 0] = target & (rng.random(count) < (0.9 if k else 1.0))
        looks.append(SensorScan(2.0 * k, sensor, ORIGIN, ORIGIN, Plots(z[:, None], valid[:, None])))
        if k < scans:
            x = x @ F.T + rng.multivariate_normal(np.zeros(4), Q, count)
    z, valid, *_ = looks[0].plots
    density = seeds(Gaussian(z[:, 0], np.broadcast_to(100.0 * np.eye(2), (*z[:, 0].shape, 2))), 8.0)
    # Every world has a plot to start with, or nothing is asked.
    assert valid is not None
    asked = valid[:, 0].any(axis=-1)
    chosen = valid[asked, 0] / valid[asked, 0].sum(axis=-1, keepdims=True)
    log_w = np.log(chosen, out=np.full_like(chosen, -np.inf), where=chosen > 0.0)
    start = candidates(np.flatnonzero(asked), Gaussian(density.x[asked], density.P[asked]), log_w)
    later = [look._replace(plots=Plots(look.plots.z[asked], look.plots.valid[asked])) for look in looks[1:]]  # type: ignore[index]
    return Runs(start, later, x)


def decided(world: Runs, extractor: Extractor) -> tuple[set[int], set[int], Candidates]:
    """Who was confirmed and who was deleted first; and the last word."""
    confirmed: set[int] = set()
    deleted: set[int] = set()
    now, given = 0.0, world.start
    for scan in world.scans:
        rows = np.isin(world.start.ids, given.ids)
        mine = scan._replace(plots=Plots(scan.plots.z[rows], scan.plots.valid[rows]))  # type: ignore[index]
        given = extractor.step(extractor.predict(given, scan.time - now), mine)
        now = scan.time
        confirmed |= {int(i) for i in given.ids[given.status == CONFIRMED]} - deleted
        deleted |= {int(i) for i in given.ids[given.status == DELETED]} - confirmed
    return confirmed, deleted, given


P0, P1 = 0.02, 0.95
TEST = Extractor(MOTION, thresholds(P0, P1), Reduction())


def test_without_a_target_few_are_confirmed() -> None:
    """1000 worlds: no more than Wald's P0 allows, at 99.9 %; nearly all others are deleted within 12 scans."""
    world = runs(1000, 12, target=False)
    count = len(world.start.ids)
    confirmed, deleted, _ = decided(world, TEST)
    assert count > 980
    # Ville: P(LR ever above B) <= 1 / B = P0 / P1, whatever the number of scans.
    assert len(confirmed) <= binom.ppf(0.999, count, P0 / P1)
    assert len(deleted) >= 0.95 * count


def test_a_target_is_found_where_it_is() -> None:
    """300 worlds, 8 scans: at least P1 confirmed, less what 99.9 % allow; their tracks are at the target."""
    world = runs(300, 8, target=True)
    confirmed, _, last = decided(world, TEST)
    assert len(confirmed) >= binom.ppf(0.001, 300, P1)
    held = last.status == CONFIRMED
    mean = np.einsum("tc,tcn->tn", np.exp(last.log_w), last.x)[held]
    distance = np.hypot(*(mean - world.truth[last.ids[held]])[:, :2].T)
    assert held.sum() >= binom.ppf(0.001, 300, P1)
    assert np.mean(distance < 50.0) > 0.95
