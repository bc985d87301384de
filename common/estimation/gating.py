"""Which plots of a scan can lie in the gate of which track, found without looking at every pair."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from waldnet.common.estimation.gaussian import Array, BoolArray

IntArray: TypeAlias = NDArray[np.intp]


class Near(NamedTuple):
    """The plots near each track, padded.

    Attributes:
        which: numbers of the plots, shape (T, K), K the most plots that any track has.
        valid: shape (T, K); false marks padding.
    """

    which: IntArray
    valid: BoolArray


def inside_boxes(z: Array, centers: Array, reach: Array, angular: tuple[int, ...] = ()) -> Near:
    """The plots inside the box ``centers +- reach`` of each track.

    The plots are sorted along one axis, so that a slab of them is left for every box; its other sides are then tested.
    Of angles the nearer way around the circle counts; at least one axis must be none.

    Args:
        z: plots, shape (M, m), M > 0.
        centers: expected plots of the tracks, shape (T, m), T > 0.
        reach: half of each side of the boxes, shape (T, m).
        angular: axes that are angles [rad].

    Returns:
        the plots of each track.
    """
    # The axis along which a box holds the smallest part of all plots.
    part = reach.mean(axis=0) / np.ptp(z, axis=0).clip(1e-300)
    part[list(angular)] = np.inf
    axis = int(np.argmin(part))
    order = np.argsort(z[:, axis])
    along = z[order, axis]
    first = np.searchsorted(along, centers[:, axis] - reach[:, axis])
    counts = np.searchsorted(along, centers[:, axis] + reach[:, axis], side="right") - first
    track = np.repeat(np.arange(len(centers)), counts)
    rank = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    plot = order[np.repeat(first, counts) + rank]
    for other in set(range(z.shape[-1])) - {axis}:
        apart = z[plot, other] - centers[track, other]
        if other in angular:
            apart = np.remainder(apart + np.pi, 2.0 * np.pi) - np.pi
        inside = np.abs(apart) <= reach[track, other]
        track, plot = track[inside], plot[inside]
    counts = np.bincount(track, minlength=len(centers))
    valid = np.arange(counts.max()) < counts[:, None]
    which = np.zeros(valid.shape, np.intp)
    which[valid] = plot
    return Near(which, valid)
