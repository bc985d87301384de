"""Track extraction by sub-tracks: is there a target at all, and where (theory.md §9, Eq. 15).

A candidate is one possible target: a sum of sub-tracks (lambda, x, P), of which one is right if it is real. They branch
as in ``mixture``; their lambdas add up to the likelihood ratio, on which Wald's test decides. A candidate that is
confirmed goes on as a track: the mixture of its sub-tracks with weights lambda_j / sum lambda.

Scans may come from one sensor or, all plots at one place, from several: one after the other, by time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from waldnet.common.estimation.association import Clutter, Expected, Plots, expect, within_reach
from waldnet.common.estimation.batch import concatenate, take
from waldnet.common.estimation.detection import Notch
from waldnet.common.estimation.gating import IntArray
from waldnet.common.estimation.gaussian import Array, BoolArray, Gaussian, as_array, log_sum_exp
from waldnet.common.estimation.mixture import Mixture, Reduction, step, step_with
from waldnet.common.estimation.motion import Motion, predict
from waldnet.common.estimation.notch import hypotheses
from waldnet.common.estimation.sensing import Sensor
from waldnet.common.estimation.sprt import DELETED, StatusArray, Thresholds, decide


class _SensorScanFields(NamedTuple):
    time: float
    sensor: Sensor
    stand: Array
    center: Array
    plots: Plots


class SensorScan(_SensorScanFields):
    """One scan of one sensor; lists of numbers are welcome.

    Attributes:
        time: of the scan [s].
        sensor: its model.
        stand: where it stood [m], shape (d,).
        center: of its field of view [m], shape (d,).
        plots: z of shape (M, m), which all candidates share; or of every candidate, shape (T, 1, M, m).
    """

    __slots__ = ()

    def __new__(
        cls, time: float, sensor: Sensor, stand: ArrayLike, center: ArrayLike, plots: Plots | ArrayLike
    ) -> Self:
        """Take lists for arrays."""
        plots = plots if isinstance(plots, Plots) else Plots(plots)
        return tuple.__new__(cls, (time, sensor, as_array(stand), as_array(center), plots))


class Candidates(NamedTuple):
    """Possible targets.

    Attributes:
        ids: numbers given by whoever started them, shape (T,).
        status: tentative, confirmed, or, for the last time, deleted, shape (T,).
        scans: scans used so far, shape (T,).
        log_lr: log LR since the start or the last confirmation, shape (T,).
        log_w: logarithms of the sub-tracks' weights, sum one, shape (T, C); -inf is none.
        log_lambda: logarithms of lambda, shape (T, C).
        x, P: sub-tracks, shapes (T, C, n), (T, C, n, n).
    """

    ids: IntArray
    status: StatusArray
    scans: IntArray
    log_lr: Array
    log_w: Array
    log_lambda: Array
    x: Array
    P: Array


def seeds(position: Gaussian, sigma_v: float) -> Gaussian:
    """What a plot says of a target: its position, and of the velocity no more than how fast targets are.

    Args:
        position: of the plots [m], shapes (..., d), (..., d, d).
        sigma_v: standard deviation of each component of the velocity [m/s].

    Returns:
        states (position, velocity), shapes (..., 2d), (..., 2d, 2d).

    References:
        theory.md §8.
    """
    z, R = position
    d = z.shape[-1]
    P = np.zeros((*z.shape[:-1], 2 * d, 2 * d))
    P[..., :d, :d], P[..., d:, d:] = R, sigma_v**2 * np.eye(d)
    return Gaussian(np.concatenate((z, np.zeros_like(z)), axis=-1), P)


def candidates(ids: IntArray, density: Gaussian, log_w: Array | None = None) -> Candidates:
    """Candidates that start, with LR = 1: what has led to them, such as their first plot, is not evidence again.

    Args:
        ids: shape (T,).
        density: shapes (T, C, n), (T, C, n, n). A hypothesis, or a plot on its own, is a candidate of one sub-track;
            the plots of a scan, one of which shows the only target there may be, are the sub-tracks of one candidate.
        log_w: logarithms of how probable the sub-tracks are, sum one, shape (T, C). None: all the same.

    Returns:
        the candidates before their first scan.
    """
    count, most = density.x.shape[:2]
    if log_w is None:
        log_w = np.full((count, most), -np.log(most))
    nothing = np.zeros(count, np.intp)
    return Candidates(ids, np.zeros(count, np.uint8), nothing, np.zeros(count), log_w, log_w, *density)


def together(first: Candidates, second: Candidates) -> Candidates:
    """Put candidates together that have been predicted to the same time.

    Args:
        first: T1 candidates.
        second: T2 candidates, with other ids.

    Returns:
        T1 + T2 candidates, with places for as many sub-tracks as any of them has.
    """
    most = max(first.log_w.shape[1], second.log_w.shape[1])
    return concatenate(_padded(first, most), _padded(second, most))


def _padded(given: Candidates, most: int) -> Candidates:
    """With so many places for sub-tracks; where there is none stands the density of another, with weight zero."""
    places = np.minimum(np.arange(most), given.log_w.shape[1] - 1)
    there = np.arange(most) < given.log_w.shape[1]
    return given._replace(
        log_w=np.where(there, given.log_w[:, places], -np.inf),
        log_lambda=np.where(there, given.log_lambda[:, places], -np.inf),
        x=given.x[:, places],
        P=given.P[:, places],
    )


@dataclass(frozen=True)
class Extractor:
    """How candidates are tested.

    Attributes:
        motion: motion model.
        limits: Wald's thresholds.
        reduction: how far the sub-tracks of a candidate may grow.
        gate_probability: that the target's plot is inside the gate of a sub-track; 1 is no gate.
    """

    motion: Motion
    limits: Thresholds
    reduction: Reduction
    gate_probability: float = 0.999

    def predict(self, given: Candidates, interval: float) -> Candidates:
        """Candidates after an interval [s]."""
        dt = np.array(interval)
        x, P = predict(Gaussian(given.x, given.P), self.motion.transition(dt), self.motion.noise(dt))
        return given._replace(x=x, P=P)

    def step(self, predicted: Candidates, scan: SensorScan) -> Candidates:
        """Work in a scan and decide (Eq. 14, 15).

        Args:
            predicted: to the time of the scan; those that are deleted already are left out.
            scan: of one sensor; no plots is evidence too.

        Returns:
            the candidates after the scan. Who is confirmed, the first time or again, has log LR = 0 and goes on with
            lambda_j / sum lambda in place of lambda_j.

        References:
            theory.md Eq. (14), (15); W. Koch, Tracking and sensor data fusion (2014), §4.
        """
        alive = predicted.status != DELETED
        given, plots = take(predicted, alive), _of(weighed(scan), alive)
        if not alive.any():
            return given
        density = Gaussian(given.x[None], given.P[None])
        prior = Mixture(given.log_w, given.log_lambda, density)
        expected = expected_of(density, scan, self.gate_probability)
        if isinstance(scan.sensor.detection, Notch):
            every = hypotheses(expected, within_reach(expected, plots), scan.sensor.detection, scan.stand)
            after = step_with(prior, *every, self.reduction)
        else:
            after = step(prior, expected, plots, self.reduction)
        verdict = decide(log_sum_exp(after.log_g), given.status, self.limits)
        return Candidates(
            ids=given.ids,
            status=verdict.status,
            scans=given.scans + 1,
            log_lr=verdict.log_lr,
            log_w=after.log_w,
            log_lambda=np.where(verdict.accepted[:, None], after.log_w, after.log_g),
            x=after.density.x[0],
            P=after.density.P[0],
        )


def extract(
    extractor: Extractor, start: Candidates, start_time: float, scans: Iterable[SensorScan]
) -> Iterator[Candidates]:
    """Test candidates on scan after scan, until none is left.

    Args:
        extractor: how.
        start: candidates.
        start_time: their time [s]; scans after it are used.
        scans: by time, of one sensor or several.

    Yields:
        the candidates after each scan; one that is deleted for the last time.

    Raises:
        ValueError: when a scan is older than the one before.
    """
    given = start
    for interval, scan in in_order(start_time, scans):
        given = extractor.step(extractor.predict(given, interval), scan)
        yield given
        if (given.status == DELETED).all():
            return


def expected_of(density: Gaussian, scan: SensorScan, gate_probability: float) -> Expected:
    """What the sensor will see of Gaussians, shapes (1, ..., n), (1, ..., n, n), if it has no clutter notch."""
    sensor = scan.sensor.without_notch
    p_d = sensor.detection_probability(Gaussian(density.x[0], density.P[0]), scan.stand)
    clutter = Clutter(p_d, np.array(sensor.log_rho_f), gate_probability, sensor.view(scan.center))
    return expect(density, sensor.measurement.linearise(density, scan.stand), clutter)


def weighed(scan: SensorScan) -> Plots:
    """The plots, with the density of false ones where they lie."""
    return scan.plots._replace(log_relative=scan.sensor.log_relative(scan.plots.z, scan.stand))


def in_order(start_time: float, scans: Iterable[SensorScan]) -> Iterator[tuple[float, SensorScan]]:
    """Scans, and the time since the one before [s].

    Raises:
        ValueError: when a scan is older than the one before.
    """
    now = start_time
    for scan in scans:
        if scan.time < now:
            raise ValueError(f"a scan at {scan.time} s comes after one at {now} s: scans by time are needed")
        yield scan.time - now, scan
        now = scan.time


def _of(plots: Plots, rows: BoolArray) -> Plots:
    """The plots of the chosen candidates; those that all share are everybody's."""
    shared = int(np.prod(plots.z.shape[:-2])) == 1
    if shared:
        return plots
    z, valid, relative, *_ = plots
    return Plots(z[rows], None if valid is None else valid[rows], None if relative is None else relative[rows])
