"""Many simulated worlds, one after the other: stands in until plots are drawn for all at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from common.config import Scenario
from common.estimation.association import Plots
from common.messages import IntArray, Scan
from scenarios.world import simulate_all, truth
from studies.course import Look, Worlds


def draw(scenario: Scenario, seeds: IntArray) -> Worlds:
    """The worlds of these seeds; the track starts with hypothesis 0, its target is the first."""
    seeds = np.asarray(seeds, np.int64)
    worlds = [truth(scenario, int(seed)) for seed in seeds]
    scans = [simulate_all(scenario, int(seed)) for seed in seeds]
    times_ns = worlds[0].times_ns
    n = scenario.motion.build().n
    x = np.array([world.x[0] if len(world.x) else np.full((len(times_ns), n), np.nan) for world in worlds])
    looks = tuple(_look(scenario, same) for same in zip(*scans, strict=True))
    return Worlds(seeds, times_ns, x, looks)


def _look(scenario: Scenario, scans: Sequence[Scan]) -> Look:
    counts = np.array([len(scan.z) for scan in scans])
    z = np.zeros((len(scans), max(1, counts.max()), scans[0].z.shape[1]))
    for row, scan in enumerate(scans):
        z[row, : len(scan.z)] = scan.z
    valid = np.arange(z.shape[1]) < counts[:, None]
    number = scenario.sensor_names.index(scans[0].sensor)
    return Look(scans[0].time_ns, number, scans[0].position, Plots(z, valid), counts)
