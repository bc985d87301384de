"""A map of false plots, learned scan by scan: where they come again and again, they are dense (theory.md §13).

The number of false plots per scan in a cell is Poisson with a rate of its own; all rates have the same Gamma prior,
with the uniform density of the sensor as its mean. Earlier scans are forgotten exponentially. What is told is a density
relative to the uniform one, so it holds in whatever numbers a sensor has its plots.

Cells are squares or cubes of the scenario's frame, where the sensor tells a position, even if it moves; where it tells
a bearing, they are of equal angle or solid angle, in directions of that frame. Every plot counts in the cells around it
with weights linear in the distance, which sum to one, and is judged with the same weights: so nothing depends on where
the edges of the cells are.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.gating import IntArray
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.sensing import Sensor

#: What has faded below this share of the prior's shape, or of a scan, is dropped.
_FADED = 1e-3
_NS_PER_S = 1e9
#: Numbers of cells along an axis go so far to either side; three of them make one number of 63 bits.
_MOST = 1 << 20


class ClutterModel(NamedTuple):
    """What is believed of the false plots of a sensor before any.

    Attributes:
        sensor: its model; its density of false plots is the prior mean everywhere.
        cell: side of a cell [m], for a bearing sensor [rad].
        memory_s: after so long a scan counts 1/e [s].
        shape: of the Gamma prior of a cell's rate: the smaller, the more false plots keep to places of their own.
    """

    sensor: Sensor
    cell: float
    memory_s: float
    shape: float

    def angular(self, d: int) -> bool:
        """Whether the sensor tells directions only, in ``d`` dimensions."""
        return self.sensor.measurement.m < d

    def sides(self, d: int) -> Array:
        """Sides of a cell, shape (axes,): [m], or [rad] of azimuth and of the sine of elevation."""
        if not self.angular(d):
            return np.full(d, self.cell)
        return np.array([2.0 * np.pi / self.around, 2.0 / self.upward][: d - 1])

    @property
    def around(self) -> int:
        """Cells around the circle of azimuths."""
        return max(round(2.0 * np.pi / self.cell), 1)

    @property
    def upward(self) -> int:
        """Cells from nadir to zenith."""
        return max(round(2.0 / self.cell), 1)

    def prior_rate(self, d: int) -> float:
        """Mean number of false plots per scan and cell, before any."""
        view, measurement = self.sensor.field_of_view, self.sensor.measurement
        whole = measurement.space(view.volume) if self.angular(d) else view.volume
        return float(self.sensor.false_plots * self.sides(d).prod() / whole)


class ClutterMap(NamedTuple):
    """What was seen, forgotten up to the newest scan.

    Attributes:
        time_ns: of the newest scan.
        cells: of earlier false plots, as one number each, ascending, shape (C,).
        counts: of false plots in them, shape (C,).
        centers: of the fields of view [m], shape (V, d).
        scans: seen from each, shape (V,).
        headings: that the fields of view are turned to [rad], shape (V,).
    """

    time_ns: int
    cells: IntArray
    counts: Array
    centers: Array
    scans: Array
    headings: Array


def start(d: int) -> ClutterMap:
    """A map of nothing, in ``d`` dimensions."""
    return ClutterMap(0, np.empty(0, np.int64), np.empty(0), np.empty((0, d)), np.empty(0), np.empty(0))


def log_relative(seen: ClutterMap, model: ClutterModel, z: Array, stand: Array) -> Array:
    """Log of the density of false plots at plots, relative to the sensor's uniform one (Eq. 22).

    Args:
        seen: the map, from earlier scans.
        model: of the sensor's false plots.
        z: plots, shape (M, m).
        stand: where the sensor stands [m], shape (d,).

    Returns:
        shape (M,): 0 before anything was seen.

    References:
        theory.md Eq. (22).
    """
    d = len(stand)
    index, share = _around(model, z, stand)
    counts = np.vecdot(share, _looked_up(seen, _numbers(index)))
    if model.angular(d):
        scans = np.full(len(z), seen.scans.sum())
    else:
        scans = np.tensordot(seen.scans, np.vecdot(_visible(model, index, seen), share), axes=1)
    relative: Array = np.log(model.shape + counts) - np.log(model.shape + model.prior_rate(d) * scans)
    return relative


def learn(
    seen: ClutterMap,
    model: ClutterModel,
    z: Array,
    false: Array,
    time_ns: int,
    stand: Array,
    center: Array,
    heading: float = 0.0,
) -> ClutterMap:
    """Count the plots of a scan, each as far as it is false, and forget (Eq. 22).

    Args:
        seen: the map, from earlier scans.
        model: of the sensor's false plots.
        z: plots, shape (M, m).
        false: their probabilities to be no track's, shape (M,).
        time_ns: of the scan.
        stand: where the sensor stands [m], shape (d,).
        center: of its field of view [m], shape (d,).
        heading: that this is turned to [rad].

    Returns:
        the map with the scan.
    """
    kept = float(np.exp(min(seen.time_ns - time_ns, 0) / (_NS_PER_S * model.memory_s)))
    index, share = _around(model, z, stand)
    new, which = np.unique(_numbers(index), return_inverse=True)
    more = np.zeros(len(new))
    np.add.at(more, which, share * false[:, None])
    cells, counts = _added(seen.cells, seen.counts * kept, new, more)
    centers, scans, headings = _watched(seen, model, kept, center, heading)
    there = counts > _FADED * model.shape
    lasting = scans > _FADED
    return ClutterMap(time_ns, cells[there], counts[there], centers[lasting], scans[lasting], headings[lasting])


def _around(model: ClutterModel, z: Array, stand: Array) -> tuple[IntArray, Array]:
    """The cells around plots, shape (M, 2^axes, axes), and the share that each has of the plot, shape (M, 2^axes)."""
    d = len(stand)
    places = model.sensor.measurement.locate(z, stand)
    if model.angular(d):
        way = places - stand
        places = np.column_stack([np.arctan2(way[:, 0], way[:, 1]), 1.0 + way[:, 2:]])
    at = places / model.sides(d) - 0.5
    low = np.floor(at)
    corners = np.array(list(product((0, 1), repeat=at.shape[-1])))
    rest = (at - low)[:, None]
    share = np.where(corners, rest, 1.0 - rest).prod(axis=-1)
    index = low[:, None].astype(np.int64) + corners
    if model.angular(d):
        index[..., 0] %= model.around
        # Beyond nadir and zenith is nothing: the last cell has it all.
        index[..., 1:] = np.clip(index[..., 1:], 0, model.upward - 1)
    return index, share


def _visible(model: ClutterModel, index: IntArray, seen: ClutterMap) -> Array:
    """How much of what counts in a cell is in the field of view from each center, shape (V, M, K)."""
    d = index.shape[-1]
    # A plot that counts in a cell lies within one side of its middle, the probability falling linearly.
    middle: Array = np.asarray((index + 0.5) * model.cell, np.float64)
    places = Gaussian(middle, np.eye(d) * model.cell**2 / 6.0)
    view = model.sensor.field_of_view
    inside = [
        view.turned(heading).probability_inside(places, center)
        for center, heading in zip(seen.centers, seen.headings.tolist(), strict=True)
    ]
    return np.array(inside).reshape(len(seen.centers), *index.shape[:-1])


def _numbers(index: IntArray) -> IntArray:
    """One number for each cell, shape (..., axes) to (...)."""
    number = np.zeros(index.shape[:-1], np.int64)
    for axis in range(index.shape[-1]):
        number = number * (2 * _MOST) + np.clip(index[..., axis] + _MOST, 0, 2 * _MOST - 1)
    return number


def _looked_up(seen: ClutterMap, cells: IntArray) -> Array:
    """Counts of cells, 0 of those that are not in the map."""
    if not len(seen.cells):
        return np.zeros(cells.shape)
    at = np.minimum(np.searchsorted(seen.cells, cells), len(seen.cells) - 1)
    return np.where(seen.cells[at] == cells, seen.counts[at], 0.0)


def _added(cells: IntArray, counts: Array, new: IntArray, more: Array) -> tuple[IntArray, Array]:
    """Counts with more, ``counts`` being overwritten; both lists of cells ascend."""
    at = np.searchsorted(cells, new)
    known = np.zeros(len(new), np.bool_)
    inside = at < len(cells)
    known[inside] = cells[at[inside]] == new[inside]
    counts[at[known]] += more[known]
    return np.insert(cells, at[~known], new[~known]), np.insert(counts, at[~known], more[~known])


def _watched(
    seen: ClutterMap, model: ClutterModel, kept: float, center: Array, heading: float
) -> tuple[Array, Array, Array]:
    """From where and which way was looked, and how often: what moves an edge by less than half a cell is the same."""
    scans, d = seen.scans * kept, len(center)
    near = np.ones(len(scans), np.bool_)
    if not model.angular(d):
        turned = np.abs(np.remainder(seen.headings - heading + np.pi, 2.0 * np.pi) - np.pi)
        width = model.sensor.field_of_view.volume ** (1.0 / d)
        near = np.linalg.vector_norm(seen.centers - center, axis=-1) <= 0.5 * model.cell
        near &= turned * width <= 0.5 * model.cell
    if near.any():
        scans[near.argmax()] += 1.0
        return seen.centers, scans, seen.headings
    return np.concatenate([seen.centers, center[None]]), np.append(scans, 1.0), np.append(seen.headings, heading)
