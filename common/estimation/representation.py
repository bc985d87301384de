"""How the density of a track is shared among the sensors: naive, federated, dkf (theory.md §4)."""

from __future__ import annotations

from typing import NamedTuple

from waldnet.common.estimation.gaussian import (
    Array,
    Gaussian,
    gram,
    joseph,
    settled_whitener,
    symmetric,
    times_transposed,
)
from waldnet.common.estimation.motion import Motion, predict


class Share(NamedTuple):
    """A sensor's share of prior and process noise.

    Attributes:
        multiplicity: factor on P0 and Q: n_sensors for ``federated`` and ``dkf``, 1 for ``naive`` and for the
            association filter, which keeps the honest prior.
    """

    multiplicity: float

    def start(self, prior: Gaussian) -> Gaussian:
        """Factor of a track that starts with ``prior``, shapes (..., n), (..., n, n)."""
        return Gaussian(prior.x, self.multiplicity * prior.P)

    def predict(self, factor: Gaussian, motion: Motion, dt: Array) -> Gaussian:
        """Relaxed evolution over ``dt`` seconds (Eq. 5).

        Args:
            factor: shapes (..., n), (..., n, n).
            motion: the motion model.
            dt: intervals [s], shape broadcast against the batch axes.

        Returns:
            the predicted factors.
        """
        return predict(factor, motion.transition(dt), self.multiplicity * motion.noise(dt))


class Global(NamedTuple):
    """Globalisation of the distributed Kalman filter: ``x~^s = G_s x^s``, ``P~`` common to all.

    Attributes:
        P: common covariance, shape (..., n, n).
        G: gains, shape (..., S, n, n).
    """

    P: Array
    G: Array


def globalise(P: Array) -> Global:
    """Give every factor the same covariance without changing their product (theory.md §4, ``dkf``).

    ``P~ = S (sum_s (P^s)^-1)^-1`` and ``x~^s = P~ (P^s)^-1 x^s``.

    Args:
        P: covariances of all factors, shape (..., S, n, n).

    Returns:
        common covariance and gains.

    References:
        theory.md §4; F. Govaers, Sequential likelihood ratio test based on the distributed Kalman filter (2015).
    """
    n_sensors = P.shape[-3]
    P, W, _ = settled_whitener(P)
    information = gram(W)
    _, V, _ = settled_whitener(information.sum(axis=-3))
    common = symmetric(n_sensors * gram(V))
    return Global(common, common[..., None, :, :] @ information)


def shrink(P: Array, H: Array, R: Array) -> Array:
    """Covariance of a Kalman update, known before the plot is: p_d = 1 and no false plots.

    Args:
        P: predicted covariances, shape (..., n, n).
        H: measurement matrix, shape (m, n).
        R: measurement noise, shape (m, m).

    Returns:
        updated covariances, shape (..., n, n).
    """
    PH = times_transposed(P, H)
    _, W, _ = settled_whitener(symmetric(times_transposed(PH.mT, H)) + R)
    return joseph(P, PH @ gram(W), H, R)
