"""The filter of a track as a scenario wants it: several models, the clutter notch, mixtures and single Gaussians."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from builders import hypothesis_table, scenario, sensor_table

from common.config import Scenario
from common.estimation.association import Plots, normalise
from common.estimation.gaussian import Gaussian
from common.estimation.notch import filtered, hypotheses
from common.local_filter import LocalFilter
from common.messages import Scan, Tracks
from scenarios.world import simulate_all
from studies.replay import Replay

UNDECIDED = {"enabled": False}
CV = {"model": "cv", "psd": 4.0}
TURNS = [{"psd": 1.0}, {"model": "ct", "psd": 2.0, "turn_rate": 0.1}, {"model": "ct", "psd": 2.0, "turn_rate": -0.1}]


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
        mixture = local.update(predicted, expected, Plots(scan.z), sensor, stand)
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
        outcomes.append(local.update(mixture, expected, plots, sensor, stand))
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
