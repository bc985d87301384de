"""What a scenario says that is allowed and yet hardly meant: warnings, each with what was got and what to do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from waldnet.common.config import HypothesisConfig, Scenario, SensorConfig
from waldnet.common.estimation.gaussian import Array, BoolArray, Gaussian, quadratic
from waldnet.common.estimation.motion import Motion, predict
from waldnet.common.messages import Scan
from waldnet.scenarios.precision_check import precision_faults

#: A standard deviation of an angle above this is hardly one in radians [rad].
WIDEST_SIGMA = 0.5
#: Hypotheses that differ by less (squared Mahalanobis distance) are one track: the default of ``initiation.merge``.
NEAREST_HYPOTHESES = 0.5
#: A track that lies inside with less than this probability is not seen.
_UNSEEN = 1e-3
#: So many hypotheses are compared with each other, so many points of a path are looked at, so many places are drawn.
_COMPARED, _POINTS, _DRAWN = 2000, 41, 200


class Finding(NamedTuple):
    """Something that does not fit.

    Attributes:
        where: a sensor, a hypothesis, a key.
        text: what was got, what was expected and what to do, in sentences.
        spoils: whether results are wrong because of it, and not only other than the user may expect.
    """

    where: str
    text: str
    spoils: bool = True

    def __str__(self) -> str:
        return f"{self.where}: {self.text}"


def scenario_findings(scenario: Scenario, scans: Sequence[Scan] = ()) -> list[Finding]:
    """Warnings about a scenario file.

    Args:
        scenario: the scenario.
        scans: recorded scans, by time, if there are any: they say where sensors stood and how long they looked.
    """
    findings = [finding for sensor in scenario.sensors for finding in _of_sensor(scenario, sensor)]
    return [*findings, *_same_hypotheses(scenario), *_unseen(scenario, scans), *_too_coarse(scenario, scans)]


def _of_sensor(scenario: Scenario, sensor: SensorConfig) -> Iterator[Finding]:
    where = f"sensor {sensor.name}"
    for number, (name, sigma) in enumerate(zip(sensor.numbers, sensor.sigma, strict=True)):
        if name in ("azimuth", "elevation") and sigma > WIDEST_SIGMA:
            yield Finding(
                f"{where}: sigma.{number}",
                f"an {name} known to {sigma:g} rad ({np.degrees(sigma):.0f} degrees) says next to nothing. Angles are "
                f"in radians; if degrees were meant, write {np.radians(sigma):.4g}.",
            )
    if sensor.p_d == 0.0:
        yield Finding(f"{where}: p_d", "0 means that the sensor never detects anything. Leave it out of the scenario.")
    yield from _too_dense(scenario, sensor, where)


def _too_dense(scenario: Scenario, config: SensorConfig, where: str) -> Iterator[Finding]:
    """False plots so dense that a plot right where a target is expected is no evidence of it."""
    sensor, rng = config.build(scenario.motion.build()), np.random.default_rng(0)
    pose = config.pose(scenario.motion.dimensions)
    sensor, stand = sensor.at(pose), pose.position
    places = sensor.field_of_view.draw(rng, _DRAWN, config.view_center(stand))
    measurement = sensor.measurement
    relative = sensor.log_relative(measurement.draw_false(rng, places, stand), stand)
    log_rho_f = sensor.log_rho_f + (0.0 if relative is None else float(np.median(relative)))
    volume = np.sqrt(np.linalg.det(2.0 * np.pi * measurement.R))
    within = float(np.exp(log_rho_f)) * float(volume)
    if within > 1.0:
        yield Finding(
            f"{where}: false_plots",
            f"{config.false_plots:g} false plots per scan in this field of view are {within:.3g} within the noise of "
            "one plot, so a plot right where a target is expected is no evidence of it, and no test can decide. "
            "Expected are less than 1. Check false_plots (per scan), sigma and the size of the field of view.",
        )


def _too_coarse(scenario: Scenario, scans: Sequence[Scan]) -> Iterator[Finding]:
    """What reports in single precision cannot hold."""
    for fault in precision_faults(scenario, scans):
        yield Finding("fusion.precision", f'{fault}: evidence is lost with every scan. Set precision = "float64".')


def _same_hypotheses(scenario: Scenario) -> Iterator[Finding]:
    """Hypotheses that one target confirms together."""
    hypotheses = scenario.hypotheses[:_COMPARED]
    if len(hypotheses) < 2:
        return
    motion = scenario.motion.build()
    found = 0
    for i, first in enumerate(hypotheses[:-1]):
        others = hypotheses[i + 1 :]
        latest = np.array([max(first.start, other.start) for other in others])
        one = _at(motion, [first] * len(others), latest)
        two = _at(motion, others, latest)
        near = quadratic(one.x - two.x, one.P + two.P)[0] < NEAREST_HYPOTHESES
        for j in np.flatnonzero(near)[: max(10 - found, 0)].tolist():
            found += 1
            yield Finding(
                f"hypothesis.{i + 1 + j}",
                f"is nearly the same as hypothesis.{i}: one target confirms both, and they are two tracks of it. "
                "Leave one out, or move them apart by more than their sigma.",
            )


def _at(motion: Motion, hypotheses: tuple[HypothesisConfig, ...] | list[HypothesisConfig], times_s: Array) -> Gaussian:
    """Densities of hypotheses at times, or at their starts where these are later, shapes (K, n), (K, n, n)."""
    x = np.array([hypothesis.state for hypothesis in hypotheses], dtype=np.float64)
    variances = np.square([hypothesis.sigma for hypothesis in hypotheses])
    dt = np.maximum(times_s - [hypothesis.start for hypothesis in hypotheses], 0.0)
    density = Gaussian(x, variances[:, :, None] * np.eye(x.shape[1]))
    return predict(density, motion.transition(dt), motion.noise(dt))


def hypotheses_at(scenario: Scenario, times_s: Array) -> Gaussian:
    """Densities of all hypotheses, each at its time [s], or at its start where that is later; shape (K,) to (K, n)."""
    return _at(scenario.motion.build(), list(scenario.hypotheses), times_s)


def _unseen(scenario: Scenario, scans: Sequence[Scan]) -> Iterator[Finding]:
    """Hypotheses that no sensor can see, and sensors that can see none of them."""
    if not scenario.hypotheses:
        return
    seen = np.array([_sees(scenario, sensor, scans) for sensor in scenario.sensors])
    for i in np.flatnonzero(~seen.any(axis=0))[:10].tolist():
        where = scenario.hypotheses[i].state[: scenario.motion.dimensions]
        yield Finding(
            f"hypothesis.{i}",
            f"lies outside all fields of view, from its start at {where} on: there will be no evidence for or "
            "against it, and it stays tentative. Check its state (east, north), and fields of view.",
        )
    if scenario.initiation is None:
        for i in np.flatnonzero(~seen.any(axis=1)).tolist():
            yield Finding(
                f"sensor {scenario.sensors[i].name}: field_of_view",
                "contains none of the hypotheses at any time, and no other tracks start (there is no [initiation]): "
                "the sensor tells nothing. Check position, center and size of its field of view.",
            )


def _sees(scenario: Scenario, config: SensorConfig, scans: Sequence[Scan]) -> BoolArray:
    """Which hypotheses a sensor can see at any time, going straight on from their start, shape (K,)."""
    d, motion = scenario.motion.dimensions, scenario.motion.build()
    sensor = config.build(motion)
    own = [scan for scan in scans if scan.sensor == config.name]
    moments = [own[i] for i in np.unique(np.linspace(0, len(own) - 1, _POINTS).astype(int))] if own else []
    poses = [(scenario.to_seconds(scan.time_ns), scan.pose) for scan in moments]
    if not poses:
        length = scenario.simulation.duration if scenario.simulation else 60.0
        poses = [(float(t), config.pose(d)) for t in np.linspace(0.0, length, _POINTS)]
    seen = np.zeros(len(scenario.hypotheses), np.bool_)
    for time_s, pose in poses:
        left = np.flatnonzero(~seen)
        if not len(left):
            break
        at = _at(motion, [scenario.hypotheses[i] for i in left], np.full(len(left), time_s))
        position = Gaussian(at.x[:, :d], at.P[:, :d, :d])
        view, center = sensor.at(pose).field_of_view, config.view_center(pose.position)
        seen[left] = view.probability_inside(position, center) > _UNSEEN
    return seen
