"""The simulated world: a function of the scenario and its seed.

Every process derives the same truth from the seed, and its own plots from the seed and the sensor's name; so what
``waldnet simulate`` writes is what the processes of ``waldnet run`` see. The truth is drawn at the scan times of the
network, so a sensor with other scan times makes another path of the same seed. Recorded targets are where they were
with any seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from waldnet.common.config import ClutterSourceConfig, Scenario, SensorConfig, TargetConfig
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.gaussian import Array, BoolArray, draw_noise
from waldnet.common.estimation.imm import draw_path
from waldnet.common.estimation.sensing import Sensor
from waldnet.common.messages import IntArray, Scan
from waldnet.common.quantities import NS_PER_S
from waldnet.scenarios.trajectories import read_trajectories


class Truth(NamedTuple):
    """True states.

    Attributes:
        times_ns: all scan times of the network, ascending, shape (K,).
        x: states, recorded targets last, shape (targets, K, n); NaN before a target's start and after its end.
    """

    times_ns: IntArray
    x: Array


def scan_times_ns(scenario: Scenario, sensor: SensorConfig) -> IntArray:
    """Times of a simulated sensor's scans, shape (K,).

    Raises:
        ConfigError: when the scenario describes no simulation.
    """
    if scenario.simulation is None:
        raise ConfigError(f"{scenario.name}: has no [simulation]; give recorded plots, or a duration to simulate")
    first = sensor.scan_interval if sensor.first_scan is None else sensor.first_scan
    # A little slack: the last scan may fall on the end.
    count = int(np.floor((scenario.simulation.duration - first) / sensor.scan_interval + 1e-9)) + 1
    return np.array([scenario.to_ns(first + k * sensor.scan_interval) for k in range(max(count, 0))], np.int64)


def truth(scenario: Scenario, seed: int) -> Truth:
    """True states of all targets at all scan times of the network.

    Raises:
        ConfigError: when the scenario describes no simulation.
        TruthError: when the file of recorded targets is wrong.
    """
    per_sensor = [scan_times_ns(scenario, sensor) for sensor in scenario.sensors]
    times_ns = np.unique(np.concatenate(per_sensor))
    n, recorded = scenario.motion.build().n, read_trajectories(scenario)
    x = np.full((len(scenario.targets) + len(recorded), len(times_ns), n), np.nan)
    for number, target in enumerate(scenario.targets):
        rng = np.random.default_rng([seed, 1, number])
        x[number] = _path(scenario, target, times_ns, rng)
    for number, trajectory in enumerate(recorded, start=len(scenario.targets)):
        x[number] = trajectory.states(times_ns, n)
    return Truth(times_ns, x)


def _path(scenario: Scenario, target: TargetConfig, times_ns: IntArray, rng: np.random.Generator) -> Array:
    motion = scenario.motion.build()
    path = np.full((len(times_ns), motion.n), np.nan)
    state, now_ns = _first_state(scenario, target, rng), scenario.to_ns(target.start)
    there = times_ns >= now_ns
    path[there] = draw_path(motion, state, np.diff(times_ns[there], prepend=now_ns) / NS_PER_S, rng)
    return path


def _first_state(scenario: Scenario, target: TargetConfig, rng: np.random.Generator) -> Array:
    if target.state is not None:
        return np.array(target.state)
    assert target.hypothesis is not None
    density = scenario.hypotheses[target.hypothesis].density
    return rng.multivariate_normal(density.x, density.P)


def simulate(scenario: Scenario, name: str, seed: int, world: Truth | None = None) -> list[Scan]:
    """All scans of one simulated sensor.

    Args:
        scenario: the network and its world.
        name: of the sensor.
        seed: of everything random.
        world: the truth, if it is at hand already.

    Returns:
        the scans, by time.
    """
    world = truth(scenario, seed) if world is None else world
    config = scenario.sensor(name)
    rng = np.random.default_rng([seed, 2, *name.encode()])
    times_ns = scan_times_ns(scenario, config)
    states = world.x[:, np.searchsorted(world.times_ns, times_ns)]
    pose = config.pose(scenario.motion.dimensions)
    sensor, stand = config.build(scenario.motion.build()).at(pose), pose.position
    center = config.view_center(stand)
    states = np.where(_visible(sensor, len(states), times_ns, seed, name)[..., None], states, np.nan)
    sources = [source for source in scenario.clutter_sources if source.sensors is None or name in source.sensors]
    return [
        Scan(name, int(t_ns), stand, _plots(sensor, stand, center, states[:, k], sources, rng), *pose[1:])
        for k, t_ns in enumerate(times_ns)
    ]


def _visible(sensor: Sensor, targets: int, times_ns: IntArray, seed: int, name: str) -> BoolArray:
    """Which targets the sensor has not lost for the moment, shape (targets, K)."""
    if sensor.visibility is None or not len(times_ns):
        return np.ones((targets, len(times_ns)), np.bool_)
    dt = np.diff(times_ns) / NS_PER_S
    rngs = (np.random.default_rng([seed, 3, number, *name.encode()]) for number in range(targets))
    return np.array([sensor.visibility.draw(rng, dt) for rng in rngs]).reshape(targets, -1)


def _plots(
    sensor: Sensor,
    stand: Array,
    center: Array,
    states: Array,
    sources: Sequence[ClutterSourceConfig],
    rng: np.random.Generator,
) -> Array:
    """Plots of one scan: of targets and clutter sources that are detected, and false ones, in random order, (M, m)."""
    measurement = sensor.measurement
    there = states[~np.isnan(states).any(axis=-1)]
    seen = there[sensor.draw_seen(rng, there, stand, center)]
    noise = draw_noise(rng, measurement.R, len(seen))
    places = sensor.field_of_view.draw(rng, int(rng.poisson(sensor.false_plots)), center)
    true = measurement.fold(measurement.observe(seen, stand) + noise)
    false = measurement.draw_false(rng, places, stand)
    if sources:
        false = np.concatenate([false, _of_sources(sensor, stand, center, sources, states.shape[-1], rng)])
    return rng.permutation(np.concatenate([true, false]))


def _of_sources(
    sensor: Sensor,
    stand: Array,
    center: Array,
    sources: Sequence[ClutterSourceConfig],
    n: int,
    rng: np.random.Generator,
) -> Array:
    """Plots of things that stand still, shape (M, m)."""
    still = np.zeros((len(sources), n))
    still[:, : len(stand)] = [source.position for source in sources]
    p_d = np.array([source.p_d for source in sources])
    seen = still[sensor.field_of_view.contains(still[:, : len(stand)], center) & (rng.random(len(p_d)) < p_d)]
    noise = draw_noise(rng, sensor.measurement.R, len(seen))
    return sensor.measurement.fold(sensor.measurement.observe(seen, stand) + noise)


def simulate_all(scenario: Scenario, seed: int) -> list[Scan]:
    """All scans of the network, by time; those of one time in the order of the sensors."""
    world = truth(scenario, seed)
    scans = [scan for name in scenario.sensor_names for scan in simulate(scenario, name, seed, world)]
    return sorted(scans, key=lambda scan: scan.time_ns)
