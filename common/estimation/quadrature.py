"""Integrals: adaptive quadrature of many functions at once, each over its own panels; sigma points."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from waldnet.common.estimation.gaussian import Array, BoolArray

#: Sigmas beyond which nothing is left: Phi(-8.5) = 1e-17 vanishes beside 1.
CERTAIN = 8.5
#: Largest difference between a panel and its two halves; the halves are better by orders of magnitude.
_TOLERANCE = 1e-9
_BISECTIONS = 30
#: A function that needs so many panels at once is rough everywhere by rounding, and more do not help.
_CROWDED = 256
#: Panels evaluated at once: bounds the memory whatever the batch.
_CHUNK = 1024
# Enough for a smooth edge within +-8.5 sigmas, so that most integrals need no bisection.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)

Indices: TypeAlias = NDArray[np.intp]
#: Values of integrals ``owner``, shape (K,), at points u, shape (K, nodes).
Integrand: TypeAlias = Callable[[Indices, Array], Array]


def decide(margin: Array, exact: Callable[[BoolArray], Array]) -> Array:
    """Probabilities by margin alone where that is certain, by ``exact`` where it is not.

    Args:
        margin: distance of the mean from the edge in sigmas, negative outside, shape (...).
        exact: gives the probabilities of the entries that a mask of shape (...) selects, shape (N,).

    Returns:
        probabilities, shape (...).
    """
    probability = np.array(margin >= CERTAIN, dtype=np.float64)
    near = np.abs(margin) < CERTAIN
    if near.any():
        probability[near] = np.clip(exact(near), 0.0, 1.0)
    return probability


def interval(lower: Array, upper: Array) -> Array:
    """Probability that a standard normal number lies between ``lower`` and ``upper``, shape (...)."""
    return ndtr(upper) - ndtr(lower)


def normal(u: Array) -> Array:
    """Standard normal density, shape (...)."""
    density: Array = np.exp(-0.5 * u * u) / np.sqrt(2.0 * np.pi)
    return density


def integrate(integrand: Integrand, breaks: Array) -> Array:
    """Integrate many functions at once, each over its own panels, bisecting these until they are resolved.

    Args:
        integrand: the functions.
        breaks: ends of the panels, ascending, shape (N, panels + 1).

    Returns:
        integrals, shape (N,).
    """
    total = np.zeros(len(breaks))
    owner, panel = np.nonzero(breaks[:, :-1] < breaks[:, 1:])
    a, b = breaks[owner, panel], breaks[owner, panel + 1]
    whole = _gauss(integrand, owner, a, b)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (a + b)
        left, right = _gauss(integrand, owner, a, middle), _gauss(integrand, owner, middle, b)
        crowded = np.bincount(owner, minlength=total.size) > _CROWDED
        rough = (np.abs(left + right - whole) > _TOLERANCE) & ~crowded[owner]
        total += np.bincount(owner[~rough], (left + right)[~rough], total.size)
        if not rough.any():
            break
        owner = np.tile(owner[rough], 2)
        a, b = np.concatenate([a[rough], middle[rough]]), np.concatenate([middle[rough], b[rough]])
        whole = np.concatenate([left[rough], right[rough]])
    return total


def _gauss(integrand: Integrand, owner: Indices, lower: Array, upper: Array) -> Array:
    """Gauss-Legendre rule on panels of the integrals ``owner``, shapes (K,) to (K,)."""
    value = np.empty_like(lower)
    for start in range(0, lower.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        half = 0.5 * (upper[part] - lower[part])
        u = (lower[part] + half)[:, None] + half[:, None] * _NODES
        # A matrix product rounds a row differently among other rows, and an integral must not depend on its batch.
        value[part] = half * (integrand(owner[part], u) * _WEIGHTS).sum(axis=-1)
    return value


@cache
def product_points(n: int, per_axis: int) -> tuple[Array, Array]:
    """Points and weights of the product rule of Gauss and Hermite for N(0, I).

    Args:
        n: dimensions.
        per_axis: points an axis.

    Returns:
        points, shape (per_axis^n, n), and weights, shape (per_axis^n,), to read only.
    """
    node, weight = np.polynomial.hermite_e.hermegauss(per_axis)
    points = np.stack(np.meshgrid(*[node] * n, indexing="ij"), axis=-1).reshape(-1, n)
    weights = np.stack(np.meshgrid(*[weight / weight.sum()] * n, indexing="ij"), axis=-1).reshape(-1, n).prod(axis=-1)
    points.flags.writeable = weights.flags.writeable = False
    return points, weights


@cache
def sigma_points(curved: int, straight: int) -> tuple[Array, Array]:
    """Points and weights for N(0, I), for functions that are curved in some numbers and linear in others.

    The product rule with three points an axis in the former: unlike the 2 n + 1 points of the unscented transform they
    see the corners, without which a bend between two axes would pass for a line. The cubature rule in the latter.

    Args:
        curved: how many numbers, counted from the first, a function is curved in.
        straight: how many more it is linear in, given those.

    Returns:
        points, shape (K, curved + straight), and weights, shape (K,), all positive, to read only.

    References:
        S. Särkkä, Bayesian filtering and smoothing (2013), §6.3; Arasaratnam & Haykin, Cubature Kalman filters (2009).
    """
    points, weights = product_points(curved, 3)
    if straight == 0:
        return points, weights
    axes = np.sqrt(straight) * np.concatenate([np.eye(straight), -np.eye(straight)])
    both = np.concatenate([np.repeat(points, len(axes), axis=0), np.tile(axes, (len(points), 1))], axis=-1)
    shares = np.repeat(weights / len(axes), len(axes))
    both.flags.writeable = shares.flags.writeable = False
    return both, shares
