"""Which plots of a scan can lie in the gate of which track, found without looking at every pair."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from common.estimation.association import Plots, gate_threshold
from common.estimation.gaussian import Array, Gaussian, times_transposed
from common.estimation.sensing import Linearised

IntArray: TypeAlias = NDArray[np.intp]

#: Up to so many pairs of track and plot it is cheaper to look at all of them.
_FEW_PAIRS = 4000


def candidates(z: Array, predicted: Gaussian, sensor: Linearised, p_g: float) -> Plots:
    """Plots of a scan for a batch of tracks, without most of those that no gate holds.

    A gate is an ellipsoid; every plot inside the box around it is kept, so a filter that gates them gives what it gives
    with all plots.

    Args:
        z: all plots, shape (M, m).
        predicted: tracks, shapes (T, n), (T, n, n).
        sensor: linearised at ``predicted.x``.
        p_g: probability that the target's plot is inside the gate; 1 is no gate.

    Returns:
        plots of shape (M, m), the same for all tracks, where there are few; else of shape (T, K, m), K the most plots
        that any track has.
    """
    tracks, plots = len(predicted.x), len(z)
    everything = Plots(z, np.ones(plots, np.bool_))
    if p_g >= 1.0 or tracks * plots <= _FEW_PAIRS:
        return everything
    HP = times_transposed(predicted.P, sensor.H).mT
    variances = (HP * sensor.H).sum(axis=-1) + np.diagonal(sensor.R)
    # A little wider, so that rounding loses none.
    reach = np.sqrt(gate_threshold(p_g, z.shape[-1]) * variances) * (1.0 + 1e-9)
    track, plot = _pairs_in_boxes(z, sensor.z, reach)
    counts = np.bincount(track, minlength=tracks)
    valid = np.arange(counts.max()) < counts[:, None]
    which = np.zeros(valid.shape, np.int64)
    which[valid] = plot
    return Plots(z[which], valid)


def _pairs_in_boxes(z: Array, centers: Array, reach: Array) -> tuple[IntArray, IntArray]:
    """Track and plot of every plot inside the box ``centers +- reach`` of a track, by track.

    The plots are sorted along one axis, so that a slab of them is left for every box; its other sides are then tested.
    """
    axis = int(np.argmin(reach.mean(axis=0) / np.ptp(z, axis=0).clip(1e-300)))
    order = np.argsort(z[:, axis])
    along = z[order, axis]
    first = np.searchsorted(along, centers[:, axis] - reach[:, axis])
    counts = np.searchsorted(along, centers[:, axis] + reach[:, axis], side="right") - first
    track = np.repeat(np.arange(len(centers)), counts)
    rank = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    plot = order[np.repeat(first, counts) + rank]
    inside = (np.abs(z[plot] - centers[track]) <= reach[track]).all(axis=-1)
    return track[inside], plot[inside]
