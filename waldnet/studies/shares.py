"""Shares and quantiles of runs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import betaincinv

from waldnet.common.estimation.gaussian import Array


class Share(NamedTuple):
    """A share of runs with its Clopper-Pearson bounds.

    Attributes:
        share: that of the sample; NaN where there are no runs.
        low: at least so large, at the stated confidence.
        high: at most so large.
    """

    share: float
    low: float
    high: float


def share_of(count: int, runs: int, confidence: float = 0.95) -> Share:
    """How surely a share is known; the bounds hold it with at least the given confidence whatever it is.

    References:
        Clopper & Pearson, The use of confidence or fiducial limits illustrated in the case of the binomial (1934).
    """
    if runs == 0:
        return Share(float("nan"), float("nan"), float("nan"))
    tail = (1.0 - confidence) / 2.0
    low = float(betaincinv(count, runs - count + 1, tail)) if count else 0.0
    high = float(betaincinv(count + 1, runs - count, 1.0 - tail)) if count < runs else 1.0
    return Share(count / runs, low, high)


def mean(values: Array) -> float:
    """Mean; NaN of nothing."""
    return float(values.mean()) if values.size else float("nan")


def quantile(values: Array, q: float) -> float:
    """The smallest value that a share ``q`` of the values does not exceed; NaN of nothing.

    It is a value that occurred, so quantiles of scan counts are scan counts, and -inf does no harm.
    """
    return float(np.quantile(values, q, method="inverted_cdf")) if values.size else float("nan")
