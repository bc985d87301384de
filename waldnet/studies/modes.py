"""The modes of a study: how a network, or one of the baselines, decides on the worlds of many runs at once.

Every run is a track with plots of its own, so the node's tracker and the center are the very ones of a live network.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from waldnet.common.codec import encode
from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.messages import NEVER, Advice, Rebase
from waldnet.fusion_center.center import Center
from waldnet.offline.loopback import Loopback
from waldnet.sensor_node.state import Look as NodeLook
from waldnet.sensor_node.state import Schedule
from waldnet.sensor_node.tracker import LocalTracker
from waldnet.studies.baselines import centralised, decentralised_decisions, decentralised_mean, own, with_fusion
from waldnet.studies.course import Course, Look, Worlds
from waldnet.studies.worlds import studied

Play = Callable[[Scenario, Worlds], Course]


def play(scenario: Scenario, mode: str, worlds: Worlds) -> Course:
    """What a mode makes of simulated worlds.

    Args:
        scenario: the network.
        mode: one of ``MODES``.
        worlds: truth and plots of all runs.

    Returns:
        log LR and fused track of every run after every measurement time; nothing is decided.
    """
    return MODES[mode](scenario, worlds)


def distributed(scenario: Scenario, worlds: Worlds, **fusion: Any) -> Course:
    """A network of nodes and a center, in order of measurement time."""
    scenario = with_fusion(scenario, **fusion)
    runs, hypothesis = len(worlds.seeds), scenario.hypotheses[studied(scenario)]
    center = Center.of(scenario)
    prior = Gaussian(*(np.repeat(part[None], runs, axis=0) for part in hypothesis.density))
    starts_ns = np.full(runs, scenario.to_ns(hypothesis.start))
    fuser = center.fuser
    center = replace(center, hypotheses=fuser.begin(fuser.empty(), np.arange(runs), starts_ns, prior))
    network = _Network(scenario, center, worlds)
    return network.run()


class _Network:
    """Nodes and center, and the bytes that go between them."""

    def __init__(self, scenario: Scenario, center: Center, worlds: Worlds) -> None:
        schedule = _schedule(worlds.looks)
        trackers = [LocalTracker.of(scenario, name, schedule) for name in scenario.sensor_names]
        self._worlds, self._network = worlds, Loopback(center, trackers)
        self._up = self._down = 0
        for number, name in enumerate(scenario.sensor_names):
            self._network.join(name, self._next_ns(number, -1))

    def run(self) -> Course:
        """All scans."""
        looks, runs = self._worlds.looks, len(self._worlds.seeds)
        x, P, log_lr = [], [], []
        for i, look in enumerate(looks):
            self._work_in(NodeLook(look.time_ns, look.pose, own(look.plots), look.sensor), i)
            if i + 1 == len(looks) or looks[i + 1].time_ns > look.time_ns:
                picture = self._network.state.picture
                log_lr.append(picture.log_lr_total)
                x.append(picture.fused_x)
                P.append(picture.fused_P)
        per_scan = len(looks) * runs
        up, down = self._up / per_scan, self._down / per_scan
        return Course(np.stack(log_lr, 1), np.stack(x, 1), np.stack(P, 1), up, down)

    def _work_in(self, look: NodeLook, at: int) -> None:
        network = self._network
        report = network.report(look, self._next_ns(look.number, at))
        rounding = network.trackers[report.sensor].rounding
        self._up += len(encode(report, rounding=rounding))
        answers = network.deliver(report)
        self._down += sum(len(encode(answer)) for answer in answers if isinstance(answer, Advice | Rebase))

    def _next_ns(self, sensor: int, after: int) -> int:
        return next((look.time_ns for look in self._worlds.looks[after + 1 :] if look.sensor == sensor), NEVER)


def _schedule(looks: tuple[Look, ...]) -> Schedule:
    times = sorted({look.time_ns for look in looks})
    return Schedule(times, [tuple(look.sensor for look in looks if look.time_ns == time) for time in times])


MODES: Mapping[str, Play] = {
    "centralised": partial(centralised, filter="pdaf"),
    "centralised-mht": partial(centralised, filter="mht"),
    "naive": partial(distributed, mode="naive", association="factor"),
    "dkf": partial(distributed, mode="dkf", association="factor"),
    "federated": partial(distributed, association="factor"),
    "federated-tight": partial(distributed),
    "federated-mirrored-1": partial(distributed, association="mirrored"),
    "federated-mirrored-3": partial(distributed, association="mirrored", terms=3),
    "federated-mirrored-8": partial(distributed, association="mirrored", terms=8),
    "federated-tight-advice": partial(distributed, feedback="advice"),
    "federated-reset": partial(distributed, association="factor", feedback="reset"),
    "federated-tight-reset": partial(distributed, feedback="reset"),
    "selected-plots": partial(distributed, mode="selected"),
    "selected-plots-float32": partial(distributed, mode="selected", precision="float32"),
    "decentralised-mean": decentralised_mean,
    "decentralised-decisions": decentralised_decisions,
}
