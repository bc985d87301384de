"""Sigma points: how a measurement function carries a Gaussian over, without its slope (statistical linearisation)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import Array, Gaussian, cholesky
from waldnet.common.estimation.quadrature import sigma_points
from waldnet.common.estimation.sensing import Linearised, Measurement


class SigmaPoint(NamedTuple):
    """A measurement that is linearised by sigma points instead of its Jacobian.

    Attributes:
        measurement: what a plot measures.
        d: size of the position, in which a plot is curved.
        doppler: whether a plot depends on the velocity too, linearly so.
    """

    measurement: Measurement
    d: int
    doppler: bool

    @property
    def m(self) -> int:
        """Size of a plot."""
        return self.measurement.m

    @property
    def R(self) -> Array:
        """Measurement noise, shape (m, m)."""
        return self.measurement.R

    @property
    def angular(self) -> tuple[int, ...]:
        """Which numbers of a plot are angles around a circle."""
        return self.measurement.angular

    def moving(self, velocity: Array) -> SigmaPoint:
        """The measurement of a sensor that moves with a velocity over ground [m/s], shape (d,)."""
        return self._replace(measurement=self.measurement.moving(velocity))

    def observe(self, x: Array, origin: Array) -> Array:
        """The plot of states ``x`` without noise, seen from ``origin``, shapes (..., n), (d,) to (..., m)."""
        return self.measurement.observe(x, origin)

    def linearise(self, density: Gaussian, origin: Array) -> Linearised:
        """The line that fits the measurement best over the whole ``density``, what it leaves out added to the noise.

        With points ``x_i = x + L xi_i`` and weights w_i, deviations ``d_i`` of the plots from their mean z:
        ``G = sum w_i d_i xi_i'`` is cov(z, x) L^-T, so ``H = cov(z, x) P^-1 = G L^-1``; the rest
        ``d_i - G xi_i`` belongs to no line.

        References:
            theory.md §2; S. Särkkä, Bayesian filtering and smoothing (2013), §5.4 and 5.5.
        """
        xi, w = sigma_points(self.d, self.d if self.doppler else 0)
        used = xi.shape[-1]
        L = cholesky(density.P[..., :used, :used])
        states = np.repeat(density.x[..., None, :], len(w), axis=-2)
        states[..., :used] += xi @ L.mT
        plots = self.observe(states, origin)
        angular = self.angular
        z = np.vecmat(w, plots)
        for i in angular:
            z[..., i] = circular_mean(plots[..., i], w)
        deviations = _wrapped(plots - z[..., None, :], angular)
        shift = np.vecmat(w, deviations)
        deviations = deviations - shift[..., None, :]
        G = (w[:, None] * deviations).mT @ xi
        rest = deviations - xi @ G.mT
        H = np.zeros((*z.shape, density.x.shape[-1]))
        H[..., :used] = np.linalg.solve(L.mT, G.mT).mT
        return Linearised(z + shift, H, self.R + (w[:, None] * rest).mT @ rest, angular)

    def locate(self, z: Array, origin: Array) -> Array:
        """The positions that plots tell of, shapes (..., m), (d,) to (..., d)."""
        return self.measurement.locate(z, origin)

    def fold(self, z: Array) -> Array:
        """Plots whose noise led out of the range of their numbers, as the sensor would give them, shape (..., m)."""
        return self.measurement.fold(z)

    def draw_false(self, rng: np.random.Generator, places: Array, stand: Array) -> Array:
        """False plots at given positions, shapes (M, d), (d,) to (M, m)."""
        return self.measurement.draw_false(rng, places, stand)

    def space(self, volume: float) -> float:
        """Size of the plot space that false plots come from, up to ``log_stretch``."""
        return self.measurement.space(volume)

    def log_stretch(self, z: Array) -> Array | None:
        """Logarithm of the volume per unit of plot space, shape (..., m) to (...); None where it is 0."""
        return self.measurement.log_stretch(z)


def circular_mean(angles: Array, w: Array) -> Array:
    """Direction of the mean of unit vectors, shapes (..., K), (K,) to (...)."""
    return np.arctan2(np.sin(angles) @ w, np.cos(angles) @ w)


def _wrapped(differences: Array, angular: tuple[int, ...]) -> Array:
    """Differences of plots, angles the short way around, shape (..., m)."""
    for i in angular:
        differences[..., i] = np.remainder(differences[..., i] + np.pi, 2.0 * np.pi) - np.pi
    return differences
