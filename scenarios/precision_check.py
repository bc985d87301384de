"""Whether single precision holds the positions and plots of a network (``fusion.precision = "float32"``)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.messages import Scan
from waldnet.common.sensor_config import BoxConfig, DiscConfig, EverywhereConfig, SectorConfig

#: A step between two numbers of single precision is at most this part of a standard deviation: then log LR stays within
#: 0.1 of that of double precision for hundreds of scans.
_STEPS = 32.0


def precision_faults(scenario: Scenario, scans: Sequence[Scan] = ()) -> Iterator[str]:
    """What single precision cannot hold, in words; nothing where reports are in double precision.

    Args:
        scenario: the scenario.
        scans: recorded scans, if there are any: they say where sensors stood.
    """
    if scenario.fusion.precision != "float32":
        return
    extent = _extent(scenario, scans)
    for sensor in scenario.sensors:
        if sensor.locates and (step := _step(extent)) * _STEPS > (sigma := _sharpest(sensor)):
            yield (
                f"single precision keeps positions of this network, which is {extent:.3g} m across, to {step:.2g} m, "
                f"and sensor {sensor.name} measures them to {sigma:g} m"
            )
        yield from _plot_faults(scenario, sensor)


def _plot_faults(scenario: Scenario, sensor: SensorConfig) -> Iterator[str]:
    """Numbers of plots that are sent as they are."""
    if sensor.kind == "position" or not (scenario.fusion.mode == "selected" or scenario.initiation is not None):
        return
    largest = {"range": _reach(sensor, scenario.motion.dimensions), "range rate": sensor.max_speed or 0.0}
    for name, sigma in zip(sensor.numbers, sensor.sigma, strict=True):
        value = largest.get(name, 2.0 * np.pi)
        if _step(value) * _STEPS > sigma:
            yield (
                f"single precision keeps the {name} of a plot, up to {value:.3g}, to {_step(value):.2g}, and sensor "
                f"{sensor.name} measures it to {sigma:g}"
            )


def _step(value: float) -> float:
    """Distance of a number to the next one of single precision."""
    return float(np.spacing(np.float32(value)))


def _sharpest(sensor: SensorConfig) -> float:
    """Smallest standard deviation of a position that a plot tells [m]."""
    return min(sensor.sigma) if sensor.kind == "position" else sensor.sigma[0]


def _extent(scenario: Scenario, scans: Sequence[Scan]) -> float:
    """How far two positions of the network lie apart along an axis at most [m]."""
    d = scenario.motion.dimensions
    low, high = [], []
    for sensor in scenario.sensors:
        own = [scan.position for scan in scans if scan.sensor == sensor.name] or [sensor.stand(d)]
        centers = np.array([sensor.view_center(stand) for stand in own])
        reach = _reach(sensor, d)
        low.append(centers.min(axis=0) - reach)
        high.append(centers.max(axis=0) + reach)
    for hypothesis in scenario.hypotheses:
        low.append(np.array(hypothesis.state[:d]))
        high.append(np.array(hypothesis.state[:d]))
    return float((np.max(high, axis=0) - np.min(low, axis=0)).max())


def _reach(sensor: SensorConfig, dimensions: int) -> float:
    """How far a field of view reaches from its center [m]; 0 for a bearing sensor that sees everywhere."""
    match sensor.field_of_view:
        case BoxConfig(size=size):
            return 0.5 * max(size)
        case DiscConfig(radius=radius) | SectorConfig(radius=radius):
            return radius
        case EverywhereConfig(area=area):
            return 0.0 if area is None else 0.5 * area ** (1.0 / dimensions)
