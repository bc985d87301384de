"""Wald's sequential test (Eq. 14) and the life of a track under it (theory.md §7)."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from waldnet.common.estimation.gaussian import Array, BoolArray, as_array


class Status(IntEnum):
    """What has been decided about a track."""

    TENTATIVE = 0
    CONFIRMED = 1
    DELETED = 2
    #: Confirmed, and without a plot for some scans of the sensors that should see it; only what is shown says so.
    COASTING = 3


#: To compare arrays with: a member of an enumeration is slow to look up.
TENTATIVE, CONFIRMED, DELETED, COASTING = (np.uint8(status) for status in Status)

StatusArray = NDArray[np.uint8]


class Thresholds(NamedTuple):
    """Thresholds on log LR.

    Attributes:
        log_a: below: accept h0, delete.
        log_b: above: accept h1, confirm.
        log_a_kept: the same as log_a for tracks that are confirmed; None: no other.
    """

    log_a: float
    log_b: float
    log_a_kept: float | None = None


class Verdict(NamedTuple):
    """Outcome of one step of the test.

    Attributes:
        log_lr: log LR to go on with: 0 where h1 was accepted, shape (...).
        status: statuses, shape (...).
        accepted: where h1 was accepted in this step (the first time or again), shape (...).
        rejected: where h0 was accepted in this step, shape (...).
    """

    log_lr: Array
    status: StatusArray
    accepted: BoolArray
    rejected: BoolArray


def thresholds(p0: float, p1: float, keep: float | None = None) -> Thresholds:
    """Wald's thresholds (Eq. 14).

    Args:
        p0: probability of accepting h1 under h0.
        p1: probability of accepting h1 under h1.
        keep: the same for the tests that follow a confirmation; None: p1.

    Returns:
        log A and log B.

    Raises:
        ValueError: unless 0 < p0 < p1 < 1, and the same of ``keep``.
    """
    for name, p in (("p1", p1), ("keep", p1 if keep is None else keep)):
        if not 0.0 < p0 < p < 1.0:
            raise ValueError(f"p0 = {p0}, {name} = {p}: 0 < p0 < {name} < 1 is needed, or log A < 0 < log B fails")
    log_a, log_a_kept = (None if p is None else float(np.log1p(-p) - np.log1p(-p0)) for p in (p1, keep))
    assert log_a is not None
    return Thresholds(log_a, float(np.log(p1) - np.log(p0)), log_a_kept)


def decide(log_lr: ArrayLike, status: ArrayLike, limits: Thresholds) -> Verdict:
    """One step of the test and of the monitoring that follows it (theory.md §7).

    Above log B a track is confirmed and its LR starts anew at 1: from then on the test monitors it, deletes it below
    log A (that of kept tracks, if it is another), and resets again whenever it is confirmed anew.

    Args:
        log_lr: after the newest data, shape (...).
        status: before, shape (...).
        limits: log A, log B.

    Returns:
        what was decided.
    """
    log_lr, status = as_array(log_lr), np.asarray(status, np.uint8)
    alive = status != DELETED
    accepted = alive & (log_lr > limits.log_b)
    kept = limits.log_a if limits.log_a_kept is None else limits.log_a_kept
    rejected = alive & (log_lr < np.where(status == CONFIRMED, kept, limits.log_a))
    new = status.copy()
    new[accepted], new[rejected] = CONFIRMED, DELETED
    return Verdict(np.where(accepted, 0.0, log_lr), new, accepted, rejected)


class Existence(NamedTuple):
    """The likelihood ratio of a track whose target may leave.

    Attributes:
        log_lr: that the target is there now, against h0 that there never was one, shape (...).
        log_left: that it was there and has left since, against h0, shape (...); -inf at the start.
    """

    log_lr: Array
    log_left: Array

    @property
    def log_odds(self) -> Array:
        """Of being there now against all else, with equal priors for h0 and h1, shape (...)."""
        odds: Array = self.log_lr - np.logaddexp(0.0, self.log_left)
        return odds


def survive(before: Existence, dt: Array, stay: float) -> Existence:
    """The likelihood ratio after a time in which the target may have left (Eq. 24).

    Args:
        before: shape (...).
        dt: time that has passed [s], shapes that broadcast.
        stay: mean time that targets stay [s]; inf: they stay for ever.

    Returns:
        the likelihood ratio at the later time, shape (...).
    """
    if stay == np.inf:
        return before
    with np.errstate(divide="ignore"):  # no time, nothing leaves
        log_leaving = np.log(-np.expm1(-dt / stay))
    return Existence(before.log_lr - dt / stay, np.logaddexp(before.log_left, before.log_lr + log_leaving))


def decide_with_life(existence: Existence, status: StatusArray, limits: Thresholds) -> tuple[Existence, Verdict]:
    """One step of the test where targets may leave (theory.md §7).

    h1 of a tentative track is "there was a target"; it is confirmed above log B. From then on its odds of being there
    now go on without a reset: they cannot grow far above log(stay / interval). Any track is deleted when these odds
    fall below log A (that of kept tracks, if it is confirmed).

    Args:
        existence: after the newest data, shape (...).
        status: before, shape (...).
        limits: log A, log B.

    Returns:
        what to go on with, and what was decided; in it, ``log_lr`` is what was compared with the thresholds.
    """
    alive, odds = status != DELETED, existence.log_odds
    accepted = (status == TENTATIVE) & (existence.log_lr > limits.log_b)
    kept = limits.log_a if limits.log_a_kept is None else limits.log_a_kept
    rejected = alive & ~accepted & (odds < np.where(status == CONFIRMED, kept, limits.log_a))
    new = status.copy()
    new[accepted], new[rejected] = CONFIRMED, DELETED
    known = new == CONFIRMED
    after = Existence(np.where(known, odds, existence.log_lr), np.where(known, -np.inf, existence.log_left))
    return after, Verdict(np.where(accepted, existence.log_lr, odds), new, accepted, rejected)
