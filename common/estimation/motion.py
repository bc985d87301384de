"""Motion models: transition F(dt) and process noise Q(dt) over any interval."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from common.estimation.gaussian import Array, Gaussian, identity, symmetric, times_transposed


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

    def transition(self, dt: Array) -> Array:
        """F over ``dt`` seconds, shape (...) to (..., n, n)."""
        ...

    def noise(self, dt: Array) -> Array:
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

    def transition(self, dt: Array) -> Array:
        """F over ``dt`` seconds, shape (...) to (..., n, n)."""
        return _blocks(np.ones_like(dt), dt, np.zeros_like(dt), np.ones_like(dt), self.dimensions)

    def noise(self, dt: Array) -> Array:
        """Q over ``dt`` seconds, shape (...) to (..., n, n)."""
        cross = self.psd * dt**2 / 2.0
        return _blocks(self.psd * dt**3 / 3.0, cross, cross, self.psd * dt, self.dimensions)


def _blocks(a: Array, b: Array, c: Array, d: Array, size: int) -> Array:
    """``[[a I, b I], [c I, d I]]`` with identities of ``size``, shape (...) to (..., 2 size, 2 size)."""
    blocks = np.empty((*a.shape, 2, 1, 2, 1))
    blocks[..., 0, 0, 0, 0], blocks[..., 0, 0, 1, 0], blocks[..., 1, 0, 0, 0], blocks[..., 1, 0, 1, 0] = a, b, c, d
    return (blocks * identity(size)[:, None, :]).reshape(*a.shape, 2 * size, 2 * size)


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
