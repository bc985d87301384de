"""How the reports of one measurement time move a picture of factors (Eq. 9-11, 18)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.estimation.batch import concatenate, put, take
from waldnet.common.estimation.gaussian import (
    Array,
    BoolArray,
    Gaussian,
    Product,
    Whitened,
    are_positive_definite,
    log_sum_exp,
    moments,
    settled_whitener,
    whitener,
)
from waldnet.common.estimation.imm import Imm, Modes, predict_modes
from waldnet.common.estimation.mixture_product import multiply_mixtures
from waldnet.common.estimation.motion import Motion
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.estimation.ratio import log_lambda
from waldnet.common.estimation.representation import Share, globalise, shrink
from waldnet.common.estimation.sensing import Sensor
from waldnet.common.estimation.sprt import DELETED, TENTATIVE, Existence, survive
from waldnet.common.limits import MAX_ESTIMATE
from waldnet.common.messages import IntArray, Picked, Rebase, Report
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.picture import Backup, Picture, common
from waldnet.fusion_center.refusal import Refusal

#: A scan says less than a missed detection by so much only if its node follows something else.
_DOUBTFUL = 1.0
#: A sensor that detects a target with less than this probability, log(1 - p), does not see it.
_LOG_BLIND = float(np.log1p(-0.05))


class Heard(NamedTuple):
    """A report, its factors taken apart when it came.

    Attributes:
        report: as it came.
        log_p_bar: of all terms of a track, shape (T,).
        log_a: relative weights of the terms, shape (T, K).
        P: of the terms, shape (T, K, n, n).
        factors: the terms, shapes (T, K, n), (T, K, n, n), (T, K).
        lineage: epoch of the rebase that they descend from; 0: none.
    """

    report: Report
    log_p_bar: Array
    log_a: Array
    P: Array
    factors: Whitened
    lineage: int = 0

    @classmethod
    def of(cls, report: Report) -> Heard:
        """Take a report apart.

        Raises:
            numpy.linalg.LinAlgError: when a covariance is not positive definite.
        """
        factors = Whitened(report.x, *whitener(report.P))
        if len(report.log_g) == len(report.ids):  # one term each
            log_a = np.zeros((len(report.ids), 1))
            return cls(report, report.log_g, log_a, report.P[:, None], Whitened(*(part[:, None] for part in factors)))
        # Where a track has fewer terms than others its first one stands there with no weight.
        size = int(report.terms.max(initial=1))
        there = np.arange(size) < report.terms[:, None]
        first = np.cumsum(report.terms) - report.terms
        which = np.where(there, first[:, None] + np.arange(size), first[:, None])
        log_g = np.where(there, report.log_g[which], -np.inf)
        log_p_bar = log_sum_exp(log_g)
        possible = (log_p_bar > -np.inf)[:, None]
        log_a = np.where(possible, log_g, np.where(there, 0.0, -np.inf)) - np.where(possible, log_p_bar[:, None], 0.0)
        log_a -= log_sum_exp(log_a)[:, None]
        return cls(report, log_p_bar, log_a, report.P[which], Whitened(*(part[which] for part in factors)))


class Expected(NamedTuple):
    """A picture at its next measurement time: all that does not depend on what will be reported.

    Attributes:
        picture: that it was worked out from.
        t_ns: the measurement time.
        kept: the tracks that had not been deleted.
        live: which of them started before.
        moving: those.
        log_a, factors: those, predicted.
        whitened: the same, taken apart.
        product: of the predicted factors.
        network_P: for ``dkf``, the covariances that all factors have by the models alone, predicted.
    """

    picture: Picture
    t_ns: int
    kept: Picture
    live: BoolArray
    moving: Picture
    log_a: Array
    factors: Gaussian
    whitened: Whitened
    product: Product
    network_P: Array


class Reported(NamedTuple):
    """What the reports of one measurement time say about the tracks of a picture.

    Attributes:
        who: which sensors reported which track, shape (T, S).
        log_p_bar: cumulative, shape (T, S); where nothing was reported, the last one.
        log_a: relative weights of the terms, shape (T, S, K); where nothing was reported, the last ones.
        P: of the factors, shape (T, S, K, n, n); where nothing was reported, of the predicted ones.
        factors: the same, taken apart.
        supported: which tracks a plot of any sensor supported, shape (T,).
    """

    who: BoolArray
    log_p_bar: Array
    log_a: Array
    P: Array
    factors: Whitened
    supported: BoolArray


@dataclass(frozen=True)
class Fuser:
    """The steps of the picture.

    Attributes:
        motion: motion model.
        sensors: models of the sensors, in the order of the scenario.
        share: a sensor's share of prior and process noise.
        terms: most terms of a factor.
        stay_s: mean time that targets stay [s].
        globalised: predict as ``dkf`` does.
        configs: of the sensors, where tracks have a life: no report says less of a track than a missed detection;
            otherwise empty.
    """

    motion: Motion
    sensors: tuple[Sensor, ...]
    share: Share
    terms: int
    stay_s: float
    globalised: bool
    configs: tuple[SensorConfig, ...] = ()

    @classmethod
    def of(cls, scenario: Scenario) -> Fuser:
        """The fuser of a scenario."""
        motion = scenario.motion.build()
        return cls(
            motion=motion,
            sensors=tuple(sensor.build(motion) for sensor in scenario.sensors),
            share=scenario.share,
            terms=len(motion.models) if isinstance(motion, Imm) else scenario.fusion.terms,
            stay_s=scenario.stay,
            globalised=scenario.fusion.mode == "dkf",
            configs=() if scenario.life is None else scenario.sensors,
        )

    def empty(self) -> Picture:
        """A picture without tracks."""
        n, n_sensors = self.motion.n, len(self.sensors)
        ints, floats = np.empty(0, np.int64), np.empty(0)
        per_sensor = np.empty((0, n_sensors))
        return Picture(
            ids=ints,
            starts_ns=ints,
            x0=np.empty((0, n)),
            P0=np.empty((0, n, n)),
            times_ns=ints,
            status=np.empty(0, np.uint8),
            scans=ints,
            log_lr=floats,
            log_left=floats,
            log_lr_total=floats,
            log_p_bar=per_sensor,
            log_a=np.empty((0, n_sensors, self.terms)),
            reported=per_sensor.astype(np.bool_),
            contributing=per_sensor.astype(np.bool_),
            supported_ns=ints,
            coasting=np.empty(0, np.bool_),
            x=np.empty((0, n_sensors, self.terms, n)),
            P=np.empty((0, n_sensors, self.terms, n, n)),
            fused_x=np.empty((0, n)),
            fused_P=np.empty((0, n, n)),
            network_P=np.empty((0, n_sensors if self.globalised else 0, n, n)),
        )

    def heard(self, report: Report | Picked) -> Heard | Refusal:
        """A report taken apart, without the tracks that cannot be computed with, or why none can be."""
        if not isinstance(report, Report):
            return "another fusion mode"
        if report.x.shape[-1] != self.motion.n:
            return "wrong dimensions"
        if (report.terms > self.terms).any():
            return "too many terms"
        # Far from where squares overflow.
        variances = report.P.diagonal(axis1=-2, axis2=-1)
        inside = (np.abs(report.x) <= MAX_ESTIMATE) & (variances <= MAX_ESTIMATE**2) & (variances >= MAX_ESTIMATE**-2)
        report = _with_terms(report, np.asarray(inside.all(axis=-1)))
        try:
            return Heard.of(report)
        except np.linalg.LinAlgError:
            return Heard.of(_with_terms(report, are_positive_definite(report.P)))

    def backup(self, picture: Picture, number: int) -> Backup:
        """What a sensor that joins goes on from: its last factor where it reported one, else the prior.

        A report is the whole state of a factor, so the center is every node's backup.
        """
        held = picture.reported[:, number]
        prior = self.share.start(Gaussian(picture.x0, picture.P0))
        # Which of its hypotheses a node held for true it has not said: the terms' own weights must do.
        last = moments(np.exp(picture.log_a[:, number]), Gaussian(picture.x[:, number], picture.P[:, number]))
        return Backup(
            times_ns=np.where(held, picture.times_ns, picture.starts_ns),
            log_p_bar=picture.log_p_bar[:, number],
            x=np.where(held[:, None], last.x, prior.x),
            P=np.where(held[:, None, None], last.P, prior.P),
            x_a=np.where(held[:, None], picture.fused_x, picture.x0),
            P_a=np.where(held[:, None, None], picture.fused_P, picture.P0),
        )

    def begin(self, picture: Picture, ids: IntArray, times_ns: IntArray, priors: Gaussian) -> Picture:
        """Add tracks that start with ``priors``, shapes (T, n), (T, n, n)."""
        tracks, n_sensors = len(ids), len(self.sensors)
        log_a, (x, P) = self._shares(priors)
        new = Picture(
            ids=ids,
            starts_ns=times_ns,
            x0=priors.x,
            P0=priors.P,
            times_ns=times_ns,
            status=np.full(tracks, TENTATIVE, np.uint8),
            scans=np.zeros(tracks, np.int64),
            log_lr=np.zeros(tracks),
            log_left=np.full(tracks, -np.inf),
            log_lr_total=np.zeros(tracks),
            log_p_bar=np.zeros((tracks, n_sensors)),
            log_a=log_a,
            reported=np.zeros((tracks, n_sensors), np.bool_),
            contributing=np.zeros((tracks, n_sensors), np.bool_),
            supported_ns=times_ns,
            coasting=np.zeros(tracks, np.bool_),
            x=x,
            P=P,
            fused_x=priors.x,
            fused_P=priors.P,
            network_P=P[:, :, 0] if self.globalised else P[:, :0, 0],
        )
        both = concatenate(picture, new)
        return take(both, np.argsort(both.ids))

    def rebased(self, now: Picture, then: Picture, told: Rebase) -> Picture:
        """The newest picture with factors that begin anew from what the nodes were told (theory.md §3).

        The density and LR at that time stay what they were; what was reported since comes again, with the new factors.

        Args:
            now: the newest picture.
            then: the picture at the time of the rebase.
            told: the fused tracks.

        Returns:
            the picture, its rebased tracks at the time of the rebase.
        """
        rows, given = common(now.ids, told.ids)
        old, _ = common(then.ids, now.ids[rows])
        assert len(then.ids[old]) == len(now.ids[rows]), "a track that was told of was there"
        log_a, (x, P) = self._shares(Gaussian(told.x[given], told.P[given]))
        if isinstance(self.motion, Imm):  # which model is in force each factor goes on to say for itself
            log_a = then.log_a[old]
        part = take(now, rows) if not isinstance(rows, slice) else now
        total, log_lr = then.log_lr_total[old], then.log_lr[old]
        if not self.configs:
            # What confirmations took from log LR since stays taken.
            possible = part.log_lr_total > -np.inf
            taken = np.subtract(part.log_lr_total, part.log_lr, out=np.zeros_like(total), where=possible)
            log_lr = np.where(possible, total - taken, log_lr)
        part = part._replace(
            times_ns=np.full_like(part.times_ns, told.time_ns),
            log_lr=log_lr,
            log_left=then.log_left[old],
            log_lr_total=total,
            log_p_bar=np.zeros_like(part.log_p_bar),
            log_a=log_a,
            reported=np.ones_like(part.reported),
            x=x,
            P=P,
            fused_x=told.x[given],
            fused_P=told.P[given],
        )
        return part if isinstance(rows, slice) else put(now, rows, part)

    def _shares(self, densities: Gaussian) -> tuple[Array, Gaussian]:
        """Weights and densities of the terms of all factors whose product is given, shapes (T, S, K), ... ."""
        n_sensors, factor = len(self.sensors), self.share.start(densities)
        log_a = np.full((len(factor.x), n_sensors, self.terms), -np.inf)
        log_a[:, :, 0] = 0.0
        if isinstance(self.motion, Imm):
            log_a[:] = -np.log(self.terms)
        x, P = (np.repeat(np.repeat(part[:, None, None], n_sensors, axis=1), self.terms, axis=2) for part in factor)
        return log_a, Gaussian(x, P)

    def expect(self, picture: Picture, t_ns: int) -> Expected:
        """Work out what a picture will be at a measurement time, as far as no report is needed for it."""
        kept = take(picture, picture.status != DELETED)
        live = kept.times_ns < t_ns
        moving = take(kept, live)
        log_a, factors, network_P = self._predict(moving, t_ns)
        P, *parts = settled_whitener(factors.P)
        factors, whitened = Gaussian(factors.x, P), Whitened(factors.x, *parts)
        product = multiply_mixtures(log_a, whitened)
        return Expected(picture, t_ns, kept, live, moving, log_a, factors, whitened, product, network_P)

    def advance(self, expected: Expected, reports: Mapping[int, Heard]) -> Picture:
        """Work in all reports of one measurement time.

        A sensor that is silent, or does not report a track, keeps its factor there, predicted, with p_bar = 1.

        Args:
            expected: the picture, predicted to the measurement time.
            reports: by number of the sensor.

        Returns:
            the picture at the measurement time.
        """
        moved = self._move(expected, reports)
        return moved if expected.live.all() else put(expected.kept, expected.live, moved)

    def _move(self, expected: Expected, reports: Mapping[int, Heard]) -> Picture:
        picture, before = expected.moving, expected.product
        said = _collect(expected, reports)
        heard = said.who.any(axis=-1)
        after = multiply_mixtures(said.log_a, said.factors) if heard.any() else before
        # Cumulative sums that are both -inf have not changed.
        same = said.log_p_bar == picture.log_p_bar
        evidence = np.where(same, 0.0, said.log_p_bar) - np.where(same, 0.0, picture.log_p_bar)
        # A track that nobody reported stays as it is, to the last digit.
        step = np.where(heard, log_lambda(before, after, evidence), 0.0)
        if self.configs and (step < -_DOUBTFUL).any():
            said, after, step = self._plausible(expected, reports, said, evidence, after, step)
        network_P = self._shrunk(expected.network_P, reports) if self.globalised else expected.network_P
        elapsed_s = (expected.t_ns - picture.times_ns) / NS_PER_S
        existence = survive(Existence(picture.log_lr, picture.log_left), elapsed_s, self.stay_s)
        return picture._replace(
            times_ns=np.full_like(picture.times_ns, expected.t_ns),
            scans=picture.scans + heard,
            log_lr=existence.log_lr + step,
            log_left=existence.log_left,
            log_lr_total=picture.log_lr_total + step,
            log_p_bar=said.log_p_bar,
            log_a=said.log_a,
            reported=picture.reported | said.who,
            contributing=said.who,
            supported_ns=np.where(said.supported, expected.t_ns, picture.supported_ns),
            x=said.factors.x,
            P=said.P,
            fused_x=after.density.x,
            fused_P=after.density.P,
            network_P=network_P,
        )

    def _plausible(
        self,
        expected: Expected,
        reports: Mapping[int, Heard],
        said: Reported,
        evidence: Array,
        after: Product,
        step: Array,
    ) -> tuple[Reported, Product, Array]:
        """Leave out what sensors say against tracks that they cannot see.

        Whatever the plots are, a scan makes a track ``1 - p_d P(in view)`` times as probable at least. Where the fused
        track is out of view that is 1. Far less comes from a node that follows something else: it counts as a miss of
        the fused track, and its factor waits until it fits again.

        Args:
            expected: the picture, predicted to the measurement time.
            reports: by number of the sensor.
            said: what they say.
            evidence: new log p_bar, shape (T, S).
            after: product of all factors, as reported.
            step: log Lambda of every track, shape (T,).

        Returns:
            what is left of the reports, and the product and log Lambda with that.
        """
        rows = np.flatnonzero(step < -_DOUBTFUL)
        fused = take(expected.product.density, rows)
        miss = np.zeros((len(rows), len(self.sensors)))
        for number, heard in reports.items():
            log_missed = self._log_missed(number, heard.report.pose, fused)
            miss[:, number] = np.where(said.who[rows, number], log_missed, 0.0)
        short = (step[rows] < miss.sum(axis=-1) - _DOUBTFUL) & (said.who[rows] & (miss > _LOG_BLIND)).any(axis=-1)
        rows, miss = rows[short], miss[short]
        if not len(rows):
            return said, after, step
        product, who = take(expected.product, rows), said.who[rows]
        left = np.zeros(who.shape, np.bool_)
        for number in reports:
            alone, _ = self._product(expected, said, rows, np.arange(len(self.sensors)) == number)
            gain = log_lambda(product, alone, evidence[rows, number, None])
            blind = miss[:, number] > _LOG_BLIND
            left[:, number] = who[:, number] & blind & (gain < miss[:, number] - _DOUBTFUL)
        part, terms = self._product(expected, said, rows, ~left)
        part_step = log_lambda(product, part, np.where(left, miss, evidence[rows]))
        said = put(said, rows, terms._replace(who=who & ~left, log_p_bar=said.log_p_bar[rows]))
        return said, put(after, rows, part), _put(step, rows, np.where(left.any(axis=-1), part_step, step[rows]))

    def _log_missed(self, number: int, pose: SensorPose, fused: Gaussian) -> Array:
        """Log probability that a scan of a sensor misses targets, shapes (R, n), (R, n, n) to (R,)."""
        sensor, d = self.sensors[number].at(pose).without_notch, self.motion.dimensions
        position = Gaussian(fused.x[:, :d], fused.P[:, :d, :d])
        inside = sensor.field_of_view.probability_inside(position, self.configs[number].view_center(pose.position))
        with np.errstate(divide="ignore"):  # surely seen
            return np.log1p(-sensor.detection_probability(fused, pose.position) * inside)

    @staticmethod
    def _product(expected: Expected, said: Reported, rows: IntArray, used: BoolArray) -> tuple[Product, Reported]:
        """The product of reported factors where they are used, and of predicted ones elsewhere.

        Args:
            expected: the predicted ones.
            said: the reported ones.
            rows: of the tracks, shape (R,).
            used: shape (S,) or (R, S).

        Returns:
            the product; and the reports, without what is not used.
        """
        used = np.broadcast_to(used, (len(rows), said.who.shape[1]))

        def chosen(reported: Array, predicted: Array) -> Array:
            return np.where(used.reshape(*used.shape, *(1,) * (reported.ndim - 2)), reported[rows], predicted[rows])

        log_a, P = chosen(said.log_a, expected.log_a), chosen(said.P, expected.factors.P)
        factors = Whitened(*(chosen(*pair) for pair in zip(said.factors, expected.whitened, strict=True)))
        part = Reported(said.who[rows], said.log_p_bar[rows], log_a, P, factors, said.supported[rows])
        return multiply_mixtures(log_a, factors), part

    def _predict(self, picture: Picture, t_ns: int) -> tuple[Array, Gaussian, Array]:
        """Predict all factors and the weights of their terms as their nodes do (Eq. 5)."""
        dt: Array = (t_ns - picture.times_ns) / NS_PER_S
        dt = dt[0, ...] if len(dt) and (dt == dt[0]).all() else dt[:, None, None]
        factors = Gaussian(picture.x, picture.P)
        if isinstance(self.motion, Imm):
            dt = dt[..., 0] if dt.ndim else dt
            modes = predict_modes(Modes(picture.log_a, factors), self.motion, dt, self.share.multiplicity)
            return modes.log_mu, modes.densities, picture.network_P
        if not self.globalised:
            return picture.log_a, self.share.predict(factors, self.motion, dt), picture.network_P
        common = globalise(picture.network_P)
        P = np.repeat(common.P[:, None, None], len(self.sensors), axis=1)
        x = np.matvec(common.G, factors.x[:, :, 0])[:, :, None]
        predicted = self.share.predict(Gaussian(x, P), self.motion, dt)
        return picture.log_a, predicted, predicted.P[:, :, 0]

    def _shrunk(self, network_P: Array, reports: Mapping[int, Heard]) -> Array:
        network_P = network_P.copy()
        for number in reports:
            P = network_P[:, number]
            linear = self.sensors[number].measurement.linearise(
                Gaussian(np.zeros(P.shape[:-1]), P), np.zeros(self.motion.dimensions)
            )
            network_P[:, number] = shrink(P, linear.H, linear.R)
        return network_P


def _with_terms(report: Report, usable: BoolArray) -> Report:
    """A report of the tracks all of whose terms are usable, shape (N,)."""
    if usable.all():
        return report
    track = np.repeat(np.arange(len(report.ids)), report.terms)
    kept = np.bincount(track[~usable], minlength=len(report.ids)) == 0
    rows = kept[track]
    return report._replace(
        ids=report.ids[kept],
        terms=report.terms[kept],
        log_g=report.log_g[rows],
        x=report.x[rows],
        P=report.P[rows],
        supported=report.supported[kept] if len(report.supported) else report.supported,
    )


def _put(values: Array, rows: IntArray, part: Array) -> Array:
    """A copy of values with some replaced, shape (T,)."""
    values = values.copy()
    values[rows] = part
    return values


def _collect(expected: Expected, reports: Mapping[int, Heard]) -> Reported:
    """Lay the reports over the predicted factors; tracks that a report or the picture lacks are left alone."""
    picture = expected.moving
    who, log_p_bar, log_a = np.zeros(picture.reported.shape, np.bool_), picture.log_p_bar.copy(), expected.log_a.copy()
    P, factors = expected.factors.P.copy(), Whitened(*(array.copy() for array in expected.whitened))
    supported = np.zeros(len(picture.ids), np.bool_)
    for number, heard in reports.items():
        rows, others = common(picture.ids, heard.report.ids)
        who[rows, number] = True
        log_p_bar[rows, number] = heard.log_p_bar[others]
        size = heard.log_a.shape[1]
        log_a[rows, number, :size], log_a[rows, number, size:] = heard.log_a[others], -np.inf
        P[rows, number, :size] = heard.P[others]
        for array, new in zip(factors, heard.factors, strict=True):
            array[rows, number, :size] = new[others]
        if len(heard.report.supported):
            supported[rows] |= heard.report.supported[others]
    return Reported(who, log_p_bar, log_a, P, factors, supported)
