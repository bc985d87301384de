"""How many false tracks a scenario confirms in a day, at most: those that false plots start, times Ville's bound.

Nothing is claimed here of false plots that are denser in places, nor of those that real targets' tracks let start.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.estimation.association import gate_threshold
from waldnet.common.estimation.gaussian import Array, Gaussian, times_transposed
from waldnet.common.estimation.initiation import from_plots
from waldnet.common.estimation.motion import predict
from waldnet.common.estimation.sensing import Sensor

_DAY_S = 86_400.0
#: So many false plots are drawn to average over their places.
_DRAWN = 200


class FalseTracks(NamedTuple):
    """What false plots can do in a day.

    Attributes:
        started: tracks that they start, at most.
        confirmed: tracks of these that are ever confirmed, at most: ``started p0 / p1``.
        p0_for_one: the p0 with which one a day is confirmed, at most; None: with any, since fewer start.
    """

    started: float
    confirmed: float
    p0_for_one: float | None


def false_tracks(scenario: Scenario, intervals_s: Mapping[str, float] | None = None) -> FalseTracks | None:
    """Upper bounds for a day; None where no tracks start by themselves, or nothing is decided.

    Args:
        scenario: whose false plots are as it says.
        intervals_s: time between the scans that are used, by sensor; default: as the scenario says.
    """
    if scenario.initiation is None or not scenario.decision.enabled:
        return None
    given = intervals_s or {}
    every = {sensor.name: given.get(sensor.name) or _interval(sensor) for sensor in scenario.sensors}
    started = sum(
        _started_per_scan(scenario, sensor, every) * _DAY_S / every[sensor.name] for sensor in _placed(scenario)
    )
    p0, p1 = scenario.decision.p0, scenario.decision.p1
    return FalseTracks(started, started * p0 / p1, p1 / started if started > p1 else None)


def _placed(scenario: Scenario) -> Iterator[SensorConfig]:
    """Sensors whose plots can start tracks: a bearing tells of no place."""
    return (sensor for sensor in scenario.sensors if sensor.locates)


def _interval(sensor: SensorConfig) -> float:
    """Time between the scans that are used [s]."""
    return sensor.scan_interval * float(max(np.ceil(sensor.spacing / sensor.scan_interval - 1e-9), 1.0))


def _started_per_scan(scenario: Scenario, later: SensorConfig, every: Mapping[str, float]) -> float:
    """Tracks that the false plots of one scan start, at most: each one, or none without an earlier plot that fits."""
    assert scenario.initiation is not None
    if scenario.initiation.plots == 1:
        return later.false_plots
    pairs = sum(_pairs(scenario, earlier, later, every) for earlier in _placed(scenario))
    return later.false_plots * float(-np.expm1(-pairs / later.false_plots))


def _pairs(scenario: Scenario, earlier: SensorConfig, later: SensorConfig, every: Mapping[str, float]) -> float:
    """Mean number of pairs of a false plot of a scan, and an earlier one of a sensor in whose gate it lies.

    A false plot of density rho lies in the gate of an earlier one with probability rho V, V the volume of the gate:
    ``V = pi^(m/2) / Gamma(m/2 + 1) gamma^(m/2) sqrt(det S)``, S the innovation covariance after the time between them.
    """
    assert scenario.initiation is not None
    config, motion = scenario.initiation, scenario.motion.build()
    dt = _times_between(earlier, later, every, config.within)
    if not len(dt):
        return 0.0
    rng, d = np.random.default_rng(0), motion.dimensions
    one, two = (_at_rest(scenario, sensor) for sensor in (earlier, later))
    stand = earlier.stand(d)
    places = one.field_of_view.draw(rng, _DRAWN, earlier.view_center(stand))
    z = one.measurement.draw_false(rng, places, stand)
    start = from_plots(z, one.measurement, stand, config.spread(motion.n, d))
    total = 0.0
    for seconds in dt:
        after = np.full(_DRAWN, seconds)
        predicted = predict(start, motion.transition(after), motion.noise(after))
        total += _in_gate(predicted, two, later, d, config.gate)
    return earlier.false_plots * total


def _at_rest(scenario: Scenario, config: SensorConfig) -> Sensor:
    """The model of a sensor as the scenario places it."""
    return config.build(scenario.motion.build()).at(config.pose(scenario.motion.dimensions))


def _times_between(earlier: SensorConfig, later: SensorConfig, every: Mapping[str, float], within: float) -> Array:
    """Times from the scans of one sensor to a later one of another [s]; of unlike intervals the middle counts."""
    interval = every[earlier.name]
    first, last = (config.first_scan or every[config.name] for config in (earlier, later))
    offset = (last - first) % interval if interval == every[later.name] else 0.5 * interval
    offset = offset if 1e-9 < offset < interval - 1e-9 else interval
    return np.arange(offset, within + 1e-9, interval)


def _in_gate(at: Gaussian, sensor: Sensor, config: SensorConfig, d: int, gate: float) -> float:
    """Mean number of false plots of one scan in the gates around predicted states."""
    stand = config.stand(d)
    seen, m = sensor.measurement.linearise(at, stand), sensor.measurement.m
    S = seen.H @ times_transposed(at.P, seen.H) + seen.R
    log_volume = 0.5 * m * np.log(np.pi * gate_threshold(gate, m)) - gammaln(0.5 * m + 1.0)
    relative = sensor.log_relative(seen.z, stand)
    log_rho = sensor.log_rho_f + (np.zeros(len(at.x)) if relative is None else relative)
    inside = sensor.field_of_view.probability_inside(Gaussian(at.x[:, :d], at.P[:, :d, :d]), config.view_center(stand))
    numbers: Array = np.exp(log_rho + log_volume + 0.5 * np.linalg.slogdet(S)[1]) * inside
    return float(np.minimum(numbers, config.false_plots).mean())
