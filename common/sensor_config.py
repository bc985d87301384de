"""Sensors in scenario files: what they measure, where they see, what they detect.

Azimuth counts clockwise from north, elevation upward from the horizontal; all angles are in radians.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import Field

from waldnet.common.estimation.clutter_map import ClutterModel
from waldnet.common.estimation.detection import Constant, Detection, Notch, Swerling
from waldnet.common.estimation.field_of_view import AllAround, Box, Disc, Everywhere, FieldOfView
from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.motion import Motion
from waldnet.common.estimation.polar import Bearing, Polar, PolarDoppler
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.estimation.sector import Sector
from waldnet.common.estimation.sensing import Measurement, Position, Sensor
from waldnet.common.estimation.sigma_points import SigmaPoint
from waldnet.common.estimation.visibility import Visibility
from waldnet.common.limits import PlotLimits, plot_limits
from waldnet.common.quantities import (
    Angle,
    Decibels,
    Delay,
    Duration,
    Elevation,
    FalsePlots,
    Finite,
    InnerProbability,
    Model,
    Name,
    NotNegative,
    Positive,
    Probability,
    Size,
    Span,
    Volume,
)

#: Range rates of false plots reach so far unless the file says otherwise [m/s].
_MAX_SPEED = 300.0
#: A circle has four cells of directions at least [rad].
_LARGEST_CELL = 0.5 * np.pi
_NUMBERS = {
    "position": ("east", "north", "up"),
    "polar": ("range", "azimuth", "elevation"),
    "bearing": ("azimuth", "elevation"),
}


class EverywhereConfig(Model):
    """Sees everywhere; the area gives the density of false plots [m^2, in 3-D m^3].

    Simulated false plots fill a square of that area around the origin. A bearing sensor has no area: its false plots
    come from all directions alike.
    """

    shape: Literal["everywhere"]
    area: Volume | None = None

    def build(self, dimensions: int) -> FieldOfView:
        """The field of view."""
        return AllAround(dimensions) if self.area is None else Everywhere(self.area, dimensions)

    def extent(self, dimensions: int) -> float | None:
        """Side of the square or cube [m]; None: there is no end."""
        return None if self.area is None else float(self.area ** (1.0 / dimensions))


class BoxConfig(Model):
    """A box with full side lengths ``size`` [m]; without a center it moves and turns with the sensor."""

    shape: Literal["box"]
    size: tuple[Size, ...]
    center: tuple[Finite, ...] | None = None

    def build(self, dimensions: int) -> FieldOfView:  # noqa: ARG002 (the size tells)
        """The field of view."""
        return Box(self.size)

    def extent(self, dimensions: int) -> float:  # noqa: ARG002
        """Longest side [m]."""
        return max(self.size)


class DiscConfig(Model):
    """A disc, in 3-D a ball, of ``radius`` [m]; without a center it moves with the sensor."""

    shape: Literal["disc"]
    radius: Size
    center: tuple[Finite, ...] | None = None

    def build(self, dimensions: int) -> FieldOfView:
        """The field of view."""
        return Disc(self.radius, dimensions)

    def extent(self, dimensions: int) -> float:  # noqa: ARG002
        """Diameter [m]."""
        return 2.0 * self.radius


class SectorConfig(Model):
    """A sector around the sensor, with which it moves and turns.

    Attributes:
        radius: largest range [m].
        inner: smallest range [m].
        direction: azimuth of its middle [rad], clockwise from the sensor's heading, without one from north.
        width: span of azimuths [rad], up to 2 pi.
        elevation: lowest and highest elevation [rad], in 3-D only; default: all.
    """

    shape: Literal["sector"]
    radius: Size
    inner: NotNegative = 0.0
    direction: Angle
    width: Span
    elevation: tuple[Elevation, Elevation] | None = None

    def build(self, dimensions: int) -> Sector:
        """The field of view."""
        elevation = self.elevation or (-0.5 * np.pi, 0.5 * np.pi)
        return Sector(self.radius, self.inner, self.direction, self.width, elevation if dimensions == 3 else None)

    def extent(self, dimensions: int) -> float:  # noqa: ARG002
        """Diameter of the disc that it is a part of [m]."""
        return 2.0 * self.radius


FieldOfViewConfig: TypeAlias = Annotated[
    EverywhereConfig | BoxConfig | DiscConfig | SectorConfig, Field(discriminator="shape")
]


class ConstantConfig(Model):
    """Everything inside the field of view is detected with ``p_d``."""

    model: Literal["constant"] = "constant"

    def build(self) -> Detection:
        """The detection model."""
        return Constant()


class SwerlingConfig(Model):
    """A fluctuating target (Swerling I): p_d = p_fa^(1 / (1 + snr)), snr falling with the fourth power of the range.

    Attributes:
        p_fa: probability of a false alarm in a resolution cell.
        snr_db: mean signal-to-noise ratio at the range ``at_range`` [dB].
        at_range: [m].
    """

    model: Literal["swerling"]
    p_fa: InnerProbability
    snr_db: Decibels
    at_range: Size

    def build(self) -> Detection:
        """The detection model."""
        return Swerling(self.p_fa, 10.0 ** (self.snr_db / 10.0), self.at_range)


class NotchConfig(Model):
    """The clutter notch of a GMTI radar: p_d falls to 0 for targets that cross its line of sight.

    Attributes:
        mdv: minimum detectable velocity [m/s], the radial speed at which half of p_d is left.
    """

    model: Literal["notch"]
    mdv: Size

    def build(self) -> Detection:
        """The detection model."""
        return Notch(self.mdv)


DetectionConfig: TypeAlias = Annotated[ConstantConfig | SwerlingConfig | NotchConfig, Field(discriminator="model")]


class VisibilityConfig(Model):
    """The sensor loses targets for a while: shadowed, hidden, overlooked; misses come in rows.

    Attributes:
        visible_for: mean time that a target stays visible, and is detected with ``p_d`` [s].
        hidden_for: mean time that it then stays hidden, and is not detected [s].
    """

    visible_for: Duration
    hidden_for: Duration

    def build(self) -> Visibility:
        """The visibility model."""
        return Visibility(self.visible_for, self.hidden_for)


class ClutterMapConfig(Model):
    """Where false plots come from, learned from the plots themselves.

    Attributes:
        cell: side of a cell [m], of a bearing sensor [rad]: about twice the standard deviation of a plot.
        memory: after so long a scan counts 1/e [s].
        shape: of the Gamma prior of the rate in a cell: the smaller, the more false plots keep to places of their own.
        start_below: a plot starts a track only where false plots are less than so many times as dense as on average.
    """

    cell: Size
    memory: Duration = 60.0
    shape: Positive = 0.1
    start_below: Positive = 10.0


class SensorConfig(Model):
    """One sensor: where it stands, what it measures, how surely, and when.

    Attributes:
        kind: what a plot is. position: east, north(, up); polar: range, azimuth(, elevation); polar-doppler: the same
            and range rate; bearing: azimuth(, elevation).
        sigma: standard deviations of a plot, one per number of it [m, rad, m/s].
        position: east, north (, up) [m]; a recorded scan may override it. Default: the origin.
        velocity: of the sensor over ground, which range rates are relative to [m/s]; a recorded scan may override it.
            Default: 0; zeros say that range rates are over ground, however the sensor moves.
        heading: of its platform [rad], clockwise from north, with which fields of view turn; a recorded scan may
            override it. Default: 0.
        azimuth: what azimuths in plots files count from: north, or the platform's heading.
        p_d: detection probability inside the field of view; with the detection model "swerling" there is none.
        detection: how the detection probability depends on the target.
        visibility: how long targets stay visible and hidden to this sensor; default: visible all the time.
        false_plots: mean false plots per scan, uniform in the field of view.
        clutter_map: learns where they are denser and where less; without it they are uniform.
        max_speed: of polar-doppler: false plots have range rates, relative to the sensor, uniform between its negative
            and itself [m/s].
        update: how plots that are not linear in the state are worked in.
        scan_interval: seconds between scans.
        spacing: scans that come sooner than this after the last one are passed over [s]: a sensor whose errors last
            for seconds tells nothing new with every frame, and counts too much if all are taken for independent.
        first_scan: time of the first one [s]; default: one interval after the start.
    """

    name: Name
    kind: Literal["position", "polar", "polar-doppler", "bearing"] = "position"
    position: tuple[Finite, ...] | None = None
    velocity: tuple[Finite, ...] | None = None
    heading: Angle | None = None
    azimuth: Literal["north", "heading"] = "north"
    sigma: tuple[Size, ...]
    p_d: Probability | None = None
    detection: DetectionConfig = ConstantConfig()
    visibility: VisibilityConfig | None = None
    false_plots: FalsePlots
    clutter_map: ClutterMapConfig | None = None
    max_speed: Size | None = None
    update: Literal["ekf", "sigma-point"] = "ekf"
    field_of_view: FieldOfViewConfig
    scan_interval: Duration = 1.0
    spacing: Delay = 0.0
    first_scan: Delay | None = None

    def build(self, motion: Motion) -> Sensor:
        """The sensor model for states of a motion model."""
        return Sensor(
            self._measurement(motion),
            1.0 if self.p_d is None else self.p_d,
            self.false_plots,
            self.field_of_view.build(motion.dimensions),
            self.detection.build(),
            None if self.visibility is None else self.visibility.build(),
            fixed_view=isinstance(self.field_of_view, BoxConfig) and self.field_of_view.center is not None,
        )

    def clutter_model(self, motion: Motion) -> ClutterModel | None:
        """What is believed of the false plots of a sensor that maps them, for states of a motion model."""
        learned = self.clutter_map
        return (
            None if learned is None else ClutterModel(self.build(motion), learned.cell, learned.memory, learned.shape)
        )

    def _measurement(self, motion: Motion) -> Measurement:
        d, n = motion.dimensions, motion.n
        if self.kind == "position":
            return Position(self.sigma, n)
        measurement: Measurement
        if self.kind == "polar":
            measurement = Polar(self.sigma, n)
        elif self.kind == "polar-doppler":
            measurement = PolarDoppler(self.sigma, n, self.max_speed or _MAX_SPEED)
        else:
            measurement = Bearing(self.sigma, n, self._directions(d))
        if self.update == "sigma-point":
            return SigmaPoint(measurement, d, self.kind == "polar-doppler")
        return measurement

    def _directions(self, dimensions: int) -> float:
        """Angle, in 3-D solid angle, that false bearings come from."""
        view = self.field_of_view
        if isinstance(view, SectorConfig):
            return view.build(dimensions).directions
        return 2.0 * np.pi if dimensions == 2 else 4.0 * np.pi

    def stand(self, dimensions: int, moved_to: tuple[float, ...] | None = None) -> Array:
        """Where the sensor stands during a scan [m], shape (d,)."""
        return np.array(moved_to or self.position or (0.0,) * dimensions)

    def pose(
        self,
        dimensions: int,
        position: Array | None = None,
        velocity: Array | None = None,
        heading: float | None = None,
    ) -> SensorPose:
        """Pose of the sensor during a scan, as far as that is told; the rest as the scenario says."""
        return SensorPose(
            self.stand(dimensions) if position is None else position,
            np.array(self.velocity or ()) if velocity is None else velocity,
            self.heading or 0.0 if heading is None else heading,
        )

    def view_center(self, stand: Array) -> Array:
        """Center of the field of view of a sensor that stands at ``stand``, shape (d,)."""
        fov = self.field_of_view
        if isinstance(fov, EverywhereConfig):
            return stand if fov.area is None else np.zeros_like(stand)
        if isinstance(fov, SectorConfig) or fov.center is None:
            return stand
        return np.array(fov.center)

    @property
    def locates(self) -> bool:
        """Whether a plot gives a position, so that a track can start from it."""
        return self.kind != "bearing"

    @property
    def numbers(self) -> tuple[str, ...]:
        """What the numbers of a plot are."""
        m = len(self.sigma)
        if self.kind == "polar-doppler":
            return (*_NUMBERS["polar"][: m - 1], "range rate")
        return _NUMBERS[self.kind][:m]

    @property
    def limits(self) -> PlotLimits:
        """What the numbers of a plot can be."""
        return plot_limits(self.numbers)


def sensor_faults(sensor: Mapping[str, Any], dimensions: int, where: str) -> Iterator[str]:
    """Faults between the keys of a ``[[sensor]]`` table, tolerant of whatever else is wrong with it."""
    kind, view = sensor.get("kind", "position"), sensor.get("field_of_view")
    if kind in ("position", "polar", "polar-doppler", "bearing"):
        numbers = dimensions + {"polar-doppler": 1, "bearing": -1}.get(kind, 0)
        why = "" if kind == "position" else f"a {kind} plot in {dimensions} dimensions has {numbers}"
        yield from wrong_length(sensor, ("sigma",), numbers, where, why)
    yield from wrong_length(sensor, ("position", "velocity"), dimensions, where)
    if kind == "position" and sensor.get("azimuth") == "heading":
        yield f"{where}.azimuth: a position has none; it is in the frame of the scenario"
    if isinstance(view, dict):
        yield from _view_faults(view, kind, dimensions, f"{where}.field_of_view")
    if kind == "position" and sensor.get("update") == "sigma-point":
        yield f"{where}.update: 'sigma-point' is for plots that are not linear in the state; a position is"
    if kind != "polar-doppler" and "max_speed" in sensor:
        yield f"{where}.max_speed: only a polar-doppler sensor has it, this one is {kind}"
    yield from _map_faults(sensor.get("clutter_map"), kind, f"{where}.clutter_map")
    detection = sensor.get("detection")
    swerling = isinstance(detection, dict) and detection.get("model") == "swerling"
    if swerling and "p_d" in sensor:
        yield f"{where}.p_d: detection 'swerling' says how probable a detection is; leave it out"
    elif not swerling and "p_d" not in sensor:
        yield f"{where}.p_d: is missing"


def _map_faults(learned: Any, kind: str, where: str) -> Iterator[str]:
    """Faults of a map of false plots."""
    cell = learned.get("cell", 0.0) if isinstance(learned, dict) else 0.0
    if kind == "bearing" and _number(cell) and cell > _LARGEST_CELL:
        yield f"{where}.cell: {cell:g} is no side of a cell of directions in radians (up to pi/2)"


def _view_faults(view: Mapping[str, Any], kind: str, dimensions: int, where: str) -> Iterator[str]:
    """Faults of a field of view."""
    shape = view.get("shape")
    yield from wrong_length(view, ("size", "center"), dimensions, where)
    if shape == "sector":
        yield from _sector_faults(view, dimensions, where)
    if kind != "bearing" and shape == "everywhere" and "area" not in view:
        yield f"{where}.area: is missing"
    elif kind == "bearing" and shape == "everywhere" and "area" in view:
        yield f"{where}.area: a bearing sensor has none: its false plots come from all directions alike"
    elif kind == "bearing" and (shape == "box" or view.get("center") is not None):
        yield f"{where}: a bearing sensor sees from where it stands: a sector, a disc without center, or everywhere"


def _sector_faults(view: Mapping[str, Any], dimensions: int, where: str) -> Iterator[str]:
    radius, inner, elevation = view.get("radius", 0.0), view.get("inner", 0.0), view.get("elevation")
    if _number(radius) and _number(inner) and 0.0 < radius <= inner:
        yield f"{where}.inner: {inner:g} is not below the radius, {radius:g}"
    if elevation is not None and dimensions == 2:
        yield f"{where}.elevation: this scenario has two dimensions"
    elif isinstance(elevation, list) and len(elevation) == 2 and all(map(_number, elevation)):
        low, high = elevation
        if low >= high:
            yield f"{where}.elevation: {low:g} is not below {high:g}"


def wrong_length(
    entry: Mapping[str, Any], keys: tuple[str, ...], length: int, where: str, why: str = ""
) -> Iterator[str]:
    """Lists that do not have the length they need, and why they need it."""
    for key in keys:
        value = entry.get(key)
        if isinstance(value, list) and len(value) != length:
            reason = why or f"this scenario's dimensions need {length}"
            yield f"{where}.{key}: has {len(value)} numbers, {reason}"


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
