"""Which plots of a scan matter to which track: those that its hypotheses hold possible (theory.md §5)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.association import Expected, Plots, gate_threshold, innovations, inside_common_boxes
from waldnet.common.estimation.gating import inside_boxes
from waldnet.common.estimation.gaussian import Array, BoolArray, squared_norm

#: Up to so many pairs of component and plot it is cheaper to look at all of them.
_FEW_PAIRS = 100_000


class Selection(NamedTuple):
    """How far a node looks for plots that matter.

    Attributes:
        probability: that the target's plot is inside the gate of the component that is right.
        weight: components lighter than this have no say.
    """

    probability: float = 0.99
    weight: float = 1e-3


def select(log_w: Array, expected: Expected, plots: Plots, how: Selection) -> BoolArray:
    """The plots in the gate of any component that counts.

    Args:
        log_w: weights of the components, shape (T, C).
        expected: the components as the sensor will see them, batch axes (F, T, C); the last filter decides.
        plots: of the scan, z of shape (M, m), or of every track, shape (T, 1, M, m).
        how: how far to look.

    Returns:
        which plot matters to which track, shape (T, M).
    """
    threshold = gate_threshold(how.probability, expected.z.shape[-1])
    counts = log_w >= np.log(how.weight)
    tracks, most = len(log_w), plots.z.shape[-2]
    if plots.z.ndim == 2 and log_w.size * most > _FEW_PAIRS and not expected.angular:
        return _select_near(counts, expected, plots, threshold)
    if plots.z.ndim == 2 or expected.angular:
        return np.broadcast_to(_inside(counts, expected, plots, threshold), (tracks, most))
    reach = np.where(counts[..., None], np.sqrt(threshold) * expected.sigma[-1] * (1.0 + 1e-9), -1.0)
    which, valid = inside_common_boxes(plots, expected.z[-1], reach)
    near = Plots(np.take_along_axis(plots.z, which[..., None], axis=-2), valid)
    chosen = np.zeros((tracks, most), np.bool_)
    np.put_along_axis(chosen, which[:, 0], _inside(counts, expected, near, threshold), axis=-1)
    return chosen


def _inside(counts: BoolArray, expected: Expected, plots: Plots, threshold: float) -> BoolArray:
    """The plots in the gate of any component that counts, every pair looked at, shape (T, M)."""
    nu = innovations(plots.z, expected.z[-1, :, :, None], expected.angular)
    distance = squared_norm(np.matvec(expected.whitener[-1, :, :, None], nu))
    inside = (distance <= threshold) & counts[..., None]
    if plots.valid is not None:
        inside &= plots.valid
    return np.asarray(inside.any(axis=1))


def _select_near(counts: BoolArray, expected: Expected, plots: Plots, threshold: float) -> BoolArray:
    """``select`` for many tracks and many plots: only pairs that a box does not exclude are looked at."""
    track, component = np.nonzero(counts)
    center, sigma, white = (array[-1, track, component] for array in (expected.z, expected.sigma, expected.whitener))
    near = inside_boxes(plots.z, center, np.sqrt(threshold) * sigma * (1.0 + 1e-9))
    distance = squared_norm(np.matvec(white[:, None], plots.z[near.which] - center[:, None]))
    row, rank = np.nonzero((distance <= threshold) & near.valid)
    chosen = np.zeros((len(counts), len(plots.z)), np.bool_)
    chosen[track[row], near.which[row, rank]] = True
    return chosen
