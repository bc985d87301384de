"""Brute force: every history of a target, or of several, by the textbook's big matrices and nothing of ours.

The likelihood of a history is one multivariate normal density of all its plots together; its smoothed states are one
least-squares problem of all its states together, in information form.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

Array: TypeAlias = NDArray[np.float64]
#: For every scan the number of the target's plot, -1: missed.
History: TypeAlias = tuple[int, ...]


class Problem(NamedTuple):
    """A prior at scan 0, and scans after it.

    Attributes:
        x, P: prior.
        F, Q: from one scan to the next.
        scans: plots of each.
        H, R: of the sensor of each scan.
        p_d, rho_f: of the sensor of each scan.
    """

    x: Array
    P: Array
    F: Sequence[Array]
    Q: Sequence[Array]
    scans: Sequence[Array]
    H: Sequence[Array]
    R: Sequence[Array]
    p_d: Sequence[float]
    rho_f: Sequence[float]


def all_histories(problem: Problem) -> list[History]:
    return list(product(*(range(-1, len(scan)) for scan in problem.scans)))


def joint_histories(problem: Problem, targets: int) -> Iterator[tuple[History, ...]]:
    """Histories of so many numbered targets, no plot being that of two."""
    for histories in product(all_histories(problem), repeat=targets):
        plots = [(k, j) for history in histories for k, j in enumerate(history) if j >= 0]
        if len(set(plots)) == len(plots):
            yield histories


def log_likelihood(problem: Problem, history: History) -> float:
    """log p(Z, history | target) / p(Z | no target)."""
    mean, P = problem.x, problem.P
    means, covariance = [], np.zeros((0, 0))
    cross = np.zeros((len(mean), 0))
    for F, Q in zip(problem.F, problem.Q, strict=True):
        mean, P, cross = F @ mean, F @ P @ F.T + Q, F @ cross
        # Covariance of the newest state with all states so far, itself last.
        covariance = np.block([[covariance, cross.T], [cross, P]])
        cross = np.hstack([cross, P])
        means.append(mean)
    total, rows, z, R = 0.0, [], [], []
    for k, j in enumerate(history):
        total += float(np.log(1.0 - problem.p_d[k]) if j < 0 else np.log(problem.p_d[k] / problem.rho_f[k]))
        if j >= 0:
            row = np.zeros((len(problem.H[k]), len(covariance)))
            row[:, k * len(mean) : (k + 1) * len(mean)] = problem.H[k]
            rows.append(row)
            z.append(problem.scans[k][j])
            R.append(problem.R[k])
    if not rows:
        return total
    H = np.vstack(rows)
    noise = np.zeros((len(H), len(H)))
    at = 0
    for block in R:
        noise[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    plots = multivariate_normal(H @ np.concatenate(means), H @ covariance @ H.T + noise)
    return total + float(plots.logpdf(np.concatenate(z)))


def least_squares(problem: Problem, history: History) -> tuple[Array, Array]:
    """Smoothed states and covariances at the scans, shapes (K, n), (K, n, n)."""
    n, count = len(problem.x), len(problem.scans)
    J, h = np.zeros(((count + 1) * n, (count + 1) * n)), np.zeros((count + 1) * n)
    J[:n, :n] = np.linalg.inv(problem.P)
    h[:n] = J[:n, :n] @ problem.x
    for k, j in enumerate(history):
        A = np.zeros((n, len(h)))
        A[:, k * n : (k + 1) * n], A[:, (k + 1) * n : (k + 2) * n] = -problem.F[k], np.eye(n)
        J += A.T @ np.linalg.inv(problem.Q[k]) @ A
        if j >= 0:
            now = slice((k + 1) * n, (k + 2) * n)
            gain = problem.H[k].T @ np.linalg.inv(problem.R[k])
            J[now, now] += gain @ problem.H[k]
            h[now] += gain @ problem.scans[k][j]
    P = np.linalg.inv(J)
    x = (P @ h).reshape(count + 1, n)
    return x[1:], np.stack([P[k * n : (k + 1) * n, k * n : (k + 1) * n] for k in range(1, count + 1)])
