"""The largest and smallest numbers of a network: one bound each, for files, messages, nodes and the center.

What a file or a message may hold is derived from ``MAX_VALUE``, so that nobody accepts what another one refuses. Every
number is small enough that its square, and the product of three of them, stay far from overflow.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import Array, BoolArray
from waldnet.common.estimation.pose import SensorPose

#: No coordinate, distance, speed, acceleration or standard deviation is larger [m, m/s, m/s^2].
MAX_VALUE = 1e9
#: No standard deviation of a file is smaller [m, rad, m/s, m/s^2].
MIN_SIGMA = 1e-6
#: No estimate is larger, and no standard deviation of an estimate smaller than its inverse: estimates may be predicted
#: beyond what is measured, and be sharper than one plot.
MAX_ESTIMATE = 1e6 * MAX_VALUE
#: Times are this close to the scenario's epoch, so that nanoseconds since 1970 fit into 64 bits [s].
MAX_SECONDS = 4e9
#: No time between two events of a file is shorter [s].
MIN_SECONDS = 1e-6
#: Scans of a simulated sensor: they are kept in memory.
MAX_SCANS = 10**7
#: Plots of a scan: their places are sent in 16 bits.
MAX_PLOTS = 2**16 - 1
#: Mean false plots of a scan, at least 60 standard deviations below ``MAX_PLOTS``, and the smallest that is not none.
MAX_FALSE_PLOTS, MIN_FALSE_PLOTS = 5e4, 1e-12
#: No other number of a file is larger, or smaller without being 0: counts, ratios, bits in a second.
MAX_NUMBER = 1e15
#: Whole numbers by which lines name targets and tracks: exact in JSON wherever it is read.
MAX_ID = 10**15
#: Written with few digits or in single precision, 2 pi and pi / 2 may come out a little too large.
FULL_CIRCLE, ZENITH = 2.0 * np.pi + 0.005, 0.5 * np.pi + 0.005

_COORDINATE = (-MAX_VALUE, MAX_VALUE, f"coordinate in metres (-{MAX_VALUE:g} to {MAX_VALUE:g})")
_RANGES = {
    "range": (0.0, MAX_VALUE, f"distance in metres (0 to {MAX_VALUE:g})"),
    "azimuth": (-FULL_CIRCLE, FULL_CIRCLE, "angle in radians (-2 pi to 2 pi)"),
    "elevation": (-ZENITH, ZENITH, "elevation in radians (-pi/2 to pi/2)"),
    "range rate": (-MAX_VALUE, MAX_VALUE, f"speed in m/s (-{MAX_VALUE:g} to {MAX_VALUE:g})"),
}


class PlotLimits(NamedTuple):
    """What the numbers of a sensor's plots can be.

    Attributes:
        names: of the numbers.
        low: smallest, shape (m,).
        high: largest, shape (m,).
        meanings: what a number between them is.
    """

    names: tuple[str, ...]
    low: Array
    high: Array
    meanings: tuple[str, ...]

    def contain(self, z: Array) -> BoolArray:
        """Which plots a sensor can mean, shape (..., m) to (...); numbers that are not finite are none."""
        return np.asarray(((self.low <= z) & (z <= self.high)).all(axis=-1))

    def fault(self, plot: Array) -> str | None:
        """What is wrong with a plot, shape (m,); None: nothing."""
        for name, value, low, high, meaning in zip(self.names, plot, self.low, self.high, self.meanings, strict=True):
            if not low <= value <= high:
                return f"{name} {value:.10g} is no {meaning}"
        return None


@cache
def plot_limits(names: tuple[str, ...]) -> PlotLimits:
    """The limits of plots with numbers of these names; every name not known here is that of a coordinate."""
    low, high, meanings = zip(*(_RANGES.get(name, _COORDINATE) for name in names), strict=True)
    return PlotLimits(names, np.array(low), np.array(high), meanings)


def is_possible(pose: SensorPose) -> bool:
    """Whether a sensor can stand there and move so."""
    return all(bool((np.abs(numbers) <= MAX_VALUE).all()) for numbers in (pose.position, pose.velocity))
