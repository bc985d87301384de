"""Detection probabilities: how they depend on the target's state, and what several sensors detect together."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from waldnet.common.estimation.gaussian import Array, Gaussian, as_array, cholesky
from waldnet.common.estimation.quadrature import product_points
from waldnet.common.estimation.sight import approach, radial_speed


class Detection(Protocol):
    """How the state of a target lowers the detection probability of a sensor."""

    def share(self, x: Array, stand: Array) -> Array:
        """The detection probability of states relative to the sensor's ``p_d``, shapes (..., n), (d,) to (...)."""
        ...

    def mean_share(self, state: Gaussian, stand: Array) -> Array:
        """Mean of ``share`` over the densities of states.

        Args:
            state: shapes (..., n), (..., n, n), position first.
            stand: where the sensor stands [m], shape (d,).

        Returns:
            shape (...).
        """
        ...


class Constant(NamedTuple):
    """Detection does not depend on the state."""

    def share(self, x: Array, stand: Array) -> Array:  # noqa: ARG002
        """1, shapes (..., n), (d,) to (...)."""
        return np.ones(x.shape[:-1])

    def mean_share(self, state: Gaussian, stand: Array) -> Array:  # noqa: ARG002
        """1, shape (...)."""
        return np.ones(state.x.shape[:-1])


class Swerling(NamedTuple):
    """A target that fluctuates from scan to scan (Swerling I) at a mean signal-to-noise ratio that falls with r^-4.

    Attributes:
        p_fa: probability of a false alarm in a resolution cell.
        snr: mean signal-to-noise ratio, as a plain ratio, at the range ``at_range``.
        at_range: [m].

    References:
        theory.md §10; P. Swerling, Probability of detection for fluctuating targets (1960).
    """

    p_fa: float
    snr: float
    at_range: float

    def share(self, x: Array, stand: Array) -> Array:
        """``p_fa^(1 / (1 + snr))`` at the range of states, shapes (..., n), (d,) to (...)."""
        square = np.square(x[..., : len(stand)] - stand).sum(axis=-1)
        # 1 / (1 + snr (r0/r)^4) without a division by zero at the sensor's own place.
        fourth = np.square(square / self.at_range**2)
        return np.asarray(self.p_fa ** (fourth / (fourth + self.snr)))

    def mean_share(self, state: Gaussian, stand: Array) -> Array:
        """Mean over the densities, by a product rule of Gauss and Hermite in the position, shape (...).

        Largest error measured 3e-8, standard deviations of the position up to a tenth of ``at_range``.
        """
        d = len(stand)
        xi, w = product_points(d, 5)
        L = cholesky(state.P[..., :d, :d])
        positions = state.x[..., None, :d] + xi @ L.mT
        return np.asarray(np.vecdot(self.share(positions, stand), w))


class Notch(NamedTuple):
    """The clutter notch of a GMTI radar: it does not see who moves across its line of sight.

    ``share = 1 - c_n N(n_c; 0, v_n)``, n_c the speed of the target away from the sensor; the clutter stands still.

    Attributes:
        mdv: minimum detectable velocity, at which half of ``p_d`` is left [m/s].

    References:
        theory.md §10; W. Koch, Tracking and sensor data fusion (2014), §7.
    """

    mdv: float

    @property
    def v_n(self) -> float:
        """Variance of the fictitious measurement ``n_c = 0`` [m^2/s^2]."""
        return float(self.mdv**2 / (2.0 * np.log(2.0)))

    def share(self, x: Array, stand: Array) -> Array:
        """``1 - 2^-(n_c / mdv)^2``, shapes (..., n), (d,) to (...)."""
        return -np.expm1(-0.5 * np.square(radial_speed(x, stand)) / self.v_n)

    def mean_share(self, state: Gaussian, stand: Array) -> Array:
        """Mean over the densities, n_c linearised: ``1 - c_n N(0; n_c, S_n)``, shape (...)."""
        return -np.expm1(self.log_blind(state, stand))

    def log_blind(self, state: Gaussian, stand: Array) -> Array:
        """``log c_n N(0; n_c, S_n)``, the probability that the notch covers the target, shape (...), at most 0."""
        seen = approach(state, stand)
        variance = np.vecdot(seen.slope, np.matvec(state.P, seen.slope)) + seen.rest
        return log_blind(seen.speed, variance, self.v_n)


def log_blind(speed: Array, variance: Array, v_n: float) -> Array:
    """``log c_n N(0; speed, variance + v_n)`` with ``c_n = sqrt(2 pi v_n)``, shape (...)."""
    return np.asarray(-0.5 * (np.log1p(variance / v_n) + np.square(speed) / (variance + v_n)))


def cumulative(p_d: ArrayLike) -> Array:
    """Probability that at least one of the sensors detects, ``1 - prod (1 - p_d^s)``.

    Args:
        p_d: detection probabilities, shape (..., S).

    Returns:
        shape (...).
    """
    p_d = as_array(p_d)
    with np.errstate(divide="ignore"):  # of a sensor that never misses the logarithm is -inf, as it should be
        return np.asarray(-np.expm1(np.log1p(-p_d).sum(axis=-1)))


def revisit_interval(intervals: ArrayLike) -> Array:
    """Mean time from scan to scan of several sensors, ``1/dT_c = sum 1/dT_s``.

    Args:
        intervals: of the sensors' scans [s], shape (..., S).

    Returns:
        mean interval [s], shape (...).
    """
    return np.asarray(1.0 / (1.0 / as_array(intervals)).sum(axis=-1))


def cumulative_rate(p_d: ArrayLike, intervals: ArrayLike) -> Array:
    """Mean cumulative detection probability per mean revisit interval, ``1 - prod (1 - p_d^s)^(dT_c / dT_s)``.

    Args:
        p_d: detection probabilities, shape (..., S).
        intervals: of the sensors' scans [s], shape (..., S).

    Returns:
        shape (...).
    """
    p_d, intervals = as_array(p_d), as_array(intervals)
    weight = revisit_interval(intervals)[..., None] / intervals
    with np.errstate(divide="ignore"):
        return np.asarray(-np.expm1((weight * np.log1p(-p_d)).sum(axis=-1)))
