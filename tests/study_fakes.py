"""Worlds and courses that nobody simulated, for what a study does around them."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.messages import IntArray
from waldnet.studies.course import Course, Worlds

#: Name: share of the evidence that a mode gets, error [m], bytes up and down.
MODES: dict[str, tuple[float, float, float, float]] = {
    "centralised": (1.0, 30.0, 90.0, 0.0),
    "centralised-mht": (1.02, 29.0, 90.0, 0.0),
    "naive": (1.15, 45.0, 132.0, 0.0),
    "dkf": (0.95, 40.0, 132.0, 0.0),
    "federated": (0.75, 48.0, 132.0, 0.0),
    "federated-tight": (0.85, 38.0, 132.0, 0.0),
    "federated-mirrored-1": (0.88, 36.0, 132.0, 0.0),
    "federated-mirrored-3": (0.93, 33.0, 372.0, 0.0),
    "federated-mirrored-8": (0.96, 32.0, 972.0, 0.0),
    "federated-tight-advice": (0.97, 31.0, 132.0, 124.0),
    "federated-reset": (0.9, 34.0, 132.0, 124.0),
    "federated-tight-reset": (0.98, 33.0, 132.0, 124.0),
    "decentralised-mean": (0.3, 60.0, 8.0, 0.0),
    "decentralised-decisions": (0.25, 60.0, 0.4, 0.0),
}


def draw(scenario: Scenario, seeds: IntArray) -> Worlds:
    """Truth and no plots, 30 scans at 2 s."""
    times_ns = np.array([scenario.to_ns(2.0 * k) for k in range(1, 31)])
    truth = np.zeros((len(seeds), len(times_ns), 4))
    return Worlds(seeds, times_ns, truth if scenario.targets else np.full_like(truth, np.nan), ())


def play(scenario: Scenario, mode: str, worlds: Worlds) -> Course:
    """A random walk of each run; modes differ in drift, error and bytes."""
    evidence, error_m, up, down = MODES[mode]
    p_d = scenario.sensors[0].p_d
    runs, scans = worlds.truth.shape[:2]
    local = np.empty((runs, scans, 4))
    x = np.empty(worlds.truth.shape)
    for row, seed in enumerate(worlds.seeds):
        rng = np.random.default_rng([int(seed), zlib.crc32(mode.encode())])
        drift = 2.0 * p_d * evidence if scenario.targets else -0.3 * (0.3 + p_d)
        local[row] = np.cumsum(rng.normal(drift, 1.5 * p_d + 0.2, (scans, 4)), axis=0)
        off = 2000.0 if rng.random() < 0.03 / evidence else 0.0
        x[row] = np.nan_to_num(worlds.truth[row]) + rng.normal(off, error_m, (scans, 4))
    P = np.broadcast_to(error_m**2 * np.eye(4), (runs, scans, 4, 4))
    decides = mode == "decentralised-decisions"
    return Course(local.sum(axis=-1), x, P, up, down, local if decides else None)


def take_over(monkeypatch: Any) -> None:
    """Let studies of this process play these modes."""
    monkeypatch.setattr("waldnet.studies.modes.MODES", MODES)
    monkeypatch.setattr("waldnet.studies.modes.play", play)
    monkeypatch.setattr("waldnet.studies.worlds.draw", draw)
