"""Integrals: adaptive quadrature of many functions at once, each over its own panels; sigma points."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from common.estimation.gaussian import Array, BoolArray

#: Sigmas beyond which nothing is left: Phi(-8.5) = 1e-17 vanishes beside 1.
CERTAIN = 8.5
#: Largest difference between a panel and its two halves; the halves are better by orders of magnitude.
_TOLERANCE = 1e-9
_BISECTIONS = 30
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
        rough = np.abs(left + right - whole) > _TOLERANCE
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
        value[part] = half * (integrand(owner[part], u) @ _WEIGHTS)
    return value


def unit_points(n: int) -> tuple[Array, Array]:
    """Points and weights with the mean, the covariance and, for n <= 3, the fourth moments of N(0, I) along the axes.

    The unscented transform with its points sqrt(3) away; in more than three dimensions its middle weight would be
    negative, and the cubature rule, sqrt(n) away and without a middle, takes its place.

    Returns:
        points, shape (2 n + 1, n), and weights, shape (2 n + 1,), none negative.

    References:
        Julier & Uhlmann, Unscented filtering (2004); Arasaratnam & Haykin, Cubature Kalman filters (2009).
    """
    spread = float(max(n, 3))
    axes = np.sqrt(spread) * np.eye(n)
    weights = np.full(2 * n + 1, 0.5 / spread)
    weights[0] = 1.0 - n / spread
    return np.concatenate([np.zeros((1, n)), axes, -axes]), weights


@cache
def product_points(n: int) -> tuple[Array, Array]:
    """Points and weights of the product rule of Gauss and Hermite for N(0, I), five points an axis.

    Returns:
        points, shape (5^n, n), and weights, shape (5^n,), to read only.
    """
    node, weight = np.polynomial.hermite_e.hermegauss(5)
    points = np.stack(np.meshgrid(*[node] * n, indexing="ij"), axis=-1).reshape(-1, n)
    weights = np.stack(np.meshgrid(*[weight / weight.sum()] * n, indexing="ij"), axis=-1).reshape(-1, n).prod(axis=-1)
    points.flags.writeable = weights.flags.writeable = False
    return points, weights
