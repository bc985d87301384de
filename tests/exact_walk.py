"""Exact figures of Wald's test for a normal mean, from integral equations.

Observations are N(0, 1) under h0 and N(d, 1) under h1, so log LR is a random walk from 0 with steps
``d z - d^2 / 2``: N(-d^2 / 2, d^2) under h0, N(d^2 / 2, d^2) under h1. With f the density of a step, what happens to a
walk that stands at x inside [a, b] obeys Fredholm equations of the second kind:

    P(leaves above | x) = P(x + Y > b) + int_a^b P(leaves above | y) f(y - x) dy
    E(steps | x)        = 1            + int_a^b E(steps | y)        f(y - x) dy

Gauss-Legendre nodes turn them into linear equations (Nystroem); f is smooth, so the error falls exponentially.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from waldnet.common.estimation.gaussian import Array


class Exit(NamedTuple):
    """How a walk from 0 leaves an interval."""

    above: float
    steps: float


def leave(a: float, b: float, d: float, under_h1: bool, nodes: int = 400) -> Exit:
    """Probability to leave [a, b] above, and mean number of steps, from 0."""
    mean = 0.5 * d**2 if under_h1 else -0.5 * d**2
    y, weights = np.polynomial.legendre.leggauss(nodes)
    y, weights = 0.5 * (b - a) * (y + 1.0) + a, 0.5 * (b - a) * weights

    def kernel(x: Array) -> Array:
        return norm.pdf(y - x[:, None], mean, d) * weights

    def first(x: Array) -> Array:
        return np.stack([norm.sf(b - x, mean, d), np.ones_like(x)], axis=-1)

    solution = np.linalg.solve(np.eye(nodes) - kernel(y), first(y))
    origin = np.zeros(1)
    above, steps = (first(origin) + kernel(origin) @ solution)[0]
    return Exit(float(above), float(steps))


def ever_above(b: float, d: float) -> float:
    """P(sup LR >= e^b | h0) without a lower threshold: one so low that no walk comes back from it (e^-35)."""
    return leave(-35.0, b, d, under_h1=False, nodes=400).above


def renewal_constant(d: float) -> float:
    """Limit of e^b P(sup LR >= e^b | h0): (2 / d^2) exp(-2 sum_n Phi(-d sqrt(n) / 2) / n).

    References:
        Siegmund, Sequential analysis (1985), Eq. 8.49 and Theorem 8.51.
    """
    n = np.arange(1, 200_000)
    return float(2.0 / d**2 * np.exp(-2.0 * np.sum(norm.cdf(-0.5 * d * np.sqrt(n)) / n)))
