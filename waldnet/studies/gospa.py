"""GOSPA: how far a set of tracks is from a set of targets, missed and false ones included."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from waldnet.common.estimation.gaussian import Array, BoolArray


def gospa(X: Array, Y: Array, c: float, p: float, alpha: float = 2.0) -> float:
    """Generalised optimal sub-pattern assignment metric between two sets of points.

    Args:
        X: points, shape (a, d).
        Y: points, shape (b, d).
        c: cutoff: farther points are no pair [unit of the points].
        p: exponent, at least 1.
        alpha: in (0, 2]; 2 makes a missed and a false point cost ``c^p / 2`` each.

    Returns:
        the distance [unit of the points].

    References:
        Rahmathullah, García-Fernández & Svensson, Generalized optimal sub-pattern assignment metric (2017), Eq. (1).
    """
    distance = np.linalg.vector_norm(X[:, None] - Y[None], axis=-1)
    cost = np.minimum(distance, c) ** p
    total = cost[linear_sum_assignment(cost)].sum() + c**p / alpha * abs(len(X) - len(Y))
    return float(total ** (1.0 / p))


def gospa_of_one(distance: Array, reported: BoolArray, there: BoolArray, c: float, p: float = 2.0) -> Array:
    """What ``gospa`` is for one target at most and one track at most, alpha = 2.

    Args:
        distance: between track and target where both are, shape (...).
        reported: whether there is a track, shape (...).
        there: whether there is a target, shape (...).
        c: cutoff.
        p: exponent.

    Returns:
        the distance, shape (...).
    """
    both = np.minimum(np.where(reported & there, distance, 0.0), c)
    return np.where(reported != there, c / 2.0 ** (1.0 / p), both)
