"""How long sensors see a target and lose it, and how long their errors last."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from waldnet.common.estimation.gaussian import Array, BoolArray
from waldnet.common.estimation.visibility import Visibility

#: Errors so long apart are compared [s].
LAG_S = 2.0


class Watch(NamedTuple):
    """A target within reach of a sensor, scan after scan.

    Attributes:
        times_s: of the scans, shape (K,).
        found: whether it has a plot, shape (K,).
        errors: of its plots, shape (K, m); NaN where it has none.
    """

    times_s: Array
    found: Array
    errors: Array


class Persistence(NamedTuple):
    """What fits best.

    Attributes:
        p_d: detection probability while visible.
        visibility: mean times.
        gained: log likelihood beside that of misses which are independent, per scan.
    """

    p_d: float
    visibility: Visibility
    gained: float


def watches(times_s: Array, within: BoolArray, errors: Array) -> list[Watch]:
    """The stretches of scans during which a target is within reach.

    Args:
        times_s: of all scans, shape (K,).
        within: whether the target is in reach, shape (K,).
        errors: of its plots, NaN where there is none, shape (K, m).
    """
    stretches = (list(rows) for there, rows in groupby(range(len(times_s)), key=lambda k: bool(within[k])) if there)
    return [Watch(times_s[rows], np.isfinite(errors[rows, 0]), errors[rows]) for rows in stretches]


def fitted(seen_by: Sequence[Watch]) -> Persistence:
    """The chain of visible and hidden that makes the hits and misses most probable."""

    def cost(parameters: Array) -> float:
        p_d, times_s = float(expit(parameters[0])), np.exp(np.clip(parameters[1:], -5.0, 10.0))
        return -sum(_log_likelihood(watch, p_d, Visibility(*times_s.tolist())) for watch in seen_by)

    best = min(
        (minimize(cost, begin, method="Nelder-Mead") for begin in ((2.0, 2.0, 0.0), (1.0, 1.0, 1.0))),
        key=lambda result: float(result.fun),
    )
    found = np.concatenate([watch.found for watch in seen_by])
    alone = np.log(found.mean()) * found.sum() + np.log(1.0 - found.mean()) * (~found).sum()
    visibility = Visibility(*np.exp(np.clip(best.x[1:], -5.0, 10.0)).tolist())
    return Persistence(float(expit(best.x[0])), visibility, float(-best.fun - alone) / len(found))


def _log_likelihood(watch: Watch, p_d: float, visibility: Visibility) -> float:
    """Of the hits and misses, by the forward algorithm."""
    dt = np.diff(watch.times_s, prepend=watch.times_s[0])
    back, stay = (visibility.predict(np.full(len(dt), before), dt).tolist() for before in (0.0, 1.0))
    v, p = visibility.share, np.empty(len(dt))
    for k, found in enumerate(watch.found.tolist()):
        v = back[k] + (stay[k] - back[k]) * v
        hit = min(v * p_d, 1.0 - 1e-12)
        p[k] = hit if found else 1.0 - hit
        v = 1.0 if found else (v - hit) / (1.0 - hit)
    return float(np.log(p).sum())


def correlation(seen_by: Sequence[Watch], lag_s: float = LAG_S) -> float:
    """Of the errors, biases included, of plots that lie about so long apart; NaN where there are none."""
    both = np.zeros(3)
    for watch in seen_by:
        t, e = watch.times_s[watch.found], watch.errors[watch.found]
        later = np.searchsorted(t, t + 0.975 * lag_s)
        first = np.flatnonzero(later < len(t))
        second = later[first]
        close = np.abs(t[second] - t[first] - lag_s) < 0.25 * lag_s
        a, b = e[first[close]], e[second[close]]
        both += [(a * b).sum(), (a * a).sum(), (b * b).sum()]
    return float(both[0] / np.sqrt(both[1] * both[2])) if both[1] > 0.0 else float("nan")
