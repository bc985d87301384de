"""What a distributed network is compared with: all plots at one place, or every sensor for itself (theory.md §4)."""

from __future__ import annotations

from typing import Any

import numpy as np

from waldnet.common.codec import encode
from waldnet.common.config import Scenario
from waldnet.common.estimation.association import Plots
from waldnet.common.estimation.gaussian import Array, Gaussian, log_sum_exp, moments
from waldnet.common.estimation.mixture import Mixture
from waldnet.common.local_filter import HONEST, LocalFilter
from waldnet.common.messages import Decision, Scan
from waldnet.common.quantities import NS_PER_S
from waldnet.studies.course import Course, Look, Worlds
from waldnet.studies.worlds import studied


def with_fusion(scenario: Scenario, **fusion: Any) -> Scenario:
    """The scenario, deciding nothing, with other keys of ``[fusion]``; mode, filter and feedback are the mode's."""
    table = scenario.fusion.model_dump() | {"mode": "federated", "filter": None, "terms": 1, "feedback": "none"}
    return scenario.model_copy(
        update={
            "fusion": type(scenario.fusion).model_validate(table | {"association": "tight"} | fusion),
            "decision": scenario.decision.model_copy(update={"enabled": False}),
        }
    )


class _Solo:
    """One filter of all runs with the whole prior and noise, and its own LR."""

    def __init__(self, scenario: Scenario, runs: int, **fusion: Any) -> None:
        scenario = with_fusion(scenario, association="factor", **fusion)
        hypothesis = scenario.hypotheses[studied(scenario)]
        motion = scenario.motion.build()
        self._filter = LocalFilter.of(scenario, HONEST)
        self._sensors = [(config, config.build(motion)) for config in scenario.sensors]
        self._now_ns = scenario.to_ns(hypothesis.start)
        prior = Gaussian(*(np.repeat(part[None], runs, axis=0) for part in hypothesis.density))
        self.mixture: Mixture = self._filter.start(prior)

    def look(self, look: Look) -> None:
        """Filter a scan."""
        config, sensor = self._sensors[look.sensor]
        self.predict(look.time_ns)
        sensor, stand = sensor.at(look.pose), look.pose.position
        center = config.view_center(stand)
        expected = self._filter.expect(self.mixture.density, sensor, stand, center)
        near = self._filter.near(expected, own(look.plots), sensor, stand)
        self.mixture = self._filter.update(self.mixture, expected, near, sensor, stand)

    def predict(self, time_ns: int) -> None:
        """Go on to a time."""
        if time_ns > self._now_ns:
            self.mixture = self._filter.predict(self.mixture, np.array((time_ns - self._now_ns) / NS_PER_S))
            self._now_ns = time_ns

    @property
    def log_lr(self) -> Array:
        """Evidence so far, shape (R,)."""
        return log_sum_exp(self.mixture.log_g)

    @property
    def density(self) -> Gaussian:
        """The track, shapes (R, n), (R, n, n)."""
        log_w, _, (x, P) = self.mixture
        return moments(np.exp(log_w), Gaussian(x[0], P[0]))


def centralised(scenario: Scenario, worlds: Worlds, **fusion: Any) -> Course:
    """All plots come to the center, which filters them sensor after sensor: the upper reference."""
    solo, course = _Solo(scenario, len(worlds.seeds), **fusion), _Recorder()
    for look, last in _ending(worlds.looks):
        solo.look(look)
        if last:
            course.note(solo.log_lr, solo.density)
    plots = np.mean([_bytes(look) for look in worlds.looks]) / max(len(scenario.hypotheses), 1)
    return course.course(float(plots))


def decentralised_mean(scenario: Scenario, worlds: Worlds) -> Course:
    """Every sensor has its own track and LR; the center takes the mean of the log LR, and of the tracks."""
    return _decentralised(scenario, worlds)._replace(local_log_lr=None)


def decentralised_decisions(scenario: Scenario, worlds: Worlds) -> Course:
    """Every sensor decides for itself and sends its decision only; what they add up to depends on the thresholds."""
    course = _decentralised(scenario, worlds)
    decision = Decision(kind="confirmed", track=0, time_ns=0, log_lr=0.0, log_lr_total=0.0, scans=1)
    scans_ns = np.unique([look.time_ns for look in worlds.looks if look.sensor == 0])
    return course._replace(uplink_bytes=len(encode(decision)) / len(scans_ns))


def _decentralised(scenario: Scenario, worlds: Worlds) -> Course:
    runs = len(worlds.seeds)
    solos = [_Solo(scenario, runs, filter="pdaf") for _ in scenario.sensors]
    course, local = _Recorder(), []
    for look, last in _ending(worlds.looks):
        solos[look.sensor].look(look)
        if last:
            for solo in solos:
                solo.predict(look.time_ns)
            log_lr = np.stack([solo.log_lr for solo in solos], axis=-1)
            x = np.mean([solo.density.x for solo in solos], axis=0)
            # What all sensors share, the prior and the process noise, does not average out.
            P = np.mean([solo.density.P for solo in solos], axis=0)
            course.note(log_lr.mean(axis=-1), Gaussian(x, P))
            local.append(log_lr)
    return course.course(8.0)._replace(local_log_lr=np.stack(local, axis=1))


class _Recorder:
    """Collects a course, measurement time by measurement time."""

    def __init__(self) -> None:
        self._log_lr: list[Array] = []
        self._densities: list[Gaussian] = []

    def note(self, log_lr: Array, density: Gaussian) -> None:
        """The next measurement time."""
        self._log_lr.append(log_lr)
        self._densities.append(density)

    def course(self, uplink_bytes: float) -> Course:
        """All that was noted."""
        x, P = (np.stack(parts, axis=1) for parts in zip(*self._densities, strict=True))
        return Course(np.stack(self._log_lr, axis=1), x, P, uplink_bytes, downlink_bytes=0.0)


def own(plots: Plots) -> Plots:
    """Plots of every run as those of every track."""
    return Plots(plots.z[:, None], None if plots.valid is None else plots.valid[:, None])


def _ending(looks: tuple[Look, ...]) -> list[tuple[Look, bool]]:
    """All scans, and whether each is the last of its time."""
    later = [*(look.time_ns for look in looks[1:]), None]
    return [(look, time_ns != look.time_ns) for look, time_ns in zip(looks, later, strict=True)]


def _bytes(look: Look) -> float:
    """Mean size of a scan's message."""
    most, m = look.plots.z.shape[1:]
    empty, full = (len(encode(Scan("", look.time_ns, look.pose.position, np.zeros((count, m))))) for count in (0, most))
    return float(empty + (full - empty) * look.counts.mean() / max(most, 1))
