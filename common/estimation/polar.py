"""Sensors that measure where a target is seen from where they stand: polar, polar with Doppler, bearing.

Azimuth [rad] counts clockwise from north in the east-north frame, elevation [rad] upward from the horizontal. A plot is
(range, azimuth), in 3-D (range, azimuth, elevation), each with range rate [m/s] last where the sensor measures it; a
bearing is (azimuth), in 3-D (azimuth, elevation). ``linearise`` is the EKF's, at close range with the care of
``sight.py``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.sensing import Linearised
from waldnet.common.estimation.sight import approach, look_at, radial_speed, to_cartesian, to_polar


class Polar(NamedTuple):
    """A sensor of range and azimuth, in 3-D of range, azimuth and elevation.

    Attributes:
        sigma: standard deviations [m, rad(, rad)].
        n: size of the state.
    """

    sigma: tuple[float, ...]
    n: int

    @property
    def m(self) -> int:
        """Size of a plot."""
        return len(self.sigma)

    @property
    def R(self) -> Array:
        """Measurement noise, shape (m, m)."""
        return np.diag(np.square(self.sigma))

    @property
    def angular(self) -> tuple[int, ...]:
        """Which numbers of a plot are angles around a circle."""
        return (1,)

    def moving(self, velocity: Array) -> Polar:  # noqa: ARG002
        """The same: range and direction do not depend on how the sensor moves."""
        return self

    def observe(self, x: Array, origin: Array) -> Array:
        """The plot of states ``x`` without noise, seen from ``origin``, shapes (..., n), (d,) to (..., m)."""
        return to_polar(x[..., : len(self.sigma)] - origin)

    def linearise(self, density: Gaussian, origin: Array) -> Linearised:
        """Expected plot, Jacobian and noise where states are distributed as ``density``, seen from ``origin``."""
        look = look_at(density, origin)
        return Linearised(look.values, _padded(look.slopes, self.n), self.R + _diagonal(look.rest), self.angular)

    def locate(self, z: Array, origin: Array) -> Array:
        """The positions that plots tell of, shapes (..., m), (d,) to (..., d)."""
        return origin + to_cartesian(z[..., : origin.shape[-1]])

    def fold(self, z: Array) -> Array:
        """Plots whose noise led out of the range of their numbers, as the sensor would give them, shape (..., m)."""
        return to_polar(to_cartesian(z))

    def draw_false(self, rng: np.random.Generator, places: Array, stand: Array) -> Array:  # noqa: ARG002
        """False plots at given positions, shapes (M, d), (d,) to (M, m)."""
        return self.observe(places, stand)

    def space(self, volume: float) -> float:
        """Size of the plot space that false plots come from, up to ``log_stretch``: that of the field of view."""
        return volume

    def log_stretch(self, z: Array) -> Array:
        """Logarithm of the area [m^2] or volume [m^3] per unit of plot space, shape (..., m) to (...).

        It is ``r`` or ``r^2 cos e``, with range and cosine at least their noise: closer, noise blurs all densities.
        """
        log_r = np.log(np.maximum(z[..., 0], self.sigma[0]))
        if len(self.sigma) == 2:
            return log_r
        return 2.0 * log_r + _log_cos(z[..., 2], self.sigma[2])


class PolarDoppler(NamedTuple):
    """A sensor of range, azimuth(, elevation), and range rate relative to itself.

    Attributes:
        sigma: standard deviations [m, rad(, rad), m/s].
        n: size of the state.
        max_speed: false plots have range rates uniform up to it, approaching and receding [m/s].
        velocity: of the sensor over ground [m/s], which range rates are relative to; default: it stands still.
    """

    sigma: tuple[float, ...]
    n: int
    max_speed: float
    velocity: tuple[float, ...] = ()

    @property
    def m(self) -> int:
        """Size of a plot."""
        return len(self.sigma)

    @property
    def R(self) -> Array:
        """Measurement noise, shape (m, m)."""
        return np.diag(np.square(self.sigma))

    @property
    def _polar(self) -> Polar:
        return Polar(self.sigma[:-1], self.n)

    @property
    def _own(self) -> Array:
        return np.array(self.velocity or 0.0)

    def moving(self, velocity: Array) -> PolarDoppler:
        """The measurement of a sensor that moves with a velocity over ground [m/s], shape (d,)."""
        return self._replace(velocity=tuple(velocity.tolist()))

    @property
    def angular(self) -> tuple[int, ...]:
        """Which numbers of a plot are angles around a circle."""
        return (1,)

    def observe(self, x: Array, origin: Array) -> Array:
        """The plot of states ``x`` without noise, seen from ``origin``, shapes (..., n), (d,) to (..., m)."""
        polar, rate = self._polar.observe(x, origin), radial_speed(x, origin, self._own)
        return np.concatenate([polar, rate[..., None]], axis=-1)

    def linearise(self, density: Gaussian, origin: Array) -> Linearised:
        """Expected plot, Jacobian and noise where states are distributed as ``density``, seen from ``origin``."""
        polar, rate = self._polar.linearise(density, origin), approach(density, origin, self._own)
        R = np.zeros((*rate.speed.shape, self.m, self.m))
        R[..., :-1, :-1], R[..., -1, -1] = polar.R, rate.rest + self.sigma[-1] ** 2
        z = np.concatenate([polar.z, rate.speed[..., None]], axis=-1)
        H = np.concatenate([polar.H, rate.slope[..., None, :]], axis=-2)
        return Linearised(z, H, R, self.angular)

    def locate(self, z: Array, origin: Array) -> Array:
        """The positions that plots tell of, shapes (..., m), (d,) to (..., d)."""
        return self._polar.locate(z, origin)

    def fold(self, z: Array) -> Array:
        """Plots whose noise led out of the range of their numbers, as the sensor would give them, shape (..., m)."""
        return np.concatenate([self._polar.fold(z[..., :-1]), z[..., -1:]], axis=-1)

    def draw_false(self, rng: np.random.Generator, places: Array, stand: Array) -> Array:
        """False plots at given positions, shapes (M, d), (d,) to (M, m)."""
        speeds = rng.uniform(-self.max_speed, self.max_speed, (len(places), 1))
        return np.concatenate([self._polar.observe(places, stand), speeds], axis=-1)

    def space(self, volume: float) -> float:
        """Size of the plot space that false plots come from, up to ``log_stretch``."""
        return volume * 2.0 * self.max_speed

    def log_stretch(self, z: Array) -> Array:
        """Logarithm of the area [m^2] or volume [m^3] per unit of the polar numbers, shape (..., m) to (...)."""
        return self._polar.log_stretch(z)


class Bearing(NamedTuple):
    """A sensor of azimuth, in 3-D of azimuth and elevation.

    Attributes:
        sigma: standard deviations [rad].
        n: size of the state.
        directions: angle [rad], in 3-D solid angle [sr], that false plots come from.
    """

    sigma: tuple[float, ...]
    n: int
    directions: float

    @property
    def m(self) -> int:
        """Size of a plot."""
        return len(self.sigma)

    @property
    def R(self) -> Array:
        """Measurement noise [rad^2], shape (m, m)."""
        return np.diag(np.square(self.sigma))

    @property
    def angular(self) -> tuple[int, ...]:
        """Which numbers of a plot are angles around a circle."""
        return (0,)

    def moving(self, velocity: Array) -> Bearing:  # noqa: ARG002
        """The same: a direction does not depend on how the sensor moves."""
        return self

    def observe(self, x: Array, origin: Array) -> Array:
        """The plot of states ``x`` without noise, seen from ``origin``, shapes (..., n), (d,) to (..., m)."""
        return to_polar(x[..., : 1 + len(self.sigma)] - origin)[..., 1:]

    def linearise(self, density: Gaussian, origin: Array) -> Linearised:
        """Expected plot, Jacobian and noise where states are distributed as ``density``, seen from ``origin``."""
        look = look_at(density, origin)
        H, R = _padded(look.slopes[..., 1:, :], self.n), self.R + _diagonal(look.rest[..., 1:])
        return Linearised(look.values[..., 1:], H, R, self.angular)

    def locate(self, z: Array, origin: Array) -> Array:
        """The positions 1 m away in the direction of plots, shapes (..., m), (d,) to (..., d)."""
        return origin + to_cartesian(np.concatenate([np.ones_like(z[..., :1]), z], axis=-1))

    def fold(self, z: Array) -> Array:
        """Plots whose noise led out of the range of their numbers, as the sensor would give them, shape (..., m)."""
        return to_polar(self.locate(z, np.zeros(1 + len(self.sigma))))[..., 1:]

    def draw_false(self, rng: np.random.Generator, places: Array, stand: Array) -> Array:  # noqa: ARG002
        """False plots at given positions, shapes (M, d), (d,) to (M, m)."""
        return self.observe(places, stand)

    def space(self, volume: float) -> float:  # noqa: ARG002 (a bearing has no distance)
        """Size of the plot space that false plots come from, up to ``log_stretch``."""
        return self.directions

    def log_stretch(self, z: Array) -> Array | None:
        """Logarithm of the solid angle per unit of plot space, shape (..., m) to (...); None in 2-D: it is 0."""
        return None if len(self.sigma) == 1 else _log_cos(z[..., 1], self.sigma[1])


def _padded(slopes: Array, n: int) -> Array:
    """Slopes by the whole state, shape (..., k, d) to (..., k, n)."""
    H = np.zeros((*slopes.shape[:-1], n))
    H[..., : slopes.shape[-1]] = slopes
    return H


def _diagonal(variances: Array) -> Array:
    """Diagonal matrices, shape (..., k) to (..., k, k)."""
    return variances[..., None] * np.eye(variances.shape[-1])


def _log_cos(elevation: Array, sigma: float) -> Array:
    return np.log(np.maximum(np.cos(elevation), np.sin(min(sigma, 1.0))))
