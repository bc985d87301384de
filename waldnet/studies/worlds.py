"""Simulated worlds, many at once: of every run the very plots that ``waldnet simulate`` writes for its seed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.association import Plots
from waldnet.common.messages import IntArray, Scan
from waldnet.scenarios.world import simulate_all, truth
from waldnet.studies.course import Look, Worlds


def draw(scenario: Scenario, seeds: IntArray) -> Worlds:
    """Simulate one world for every seed.

    The studied track is the one of the hypothesis that the first target is drawn from, else the first hypothesis.

    Args:
        scenario: the network and its world.
        seeds: shape (R,).

    Returns:
        truth and plots after the start of the track.

    Raises:
        ConfigError: when there is nothing to simulate or no hypothesis.
    """
    start_ns = scenario.to_ns(scenario.hypotheses[studied(scenario)].start)
    scans = [[scan for scan in simulate_all(scenario, int(seed)) if scan.time_ns > start_ns] for seed in seeds]
    looks = tuple(_look(scenario, alike) for alike in zip(*scans, strict=True))
    times_ns = np.array(sorted({look.time_ns for look in looks}), np.int64)
    return Worlds(seeds, times_ns, _truth(scenario, seeds, times_ns), looks)


def studied(scenario: Scenario) -> int:
    """Number of the hypothesis whose track is studied.

    Raises:
        ConfigError: when there is none.
    """
    if not scenario.hypotheses:
        raise ConfigError(f"{scenario.name}: has no [[hypothesis]]; a study needs one: the track that is decided on")
    drawn = [target.hypothesis for target in scenario.targets if target.hypothesis is not None]
    return drawn[0] if drawn else 0


def _truth(
    scenario: Scenario, seeds: IntArray, times_ns: IntArray
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    hypothesis = studied(scenario)
    mine = next((i for i, target in enumerate(scenario.targets) if target.hypothesis == hypothesis), 0)
    states = np.full((len(seeds), len(times_ns), scenario.motion.build().n), np.nan)
    if scenario.targets:
        for run, seed in enumerate(seeds):
            world = truth(scenario, int(seed))
            states[run] = world.x[mine, np.searchsorted(world.times_ns, times_ns)]
    return states


def _look(scenario: Scenario, scans: Sequence[Scan]) -> Look:
    """The scans that all worlds have of one sensor at one time."""
    counts = np.array([len(scan.z) for scan in scans])
    z = np.zeros((len(scans), int(counts.max()), scans[0].z.shape[-1]))
    for row, scan in zip(z, scans, strict=True):
        row[: len(scan.z)] = scan.z
    valid = np.arange(z.shape[1]) < counts[:, None]
    number = scenario.sensor_names.index(scans[0].sensor)
    return Look(scans[0].time_ns, number, scans[0].pose, Plots(z, valid), counts)
