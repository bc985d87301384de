"""What every run of a mode comes to: decisions, errors, loss; arrays over runs, never a loop over them.

A mode computes and decides nothing (`studies.course`), so one play serves every pair of thresholds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import Array, BoolArray
from waldnet.common.estimation.sprt import CONFIRMED, DELETED, TENTATIVE, StatusArray, Thresholds, decide
from waldnet.common.messages import IntArray
from waldnet.studies.course import Course, Worlds
from waldnet.studies.gospa import gospa_of_one

#: Decisions of sensors add up to the thresholds themselves; rounding must not keep them below.
_REACHED = 1.0 - 1e-9


class Result(NamedTuple):
    """What is kept of a course.

    Attributes:
        times_ns: measurement times, shape (K,).
        log_lr: after every measurement time, shape (R, K).
        error_m: distance of the fused track from the target, shape (R, K); NaN where there is no target.
        nees: squared error in units of the track's own covariance, all of the state, shape (R, K).
        uplink_bytes: per track and scan of a sensor.
        downlink_bytes: per track and scan of a sensor.
        local_log_lr: of the sensors, where each decides for itself, shape (R, K, S); else None.
    """

    times_ns: IntArray
    log_lr: Array
    error_m: Array
    nees: Array
    uplink_bytes: float
    downlink_bytes: float
    local_log_lr: Array | None = None


class Evidence(NamedTuple):
    """Log LR as the network knows it, and the thresholds that it must pass.

    Attributes:
        log_lr: shape (R, K).
        limits: below log_a: delete; above log_b: confirm.
    """

    log_lr: Array
    limits: Thresholds


class Decided(NamedTuple):
    """First decision of every run.

    Attributes:
        kind: TENTATIVE where none fell, shape (R,).
        scans: measurement times of the network until it fell; 0 where none fell, shape (R,).
    """

    kind: StatusArray
    scans: IntArray


def reduce(course: Course, worlds: Worlds, dimensions: int) -> Result:
    """Compare the tracks of a course with the truth.

    A track that is no number is infinitely far off.
    """
    difference = course.x - worlds.truth
    there = np.asarray(np.isfinite(worlds.truth).all(axis=-1))
    known = np.asarray(np.isfinite(course.x).all(axis=-1) & np.isfinite(course.P).all(axis=(-2, -1)))
    usable = there & known
    P = np.where(usable[..., None, None], course.P, np.eye(course.x.shape[-1]))
    nu = np.where(usable[..., None], difference, 0.0)
    nees = np.vecdot(nu, np.linalg.solve(P, nu[..., None])[..., 0])
    error_m = np.linalg.vector_norm(nu[..., :dimensions], axis=-1)
    return Result(
        times_ns=worlds.times_ns,
        log_lr=course.log_lr,
        error_m=_known(error_m, there, known),
        nees=_known(nees, there, known),
        uplink_bytes=float(course.uplink_bytes),
        downlink_bytes=float(course.downlink_bytes),
        local_log_lr=course.local_log_lr,
    )


def _known(values: Array, there: BoolArray, known: BoolArray) -> Array:
    return np.where(there, np.where(known, values, np.inf), np.nan)


def evidence(result: Result, limits: Thresholds) -> Evidence:
    """What the network tests against the thresholds.

    Where sensors decide for themselves, what it knows of are their decisions, and those depend on the thresholds.
    """
    if result.local_log_lr is None:
        return Evidence(result.log_lr, limits)
    reached = Thresholds(limits.log_a * _REACHED, limits.log_b * _REACHED)
    return Evidence(fuse_decisions(result.local_log_lr, limits), reached)


def fuse_decisions(local_log_lr: Array, limits: Thresholds) -> Array:
    """Log LR of the sensors' decisions: each runs its own Wald test, sends what it decided, and starts anew.

    A decision to confirm has the log LR log P1/P0 = log B, one to delete log (1-P1)/(1-P0) = log A: the weights of the
    optimal fusion of binary decisions when the sensors' tests keep what their thresholds promise. The network tests
    the sum against the same thresholds, so the first decision of a sensor decides, unless another sensor has said or
    says at the same time the opposite. Starting anew after a decision is theory.md §7's monitoring.

    Args:
        local_log_lr: of each sensor's own data, nothing decided, shape (R, K, S).
        limits: of the sensors' tests.

    Returns:
        the sum so far, shape (R, K).

    References:
        Chair & Varshney, Optimal data fusion in multiple sensor detection systems (1986).
    """
    own, total = np.zeros(local_log_lr[:, 0].shape), np.zeros(len(local_log_lr))
    fused = np.empty(local_log_lr.shape[:2])
    for k, step in enumerate(np.moveaxis(_steps(local_log_lr), 1, 0)):
        own = own + step
        accepted, rejected = own > limits.log_b, own < limits.log_a
        total = total + limits.log_b * accepted.sum(axis=-1) + limits.log_a * rejected.sum(axis=-1)
        own = np.where(accepted | rejected, 0.0, own)
        fused[:, k] = total
    return fused


def _steps(log_lr: Array) -> Array:
    """Log Lambda of every measurement time, which axis 1 counts; NaN, which decides nothing, after log LR = -inf."""
    with np.errstate(invalid="ignore"):
        return np.diff(log_lr, axis=1, prepend=0.0)


def first_decisions(seen: Evidence) -> Decided:
    """When log LR first leaves the thresholds, and on which side (Eq. 14)."""
    above, below = seen.log_lr > seen.limits.log_b, seen.log_lr < seen.limits.log_a
    outside = above | below
    decided = outside.any(axis=1)
    at = outside.argmax(axis=1)
    confirmed = np.take_along_axis(above, at[:, None], axis=1)[:, 0]
    kind = np.where(decided, np.where(confirmed, CONFIRMED, DELETED), TENTATIVE)
    return Decided(kind.astype(np.uint8), np.where(decided, at + 1, 0))


def monitor(seen: Evidence) -> StatusArray:
    """Life of the track under the test and the monitoring that follows a confirmation (theory.md §7).

    Returns:
        status after every measurement time, shape (R, K).
    """
    log_lr = np.zeros(len(seen.log_lr))
    status = np.full(len(seen.log_lr), TENTATIVE, np.uint8)
    life = np.empty(seen.log_lr.shape, np.uint8)
    for k, step in enumerate(_steps(seen.log_lr).T):
        verdict = decide(log_lr + step, status, seen.limits)
        log_lr, status = verdict.log_lr, verdict.status
        life[:, k] = status
    return life


def gospa_per_scan(result: Result, life: StatusArray, cutoff_m: float) -> Array:
    """GOSPA (p = 2, alpha = 2) of the operator's picture: a track is reported while it is confirmed.

    Args:
        result: of the mode.
        life: status after every measurement time, shape (R, K).
        cutoff_m: farther from the target, a track is not of it.

    Returns:
        GOSPA [m], shape (R, K).
    """
    return gospa_of_one(result.error_m, life == CONFIRMED, ~np.isnan(result.error_m), cutoff_m)


def lost(result: Result, beyond_m: float) -> BoolArray:
    """Runs whose track is too far from its target after the last scan; never without a target, shape (R,)."""
    return result.error_m[:, -1] > beyond_m
