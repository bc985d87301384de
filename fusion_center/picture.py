"""The fused picture: all tracks of the center, and the test of every one (Eq. 14)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.batch import take
from waldnet.common.estimation.gaussian import Array, BoolArray
from waldnet.common.estimation.sprt import COASTING, DELETED, StatusArray
from waldnet.common.messages import Decision, IntArray, Tracks


class Picture(NamedTuple):
    """All tracks of the center, one row a track; deleted ones leave at the next step.

    Attributes:
        ids: ascending, shape (T,).
        starts_ns: start of the track, shape (T,).
        x0, P0: prior at the start, shapes (T, n), (T, n, n).
        times_ns: of the factors: the start, then the newest measurement time, shape (T,).
        status: shape (T,).
        scans: measurement times used, shape (T,).
        log_lr: of the test (theory.md §7), shape (T,).
        log_left: where targets may leave, log LR that the target was there and has left; else -inf, shape (T,).
        log_lr_total: the sum of all log Lambda since the start, shape (T,).
        log_p_bar: cumulative, as last reported, of all terms of a factor, shape (T, S).
        log_a: relative weights of the terms, shape (T, S, K); -inf is no term.
        reported: which sensors' factors are no more the prior predicted: they reported the track, or were rebased,
            shape (T, S).
        contributing: which sensors reported it at the newest time, shape (T, S).
        supported_ns: time of the last scan with a plot that was the track's, the start at first, shape (T,).
        coasting: confirmed, but without such a plot for too long, shape (T,).
        x, P: terms of the factors, shapes (T, S, K, n), (T, S, K, n, n).
        fused_x, fused_P: the product (Eq. 9), shapes (T, n), (T, n, n).
        network_P: for ``dkf``, the covariances that follow from the models alone, shape (T, S, n, n); otherwise S = 0.
    """

    ids: IntArray
    starts_ns: IntArray
    x0: Array
    P0: Array
    times_ns: IntArray
    status: StatusArray
    scans: IntArray
    log_lr: Array
    log_left: Array
    log_lr_total: Array
    log_p_bar: Array
    log_a: Array
    reported: BoolArray
    contributing: BoolArray
    supported_ns: IntArray
    coasting: BoolArray
    x: Array
    P: Array
    fused_x: Array
    fused_P: Array
    network_P: Array


class Backup(NamedTuple):
    """What a node goes on from, one row a track of the picture.

    Attributes:
        times_ns: of the densities, shape (T,).
        log_p_bar: cumulative so far, shape (T,).
        x, P: factors, shapes (T, n), (T, n, n).
        x_a, P_a: association filters, same shapes.
    """

    times_ns: IntArray
    log_p_bar: Array
    x: Array
    P: Array
    x_a: Array
    P_a: Array


def corrections(before: list[Decision], after: list[Decision]) -> list[Decision]:
    """Decisions that a late report brought, undid, or changed in their numbers."""
    withdrawn = [decision._replace(kind="withdrawn") for decision in before if decision not in after]
    return [*withdrawn, *(decision for decision in after if decision not in before)]


def fused(picture: Picture, time_ns: int) -> tuple[IntArray, Array, Array]:
    """Ids and fused densities of the tracks that live at the time of a picture."""
    live = (picture.starts_ns <= time_ns) & (picture.status != DELETED)
    return picture.ids[live], picture.fused_x[live], picture.fused_P[live]


def shown(picture: Picture, time_ns: int, names: tuple[str, ...]) -> Tracks:
    """A picture as a message: all tracks that have started.

    Args:
        picture: of a measurement time.
        time_ns: that time.
        names: of the sensors.
    """
    picture = take(picture, picture.starts_ns <= time_ns)
    return Tracks(
        time_ns=time_ns,
        sensors=names,
        ids=picture.ids,
        status=np.where(picture.coasting & (picture.status != DELETED), COASTING, picture.status),
        scans=picture.scans,
        contributing=picture.contributing,
        log_lr=picture.log_lr,
        log_lr_total=picture.log_lr_total,
        x=picture.fused_x,
        P=picture.fused_P,
        supported_ns=picture.supported_ns,
    )


def common(ours: IntArray, theirs: IntArray) -> tuple[IntArray | slice, IntArray | slice]:
    """Where ids that both have stand in each; mostly both have the same."""
    if ours.tobytes() == theirs.tobytes():
        return slice(None), slice(None)
    _, rows, others = np.intersect1d(ours, theirs, assume_unique=True, return_indices=True)
    return rows, others
