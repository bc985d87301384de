"""Where the scans of a sensor come from: a simulated world or recorded plots."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from waldnet.common.config import Scenario
from waldnet.common.errors import ConfigError
from waldnet.common.messages import NEVER, Scan
from waldnet.common.quantities import NS_PER_S
from waldnet.scenarios.plots import in_order, read_plots
from waldnet.scenarios.world import scan_times_ns, simulate, simulate_all
from waldnet.sensor_node.state import Schedule


class Source(NamedTuple):
    """What one sensor sees, and when all of them look.

    Attributes:
        scans: of the sensor, by time.
        schedule: of the whole network.
    """

    scans: list[Scan]
    schedule: Schedule


def recording_of(scenario: Scenario, plots: Path | None) -> Path | None:
    """The recording to use: the one given, else the scenario's, else none: the world is simulated.

    Raises:
        ConfigError: when there is nothing to see.
    """
    if plots is None and scenario.recording is not None:
        return scenario.recording.plots
    if plots is None and scenario.simulation is None:
        raise ConfigError(f"{scenario.name}: has neither [recording] nor [simulation], and no plots were given")
    return plots


def seed_of(scenario: Scenario, seed: int | None) -> int:
    """The seed given, else the scenario's."""
    return seed if seed is not None else scenario.simulation.seed if scenario.simulation else 0


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
    recording = recording_of(scenario, plots)
    scans = simulate_all(scenario, seed_of(scenario, seed)) if recording is None else read_plots(recording, scenario)
    return spaced(scans, scenario)


def source(scenario: Scenario, name: str, *, plots: Path | None = None, seed: int | None = None) -> Source:
    """What the named sensor sees; arguments and errors as for ``all_scans``."""
    recording = recording_of(scenario, plots)
    if recording is None:
        spacing = Spacing.of(scenario)
        times = [
            (int(t_ns), number)
            for number, sensor in enumerate(scenario.sensors)
            for t_ns in scan_times_ns(scenario, sensor).tolist()
            if spacing.keeps(sensor.name, t_ns)
        ]
        scans = spaced(simulate(scenario, name, seed_of(scenario, seed)), scenario)
        return Source(scans, _schedule(sorted(times)))
    scans = spaced(read_plots(recording, scenario), scenario)
    return Source([scan for scan in scans if scan.sensor == name], schedule_of(scans, scenario))


class Spacing:
    """Leaves out scans that come sooner after the last one of their sensor than its ``spacing``."""

    def __init__(self, spacings_s: Mapping[str, float]) -> None:
        """From the spacing of every sensor [s]."""
        self._spacings_s = spacings_s
        self._last_ns: dict[str, int] = {}

    @classmethod
    def of(cls, scenario: Scenario) -> Spacing:
        """For the sensors of a scenario."""
        return cls({sensor.name: sensor.spacing for sensor in scenario.sensors})

    def keeps(self, sensor: str, time_ns: int) -> bool:
        """Whether the next scan of a sensor stays; one that is older than the last is not for this to judge."""
        last_ns = self._last_ns.get(sensor, -NEVER)
        if last_ns < time_ns < last_ns + round(self._spacings_s.get(sensor, 0.0) * NS_PER_S):
            return False
        self._last_ns[sensor] = time_ns
        return True


def spaced(scans: Iterable[Scan], scenario: Scenario) -> list[Scan]:
    """Without the scans that come sooner after the last one of their sensor than its ``spacing``.

    Args:
        scans: those of each sensor by time.
        scenario: says the spacings.
    """
    spacing = Spacing.of(scenario)
    return [scan for scan in scans if spacing.keeps(scan.sensor, scan.time_ns)]


def schedule_of(scans: Iterable[Scan], scenario: Scenario) -> Schedule:
    """Who scans when, in recorded scans."""
    ordered = in_order(scans, scenario)
    return _schedule((scan.time_ns, scenario.sensor_names.index(scan.sensor)) for scan in ordered)


def _schedule(times: Iterable[tuple[int, int]]) -> Schedule:
    groups: dict[int, list[int]] = {}
    for t_ns, number in times:
        groups.setdefault(t_ns, []).append(number)
    return Schedule(list(groups), [tuple(numbers) for numbers in groups.values()])
