"""Densities that tracks start from: of one plot, or of two (theory.md §8)."""

from __future__ import annotations

import numpy as np

from waldnet.common.estimation.association import innovations
from waldnet.common.estimation.gating import IntArray, inside_boxes
from waldnet.common.estimation.gaussian import (
    Array,
    BoolArray,
    Gaussian,
    gram,
    joseph,
    quadratic,
    settled_whitener,
    squared_norm,
    symmetric,
    times_transposed,
)
from waldnet.common.estimation.motion import Motion, predict
from waldnet.common.estimation.sensing import Measurement

#: Standard deviation of a position around which a measurement is linearised [m].
_POINT = 1e-3
#: Information that is as good as none [1/m^2], so that what a plot says nothing of has a variance.
_NOTHING = 1e-18


def from_plots(z: Array, measurement: Measurement, stand: Array, spread: Array) -> Gaussian:
    """What a plot says of a target, and no more of what it does not measure than how targets move.

    With the measurement linearised, ``z = h(x0) + H (x - x0) + v``, and a prior N(0, diag(spread^2)) of all but the
    position: information H' R^-1 H + diag(0, spread^-2). A range rate so tells of the velocity.

    Args:
        z: plots that tell of a position, shape (M, m).
        measurement: of the sensor.
        stand: where it stood [m], shape (d,).
        spread: standard deviations of velocity, and acceleration, around 0 [m/s, m/s^2], shape (n - d,).

    Returns:
        states, shapes (M, n), (M, n, n).
    """
    d = len(stand)
    n = d + len(spread)
    x = np.zeros((len(z), n))
    x[:, :d] = measurement.locate(z, stand)
    around = np.diag(np.square(np.concatenate([np.full(d, _POINT), spread])))
    seen = measurement.linearise(Gaussian(x, np.broadcast_to(around, (len(z), n, n))), stand)
    information = np.zeros((n, n))
    information[range(d, n), range(d, n)] = spread**-2.0
    HR = np.linalg.solve(seen.R, np.broadcast_to(seen.H, (len(z), *seen.H.shape[-2:]))).mT
    known: Array = HR @ seen.H + information + _NOTHING * np.eye(n)
    P = _inverse(symmetric(known))
    return Gaussian(x + np.matvec(P @ HR, innovations(z, seen.z, seen.angular)), P)


def _inverse(information: Array) -> Array:
    """Covariances of information matrices, shape (M, n, n)."""
    try:
        return symmetric(np.linalg.inv(information).astype(np.float64))
    except np.linalg.LinAlgError:
        return gram(settled_whitener(information)[1])


def with_second(
    first: Gaussian, dt: Array, z: Array, measurement: Measurement, stand: Array, motion: Motion
) -> tuple[Gaussian, Array]:
    """What a second plot adds: one step of the Kalman filter.

    Args:
        first: states at the time of the first plots, shapes (M, n), (M, n, n).
        dt: time between the plots [s], shape (M,).
        z: second plots, shape (M, m).
        measurement: of the sensor that saw them.
        stand: where it stood [m], shape (d,).
        motion: how targets move.

    Returns:
        states at the time of the second plots, and the squared Mahalanobis distances of these from where they were
        expected, shape (M,).
    """
    predicted = predict(first, motion.transition(dt), motion.noise(dt))
    seen = measurement.linearise(predicted, stand)
    PH = times_transposed(predicted.P, seen.H)
    _, white, _ = settled_whitener(symmetric(times_transposed(PH.mT, seen.H)) + seen.R)
    w = np.matvec(white, innovations(z, seen.z, seen.angular))
    gain = times_transposed(PH, white)
    P = joseph(predicted.P, gain @ white, seen.H, seen.R)
    return Gaussian(predicted.x + np.matvec(gain, w), P), squared_norm(w)


def apart(new: Gaussian, known: Gaussian, gate: float) -> BoolArray:
    """Which densities are near no known one, nor near one before them that is near none.

    Args:
        new: in the order in which they count, shapes (Q, d), (Q, d, d).
        known: shapes (T, d), (T, d, d).
        gate: near are two whose squared Mahalanobis distance is at most this.

    Returns:
        shape (Q,).
    """
    free = np.ones(len(new.x), np.bool_)
    free[_near(new, known, gate)[0]] = False
    rows = np.flatnonzero(free)
    left = Gaussian(new.x[rows], new.P[rows])
    one, other = (rows[pair] for pair in _near(left, left, gate))
    earlier = other < one
    # In order: whoever comes first keeps those near it from starting.
    for row, before in sorted(zip(one[earlier].tolist(), other[earlier].tolist(), strict=True)):
        if free[before]:
            free[row] = False
    return free


def _near(new: Gaussian, known: Gaussian, gate: float) -> tuple[IntArray, IntArray]:
    """Rows of all pairs of new and known densities that are near each other, by the new ones."""
    if not len(new.x) or not len(known.x):
        return np.empty(0, np.intp), np.empty(0, np.intp)
    variances = new.P.diagonal(axis1=-2, axis2=-1) + known.P.diagonal(axis1=-2, axis2=-1).max(axis=0)
    # A little more, so that rounding loses none.
    boxes = inside_boxes(known.x, new.x, np.sqrt(gate * variances) * (1.0 + 1e-9))
    one, at = np.nonzero(boxes.valid)
    other = boxes.which[one, at]
    near = quadratic(known.x[other] - new.x[one], known.P[other] + new.P[one])[0] <= gate
    return one[near], other[near]
