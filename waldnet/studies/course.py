"""What a study works with: many simulated worlds at once, and what a mode made of them."""

from __future__ import annotations

from typing import NamedTuple

from waldnet.common.estimation.association import Plots
from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.messages import IntArray


class Look(NamedTuple):
    """One scan of one sensor, in every world of a batch.

    Attributes:
        time_ns: of the scan.
        sensor: number of the sensor.
        pose: of it.
        plots: z of shape (R, M, m), padded; valid of shape (R, M).
        counts: plots of each world, shape (R,).
    """

    time_ns: int
    sensor: int
    pose: SensorPose
    plots: Plots
    counts: IntArray


class Worlds(NamedTuple):
    """Simulated worlds, one a run: truth and plots.

    Attributes:
        seeds: of the worlds, as ``waldnet simulate --seed`` takes them, shape (R,).
        times_ns: measurement times of the network after the track's start, ascending, shape (K,).
        truth: state of the track's target at these times, shape (R, K, n); NaN where it is not there.
        looks: all scans after the track's start, by time; those of one time in the order of the sensors.
    """

    seeds: IntArray
    times_ns: IntArray
    truth: Array
    looks: tuple[Look, ...]


class Course(NamedTuple):
    """What one mode made of every run: nothing is decided, so log LR is the whole evidence so far.

    Attributes:
        log_lr: after every measurement time, shape (R, K).
        x, P: fused track, shapes (R, K, n), (R, K, n, n).
        uplink_bytes: sent by a sensor for one track and scan, mean over all, payload.
        downlink_bytes: sent back to a sensor for one track and scan, mean over all, payload.
        local_log_lr: of the sensors, where each decides for itself, shape (R, K, S); else None.
    """

    log_lr: Array
    x: Array
    P: Array
    uplink_bytes: float
    downlink_bytes: float
    local_log_lr: Array | None = None
