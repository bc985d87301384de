"""The step of the likelihood ratio at the fusion center (Eq. 10, 11)."""

from __future__ import annotations

import numpy as np

from common.estimation.gaussian import Array, BoolArray, Gaussian, product


def log_lambda(before: Gaussian, after: Gaussian, log_p_bar: Array, members: BoolArray | None = None) -> Array:
    """``log Lambda = log c_after - log c_before + sum of log p_bar`` of those who reported (Eq. 10, 11).

    With all sensors replaced this is Eq. (10), with one of them Eq. (11); reports of one time taken one by one add up
    to the same number, because the constants in between cancel.

    Args:
        before: all factors predicted to the time of the reports, x of shape (..., S, n).
        after: the same with the reported factors in their places.
        log_p_bar: log weight sums, shape (..., S); 0 for a sensor that did not report.
        members: which sensors share the track, shape (..., S); None: all.

    Returns:
        log Lambda, shape (...).

    References:
        theory.md Eq. (10), (11).
    """
    share = np.ones(log_p_bar.shape) if members is None else members.astype(np.float64)
    evidence = np.where(share > 0.0, log_p_bar, 0.0).sum(axis=-1)
    result: Array = product(after, members).log_c - product(before, members).log_c + evidence
    return result
