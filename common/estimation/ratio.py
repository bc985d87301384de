"""The step of the likelihood ratio at the fusion center (Eq. 10, 11)."""

from __future__ import annotations

from waldnet.common.estimation.gaussian import Array, Product


def log_lambda(before: Product, after: Product, log_p_bar: Array) -> Array:
    """``log Lambda = log c_after - log c_before + sum of log p_bar`` of those who reported (Eq. 10, 11).

    With all sensors' factors replaced this is Eq. (10), with one of them Eq. (11); reports of one time taken one by one
    add up to the same number, because the constants in between cancel.

    Args:
        before: product of all factors, predicted to the time of the reports, batch shape (...).
        after: product with the reported factors in their places.
        log_p_bar: log weight sums, shape (..., S); 0 for a sensor that did not report.

    Returns:
        log Lambda, shape (...).

    References:
        theory.md Eq. (10), (11).
    """
    result: Array = after.log_c - before.log_c + log_p_bar.sum(axis=-1)
    return result
