"""Sensors as likelihoods: what a plot measures, where, and how surely."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from common.estimation.field_of_view import FieldOfView
from common.estimation.gaussian import Array, Gaussian


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

    def observe(self, x: Array, origin: Array) -> Array:
        """The plot of states ``x`` without noise, seen from ``origin``, shapes (..., n), (d,) to (..., m)."""
        ...

    def linearise(self, density: Gaussian, origin: Array) -> Linearised:
        """Expected plot, Jacobian and noise where states are distributed as ``density``, seen from ``origin``."""
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

    def observe(self, x: Array, origin: Array) -> Array:  # noqa: ARG002 (a position is seen from anywhere)
        """The position of states ``x``, shape (..., n) to (..., m)."""
        return x[..., : self.m]

    def linearise(self, density: Gaussian, origin: Array) -> Linearised:
        """Expected plot, Jacobian and noise: exact, as a position is linear in the state."""
        return Linearised(self.observe(density.x, origin), self.H, self.R)


class Sensor(NamedTuple):
    """The sensor model that node, center and simulation share.

    Attributes:
        measurement: what a plot measures.
        p_d: detection probability inside the field of view.
        false_plots: mean number of false plots per scan, uniform in the field of view.
        field_of_view: where it sees.
    """

    measurement: Measurement
    p_d: float
    false_plots: float
    field_of_view: FieldOfView

    @property
    def log_rho_f(self) -> float:
        """Logarithm of the density of false plots [1/volume of z]."""
        return float(np.log(self.false_plots) - np.log(self.field_of_view.volume))

    def detection_probability(self, state: Gaussian, stand: Array, center: Array) -> Array:  # noqa: ARG002
        """``p_d`` weighted by the probability that the state lies inside the field of view.

        Args:
            state: predicted states, shapes (..., n), (..., n, n), position first.
            stand: where the sensor stands [m], shape (d,).
            center: of the field of view [m], shape (..., d).

        Returns:
            detection probabilities, shape (...); 0 where the sensor cannot see.
        """
        d = center.shape[-1]
        position = Gaussian(state.x[..., :d], state.P[..., :d, :d])
        return self.p_d * self.field_of_view.probability_inside(position, center)
