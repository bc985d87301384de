"""Whether the velocities that a recording tells of its sensors are those with which their positions move."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import Scan
from waldnet.common.quantities import NS_PER_S
from waldnet.scenarios.scenario_check import Finding

#: Way and velocity are compared over so long, so that noise of positions does not count [s].
_SPAN_S = 5.0
#: They may differ by this share of the speed, by so many sigma of a range rate, and by this [m/s].
_SHARE, _SIGMAS, _LEAST = 0.25, 3.0, 0.5
#: What a velocity is taken for by mistake.
_READINGS: dict[str, Callable[[Array], Array]] = {
    "km/h": lambda v: v / 3.6,
    "knots": lambda v: v * (1852.0 / 3600.0),
    "north before east": lambda v: np.concatenate([v[:, 1::-1], v[:, 2:]], axis=1),
    "of the ground relative to the sensor": lambda v: -v,
}


def pose_findings(scenario: Scenario, scans: Sequence[Scan]) -> Iterator[Finding]:
    """Velocities of sensors that measure range rates, and that do not fit how their positions move.

    Args:
        scenario: the scenario.
        scans: recorded, by time.
    """
    for config in scenario.sensors:
        own = [scan for scan in scans if scan.sensor == config.name and len(scan.velocity)]
        # Zeros say that range rates are over ground, however the sensor moves.
        if config.kind == "polar-doppler" and len(own) > 1 and any(scan.velocity.any() for scan in own):
            yield from _finding(config, own)


def _finding(config: SensorConfig, scans: Sequence[Scan]) -> Iterator[Finding]:
    times_s = np.array([scan.time_ns - scans[0].time_ns for scan in scans]) / NS_PER_S
    velocities = np.array([scan.velocity for scan in scans])
    ends = _ends(times_s)
    moved = np.diff(np.array([scan.position for scan in scans])[ends], axis=0) / np.diff(times_s[ends])[:, None]
    speed, told = (float(np.median(np.linalg.vector_norm(v, axis=-1))) for v in (moved, velocities))
    error = _error(moved, velocities, times_s, ends)
    if error <= max(_SHARE * max(speed, told), _SIGMAS * config.sigma[-1], _LEAST):
        return
    errors = {name: _error(moved, read(velocities), times_s, ends) for name, read in _READINGS.items()}
    best = min(errors, key=errors.__getitem__)
    as_what = f" Read as {best} it would fit." if errors[best] < 0.2 * error else ""
    yield Finding(
        f"sensor {config.name}",
        f"its positions move with {speed:.3g} m/s, its velocity says {told:.3g} m/s, and the two differ by {error:.3g} "
        f"m/s (medians).{as_what} Range rates are read with the velocity: expected are m/s over ground, east before "
        "north.",
    )


def _ends(times_s: Array) -> Array:
    """Scans between which is enough time, as far as there are such; else the first and the last."""
    ends = [0]
    for k, time_s in enumerate(times_s.tolist()):
        if time_s >= times_s[ends[-1]] + _SPAN_S:
            ends.append(k)
    return np.array(ends if len(ends) > 1 else [0, len(times_s) - 1])


def _error(moved: Array, velocities: Array, times_s: Array, ends: Array) -> float:
    """Median difference of mean velocities between the ends, as positions and as velocities have them [m/s]."""
    between = 0.5 * (velocities[1:] + velocities[:-1]) * np.diff(times_s)[:, None]
    way = np.concatenate([np.zeros((1, velocities.shape[1])), np.cumsum(between, axis=0)])
    told = np.diff(way[ends], axis=0) / np.diff(times_s[ends])[:, None]
    return float(np.median(np.linalg.vector_norm(moved - told, axis=-1)))
