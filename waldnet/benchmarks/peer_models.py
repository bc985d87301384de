"""What Stone Soup is told of a scenario: its sensors, plots and motion, in Stone Soup's own terms.

A state is (east, its rate, north, its rate). Stone Soup's bearing counts from its first axis towards its second;
with north first and east second that is clockwise from north, as here.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from datetime import datetime, timedelta
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
from stonesoup.functions import gm_reduce_single
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.measurement.nonlinear import Cartesian2DToBearing, CartesianToBearingRange
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.angle import Bearing
from stonesoup.types.array import StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.types.state import GaussianState
from stonesoup.types.update import GaussianStateUpdate
from stonesoup.updater.kalman import ExtendedKalmanUpdater, UnscentedKalmanUpdater

from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.sensing import Sensor
from waldnet.common.messages import Scan
from waldnet.common.quantities import NS_PER_S

#: Where a state has east and north, and their order for angles.
PLACE, NORTH_FIRST = (0, 2), (2, 0)
_NOWHERE = np.full(2, np.nan)
#: A plot this many times farther from a track than its gate reaches is not even looked at.
_FAR = 1.5


class Eye(NamedTuple):
    """A sensor as the peer sees it.

    Attributes:
        config: as the scenario has it.
        model: field of view and density of false plots.
        updater: Stone Soup's, for plots of this sensor.
    """

    config: SensorConfig
    model: Sensor
    updater: Any

    @property
    def locates(self) -> bool:
        """Whether a plot tells where its target is."""
        return self.config.locates


def eyes_of(scenario: Scenario, bearing_sigma: float = 1.0) -> dict[str, Eye]:
    """All sensors, by name.

    Args:
        scenario: the network.
        bearing_sigma: factor on the noise of bearings.

    Raises:
        ConfigError: for what the peer is not built for.
    """
    if scenario.motion.dimensions != 2 or scenario.motion.model != "cv":
        raise ConfigError(f"{scenario.name}: the peer tracks with constant velocity in two dimensions")
    motion = scenario.motion.build()
    sensors = [_noisier(each, bearing_sigma) if each.kind == "bearing" else each for each in scenario.sensors]
    return {sensor.name: _eye(sensor, sensor.build(motion)) for sensor in sensors}


def _noisier(config: SensorConfig, factor: float) -> SensorConfig:
    return config.model_copy(update={"sigma": tuple(factor * sigma for sigma in config.sigma)})


def _eye(config: SensorConfig, model: Sensor) -> Eye:
    if config.kind not in ("position", "polar", "bearing"):
        raise ConfigError(f"{config.name}: the peer knows no plots of kind {config.kind!r}")
    updater = UnscentedKalmanUpdater if config.update == "sigma-point" else ExtendedKalmanUpdater
    return Eye(config, model, updater(None))


def predictor_of(scenario: Scenario) -> Any:
    """The scenario's motion, as Stone Soup's predictor."""
    axis = ConstantVelocity(scenario.motion.psd)
    return KalmanPredictor(CombinedLinearGaussianTransitionModel([axis, axis]))


def start_of(scenario: Scenario) -> Any:
    """What is known of a track beside the plot that starts it: its speed."""
    speed = 5.0 if scenario.initiation is None else scenario.initiation.speed
    return GaussianState([[0.0]] * 4, np.diag([0.0, speed**2, 0.0, speed**2]))


def instant(scenario: Scenario, t_ns: int) -> datetime:
    """A time as Stone Soup has it, to the microsecond."""
    return scenario.epoch + timedelta(microseconds=(t_ns - scenario.epoch_ns) * 1e6 / NS_PER_S)


def detections_of(eye: Eye, scan: Scan, time: datetime) -> set[Any]:
    """The plots of a scan; each knows how it was measured, where it lies, and how dense false plots are there."""
    model = measurement_of(eye, scan.position)
    relative = eye.model.log_relative(scan.z, scan.position)
    density = np.exp(eye.model.log_rho_f + (np.zeros(len(scan.z)) if relative is None else relative))
    places = eye.model.measurement.locate(scan.z, scan.position)
    return {
        Detection(
            vector_of(eye, z),
            timestamp=time,
            measurement_model=model,
            metadata={"density": rho, "place": place if eye.locates else _NOWHERE, "spread": _spread(eye, z)},
        )
        for z, rho, place in zip(scan.z, density, places, strict=True)
    }


def measurement_of(eye: Eye, stand: Array) -> Any:
    """The measurement model of a sensor that stands there."""
    kind, sigma = eye.config.kind, np.square(eye.config.sigma)
    if kind == "position":
        return LinearGaussian(4, PLACE, np.diag(sigma))
    offset = StateVector(stand[::-1])
    if kind == "bearing":
        return Cartesian2DToBearing(4, NORTH_FIRST, np.diag(sigma), translation_offset=offset)
    return CartesianToBearingRange(4, NORTH_FIRST, np.diag(sigma[::-1]), translation_offset=offset)


def vector_of(eye: Eye, z: Array) -> Any:
    """A plot as Stone Soup has it."""
    kind = eye.config.kind
    if kind == "position":
        return StateVector(z)
    return StateVector([Bearing(z[-1]), *z[-2::-1]])


def _spread(eye: Eye, z: Array) -> float:
    """Mean square error of a plot's place [m^2]; infinite where it has none."""
    sigma = eye.config.sigma
    if eye.config.kind == "position":
        return float(np.square(sigma).sum())
    return float(sigma[0] ** 2 + (z[0] * sigma[1]) ** 2) if eye.config.kind == "polar" else np.inf


class Nearby:
    """A hypothesiser of Stone Soup, asked only about plots that may be in the gate: the same answers, sooner.

    Plots of a hypothesiser of probabilities count with the density of false plots where they lie.
    """

    def __init__(self, inner: Any, gate: float, clutter: float | None = None) -> None:
        """Wrap a hypothesiser.

        Args:
            inner: of Stone Soup.
            gate: largest squared Mahalanobis distance.
            clutter: factor on the density of false plots; None: the hypothesiser knows no probabilities.
        """
        self._inner, self._gate, self._clutter = inner, gate, clutter
        self._asked: tuple[Any, list[Any], Array, Array] = (None, [], np.empty((0, 2)), np.empty(0))

    def hypothesise(self, track: Any, detections: Collection[Any], timestamp: datetime, **options: Any) -> Any:
        """All hypotheses of a track."""
        prediction = self._inner.predictor.predict(track, timestamp=timestamp)
        found = self._inner.hypothesise(track, set(self._near(prediction, detections)), timestamp, **options)
        if self._clutter is not None:
            for hypothesis in found:
                if hypothesis:
                    hypothesis.probability /= self._clutter * hypothesis.measurement.metadata["density"]
            found.normalise_probabilities(total_weight=1)
        return found

    def _near(self, prediction: Any, detections: Collection[Any]) -> Iterator[Any]:
        if detections is not self._asked[0] or len(detections) != len(self._asked[1]):
            self._asked = (detections, list(detections), *_places(detections))
        _, listed, places, spreads = self._asked
        spread = float(np.trace(prediction.covar[np.ix_(PLACE, PLACE)]))
        reach = self._gate * (spread + spreads) * _FAR**2
        near = ~(np.square(places - place_of(prediction)).sum(axis=-1) > reach)
        return compress(listed, near)


def _places(detections: Collection[Any]) -> tuple[Array, Array]:
    """Where plots lie, and the mean square errors; NaN where they do not tell, shapes (M, 2), (M,)."""
    places = [detection.metadata["place"] for detection in detections]
    spreads = np.array([detection.metadata["spread"] for detection in detections])
    return np.array(places).reshape(-1, 2), spreads


def place_of(state: Any) -> Array:
    """East and north of a state [m]."""
    return np.asarray(state.state_vector, np.float64)[list(PLACE), 0]


def x_of(state: Any, later_s: float = 0.0) -> list[float]:
    """East, north and their rates, some time later if nothing happens."""
    east, east_rate, north, north_rate = np.asarray(state.state_vector, np.float64)[:, 0].tolist()
    return [east + later_s * east_rate, north + later_s * north_rate, east_rate, north_rate]


def absorb(track: Any, hypotheses: Any, updater: Any, *, counts: bool) -> set[Any]:
    """Update a track with all its hypotheses, as Stone Soup's ``MultiTargetMixtureTracker`` does.

    Args:
        track: to update.
        hypotheses: of the track, with their probabilities.
        updater: of the sensor.
        counts: whether a plot counts as an update for those who delete tracks.

    Returns:
        the plots that are more probably the track's than all are not.
    """
    states = [updater.update(each) if each else each.prediction for each in hypotheses]
    weights = np.asarray([each.probability for each in hypotheses])
    means = StateVectors([state.state_vector for state in states])
    mean, covariance = gm_reduce_single(means, np.stack([state.covar for state in states], axis=2), weights)
    missed = next(each.weight for each in hypotheses if not each)
    claimed = {each.measurement for each in hypotheses if each.weight > missed}
    time = states[0].timestamp
    if claimed and counts:
        track.append(GaussianStateUpdate(mean, covariance, hypotheses, time))
    else:
        track.append(GaussianStatePrediction(mean, covariance, time))
    return claimed


def seen_share(sensor: Sensor) -> float:
    """Of the scans, in how many a target is detected: the peer takes targets for visible all the time."""
    return sensor.p_d if sensor.visibility is None else sensor.p_d * sensor.visibility.share
