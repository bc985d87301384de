"""The filter of a track as a scenario wants it: several models, the clutter notch, mixtures and single Gaussians."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pytest
from builders import hypothesis_table, scenario, sensor_table

from waldnet.common.config import Scenario
from waldnet.common.estimation.association import Expected, Plots, normalise
from waldnet.common.estimation.gaussian import Array, Gaussian, moments
from waldnet.common.estimation.mixture import Mixture
from waldnet.common.estimation.notch import filtered, hypotheses
from waldnet.common.estimation.sensing import Sensor
from waldnet.common.local_filter import LocalFilter
from waldnet.common.messages import Scan, Tracks
from waldnet.offline.replay import Replay
from waldnet.scenarios.world import simulate_all

UNDECIDED = {"enabled": False}
CV = {"model": "cv", "psd": 4.0}
TURNS = [{"psd": 1.0}, {"model": "ct", "psd": 2.0, "turn_rate": 0.1}, {"model": "ct", "psd": 2.0, "turn_rate": -0.1}]


def updated(
    local: LocalFilter,
    predicted: Mixture,
    expected: Expected,
    plots: Plots,
    sensor: Sensor,
    stand: Array,
    existence: Array | None = None,
) -> Mixture:
    """The tracks after a scan, jointly associated where existence is given."""
    near = local.near(expected, plots, sensor, stand)
    if existence is not None:
        near, _ = local.shared(predicted, expected, near, len(plots.z), sensor, stand, existence)
    return local.update(predicted, expected, near, sensor, stand)


def imm(models: list[dict[str, Any]]) -> dict[str, Any]:
    return {"model": "imm", "psd": 100.0, "sojourn": 7.0, "models": models}


def pictures(plot: Scenario, scans: list[Scan]) -> list[Tracks]:
    return [message for message in Replay(plot, scans).run() if isinstance(message, Tracks)]


def network(motion: dict[str, Any], **fusion: Any) -> Scenario:
    sensors = sensor_table("a", p_d=0.7, false_plots=20.0), sensor_table("b", p_d=0.8, scan_interval=3.0)
    return scenario(*sensors, motion=motion, fusion=fusion, decision=UNDECIDED)


# Several models -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fusion",
    [
        {"association": "factor"},
        {"association": "tight"},
        {"association": "tight", "feedback": "advice"},
        {"feedback": "reset", "feedback_delay": 3.0},
    ],
)
def test_models_that_are_equal_are_one(fusion: dict[str, Any]) -> None:
    one, many = network(CV, **fusion), network(imm([CV, CV, CV]), **fusion)
    scans = simulate_all(one, 3)
    for ours, theirs in zip(pictures(many, scans), pictures(one, scans), strict=True):
        np.testing.assert_allclose(ours.log_lr_total, theirs.log_lr_total, rtol=1e-9)
        np.testing.assert_allclose(ours.x, theirs.x, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(ours.P, theirs.P, rtol=1e-7, atol=1e-6)


@pytest.mark.parametrize("fusion", [{"association": "factor"}, {"association": "tight"}])
def test_the_center_predicts_several_models_as_the_nodes_do(fusion: dict[str, Any]) -> None:
    """Then scans without plots, after some with, are no more than their missed detections: both constants cancel."""
    anywhere = {"shape": "everywhere", "area": 4e8}
    plot = scenario(
        sensor_table("a", p_d=0.7, false_plots=20.0, field_of_view=anywhere),
        sensor_table("b", p_d=0.8, field_of_view=anywhere),
        motion=imm(TURNS),
        fusion=fusion,
        decision=UNDECIDED,
    )
    scans = simulate_all(plot, 3)
    late = plot.to_ns(8.0)
    blank = [scan if scan.time_ns <= late else scan._replace(z=np.empty((0, 2))) for scan in scans]
    told = pictures(plot, blank)
    after = [tracks for tracks in told if tracks.time_ns >= late]
    p_g = plot.fusion.gate_probability
    step = np.log(1.0 - 0.7 * p_g) + np.log(1.0 - 0.8 * p_g)
    for one, other in pairwise(after):
        np.testing.assert_allclose(other.log_lr_total - one.log_lr_total, step, rtol=1e-9)


def test_the_only_sensor_has_one_opinion_on_the_model() -> None:
    """Its factor is the whole prior, so that it must believe of the models what the filter that associates believes."""
    plot = scenario(sensor_table("a", p_d=0.8, false_plots=50.0), motion=imm(TURNS))
    local, config = LocalFilter.of(plot), plot.sensors[0]
    sensor, stand, center = config.build(local.motion), np.array([3000.0, 0.0]), np.zeros(2)
    prior = Gaussian(*(part[None] for part in plot.hypotheses[0].density))
    mixture, changed = local.start(prior), 0.0
    for scan in simulate_all(plot, 3):
        predicted = local.predict(mixture, np.array(2.0), np.array(2.0))
        expected = local.expect(predicted.density, sensor, stand, center)
        mixture = updated(local, predicted, expected, Plots(scan.z), sensor, stand)
        belief = mixture.log_g - np.logaddexp.reduce(mixture.log_g, axis=-1)[:, None]
        np.testing.assert_allclose(mixture.log_w, belief, rtol=1e-9, atol=1e-9)
        changed = max(changed, float(np.exp(mixture.log_w).max()))
    assert changed > 0.5  # of three models


def test_a_report_has_a_term_for_every_model() -> None:
    plot = network(imm(TURNS))
    local = LocalFilter.of(plot)
    mixture = local.start(Gaussian(np.zeros((2, 4)), np.tile(np.eye(4), (2, 1, 1))))
    assert local.report(mixture).log_g.shape == (2, 3)
    np.testing.assert_allclose(np.exp(mixture.log_g).sum(axis=-1), 1.0)


# The clutter notch ----------------------------------------------------------------------------------------------------


def gmti(**fusion: Any) -> Scenario:
    radars = [
        sensor_table(name, position=position, p_d=0.9, detection={"model": "notch", "mdv": 10.0}, false_plots=20.0)
        for name, position in (("a", [9000.0, 0.0]), ("b", [0.0, 9000.0]))
    ]
    hypotheses_ = [hypothesis_table(), hypothesis_table(3000.0, -2000.0)]
    return scenario(*radars, fusion=fusion, hypothesis=hypotheses_, decision=UNDECIDED)


@pytest.mark.parametrize("association", ["factor", "tight"])
def test_a_mixture_that_combines_all_is_the_pdaf_with_the_notch(association: str) -> None:
    single, many = (
        gmti(association=association),
        gmti(
            association="mirrored" if association == "tight" else "factor",
            filter="mht",
            mixture={"combine": 1e12, "prune": 0.0},
        ),
    )
    prior = Gaussian(*(np.array(part) for part in zip(*(entry.density for entry in single.hypotheses), strict=True)))
    stand, center = np.array([9000.0, 0.0]), np.zeros(2)
    outcomes = []
    for plot in (single, many):
        local, sensor = LocalFilter.of(plot), plot.sensors[0].build(plot.motion.build())
        mixture = local.predict(local.start(prior), np.array(2.0), np.array(2.0))
        expected = local.expect(mixture.density, sensor, stand, center)
        plots = Plots(np.array([300.0, 0.0]) + np.random.default_rng(4).normal(0.0, 150.0, (3, 2)))
        outcomes.append(updated(local, mixture, expected, plots, sensor, stand))
        if plot is single:
            given = filtered(hypotheses(expected, plots, sensor.detection, stand), normalise)  # type: ignore[arg-type]
            np.testing.assert_allclose(outcomes[0].log_g, given.log_p_bar, rtol=1e-12)
    one, other = outcomes
    np.testing.assert_allclose(other.log_g, one.log_g, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(other.density.x, one.density.x, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(other.density.P, one.density.P, rtol=1e-7, atol=1e-6)


@pytest.mark.parametrize("fusion", [{}, {"association": "mirrored", "terms": 3}, {"mode": "selected"}])
def test_a_target_in_the_notch_of_a_radar_is_not_refuted_by_it(fusion: dict[str, Any]) -> None:
    """The first hypothesis flies past radar b, in its notch, and towards a; nobody sees anything."""
    plot = gmti(**fusion)
    past_b = plot.model_copy(update={"hypotheses": plot.hypotheses[:1]})
    times = [plot.to_ns(2.0)]
    by_b = [Scan("b", t_ns, np.array([0.0, 9000.0]), np.empty((0, 2))) for t_ns in times]
    by_a = [Scan("a", t_ns, np.array([9000.0, 0.0]), np.empty((0, 2))) for t_ns in times]
    (hidden,), (seen,) = pictures(past_b, by_b), pictures(past_b, by_a)
    assert -0.9 < hidden.log_lr_total[0] < -0.05
    assert seen.log_lr_total[0] < np.log(1.0 - 0.9) + 0.2
    # What is not seen by b flies across: its speed towards b is known better than before.
    toward_b = [tracks.P[0, 3, 3] for tracks in (hidden, seen)]
    assert toward_b[0] < 0.8 * toward_b[1]


# Tracks that share plots ----------------------------------------------------------------------------------------------

SIGMA, SIDE, SPEED, STEP = 50.0, 5000.0, 20.0, 2.0
FILTERS = [
    {"association": "factor"},
    {"association": "tight"},
    {"association": "mirrored", "filter": "mht"},
    {"association": "factor", "filter": "nearest"},
    {"association": "factor", "filter": "kalman"},
]


class Flight(NamedTuple):
    """Pairs of targets side by side, each pair kilometres from the next.

    Attributes:
        scenario: one sensor, or, where the factor is not the honest filter, two; only the first one scans.
        priors: of the tracks, those of a pair together.
        states: of the targets at each scan.
        scans: one for all.
    """

    scenario: Scenario
    priors: Gaussian
    states: list[Array]
    scans: list[Array]


def flight(fusion: dict[str, Any], pairs: int, count: int, apart: float = 3.0, p_d: float = 0.9) -> Flight:
    """One false plot in 14 by 14 standard deviations."""
    rng = np.random.default_rng(1)
    area = SIDE**2 * pairs
    false = area / (200.0 * SIGMA**2)
    anywhere = {"shape": "everywhere", "area": area}
    names = "a" if fusion["association"] == "factor" else "ab"
    sensors = [sensor_table(name, p_d=p_d, false_plots=false, field_of_view=anywhere) for name in names]
    x = np.zeros((2 * pairs, 4))
    x[:, 0], x[1::2, 1], x[:, 2] = SIDE * np.repeat(np.arange(pairs), 2), apart * SIGMA, SPEED
    P = np.diag([SIGMA**2, SIGMA**2, 25.0, 25.0])
    priors = Gaussian(x + rng.multivariate_normal(np.zeros(4), P, len(x)), np.tile(P, (len(x), 1, 1)))
    states, scans = [], []
    for _ in range(count):
        x = x + STEP * SPEED * np.eye(4)[0]
        seen = x[rng.random(len(x)) < p_d, :2]
        false_plots = rng.random((rng.poisson(false), 2)) * [SIDE * pairs, SIDE] + x[0, :2] - 0.5 * SIDE
        states.append(x)
        scans.append(np.concatenate([seen + rng.normal(0.0, SIGMA, seen.shape), false_plots]))
    return Flight(scenario(*sensors, fusion=fusion, motion={"model": "cv", "psd": 1.0}), priors, states, scans)


def flown(flight: Flight, existence: float | None, rows: slice = slice(None)) -> Mixture:
    """The tracks after the last scan, or some of them as if there were no others."""
    local = LocalFilter.of(flight.scenario)
    sensor, stand = flight.scenario.sensors[0].build(local.motion), np.zeros(2)
    mixture = local.start(Gaussian(flight.priors.x[rows], flight.priors.P[rows]))
    r = None if existence is None else np.full(len(mixture.log_w), existence)
    for z in flight.scans:
        predicted = local.predict(mixture, np.array(STEP), np.array(STEP))
        expected = local.expect(predicted.density, sensor, stand, stand)
        mixture = updated(local, predicted, expected, Plots(z), sensor, stand, r)
    return mixture


def places(mixture: Mixture) -> Array:
    """Estimated positions of the honest filter, shape (pairs, 2, 2)."""
    mean: Array = moments(np.exp(mixture.log_w), Gaussian(mixture.density.x[-1], mixture.density.P[-1])).x
    return mean[:, :2].reshape(-1, 2, 2)


@pytest.mark.parametrize("fusion", FILTERS)
def test_near_targets_keep_their_tracks_apart(fusion: dict[str, Any]) -> None:
    """Three standard deviations apart for a minute. Filters on their own run into one; a swap is nobody's fault."""
    near = flight(fusion, pairs=60, count=30)
    truth = near.states[-1][:, :2].reshape(-1, 2, 2)
    together, right = [], []
    for existence in (None, 0.99):
        ours = places(flown(near, existence))
        together.append((np.linalg.norm(ours[:, 0] - ours[:, 1], axis=-1) < SIGMA).mean())
        either = [np.linalg.norm(ours - order, axis=-1).max(axis=-1) < 1.5 * SIGMA for order in (truth, truth[:, ::-1])]
        right.append(np.logical_or(*either).mean())
    assert together[0] > 0.5
    assert together[1] < 0.2
    assert right[1] > 0.75
    assert right[0] < 0.35


@pytest.mark.parametrize("fusion", FILTERS)
def test_tracks_that_share_no_plot_are_filtered_as_before_bit_for_bit(fusion: dict[str, Any]) -> None:
    """Every second target of each pair is left out; there are enough plots that not all of them are looked at."""
    far = flight(fusion, pairs=80, count=3)
    for ours, before in zip(flown(far, 0.9, slice(None, None, 2)), flown(far, None, slice(None, None, 2)), strict=True):
        for one, other in zip(ours, before, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("fusion", FILTERS)
def test_a_pair_does_not_feel_the_other_pairs(fusion: dict[str, Any]) -> None:
    """Alone it is shown all plots, among the others those near each component."""
    near = flight(fusion, pairs=30, count=6)
    every, alone = flown(near, 0.9), flown(near, 0.9, slice(8, 10))
    np.testing.assert_allclose(places(every)[4], places(alone)[0], rtol=1e-9)
    of_all, of_two = (np.logaddexp.reduce(mixture.log_g, axis=-1) for mixture in (every, alone))
    np.testing.assert_allclose(of_all[8:10], of_two, rtol=1e-9)


@pytest.mark.parametrize(
    "radar", [{"detection": {"model": "notch", "mdv": 10.0}}, {"kind": "polar", "sigma": [50.0, 0.01]}, {}]
)
@pytest.mark.parametrize(
    ("motion", "fusion"),
    [
        (CV, {"association": "factor"}),
        (imm(TURNS), {"association": "factor"}),
        (CV, {"filter": "mht", "mixture": {"prune": 0.0}}),
    ],
)
def test_twins_share_a_plot(radar: dict[str, Any], motion: dict[str, Any], fusion: dict[str, Any]) -> None:
    """With r = 1/2 each, nu = (1 + p*_0) / (1 + p*_0 + p*_1), and p* is what a track alone makes of the scan."""
    plot = scenario(sensor_table("a", position=[9000.0, 0.0], **radar), motion=motion, fusion=fusion)
    local, stand, center = LocalFilter.of(plot), np.array([9000.0, 0.0]), np.zeros(2)
    sensor, prior = plot.sensors[0].build(local.motion), plot.hypotheses[0].density
    one, two = (
        local.predict(
            local.start(Gaussian(*(np.stack([part] * count) for part in prior))), np.array(2.0), np.array(2.0)
        )
        for count in (1, 2)
    )
    z = sensor.measurement.observe(np.array([350.0, 40.0, 150.0, 0.0]), stand)[None]

    def p_bar(mixture: Mixture, z: Array, existence: Array | None = None) -> Array:
        expected = local.expect(mixture.density, sensor, stand, center)
        after = updated(local, mixture, expected, Plots(z), sensor, stand, existence)
        return np.exp(np.logaddexp.reduce(after.log_g, axis=-1))

    (none,), (both,) = p_bar(one, z[:0]), p_bar(one, z)
    hit = both - none
    nu = (1.0 + none) / (1.0 + none + hit)
    r = np.full(2, 0.5)
    np.testing.assert_allclose(p_bar(two, z, r), none + nu * hit, rtol=1e-9)
    expected = local.expect(two.density, sensor, stand, center)
    near = local.near(expected, Plots(z), sensor, stand)
    _, (unclaimed, _) = local.shared(two, expected, near, len(z), sensor, stand, r)
    np.testing.assert_allclose(unclaimed, (1.0 + none) / (1.0 + none + 2.0 * hit), rtol=1e-9)
