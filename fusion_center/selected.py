"""The picture where the center tracks: nodes send the plots that matter, track by track (theory.md §5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.estimation.association import Plots
from waldnet.common.estimation.batch import concatenate, put, take
from waldnet.common.estimation.gaussian import Array, BoolArray, Gaussian, log_sum_exp, moments
from waldnet.common.estimation.mixture import Mixture
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.estimation.sensing import Sensor
from waldnet.common.estimation.sprt import CONFIRMED, DELETED, TENTATIVE, Existence, survive
from waldnet.common.limits import is_possible
from waldnet.common.local_filter import SUREST, LocalFilter
from waldnet.common.messages import IntArray, Picked, Rebase, Report
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.picture import Backup, Picture, common
from waldnet.fusion_center.refusal import Refusal


class HeardPlots(NamedTuple):
    """A report, its plots laid out track by track.

    Attributes:
        report: as it came.
        plots: z of shape (T, 1, K, m), padded.
        lineage: of factors, which there are none of.
    """

    report: Picked
    plots: Plots
    lineage: int = 0


class ExpectedTracks(NamedTuple):
    """A picture at its next measurement time: all that does not depend on what will be reported.

    Attributes:
        picture: that it was worked out from.
        t_ns: the measurement time.
        kept: the tracks that had not been deleted.
        live: which of them started before.
        moving: those.
        mixture: those, predicted.
    """

    picture: Picture
    t_ns: int
    kept: Picture
    live: BoolArray
    moving: Picture
    mixture: Mixture


class _Seen(NamedTuple):
    """What one sensor saw.

    Attributes:
        number: of the sensor.
        pose: of it.
        plots: of every track its own.
        many: how many there are in all.
        existence: probability of the tracks to exist, before, shape (T,).
    """

    number: int
    pose: SensorPose
    plots: Plots
    many: int
    existence: Array


@dataclass(frozen=True)
class SelectedFuser:
    """The steps of a picture whose tracks are mixtures of the center's own: the only factor of a track is the whole.

    Attributes:
        filter: predicts and filters the tracks.
        sensors: as the scenario describes them, and their models.
        stay_s: mean time that targets stay [s].
        gained: log LR that a confirmed track has beyond ``log_lr``: what a reset at its confirmation took away.
        supporting: it is kept when a plot supported a track.
        joint: tracks that share plots are associated jointly (Eq. 21).
    """

    filter: LocalFilter
    sensors: tuple[tuple[SensorConfig, Sensor], ...]
    stay_s: float
    gained: float
    supporting: bool
    joint: bool

    @classmethod
    def of(cls, scenario: Scenario) -> SelectedFuser:
        """The fuser of a scenario."""
        local = LocalFilter.of(scenario)
        return cls(
            filter=local,
            sensors=tuple((config, config.build(local.motion)) for config in scenario.sensors),
            stay_s=scenario.stay,
            gained=scenario.decision.thresholds.log_b if scenario.decision.enabled and scenario.life is None else 0.0,
            supporting=scenario.life is not None,
            joint=scenario.joint,
        )

    def empty(self) -> Picture:
        """A picture without tracks."""
        n = self.filter.motion.n
        return self._begun(
            np.empty(0, np.int64), np.empty(0, np.int64), Gaussian(np.empty((0, n)), np.empty((0, n, n)))
        )

    def begin(self, picture: Picture, ids: IntArray, times_ns: IntArray, priors: Gaussian) -> Picture:
        """Add tracks that start with ``priors``, shapes (T, n), (T, n, n)."""
        both = concatenate(*_alike(picture, self._begun(ids, times_ns, priors)))
        return take(both, np.argsort(both.ids))

    def _begun(self, ids: IntArray, times_ns: IntArray, priors: Gaussian) -> Picture:
        tracks, n_sensors = len(ids), len(self.sensors)
        log_w, _, (x, P) = self.filter.start(priors)
        nobody, zero = np.zeros((tracks, n_sensors), np.bool_), np.zeros(tracks)
        return Picture(
            ids=ids,
            starts_ns=times_ns,
            x0=priors.x,
            P0=priors.P,
            times_ns=times_ns,
            status=np.full(tracks, TENTATIVE, np.uint8),
            scans=np.zeros(tracks, np.int64),
            log_lr=zero,
            log_left=np.full(tracks, -np.inf),
            log_lr_total=zero,
            log_p_bar=np.zeros((tracks, 1)),
            log_a=log_w[:, None],
            reported=nobody,
            contributing=nobody,
            supported_ns=times_ns,
            coasting=np.zeros(tracks, np.bool_),
            x=x[0][:, None],
            P=P[0][:, None],
            fused_x=priors.x,
            fused_P=priors.P,
            network_P=np.empty((tracks, 0, *priors.P.shape[1:])),
        )

    def heard(self, report: Report | Picked) -> HeardPlots | Refusal:
        """A report laid out, without the plots that its sensor cannot mean, or why none of it can be used."""
        if not isinstance(report, Picked):
            return "another fusion mode"
        config, sensor = next(entry for entry in self.sensors if entry[0].name == report.sensor)
        stand = config.stand(self.filter.motion.dimensions)
        if report.z.shape[-1] != sensor.measurement.m or report.position.shape != stand.shape:
            return "wrong dimensions"
        if not is_possible(report.pose):
            return "position out of range"
        report = _with_plots(report, config.limits.contain(report.z))
        valid = np.arange(int(report.plots.max(initial=0))) < report.plots[:, None]
        z, number = np.zeros((*valid.shape, report.z.shape[-1])), np.zeros(valid.shape, np.intp)
        z[valid], number[valid] = report.z[report.which], report.which
        return HeardPlots(report, Plots(z[:, None], valid[:, None], number=number[:, None]))

    def backup(self, picture: Picture, number: int) -> Backup:  # noqa: ARG002 (the same for every sensor)
        """What a sensor that joins goes on from: the fused tracks, as its own only say which plots matter."""
        fused = (picture.fused_x, picture.fused_P)
        return Backup(picture.times_ns, np.zeros(len(picture.ids)), *fused, *fused)

    def rebased(self, now: Picture, then: Picture, told: Rebase) -> Picture:  # noqa: ARG002 (there are no factors)
        """The picture as it is: no factor has to begin anew."""
        return now

    def expect(self, picture: Picture, t_ns: int) -> ExpectedTracks:
        """Work out what a picture will be at a measurement time, as far as no report is needed for it."""
        kept = take(picture, picture.status != DELETED)
        live = kept.times_ns < t_ns
        moving = take(kept, live)
        dt: Array = (t_ns - moving.times_ns) / NS_PER_S
        dt = dt[0, ...] if len(dt) and (dt == dt[0]).all() else dt
        log_w = moving.log_a[:, 0]
        mixture = Mixture(log_w, log_w, Gaussian(moving.x[None, :, 0], moving.P[None, :, 0]))
        return ExpectedTracks(picture, t_ns, kept, live, moving, self.filter.predict(mixture, dt))

    def advance(self, expected: ExpectedTracks, reports: Mapping[int, HeardPlots]) -> Picture:
        """Work in all reports of one measurement time, sensor after sensor.

        Args:
            expected: the picture, predicted to the measurement time.
            reports: by number of the sensor.

        Returns:
            the picture at the measurement time.
        """
        picture, mixture = expected.moving, expected.mixture
        existence = self._existence(picture)
        who, supported = np.zeros(picture.reported.shape, np.bool_), np.zeros(len(picture.ids), np.bool_)
        for number in sorted(reports):
            report, plots, _ = reports[number]
            rows, others = common(picture.ids, report.ids)
            who[rows, number] = True
            assert plots.valid is not None and plots.number is not None
            theirs = Plots(plots.z[others], plots.valid[others], number=plots.number[others])
            seen = _Seen(number, report.pose, theirs, len(report.z), existence[rows])
            mixture, by_this = self._filtered(mixture, rows, seen)
            supported[rows] |= by_this
        # Weights start each time with sum one, so their sum is the evidence of this time alone.
        step = log_sum_exp(mixture.log_g)
        x, P = mixture.density.x[0], mixture.density.P[0]
        fused = moments(np.exp(mixture.log_w), Gaussian(x, P))
        elapsed_s = (expected.t_ns - picture.times_ns) / NS_PER_S
        survived = survive(Existence(picture.log_lr, picture.log_left), elapsed_s, self.stay_s)
        moved = picture._replace(
            times_ns=np.full_like(picture.times_ns, expected.t_ns),
            scans=picture.scans + who.any(axis=-1),
            log_lr=survived.log_lr + step,
            log_left=survived.log_left,
            log_lr_total=picture.log_lr_total + step,
            log_a=mixture.log_w[:, None],
            reported=picture.reported | who,
            contributing=who,
            supported_ns=np.where(supported, expected.t_ns, picture.supported_ns),
            x=x[:, None],
            P=P[:, None],
            fused_x=fused.x,
            fused_P=fused.P,
        )
        if expected.live.all():
            return moved
        kept, moved = _alike(expected.kept, moved)
        return put(kept, expected.live, moved)

    def _existence(self, picture: Picture) -> Array:
        """Probability of the tracks to exist."""
        odds = Existence(picture.log_lr, picture.log_left).log_odds
        odds = odds + np.where(picture.status == CONFIRMED, self.gained, 0.0)
        existence: Array = expit(np.clip(odds, -SUREST, SUREST))
        return existence

    def _filtered(self, mixture: Mixture, rows: IntArray | slice, seen: _Seen) -> tuple[Mixture, BoolArray]:
        """The mixtures after a scan of one sensor; tracks that it does not know stay as they are.

        Returns:
            all tracks; and which of those in ``rows`` a plot supported.
        """
        config, sensor = self.sensors[seen.number]
        sensor, stand = sensor.at(seen.pose), seen.pose.position
        density = Gaussian(*(part[:, rows] for part in mixture.density))
        mine = Mixture(mixture.log_w[rows], mixture.log_g[rows], density)
        expected = self.filter.expect(mine.density, sensor, stand, config.view_center(stand))
        near = self.filter.near(expected, seen.plots, sensor, stand)
        supported = np.zeros(len(mine.log_w), np.bool_)
        if self.supporting:
            supported = self.filter.supported(mine, expected, near, sensor, stand)
        if self.joint and len(seen.existence) > 1:
            near, _ = self.filter.shared(mine, expected, near, seen.many, sensor, stand, seen.existence)
        mine = self.filter.update(mine, expected, near, sensor, stand)
        if isinstance(rows, slice):
            return mine, supported
        size = max(mixture.log_w.shape[1], mine.log_w.shape[1])
        whole, part = _wide(mixture, size), _wide(mine, size)
        for old, new in zip(whole[:2], part[:2], strict=True):
            old[rows] = new
        for old, new in zip(whole.density, part.density, strict=True):
            old[:, rows] = new
        return whole, supported


def _with_plots(report: Picked, usable: BoolArray) -> Picked:
    """A report with only its usable plots, shape (M,)."""
    if usable.all():
        return report
    kept = usable[report.which]
    track = np.repeat(np.arange(len(report.ids)), report.plots)
    return report._replace(
        plots=np.bincount(track[kept], minlength=len(report.ids)),
        which=(np.cumsum(usable) - 1)[report.which[kept]],
        z=report.z[usable],
    )


def _wide(mixture: Mixture, size: int) -> Mixture:
    """A copy with so many components; those that are added are none."""
    log_w, log_g, (x, P) = mixture
    more = size - log_w.shape[1]
    absent = np.full((len(log_w), more), -np.inf)
    x, P = (np.concatenate([part, np.repeat(part[:, :, :1], more, axis=2)], axis=2) for part in (x, P))
    return Mixture(np.hstack([log_w, absent]), np.hstack([log_g, absent]), Gaussian(x, P))


def _alike(first: Picture, second: Picture) -> tuple[Picture, Picture]:
    """Both with the same number of components."""
    size = max(first.log_a.shape[2], second.log_a.shape[2])
    return _grown(first, size), _grown(second, size)


def _grown(picture: Picture, size: int) -> Picture:
    if picture.log_a.shape[2] == size:
        return picture
    log_w = picture.log_a[:, 0]
    log_w, _, (x, P) = _wide(Mixture(log_w, log_w, Gaussian(picture.x[None, :, 0], picture.P[None, :, 0])), size)
    return picture._replace(log_a=log_w[:, None], x=x[0][:, None], P=P[0][:, None])
