"""Where a sensor is during a scan, how it moves and which way its platform points."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import Array

#: Weight of the newest interval between two scans in their mean.
_NEWEST = 0.2


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


class Outlook(NamedTuple):
    """Pose of a sensor at its last scan, how often it scans, and where it has looked lately: it may look there again.

    Attributes:
        pose: at its last scan, or as the scenario has it.
        interval_s: mean time between its last scans [s], or as the scenario has it.
        since_ns: time since its last scan.
        left: how far to the left of its heading it has headed lately [rad], from 0 on.
        right: the same to the right [rad].
        told: it has scanned.
    """

    pose: SensorPose
    interval_s: float
    since_ns: int = 0
    left: float = 0.0
    right: float = 0.0
    told: bool = False

    def after(self, pose: SensorPose | None, elapsed_ns: int, memory_s: float) -> Outlook:
        """The outlook after a time, which forgets headings little by little.

        Args:
            pose: of a scan at that time, if there is one.
            elapsed_ns: the time.
            memory_s: it forgets all but 1/e in so long [s].
        """
        kept, since_ns = math.exp(-elapsed_ns / 1e9 / memory_s), self.since_ns + elapsed_ns
        left, right = kept * self.left, kept * self.right
        if pose is None:
            return self._replace(since_ns=since_ns, left=left, right=right)
        if not self.told:
            return Outlook(pose, self.interval_s, told=True)
        interval_s = self.interval_s + _NEWEST * (since_ns / 1e9 - self.interval_s)
        turn = math.remainder(pose.heading - self.pose.heading, math.tau)
        return Outlook(pose, interval_s, 0, max(left + turn, 0.0), max(right - turn, 0.0), told=True)
