"""Where the scans of a sensor come from: a simulated world or recorded plots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from common.config import Scenario
from common.errors import ConfigError
from common.messages import Scan
from scenarios.plots import of_sensor, read_plots
from scenarios.world import simulate_all
from sensor_node.tracker import Schedule


def all_scans(scenario: Scenario, *, plots: Path | None = None, seed: int | None = None) -> list[Scan]:
    """All scans of a network, by time: recorded if there is a recording, else simulated.

    Args:
        scenario: the network.
        plots: a recording to use instead of the scenario's.
        seed: of the simulated world, instead of the scenario's.

    Raises:
        ConfigError: when there is nothing to see.
        PlotsError: when the recording is wrong.
    """
    if plots is None and scenario.recording is not None:
        plots = scenario.recording.plots
    if plots is not None:
        return read_plots(plots, scenario)
    if scenario.simulation is None:
        raise ConfigError(f"{scenario.name}: has neither [recording] nor [simulation], and no plots were given")
    return simulate_all(scenario, scenario.simulation.seed if seed is None else seed)


def schedule_of(scans: Sequence[Scan], scenario: Scenario) -> Schedule:
    """Who scans when, in scans ordered by time."""
    times: dict[int, list[int]] = {}
    for scan in scans:
        times.setdefault(scan.time_ns, []).append(scenario.sensor_names.index(scan.sensor))
    return Schedule(list(times), [tuple(numbers) for numbers in times.values()])


__all__ = ["all_scans", "of_sensor", "schedule_of"]
