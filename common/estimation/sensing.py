"""Sensors as likelihoods: what a plot measures, where, and how surely."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from waldnet.common.estimation.detection import Constant, Detection, Notch
from waldnet.common.estimation.field_of_view import AllAround, Everywhere, FieldOfView, View
from waldnet.common.estimation.gaussian import Array, BoolArray, Gaussian, as_array
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.estimation.visibility import Visibility


class Linearised(NamedTuple):
    """A measurement function linearised where a track is expected.

    Attributes:
        z: expected plot, shape (..., m).
        H: Jacobian, shape (..., m, n) or (m, n).
        R: noise covariance, shape (..., m, m) or (m, m).
        angular: which numbers of a plot are angles, whose differences are taken around the circle.
    """

    z: Array
    H: Array
    R: Array
    angular: tuple[int, ...] = ()


class Measurement(Protocol):
    """What a plot measures."""

    @property
    def m(self) -> int:
        """Size of a plot."""
        ...

    @property
    def R(self) -> Array:
        """Measurement noise, shape (m, m)."""
        ...

    @property
    def angular(self) -> tuple[int, ...]:
        """Which numbers of a plot are angles around a circle."""
        ...

    def moving(self, velocity: Array) -> Measurement:
        """The measurement of a sensor that moves with a velocity over ground [m/s], shape (d,)."""
        ...

    def observe(self, x: Array, origin: Array) -> Array:
        """The plot of states ``x`` without noise, seen from ``origin``, shapes (..., n), (d,) to (..., m)."""
        ...

    def linearise(self, density: Gaussian, origin: Array) -> Linearised:
        """Expected plot, Jacobian and noise where states are distributed as ``density``, seen from ``origin``."""
        ...

    def locate(self, z: Array, origin: Array) -> Array:
        """The positions that plots tell of, shapes (..., m), (d,) to (..., d); 1 m away where they tell no range."""
        ...

    def fold(self, z: Array) -> Array:
        """Plots whose noise led out of the range of their numbers, as the sensor would give them, shape (..., m)."""
        ...

    def draw_false(self, rng: np.random.Generator, places: Array, stand: Array) -> Array:
        """False plots at given positions, shapes (M, d), (d,) to (M, m)."""
        ...

    def space(self, volume: float) -> float:
        """Size of the plot space that false plots come from, up to ``log_stretch``.

        Args:
            volume: of the field of view, in which they are uniform [m^2, in 3-D m^3].
        """
        ...

    def log_stretch(self, z: Array) -> Array | None:
        """Logarithm of the volume per unit of plot space at plots, shape (..., m) to (...); None where it is 0."""
        ...


class Position(NamedTuple):
    """A sensor of Cartesian position: ``z = position + v``, ``v ~ N(0, diag(sigma^2))``.

    Attributes:
        sigma: standard deviations [m], one per dimension.
        n: size of the state.
    """

    sigma: tuple[float, ...]
    n: int

    @property
    def m(self) -> int:
        """Size of a plot."""
        return len(self.sigma)

    @property
    def H(self) -> Array:
        """Measurement matrix, shape (m, n)."""
        return np.eye(self.m, self.n)

    @property
    def R(self) -> Array:
        """Measurement noise [m^2], shape (m, m)."""
        return np.diag(np.square(self.sigma))

    @property
    def angular(self) -> tuple[int, ...]:
        """Which numbers of a plot are angles around a circle: none."""
        return ()

    def moving(self, velocity: Array) -> Position:  # noqa: ARG002
        """The same: a position does not depend on how the sensor moves."""
        return self

    def observe(self, x: Array, origin: Array) -> Array:  # noqa: ARG002 (a position is seen from anywhere)
        """The position of states ``x``, shape (..., n) to (..., m)."""
        return x[..., : self.m]

    def linearise(self, density: Gaussian, origin: Array) -> Linearised:
        """Expected plot, Jacobian and noise: exact, as a position is linear in the state."""
        return Linearised(self.observe(density.x, origin), self.H, self.R)

    def locate(self, z: Array, origin: Array) -> Array:  # noqa: ARG002 (a position is seen from anywhere)
        """The positions that plots tell of: the plots, shape (..., m)."""
        return z

    def fold(self, z: Array) -> Array:
        """Plots as the sensor would give them: as they are, shape (..., m)."""
        return z

    def draw_false(self, rng: np.random.Generator, places: Array, stand: Array) -> Array:  # noqa: ARG002
        """False plots at given positions, shapes (M, d), (d,) to (M, m)."""
        return places

    def space(self, volume: float) -> float:
        """Size of the plot space that false plots come from: that of the field of view."""
        return volume

    def log_stretch(self, z: Array) -> Array | None:  # noqa: ARG002
        """None: plot space is space."""
        return None


class Sensor(NamedTuple):
    """The sensor model that node, center and simulation share.

    Attributes:
        measurement: what a plot measures.
        p_d: detection probability inside the field of view, where ``detection`` does not lower it.
        false_plots: mean number of false plots per scan, uniform in the field of view.
        field_of_view: where it sees.
        detection: how the detection probability depends on the target's state.
        visibility: how long it loses targets; None: it does not.
        fixed_view: the field of view does not turn with the sensor.
    """

    measurement: Measurement
    p_d: float
    false_plots: float
    field_of_view: FieldOfView
    detection: Detection = Constant()
    visibility: Visibility | None = None
    fixed_view: bool = False

    def at(self, pose: SensorPose) -> Sensor:
        """The model for a scan at a pose: its range rates are relative to the sensor, its field of view is turned."""
        if not pose.velocity.any() and pose.heading == 0.0:
            return self
        view = self.field_of_view if self.fixed_view else self.field_of_view.turned(pose.heading)
        return self._replace(measurement=self.measurement.moving(pose.velocity), field_of_view=view)

    @property
    def log_rho_f(self) -> float:
        """Logarithm of the density of false plots [1/volume of z], where ``log_relative`` is 0."""
        return float(np.log(self.false_plots) - np.log(self.measurement.space(self.field_of_view.volume)))

    @property
    def without_notch(self) -> Sensor:
        """The sensor as if it had no clutter notch: what ``notch.hypotheses`` starts from."""
        return self._replace(detection=Constant()) if isinstance(self.detection, Notch) else self

    def log_relative(self, z: Array, stand: Array) -> Array | None:  # noqa: ARG002 (plots count from the stand)
        """Log of the density of false plots where a plot lies, relative to ``log_rho_f`` (theory.md §2).

        Args:
            z: plots, shape (..., m).
            stand: where the sensor stands [m], shape (d,).

        Returns:
            shape (...); None where the density is the same everywhere.
        """
        return self.measurement.log_stretch(z)

    def view(self, center: ArrayLike) -> View | None:
        """The field of view where its center [m] is, shape (..., d); None: every target is in it."""
        if isinstance(self.field_of_view, Everywhere | AllAround):
            return None
        return View(self.field_of_view, as_array(center))

    def detection_probability(self, state: Gaussian, stand: Array) -> Array:
        """Mean detection probability in the field of view.

        Args:
            state: predicted states, shapes (..., n), (..., n, n), position first.
            stand: where the sensor stands [m], shape (d,).

        Returns:
            detection probabilities, shape (...).
        """
        return self.p_d * self.detection.mean_share(state, stand)

    def draw_seen(self, rng: np.random.Generator, x: Array, stand: Array, center: Array) -> BoolArray:
        """Draw which targets are detected, shape (targets, n) to (targets,)."""
        inside = self.field_of_view.contains(x[:, : len(stand)], center)
        return inside & (rng.random(len(x)) < self.p_d * self.detection.share(x, stand))
