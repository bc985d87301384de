"""Tracks that start from plots no track claims, and tracks that turn out to be one (theory.md §8)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.estimation.association import gate_threshold
from waldnet.common.estimation.gating import inside_boxes
from waldnet.common.estimation.gaussian import Array, BoolArray, Gaussian, quadratic
from waldnet.common.estimation.initiation import apart, from_plots, with_second
from waldnet.common.estimation.motion import Motion
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.estimation.sensing import Measurement, Sensor
from waldnet.common.estimation.sprt import CONFIRMED, DELETED, TENTATIVE, Thresholds
from waldnet.common.initiation_config import InitiationConfig
from waldnet.common.limits import MAX_VALUE, PlotLimits, is_possible
from waldnet.common.messages import Decision, IntArray, Picked, Report
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.life import decision_of
from waldnet.fusion_center.picture import Picture, common
from waldnet.fusion_center.refusal import Refusal


class Unclaimed(NamedTuple):
    """Plots of one scan that no track of its node claims.

    Attributes:
        time_ns: of the scan.
        number: of the sensor.
        pose: of it.
        ids: tracks that the node knew, ascending, shape (T,).
        z: the plots, shape (U, m).
    """

    time_ns: int
    number: int
    pose: SensorPose
    ids: IntArray
    z: Array

    @classmethod
    def of(cls, number: int, report: Report | Picked) -> Unclaimed:
        """Those that a sensor reports."""
        return cls(report.time_ns, number, report.pose, report.ids, report.unclaimed)


#: Two tracks have parted when their squared distance is so many times that at which they were close.
_PARTED = 4.0
#: Log LR of two targets against one, of confirmed tracks that are close to each other, by their ids, ascending.
Pairs: TypeAlias = Mapping[tuple[int, int], float]


class Duplicate(NamedTuple):
    """A track that is another one."""

    row: int
    into: int


@dataclass(frozen=True)
class Initiation:
    """How tracks start.

    Attributes:
        config: as the scenario says.
        motion: how targets move.
        sensors: models of the sensors.
        limits: of their plots.
        thresholds: of the test whether two confirmed tracks are one; None: they are, once they are close.
    """

    config: InitiationConfig
    motion: Motion
    sensors: tuple[Sensor, ...]
    limits: tuple[PlotLimits, ...]
    thresholds: Thresholds | None

    @classmethod
    def of(cls, scenario: Scenario) -> Initiation | None:
        """How tracks of a scenario start; None: only from its hypotheses."""
        if scenario.initiation is None:
            return None
        motion = scenario.motion.build()
        return cls(
            config=scenario.initiation,
            motion=motion,
            sensors=tuple(sensor.build(motion) for sensor in scenario.sensors),
            limits=tuple(sensor.limits for sensor in scenario.sensors),
            # Of tracks that do not share plots jointly each explains all plots, as if the other were not there.
            thresholds=scenario.decision.thresholds if scenario.joint else None,
        )

    def fault(self, report: Report | Picked, number: int) -> Refusal | None:
        """Why the unclaimed plots of a report are not such as its sensor gives, or tell of no positions; None: fine."""
        z, stand, measurement = report.unclaimed, report.position, self.sensors[number].measurement
        d = self.motion.dimensions
        fits = not len(z) or ((z.shape[1], len(stand)) == (measurement.m, d) and measurement.m >= d)
        return None if fits else "unclaimed plots of another sensor"

    def usable(self, report: Report | Picked, number: int) -> Report | Picked:
        """A report without fault, without the unclaimed plots that its sensor cannot mean, seen from where it stood."""
        if not len(report.unclaimed):
            return report
        usable = self.limits[number].contain(report.unclaimed) & is_possible(report.pose)
        return report if usable.all() else report._replace(unclaimed=report.unclaimed[usable])

    def seeds(self, picture: Picture, now: Sequence[Unclaimed], before: Sequence[Unclaimed]) -> Gaussian:
        """What starts at a measurement time.

        Args:
            picture: all tracks, at that time.
            now: unclaimed plots of that time, by sensor.
            before: those of earlier times, oldest first.

        Returns:
            densities that are neither of one target with each other nor, as far as the node that saw the plots knew
            nothing of it, with a track, shapes (Q, n), (Q, n, n).
        """
        room = max(self.config.tentative - int((picture.status == TENTATIVE).sum()), 0)
        found = Gaussian(np.empty((0, self.motion.n)), np.empty((0, self.motion.n, self.motion.n)))
        for scan in now:
            if len(scan.z) and len(found.x) < room:
                more = self._single(scan) if self.config.plots == 1 else self._pairs(scan, before)
                found = self._apart(found, more, _live(picture, scan.ids))
        return Gaussian(found.x[:room], found.P[:room])

    def merged(self, before: Picture, picture: Picture, pairs: Pairs) -> tuple[Picture, Pairs, list[Decision]]:
        """The picture without tracks that are another one.

        Args:
            before: the picture before the newest data.
            picture: after it.
            pairs: of confirmed tracks that were close to each other before.

        Returns:
            the picture, the pairs that are close now, and what was decided.
        """
        duplicates, pairs = self.duplicates(before, picture, pairs)
        if not duplicates:
            return picture, pairs, []
        status = picture.status.copy()
        status[[duplicate.row for duplicate in duplicates]] = DELETED
        decisions = [decision_of("merged", picture, row, int(picture.ids[into])) for row, into in duplicates]
        return picture._replace(status=status), pairs, decisions

    def duplicates(self, before: Picture, picture: Picture, pairs: Pairs) -> tuple[list[Duplicate], Pairs]:
        """Tracks of one target, the weaker of each two: not confirmed, coasting, of less LR, younger.

        A tentative track is given up as soon as it is close to another one. Of two confirmed ones a sequential test
        decides: is it more probable that both have a target than that one of them has it (theory.md §8)? Arguments
        and returns are those of ``merged``.
        """
        one, other, distance = self._near(picture)
        if not len(one):
            return [], {}
        confirmed = picture.status == CONFIRMED
        tested = confirmed[one] & confirmed[other] & (self.thresholds is not None)
        same = ~tested & (distance < self.config.merge)
        close: dict[tuple[int, int], float] = {}
        if tested.any():
            gain = _gained(before, picture)
            for place in np.flatnonzero(tested).tolist():
                first, second = int(one[place]), int(other[place])
                key = (int(picture.ids[first]), int(picture.ids[second]))
                if key in pairs or distance[place] < self.config.merge:
                    log_lr = pairs.get(key, 0.0) + float(min(gain[first], gain[second]))
                    same[place], close[key] = self._tested(log_lr)
        rank = np.lexsort((-picture.ids, picture.log_lr_total, confirmed & ~picture.coasting, confirmed))
        strength = np.empty(len(rank), np.intp)
        strength[rank] = np.arange(len(rank))
        return list(_merged(np.stack([one[same], other[same]], axis=1), strength)), close

    def _tested(self, log_lr: float) -> tuple[bool, float]:
        """Whether two tracks are one, and the log LR to go on with: the test begins anew when they are two."""
        assert self.thresholds is not None
        log_a = self.thresholds.log_a if self.thresholds.log_a_kept is None else self.thresholds.log_a_kept
        return log_lr < log_a, 0.0 if log_lr > self.thresholds.log_b else log_lr

    def _near(self, picture: Picture) -> tuple[IntArray, IntArray, Array]:
        """Pairs of tracks that are close to each other, or were before they parted a little.

        Returns:
            rows of the tracks, in each pair the older one first, and squared Mahalanobis distances of their states.
        """
        rows = np.nonzero((picture.status != DELETED) & (picture.scans > 0))[0]
        if len(rows) < 2 or self.config.merge == 0.0:
            return rows[:0], rows[:0], np.empty(0)
        d = self.motion.dimensions
        x, P = picture.fused_x[rows], picture.fused_P[rows]
        limit = _PARTED * self.config.merge
        reach = np.sqrt(2.0 * limit * P.diagonal(axis1=-2, axis2=-1)[:, :d])
        boxes = inside_boxes(x[:, :d], x[:, :d], reach)
        # Whichever of two is the wider one has the other in its box.
        one, at = np.nonzero(boxes.valid)
        other = boxes.which[one, at]
        pairs = np.unique(np.sort(np.stack([one, other], axis=1)[one != other], axis=1), axis=0)
        one, other = pairs.T
        distance = quadratic(x[one] - x[other], P[one] + P[other])[0]
        near = distance < limit
        return rows[one[near]], rows[other[near]], distance[near]

    def _single(self, scan: Unclaimed) -> Gaussian:
        density = self._from_plots(scan)
        slow = self._slow(density)
        return Gaussian(density.x[slow], density.P[slow])

    def _pairs(self, scan: Unclaimed, before: Sequence[Unclaimed]) -> Gaussian:
        """Of every plot and the earlier one that fits it best."""
        n, count, measurement = self.motion.n, len(scan.z), self._measurement(scan)
        gate = gate_threshold(self.config.gate, measurement.m)
        oldest_ns = scan.time_ns - round(self.config.within * NS_PER_S)
        best, x, P = np.full(count, np.inf), np.zeros((count, n)), np.zeros((count, n, n))
        for earlier in before:
            if not (len(earlier.z) and oldest_ns <= earlier.time_ns < scan.time_ns):
                continue
            first, second = np.divmod(np.arange(len(earlier.z) * count), count)
            start = self._from_plots(earlier)
            dt = np.full(len(first), (scan.time_ns - earlier.time_ns) / NS_PER_S)
            chosen = Gaussian(start.x[first], start.P[first])
            density, distance = with_second(chosen, dt, scan.z[second], measurement, scan.pose.position, self.motion)
            fits = (distance <= gate) & self._slow(density)
            distance = np.where(fits, distance, np.inf).reshape(-1, count)
            closest = distance.argmin(axis=0) * count + np.arange(count)
            for plot, pair in enumerate(closest.tolist()):
                if distance.flat[pair] < best[plot]:
                    best[plot], x[plot], P[plot] = distance.flat[pair], density.x[pair], density.P[pair]
        found = np.isfinite(best)
        return Gaussian(x[found], P[found])

    def _measurement(self, scan: Unclaimed) -> Measurement:
        return self.sensors[scan.number].at(scan.pose).measurement

    def _from_plots(self, scan: Unclaimed) -> Gaussian:
        spread = self.config.spread(self.motion.n, self.motion.dimensions)
        return from_plots(scan.z, self._measurement(scan), scan.pose.position, spread)

    def _slow(self, density: Gaussian) -> BoolArray:
        """No faster than a target can be, as far as that is known, and somewhere."""
        d = self.motion.dimensions
        somewhere = (density.P.diagonal(axis1=-2, axis2=-1)[:, :d] < MAX_VALUE**2).all(axis=-1)
        speed = np.linalg.vector_norm(density.x[:, d : 2 * d], axis=-1)
        known = np.minimum(density.P.diagonal(axis1=-2, axis2=-1)[:, d : 2 * d].sum(axis=-1), self.config.fastest**2)
        slow: BoolArray = somewhere & (speed <= self.config.fastest + np.sqrt(known))
        return slow

    def _apart(self, found: Gaussian, more: Gaussian, tracks: Gaussian) -> Gaussian:
        """What is found, and what more there is that is neither near that nor near tracks."""
        d = self.motion.dimensions
        gate = gate_threshold(self.config.gate, d)
        known = Gaussian(*(np.concatenate(parts) for parts in zip(tracks, found, strict=True)))
        new, known = (Gaussian(x[:, :d], P[:, :d, :d]) for x, P in (more, known))
        kept = apart(new, known, gate)
        return Gaussian(*(np.concatenate([old, new[kept]]) for old, new in zip(found, more, strict=True)))


def _live(picture: Picture, known: IntArray) -> Gaussian:
    """Positions of the tracks that a node did not know."""
    others = (picture.status != DELETED) & ~np.isin(picture.ids, known)
    return Gaussian(picture.fused_x[others], picture.fused_P[others])


def _gained(before: Picture, picture: Picture) -> Array:
    """The newest log Lambda of every track of a picture, shape (T,)."""
    gain = picture.log_lr_total.copy()
    rows, others = common(picture.ids, before.ids)
    with np.errstate(invalid="ignore"):  # what was impossible stays so
        gain[rows] -= before.log_lr_total[others]
    return np.nan_to_num(gain, nan=0.0, neginf=-np.inf)


def _merged(pairs: IntArray, strength: IntArray) -> Iterator[Duplicate]:
    """The weaker tracks of pairs, each going into a stronger one that stays."""
    gone: set[int] = set()
    by_strength = sorted(pairs.tolist(), key=lambda pair: -max(strength[pair[0]], strength[pair[1]]))
    for pair in by_strength:
        weak, strong = sorted(pair, key=lambda row: strength[row])
        if weak not in gone and strong not in gone:
            gone.add(weak)
            yield Duplicate(weak, strong)
