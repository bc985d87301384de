"""Two modes, to try studies with: stands in until all modes play on batches."""

from __future__ import annotations

import numpy as np

from common.config import DecisionConfig, Scenario
from common.estimation.association import Clutter, Filtered, pdaf
from common.estimation.gaussian import Array, Gaussian
from common.messages import Scan, Tracks
from studies.course import Course, Look, Worlds
from studies.replay import Replay

MODES = ("centralised", "federated")


def play(scenario: Scenario, mode: str, worlds: Worlds) -> Course:
    """One mode on all worlds."""
    return _centralised(scenario, worlds) if mode == "centralised" else _federated(scenario, worlds)


def _centralised(scenario: Scenario, worlds: Worlds) -> Course:
    runs, prior, motion = len(worlds.seeds), scenario.hypotheses[0].density, scenario.motion.build()
    track = Filtered(Gaussian(np.tile(prior.x, (runs, 1)), np.tile(prior.P, (runs, 1, 1))), np.zeros(runs))
    now_ns, log_lr, course = scenario.to_ns(scenario.hypotheses[0].start), np.zeros(runs), []
    for time_ns in worlds.times_ns:
        dt = np.array((time_ns - now_ns) / 1e9)
        F, now_ns = motion.transition(dt), int(time_ns)
        track = Filtered(Gaussian(np.matvec(F, track.density.x), F @ track.density.P @ F.mT + motion.noise(dt)), log_lr)
        for look in worlds.looks:
            if look.time_ns == time_ns:
                track = _see(scenario, track.density, look)
                log_lr = log_lr + track.log_p_bar
        course.append((log_lr, track.density.x, track.density.P))
    columns = [np.stack(column, axis=1) for column in zip(*course, strict=True)]
    plots = np.mean([look.counts for look in worlds.looks])
    return Course(columns[0], columns[1], columns[2], uplink_bytes=float(16.0 * plots), downlink_bytes=0.0)


def _see(scenario: Scenario, density: Gaussian, look: Look) -> Filtered:
    config = scenario.sensors[look.sensor]
    sensor = config.build(scenario.motion.build())
    p_d = sensor.detection_probability(density, config.view_center(look.stand))
    clutter = Clutter(p_d, np.full(p_d.shape, sensor.log_rho_f), scenario.fusion.gate_probability)
    return pdaf(density, look.plots, sensor.measurement.linearise(density.x, look.stand), clutter)


def _federated(scenario: Scenario, worlds: Worlds) -> Course:
    fusion = scenario.fusion.model_copy(update={"mode": "federated", "association": "factor", "feedback": "none"})
    changes = {"decision": DecisionConfig(enabled=False), "fusion": fusion, "hypotheses": scenario.hypotheses[:1]}
    plain = scenario.model_copy(update=changes)
    courses = [_replay(plain, worlds, run) for run in range(len(worlds.seeds))]
    columns = [np.array(column) for column in zip(*courses, strict=True)]
    return Course(columns[0], columns[1], columns[2], uplink_bytes=132.0, downlink_bytes=0.0)


def _replay(scenario: Scenario, worlds: Worlds, run: int) -> tuple[Array, Array, Array]:
    scans = [
        Scan(scenario.sensor_names[look.sensor], look.time_ns, look.stand, look.plots.z[run, : look.counts[run]])
        for look in worlds.looks
    ]
    pictures = [m for m in Replay(scenario, scans).run() if isinstance(m, Tracks)]
    return (
        np.array([m.log_lr_total[0] for m in pictures]),
        np.array([m.x[0] for m in pictures]),
        np.array([m.P[0] for m in pictures]),
    )
