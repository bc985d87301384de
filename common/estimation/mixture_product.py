"""Products of Gaussian mixtures: the center's side of reports with several terms (theory.md §5, Eq. 18)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import (
    LOG_2PI,
    Array,
    Gaussian,
    Product,
    Whitened,
    gram,
    log_sum_exp,
    moments,
    multiply,
    quadratic,
    settled_whitener,
    squared_norm,
)

#: Products kept from sensor to sensor.
KEEP = 25


class _Canonical(NamedTuple):
    """Terms ``exp(zeta + h'd - d'J d / 2)`` of a mixture, d the difference to a point that all of a track share.

    Attributes:
        zeta: shape (T, A).
        h: shape (T, A, n).
        J: shape (T, A, n, n).
    """

    zeta: Array
    h: Array
    J: Array


def multiply_mixtures(log_a: Array, terms: Whitened, keep: int = KEEP) -> Product:
    """Integral and moments of a product of mixtures, one per sensor (Eq. 18).

    Mixture after mixture, pair by pair with Eq. (8), (9) in information form, where a product is a sum. Of the products
    so far the heaviest are kept, with the weight of those that are not: the sum of weights stays what it was.

    Args:
        log_a: log weights of the terms, shape (T, S, K); -inf is no term.
        terms: densities, shapes (T, S, K, n), (T, S, K, n, n), (T, S, K).
        keep: products kept.

    Returns:
        the moments of the product, shapes (T, n), (T, n, n), and the logarithm of its integral, shape (T,).
    """
    if log_a.shape[-1] == 1:
        x, W, half = terms
        density, log_c = multiply(Whitened(x[:, :, 0], W[:, :, 0], half[:, :, 0]))
        return Product(density, log_c + log_a[:, :, 0].sum(axis=-1))
    reference = terms.x[:, 0, 0]
    sensors = [_canonical(log_a[:, s], terms, s, reference) for s in range(log_a.shape[1])]
    product = sensors[0]
    value = _log_integral(product)
    for mixture in sensors[1:]:
        pairs = [(a[:, :, None] + b[:, None]) for a, b in zip(product, mixture, strict=True)]
        product = _Canonical(
            *(pair.reshape(len(pair), pair.shape[1] * pair.shape[2], *pair.shape[3:]) for pair in pairs)
        )
        value = _log_integral(product)
        if value.shape[-1] > keep:
            total = log_sum_exp(value)
            best = np.argpartition(-value, keep, axis=-1)[:, :keep]
            rows = np.arange(len(value))[:, None]
            product, value = _Canonical(*(part[rows, best] for part in product)), value[rows, best]
            lost = (total - log_sum_exp(value))[:, None]
            product, value = product._replace(zeta=product.zeta + lost), value + lost
    log_c = log_sum_exp(value)
    _, W, _ = settled_whitener(product.J)
    P = gram(W)
    mixture_density = Gaussian(reference[:, None] + np.matvec(P, product.h), P)
    return Product(moments(np.exp(value - log_c[:, None]), mixture_density), log_c)


def _canonical(log_a: Array, terms: Whitened, s: int, reference: Array) -> _Canonical:
    W = terms.W[:, s]
    u = np.matvec(W, terms.x[:, s] - reference[:, None])
    zeta = log_a - terms.half_log_det[:, s] - 0.5 * squared_norm(u) - 0.5 * LOG_2PI * u.shape[-1]
    return _Canonical(zeta, np.vecmat(u, W), gram(W))


def _log_integral(product: _Canonical) -> Array:
    """Logarithms of the integrals of all terms, shape (T, A)."""
    n = product.h.shape[-1]
    square, half = quadratic(product.h.reshape(-1, n), product.J.reshape(-1, n, n))
    integral: Array = product.zeta + (0.5 * square - half + 0.5 * LOG_2PI * n).reshape(product.zeta.shape)
    return integral
