"""theory.md written out a second time, with loops over sensors, histories and plots.

Nothing of ``common.estimation`` is used here.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

Array: TypeAlias = NDArray[np.float64]


class Density(NamedTuple):
    x: Array
    P: Array


class Term(NamedTuple):
    """A term ``e^g N(x; ...)`` of a factor."""

    log_g: float
    density: Density


class History(NamedTuple):
    """One history of associations, in the honest filter and in the factor (Eq. 17).

    With both densities equal, ``log_g`` is the logarithm of the lambda of Eq. (15).
    """

    log_w: float
    log_g: float
    honest: Density
    factor: Density


class Seer(NamedTuple):
    """A sensor of position that sees everywhere."""

    sigma: Sequence[float]
    p_d: float
    rho_f: float


def predicted(density: Density, dt: float, psd: float, share: float) -> Density:
    """Eq. (5): constant velocity, noise of ``share`` times the power spectral density."""
    d = len(density.x) // 2
    one, zero = np.eye(d), np.zeros((d, d))
    F = np.block([[one, dt * one], [zero, one]])
    Q = psd * np.block([[dt**3 / 3 * one, dt**2 / 2 * one], [dt**2 / 2 * one, dt * one]])
    return Density(F @ density.x, F @ density.P @ F.T + share * Q)


def log_normal(d: Array, S: Array) -> float:
    """log N(d; 0, S)."""
    _, log_det = np.linalg.slogdet(2 * np.pi * S)
    return -0.5 * float(log_det + d @ np.linalg.solve(S, d))


def combined(one: Density, other: Density) -> Density:
    """Eq. (9) of two factors."""
    J1, J2 = np.linalg.inv(one.P), np.linalg.inv(other.P)
    P = np.linalg.inv(J1 + J2)
    return Density(P @ (J1 @ one.x + J2 @ other.x), P)


def folded(factors: Sequence[Density]) -> tuple[float, Density]:
    """Eq. (8) and (9), one sensor after the other."""
    log_c, fused = 0.0, factors[0]
    for factor in factors[1:]:
        log_c += log_normal(factor.x - fused.x, fused.P + factor.P)
        fused = combined(fused, factor)
    return log_c, fused


def mean_of(log_weights: Sequence[float], densities: Sequence[Density]) -> Density:
    """Moments of a mixture."""
    a = np.exp(np.array(log_weights) - logsumexp(log_weights))
    near = densities[int(np.argmax(a))].x
    shift = sum((w * (density.x - near) for w, density in zip(a, densities, strict=True)), np.zeros(len(near)))
    P = np.zeros((len(near), len(near)))
    for w, density in zip(a, densities, strict=True):
        d = density.x - near - shift
        P += w * (density.P + np.outer(d, d))
    return Density(near + shift, P)


def multiplied(factors: Sequence[Sequence[Term]]) -> tuple[float, Density]:
    """E of Eq. (18) and the moments of the product, over all combinations of terms."""
    log_weights, densities = [], []
    for terms in product(*factors):
        log_c, density = folded([term.density for term in terms])
        log_weights.append(log_c + sum(term.log_g for term in terms))
        densities.append(density)
    return float(logsumexp(log_weights)), mean_of(log_weights, densities)


def corrected(density: Density, z: Array, seer: Seer) -> tuple[Density, float]:
    """A Kalman update, and log N(z; H x, S)."""
    H, R = np.eye(len(z), len(density.x)), np.diag(np.square(seer.sigma))
    S, nu = H @ density.P @ H.T + R, z - H @ density.x
    K = density.P @ H.T @ np.linalg.inv(S)
    A = np.eye(len(density.x)) - K @ H
    return Density(density.x + K @ nu, A @ density.P @ A.T + K @ R @ K.T), log_normal(nu, S)


def branched(histories: Sequence[History], plots: Array, seer: Seer) -> list[History]:
    """All sons of all histories (Eq. 15, 17); no gate."""
    sons = []
    for history in histories:
        if seer.p_d < 1.0:
            log_miss = float(np.log(1.0 - seer.p_d))
            sons.append(history._replace(log_w=history.log_w + log_miss, log_g=history.log_g + log_miss))
        for z in plots:
            log_hit = float(np.log(seer.p_d / seer.rho_f))
            honest, log_w = corrected(history.honest, z, seer)
            factor, log_g = corrected(history.factor, z, seer)
            log_w, log_g = history.log_w + log_hit + log_w, history.log_g + log_hit + log_g
            sons.append(History(log_w, log_g, honest, factor))
    return sons


def aged(histories: Sequence[History], dt: float, psd: float, share: float) -> list[History]:
    """All histories after ``dt`` seconds: the honest filter with the noise as it is, the factor with a share of it."""
    return [
        history._replace(
            honest=predicted(history.honest, dt, psd, 1.0), factor=predicted(history.factor, dt, psd, share)
        )
        for history in histories
    ]


def merged(histories: Sequence[History]) -> History:
    """Both densities by moments, ``g = sum a (g - log a)`` with the shares a of the honest weights."""
    log_w = [history.log_w for history in histories]
    total = float(logsumexp(log_w))
    log_g = sum(float(np.exp(h.log_w - total)) * (h.log_g - (h.log_w - total)) for h in histories)
    honest = mean_of(log_w, [history.honest for history in histories])
    factor = mean_of(log_w, [history.factor for history in histories])
    return History(total, log_g, honest, factor)


def told(histories: Sequence[History], count: int) -> list[Term]:
    """The terms of a report: the heaviest by honest weight, the last one all that is left."""
    ordered = sorted(histories, key=lambda history: -history.log_w)
    kept = ordered if len(ordered) <= count else [*ordered[: count - 1], merged(ordered[count - 1 :])]
    return [Term(history.log_g, history.factor) for history in kept]
