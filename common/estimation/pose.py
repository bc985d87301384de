"""Where a sensor is during a scan, how it moves and which way its platform points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import Array


class SensorPose(NamedTuple):
    """Pose of a sensor at one scan.

    Attributes:
        position: east, north(, up) [m], shape (d,).
        velocity: over ground [m/s], shape (d,); shape (0,) if it is not known, which counts as 0.
        heading: of the platform, clockwise from north [rad].
    """

    position: Array
    velocity: Array = np.empty(0)
    heading: float = 0.0

    def equals(self, other: SensorPose) -> bool:
        """Whether all numbers are the same."""
        same_place = np.array_equal(self.position, other.position)
        return same_place and np.array_equal(self.velocity, other.velocity) and self.heading == other.heading
