"""Motion models: transition F(dt) and process noise Q(dt) over any interval."""

from __future__ import annotations

from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from waldnet.common.estimation.gaussian import Array, Gaussian, as_array, identity, symmetric, times_transposed

#: Of the power series of (theta - sin theta) / theta^3: 6 / (2 k + 3)! is below 1e-16 from k = 8 on.
_TERMS = 8


class Motion(Protocol):
    """A linear motion model; states start with the position."""

    @property
    def n(self) -> int:
        """Size of the state."""
        ...

    @property
    def dimensions(self) -> int:
        """Size of the position, 2 or 3."""
        ...

    def transition(self, dt: ArrayLike) -> Array:
        """F over ``dt`` seconds, shape (...) to (..., n, n)."""
        ...

    def noise(self, dt: ArrayLike) -> Array:
        """Q over ``dt`` seconds, shape (...) to (..., n, n)."""
        ...


class ConstantVelocity(NamedTuple):
    """Continuous white-noise acceleration: state (position, velocity), in 2-D (n = 4) or 3-D (n = 6).

    F and Q of two intervals compose to those of their sum, so a factor may be predicted in one step or in many.

    Attributes:
        dimensions: of the position, 2 or 3.
        psd: power spectral density q of the acceleration [m^2/s^3].

    References:
        theory.md §1; Bar-Shalom, Li & Kirubarajan, Estimation with applications to tracking and navigation, §6.2.2.
    """

    dimensions: int
    psd: float

    @property
    def n(self) -> int:
        """Size of the state."""
        return 2 * self.dimensions

    def transition(self, dt: ArrayLike) -> Array:
        """F over ``dt`` seconds, shape (...) to (..., n, n)."""
        dt = as_array(dt)
        return _each_axis(((1.0, dt), (0.0, 1.0)), dt, self.dimensions)

    def noise(self, dt: ArrayLike) -> Array:
        """Q over ``dt`` seconds, shape (...) to (..., n, n)."""
        dt = as_array(dt)
        cross = self.psd * dt**2 / 2.0
        return _each_axis(((self.psd * dt**3 / 3.0, cross), (cross, self.psd * dt)), dt, self.dimensions)


class ConstantAcceleration(NamedTuple):
    """Continuous white-noise jerk: state (position, velocity, acceleration), in 2-D (n = 6) or 3-D (n = 9).

    F and Q of two intervals compose to those of their sum.

    Attributes:
        dimensions: of the position, 2 or 3.
        psd: power spectral density q of the jerk [m^2/s^5].

    References:
        theory.md §1; Bar-Shalom, Li & Kirubarajan, Estimation with applications to tracking and navigation, §6.2.3.
    """

    dimensions: int
    psd: float

    @property
    def n(self) -> int:
        """Size of the state."""
        return 3 * self.dimensions

    def transition(self, dt: ArrayLike) -> Array:
        """F over ``dt`` seconds, shape (...) to (..., n, n)."""
        dt = as_array(dt)
        return _each_axis(((1.0, dt, 0.5 * dt**2), (0.0, 1.0, dt), (0.0, 0.0, 1.0)), dt, self.dimensions)

    def noise(self, dt: ArrayLike) -> Array:
        """Q over ``dt`` seconds, shape (...) to (..., n, n)."""
        dt = as_array(dt)
        q, square = self.psd * dt, dt * dt
        pp, pv, pa = q * square * square / 20.0, q * square * dt / 8.0, q * square / 6.0
        return _each_axis(((pp, pv, pa), (pv, 2.0 * pa, 0.5 * q * dt), (pa, 0.5 * q * dt, q)), dt, self.dimensions)


class CoordinatedTurn(NamedTuple):
    """A turn at a known rate, with continuous white-noise acceleration: state (position, velocity) as of CV.

    The velocity rotates, ``dv = turn_rate J v dt + dw`` with J the quarter turn from east to north; in 3-D the turn is
    horizontal and the vertical is CV. With ``F_pv`` the rows of position and ``F_vv`` those of velocity in the columns
    of velocity, ``F_vv`` is the rotation by ``theta = turn_rate dt`` and ``F_pv`` its integral; Q is the integral over
    the interval of ``q [F_pv; F_vv] [F_pv; F_vv]'``. In the products all terms in cos^2 and sin^2 cancel, which leaves

        Q_vv = q dt I          Q_pp = 2 q dt^3 (theta - sin theta) / theta^3 I
        Q_pv = q dt^2 ((1 - cos theta) / theta^2 I - (theta - sin theta) / theta^2 J)

    So F and Q of two intervals compose to those of their sum, and turn_rate = 0 is CV. Textbooks often take the Q of
    CV, which does not compose.

    Attributes:
        dimensions: of the position, 2 or 3.
        psd: power spectral density q of the acceleration [m^2/s^3].
        turn_rate: of the velocity, counter-clockwise seen from above [rad/s].

    References:
        theory.md §1; Bar-Shalom, Li & Kirubarajan, Estimation with applications to tracking and navigation, §11.7.1.
    """

    dimensions: int
    psd: float
    turn_rate: float

    @property
    def n(self) -> int:
        """Size of the state."""
        return 2 * self.dimensions

    def transition(self, dt: ArrayLike) -> Array:
        """F over ``dt`` seconds, shape (...) to (..., n, n)."""
        dt = as_array(dt)
        theta = self.turn_rate * dt
        along, across = dt * np.sinc(theta / np.pi), 0.5 * theta * dt * _half(theta)
        F = _each_axis(((1.0, dt), (0.0, 1.0)), dt, self.dimensions)
        _turn(F, 0, self.dimensions, along, across)
        _turn(F, self.dimensions, self.dimensions, np.cos(theta), np.sin(theta))
        return F

    def noise(self, dt: ArrayLike) -> Array:
        """Q over ``dt`` seconds, shape (...) to (..., n, n)."""
        dt = as_array(dt)
        theta, q = self.turn_rate * dt, self.psd * dt
        cubic = _cubic(theta)
        Q = _each_axis(((q * dt**2 / 3.0, q * dt / 2.0), (q * dt / 2.0, q)), dt, self.dimensions)
        _turn(Q, 0, 0, 2.0 * q * dt**2 * cubic, np.zeros_like(dt))
        along, across = 0.5 * q * dt * _half(theta), q * dt * theta * cubic
        _turn(Q, 0, self.dimensions, along, -across)
        _turn(Q, self.dimensions, 0, along, across)
        return Q


#: The models of one target that does one thing.
Kinematic: TypeAlias = ConstantVelocity | ConstantAcceleration | CoordinatedTurn


def _each_axis(entries: tuple[tuple[Array | float, ...], ...], dt: Array, size: int) -> Array:
    """The matrix of one axis for each of ``size`` axes that do not mix: k x k entries to (..., k size, k size)."""
    k = len(entries)
    one = np.empty((*dt.shape, k, 1, k, 1))
    for i, row in enumerate(entries):
        for j, entry in enumerate(row):
            one[..., i, 0, j, 0] = entry
    return (one * identity(size)[:, None, :]).reshape(*dt.shape, k * size, k * size)


def _turn(matrix: Array, row: int, column: int, along: Array, across: Array) -> None:
    """Set the horizontal block at (row, column) to ``along I + across J``, in place."""
    matrix[..., row, column] = matrix[..., row + 1, column + 1] = along
    matrix[..., row, column + 1], matrix[..., row + 1, column] = -across, across


def _half(theta: Array) -> Array:
    """``2 (1 - cos theta) / theta^2`` with all digits for small ``theta`` too, by the half angle."""
    return np.square(np.sinc(theta / (2.0 * np.pi)))


def _cubic(theta: Array) -> Array:
    """``(theta - sin theta) / theta^3``: up to 1 rad by its power series."""
    small = np.minimum(np.abs(theta), 1.0) ** 2
    nested = np.ones_like(theta)
    for k in range(_TERMS, 0, -1):
        nested = 1.0 - nested * small / ((2 * k + 2) * (2 * k + 3))
    is_large = np.abs(theta) > 1.0
    large = np.where(is_large, theta, 1.0)
    return np.where(is_large, (large - np.sin(large)) / (large * large * large), nested / 6.0)


def predict(prior: Gaussian, F: Array, Q: Array) -> Gaussian:
    """Propagate through ``x' = F x + w``, ``w ~ N(0, Q)`` (Eq. 5 with ``Q = n_sensors Q``).

    Args:
        prior: shapes (..., n), (..., n, n).
        F: transition, shape (..., n, n).
        Q: process noise, shape (..., n, n).

    Returns:
        the predicted densities.
    """
    # (F P)' = P F', and the product with F once more gives F P F'.
    FP = times_transposed(prior.P, F).mT
    return Gaussian(times_transposed(prior.x[..., None, :], F)[..., 0, :], symmetric(times_transposed(FP, F)) + Q)
