"""The line of sight from a sensor to a target: range, azimuth, elevation, radial speed, and their slopes.

Azimuth [rad] counts clockwise from north in the east-north frame, elevation [rad] upward from the horizontal. States
start with position and velocity.

Slopes are those at the mean, as the EKF takes them. Where the position is known no better than its distance from the
sensor, no straight line tells what will be seen: there a slope is that at a distance of one standard deviation, and
what the line leaves out is given as a variance, up to that of an angle of which nothing is known. So a target at
the sensor's own place, or in its zenith, gets a vague update and not a wrong one. Everywhere else that variance is 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import Array, Gaussian

#: Variance of an angle of which nothing is known, around the circle and from nadir to zenith [rad^2].
_ANY_AZIMUTH, _ANY_ELEVATION = np.pi**2 / 3.0, np.pi**2 / 12.0
#: Shortest distance that is divided by [m].
_SHORTEST = 1e-9
#: Velocity of an observer that stands still, in any dimensions [m/s].
_AT_REST = np.zeros(())


class Look(NamedTuple):
    """How positions are seen: values of range, azimuth(, elevation), shape (..., d).

    Attributes:
        values: at the mean.
        slopes: by the position, shape (..., d, d).
        rest: variances that the slopes leave out; 0 where the distance is more than the position's standard deviation.
        direction: unit vectors towards the mean, 0 where there is none, shape (..., d).
        reach: distances, at least one standard deviation, shape (...).
        fade: 0 at a distance of one standard deviation and beyond, 1 at the sensor's own place, shape (...).
    """

    values: Array
    slopes: Array
    rest: Array
    direction: Array
    reach: Array
    fade: Array


class Approach(NamedTuple):
    """Speed away from a sensor [m/s], shape (...); its slope by the state, (..., n); the variance this leaves out."""

    speed: Array
    slope: Array
    rest: Array


def to_polar(offset: Array) -> Array:
    """Range, azimuth in [0, 2 pi) (, elevation) of (east, north(, up)), shape (..., d)."""
    azimuth = np.remainder(np.arctan2(offset[..., 0], offset[..., 1]), 2.0 * np.pi)
    ground = np.hypot(offset[..., 0], offset[..., 1])
    if offset.shape[-1] == 2:
        return np.stack([ground, azimuth], axis=-1)
    return np.stack([np.hypot(ground, offset[..., 2]), azimuth, np.arctan2(offset[..., 2], ground)], axis=-1)


def to_cartesian(polar: Array) -> Array:
    """(east, north(, up)) of range, azimuth(, elevation), shape (..., d)."""
    r, azimuth = polar[..., 0], polar[..., 1]
    if polar.shape[-1] == 2:
        return np.stack([r * np.sin(azimuth), r * np.cos(azimuth)], axis=-1)
    ground = r * np.cos(polar[..., 2])
    return np.stack([ground * np.sin(azimuth), ground * np.cos(azimuth), r * np.sin(polar[..., 2])], axis=-1)


def radial_speed(x: Array, origin: Array, velocity: Array = _AT_REST) -> Array:
    """Speed of states away from ``origin`` [m/s], ``u . (v - velocity)``, 0 at the origin itself.

    Args:
        x: states, shape (..., n).
        origin: [m], shape (d,).
        velocity: of an observer at the origin [m/s], shape (d,); default: over ground.

    Returns:
        shape (...).
    """
    d = origin.shape[-1]
    offset = x[..., :d] - origin
    distance = np.maximum(np.linalg.vector_norm(offset, axis=-1), _SHORTEST)
    return np.asarray(np.vecdot(offset, x[..., d : 2 * d] - velocity) / distance)


def approach(density: Gaussian, origin: Array, velocity: Array = _AT_REST) -> Approach:
    """``radial_speed`` linearised at the means, shapes (..., n), (..., n, n), (d,), (d,)."""
    d, (x, P) = origin.shape[-1], density
    look, v = look_at(density, origin), x[..., d : 2 * d] - velocity
    speed = np.vecdot(look.direction, v)
    slope = np.zeros_like(x)
    slope[..., :d] = (v - speed[..., None] * look.direction) / look.reach[..., None]
    slope[..., d : 2 * d] = look.direction
    any_speed = np.vecdot(v, v) + np.trace(P[..., d : 2 * d, d : 2 * d], axis1=-2, axis2=-1)
    return Approach(speed, slope, any_speed * look.fade)


def look_at(density: Gaussian, origin: Array) -> Look:
    """How states are seen, linearised at the means, shapes (..., n), (..., n, n), (d,)."""
    d = origin.shape[-1]
    p = density.x[..., :d] - origin
    variances = np.diagonal(density.P, axis1=-2, axis2=-1)
    values = to_polar(p)
    r, ground = values[..., 0], np.hypot(p[..., 0], p[..., 1])
    reach, fade = _reach(r, variances[..., :d].sum(axis=-1))
    ground_reach, ground_fade = _reach(ground, variances[..., :2].sum(axis=-1))
    direction = p / np.maximum(r, _SHORTEST)[..., None]
    flat = p[..., :2] / np.maximum(ground, _SHORTEST)[..., None]
    slopes, rest = np.zeros((*p.shape, d)), np.zeros_like(values)
    slopes[..., 0, :] = direction
    slopes[..., 1, 0], slopes[..., 1, 1] = flat[..., 1] / ground_reach, -flat[..., 0] / ground_reach
    rest[..., 0] = fade * reach**2
    rest[..., 1] = _ANY_AZIMUTH * ground_fade
    if d == 3:
        slopes[..., 2, :2] = -flat * (direction[..., 2] / reach)[..., None]
        slopes[..., 2, 2] = ground / np.maximum(r, _SHORTEST) / reach
        # In the zenith all ways lead down.
        rest[..., 2] = ground_fade * np.minimum((ground_reach / reach) ** 2, _ANY_ELEVATION) + _ANY_ELEVATION * fade
    return Look(values, slopes, rest, direction, reach, fade)


def _reach(distance: Array, variance: Array) -> tuple[Array, Array]:
    """``reach`` and ``fade`` of ``Look`` for a distance and the variance of the position, shapes (...)."""
    close = variance > np.square(distance)
    fade = np.where(close, 1.0 - np.square(distance) / np.where(close, variance, 1.0), 0.0)
    return np.maximum(np.where(close, np.sqrt(variance), distance), _SHORTEST), fade
