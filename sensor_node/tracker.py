"""The local tracker of a sensor: pure steps from scans and commands to reports.

State and events go in, state and messages come out; no clock, no network. A live process, a replay and a study run
the same code.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from waldnet.common.codec import Rounding
from waldnet.common.config import Scenario, SensorConfig
from waldnet.common.estimation import clutter_map
from waldnet.common.estimation.association import Expected, Plots
from waldnet.common.estimation.batch import concatenate, put, take
from waldnet.common.estimation.gaussian import Array, Gaussian, log_sum_exp
from waldnet.common.estimation.mixture import Mixture
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.estimation.representation import globalise, shrink
from waldnet.common.estimation.selection import Selection, select
from waldnet.common.local_filter import SUREST, LocalFilter
from waldnet.common.messages import (
    NEVER,
    Advice,
    Begin,
    IntArray,
    Join,
    Picked,
    Rebase,
    Report,
    Scan,
    Start,
    Stop,
    ToNode,
    ToNodes,
)
from waldnet.common.quantities import NS_PER_S
from waldnet.sensor_node.sight import Seen, Sight
from waldnet.sensor_node.state import (
    Beliefs,
    Look,
    Ready,
    Schedule,
    State,
    Tracks,
    alike,
    left,
    put_tracks,
    with_before,
)


@dataclass(frozen=True)
class LocalTracker:
    """The steps of one sensor's tracker; it works in the scans of other sensors as well, where it is given them.

    Attributes:
        name: of the sensor.
        number: of it among all sensors of the network.
        sights: of all of them.
        filter: predicts and filters the tracks.
        feedback: the center answers every measurement time: with the fused tracks, as advice or to begin anew
            (theory.md §3, 6), or with those that begin (§8).
        advised: that answer is advice or to begin anew.
        believing: it is kept how surely tracks exist.
        rounding: how its reports are sent in single precision; None: they are not.
        selection: which plots are sent, where the center tracks; else None.
        digest: of what the center must have in common with this node.
        digests: of its parts, by name.
        buffer_ns: how long scans are kept.
        schedule: scan times of the network, only for ``dkf``.
    """

    name: str
    number: int
    sights: tuple[Sight, ...]
    filter: LocalFilter
    feedback: bool
    advised: bool
    believing: bool
    rounding: Rounding | None
    selection: Selection | None
    digest: str
    digests: Mapping[str, str]
    buffer_ns: int
    schedule: Schedule | None

    @classmethod
    def of(cls, scenario: Scenario, name: str, schedule: Schedule | None = None) -> LocalTracker:
        """The tracker of the named sensor of a scenario.

        Raises:
            ConfigError: when there is no such sensor.
            ValueError: when the scenario's mode needs a schedule and there is none.
        """
        if scenario.fusion.mode == "dkf" and schedule is None:
            raise ValueError("mode 'dkf' needs the scan times of all sensors beforehand")
        sights = tuple(Sight.of(scenario, number) for number in range(len(scenario.sensors)))
        return cls(
            name=name,
            number=scenario.sensors.index(scenario.sensor(name)),
            sights=sights,
            filter=LocalFilter.of(scenario),
            feedback=scenario.fusion.feedback != "none" or scenario.initiation is not None,
            advised=scenario.fusion.feedback != "none",
            believing=scenario.joint or any(sight.sharing for sight in sights),
            rounding=_rounding(scenario, scenario.sensor(name)) if scenario.fusion.precision == "float32" else None,
            selection=scenario.fusion.selection.build() if scenario.fusion.mode == "selected" else None,
            digest=scenario.digest,
            digests=scenario.digests,
            buffer_ns=round(scenario.fusion.window * NS_PER_S),
            schedule=schedule if scenario.fusion.mode == "dkf" else None,
        )

    def initial(self) -> State:
        """A node that was told of no track yet."""
        n, none = self.filter.motion.n, np.empty(0, np.int64)
        x, P = np.empty((0, n)), np.empty((0, n, n))
        start = Start("", epoch=0, ids=none, times_ns=none, log_p_bar=np.empty(0), x=x, P=P, x_a=x, P_a=P)
        maps = tuple(
            None if sight.clutter is None else clutter_map.start(self.filter.motion.dimensions) for sight in self.sights
        )
        return State(epoch=0, sequence=0, tracks=self._fresh(start), recent=(), maps=maps)

    def prepare(self, state: State, time_ns: int, pose: SensorPose) -> State:
        """Work out ahead what the next scan will need: its time and the pose of the sensor must be known, no more."""
        state = self._rebased(state, time_ns)
        return state._replace(ready=self._ready(state, time_ns, pose, self.number))

    def scan(self, state: State, scan: Scan, next_ns: int) -> tuple[State, Report | Picked]:
        """Filter one scan, without the plots that no sensor can mean, and report every track that started before it."""
        sight = next(sight for sight in self.sights if sight.config.name == scan.sensor)
        z = scan.z[sight.config.limits.contain(scan.z)]
        state = state._replace(unusable=state.unusable + len(scan.z) - len(z))
        return self.look(state, Look(scan.time_ns, scan.pose, Plots(z), sight.number), next_ns)

    def look(self, state: State, look: Look, next_ns: int) -> tuple[State, Report | Picked]:
        """``scan``, for plots that may be of every track its own."""
        sight, state = self.sights[look.number], self._rebased(state, look.time_ns)
        look = sight.mapped(state.maps[look.number], look)
        ready = self._ready(state, look.time_ns, look.pose, look.number)
        seen = sight.look(self.filter, ready.predicted, ready.mixture, ready.expected, look)
        mixture, visible, rest, _ = seen
        filtered = self._with(ready.predicted, mixture)._replace(visible=visible)
        maps = tuple(
            sight.learned(known, look, rest) if number == look.number else known
            for number, known in enumerate(state.maps)
        )
        look, unclaimed = sight.unclaimed(look, rest)
        tracks = filtered if ready.live.all() else put_tracks(ready.advised, ready.live, filtered)
        advice = tuple(later for later in state.advice if later.time_ns >= look.time_ns)
        kept = tuple(old for old in state.recent if old.time_ns >= look.time_ns - self.buffer_ns)
        if self.advised:
            look = look._replace(before=self._beliefs(take(ready.advised, ready.live)))
        if self.selection is None:
            report: Report | Picked = self._report(state, look, next_ns, filtered.ids, seen, unclaimed)
        else:
            report = self._picked(state, look, next_ns, ready, self.selection, unclaimed)
        sequence, recent = state.sequence + 1, (*kept, look)
        state = state._replace(sequence=sequence, tracks=tracks, recent=recent, advice=advice, maps=maps, ready=None)
        return state, report

    def _picked(
        self, state: State, look: Look, next_ns: int, ready: Ready, selection: Selection, unclaimed: Array
    ) -> Picked:
        plots = look.plots
        mine = select(ready.mixture.log_w, ready.expected, plots, selection)
        track, plot = np.nonzero(mine)
        z, which = plots.z, np.arange(len(track))
        if z.ndim == 2:
            used = mine.any(axis=0)
            z, which = z[used], (np.cumsum(used) - 1)[plot]
        else:
            z = z[track, 0, plot]
        return Picked(
            sensor=self.sights[look.number].config.name,
            sequence=state.sequence,
            time_ns=look.time_ns,
            next_ns=next_ns,
            epoch=state.epoch,
            position=look.pose.position,
            ids=ready.predicted.ids,
            plots=mine.sum(axis=-1),
            which=which,
            z=z,
            unclaimed=unclaimed,
            velocity=look.pose.velocity,
            heading=look.pose.heading,
        )

    def _report(self, state: State, look: Look, next_ns: int, ids: IntArray, seen: Seen, unclaimed: Array) -> Report:
        mixture, sight = self.filter.report(seen.mixture), self.sights[look.number]
        there = mixture.log_w > -np.inf
        x, P = (array[0][there] for array in mixture.density)
        pose = look.pose if sight.supporting or sight.claimed is not None else SensorPose(np.empty(0))
        return Report(
            sensor=sight.config.name,
            sequence=state.sequence,
            time_ns=look.time_ns,
            next_ns=next_ns,
            epoch=state.lineage or state.epoch,
            ids=ids,
            terms=there.sum(axis=-1),
            log_g=mixture.log_g[there],
            x=x,
            P=P,
            position=pose.position,
            unclaimed=unclaimed,
            velocity=pose.velocity,
            heading=pose.heading,
            supported=seen.supported,
        )

    def join(self, state: State, incarnation: int, next_ns: int) -> Join:
        """Ask a center for the tracks, and tell it up to where epochs and ids are taken.

        Args:
            state: of the node.
            incarnation: random number of its process.
            next_ns: time of its next scan.
        """
        epoch = max(state.epoch, state.lineage, *(rebase.epoch for rebase in state.rebases))
        return Join(self.name, incarnation, next_ns, self.digest, epoch, state.known_id)

    def told(self, state: State, message: ToNode | ToNodes) -> State:
        """Follow what the center says."""
        match message:
            case Start():
                return self.start(state, message)
            case Begin():
                return self.begin(state, message)
            case Stop():
                return self.stop(state, message)
            case Advice():
                return self.advise(state, message)
            case Rebase():
                return self.rebase(state, message)

    def start(self, state: State, start: Start) -> State:
        """Take over tracks, and catch up on the scans since their start; a higher epoch names all tracks there are."""
        if start.epoch > state.epoch:
            # What was known of an earlier center's tracks says nothing of these.
            recent = tuple(look._replace(before=None) for look in state.recent)
            tracks = self.initial().tracks
            state = state._replace(epoch=start.epoch, tracks=tracks, recent=recent, lineage=0, rebases=())
        heard = _above(start.ids, start.next_id if start.next_id < NEVER else 0)
        state = state._replace(next_id=start.next_id, known_id=max(state.known_id, heard))
        state = self._taken_over(state, take(self._fresh(start), ~np.isin(start.ids, state.tracks.ids)))
        begun, state = state.begun, state._replace(begun=())
        for begin in begun:
            state = self.begin(state, begin)
        return state

    def begin(self, state: State, begin: Begin) -> State:
        """Keep tracks that begin, and catch up on the scans since; what the start message knew it has told."""
        state = state._replace(known_id=_above(begin.ids, state.known_id))
        if state.epoch <= begin.epoch:
            return state._replace(begun=(*state.begun, begin))
        factor, zero = self.filter.share.start(Gaussian(begin.x, begin.P)), np.zeros(len(begin.ids))
        start = Start("", state.epoch, begin.ids, begin.times_ns, zero, *factor, begin.x, begin.P)
        new = (begin.ids >= state.next_id) & ~np.isin(begin.ids, state.tracks.ids)
        over = np.isin(state.tracks.ids, begin.ended)
        if over.any():
            log_odds = np.where(over, -np.inf, state.tracks.log_odds)
            state = state._replace(tracks=state.tracks._replace(log_odds=log_odds))
        return self._taken_over(state, take(self._fresh(start), new), alone=False)

    def rebase(self, state: State, rebase: Rebase) -> State:
        """Keep a rebase for the first scan that it holds for."""
        return state if rebase.epoch <= state.lineage else state._replace(rebases=(*state.rebases, rebase))

    def _rebased(self, state: State, t_ns: int) -> State:
        """Begin anew from the newest rebase that holds for a scan, and catch up on the scans since (theory.md §3).

        Only the densities begin anew: all else is what it was at that time, and sees the scans since again.
        """
        holding = [rebase for rebase in state.rebases if rebase.after_ns < t_ns]
        if not holding:
            return state
        told, mine = max(holding, key=lambda rebase: rebase.epoch), state.tracks
        factor = self.filter.share.start(Gaussian(told.x, told.P))
        times_ns, zero = np.full(len(told.ids), told.time_ns), np.zeros(len(told.ids))
        start = Start("", told.epoch, told.ids, times_ns, zero, *factor, told.x, told.P)
        fresh = take(self._fresh(start), np.isin(told.ids, mine.ids))
        fresh = self._recalled(fresh, self._known(state, told.time_ns))
        ended = np.isin(fresh.ids, mine.ids[mine.log_odds == -np.inf])
        fresh = fresh._replace(log_odds=np.where(ended, -np.inf, fresh.log_odds))
        later = tuple(rebase for rebase in state.rebases if rebase.epoch > told.epoch)
        state = state._replace(tracks=take(mine, ~np.isin(mine.ids, told.ids)), lineage=told.epoch, rebases=later)
        return self._taken_over(state, fresh)

    def _taken_over(self, state: State, fresh: Tracks, *, alone: bool = True) -> State:
        """The state with new tracks, which have seen the scans that are kept; if not alone, what the others left."""
        recent = []
        for kept in state.recent:
            look, due = kept if alone else left(kept), fresh.times_ns < kept.time_ns
            if due.any():
                part = take(fresh, due)
                recent.append(with_before(kept, self._beliefs(part)) if self.advised else kept)
                predicted, mixture, expected = self._expect(part, look.time_ns, look.pose, look.number)
                seen = self.sights[look.number].look(self.filter, predicted, mixture, expected, look)
                fresh = put_tracks(fresh, due, self._with(predicted, seen.mixture)._replace(visible=seen.visible))
            else:
                recent.append(kept)
        tracks = concatenate(*alike(state.tracks, fresh))
        tracks = take(tracks, np.argsort(tracks.ids))
        return state._replace(tracks=tracks, recent=tuple(recent))

    def _beliefs(self, tracks: Tracks) -> Beliefs:
        """What is known of tracks beside their densities."""
        log_mu = np.empty((len(tracks.ids), 2, 0))
        if self.filter.models:
            # Evidence that is impossible tells nothing of the models.
            log_g = np.where((tracks.log_g > -np.inf).any(axis=-1, keepdims=True), tracks.log_g, 0.0)
            log_mu = np.stack([log_g - log_sum_exp(log_g)[:, None], tracks.log_w], axis=1)
        return Beliefs(tracks.ids, tracks.times_ns, tracks.times_a_ns, tracks.log_odds, tracks.visible, log_mu)

    def _known(self, state: State, time_ns: int) -> Beliefs | None:
        """What was known of the tracks at a time, of no later scan; None: that is not kept."""
        later = [look for look in state.recent if look.time_ns > time_ns]
        known = later[0].before if later else self._beliefs(state.tracks)
        if known is None:
            return None
        dt, dt_a = (np.maximum(time_ns - times, 0) / NS_PER_S for times in (known.times_ns, known.times_a_ns))
        times, visible = np.full_like(known.times_ns, time_ns), self._still_visible(known.visible, dt_a)
        log_mu = self.filter.predict_probabilities(known.log_mu, np.stack([dt, dt_a], axis=1))
        return known._replace(times_ns=times, times_a_ns=times, visible=visible, log_mu=log_mu)

    def _recalled(self, tracks: Tracks, known: Beliefs | None) -> Tracks:
        """Tracks whose densities begin anew, with what else was known of them at that time."""
        if known is None or not len(known.ids):
            return tracks
        _, rows, others = np.intersect1d(tracks.ids, known.ids, assume_unique=True, return_indices=True)
        part, known = take(tracks, rows), take(known, others)
        if self.filter.models:
            part = part._replace(log_g=known.log_mu[:, 0], log_w=known.log_mu[:, 1])
        return put(tracks, rows, part._replace(log_odds=known.log_odds, visible=known.visible))

    def stop(self, state: State, stop: Stop) -> State:
        """Forget tracks."""
        return state._replace(tracks=take(state.tracks, ~np.isin(state.tracks.ids, stop.ids)))

    def advise(self, state: State, advice: Advice) -> State:
        """Keep advice for the next scan after its time (theory.md §6)."""
        return state._replace(advice=(*state.advice, advice))

    def _ready(self, state: State, time_ns: int, pose: SensorPose, number: int) -> Ready:
        """What the scan of a time needs: as it was prepared, where that still holds."""
        ready = state.ready
        if ready is not None and ready.fits(state, time_ns, pose, number):
            return ready
        advised = self._follow_advice(state, time_ns)
        # Another sensor may have scanned at this very time.
        again = bool(state.recent) and state.recent[-1].time_ns == time_ns
        live = advised.times_ns < time_ns + again
        moving = self._expect(take(advised, live), time_ns, pose, number)
        return Ready(state.tracks, state.advice, time_ns, pose, number, advised, live, *moving)

    def _follow_advice(self, state: State, t_ns: int) -> Tracks:
        """Set the association filters to the newest fused tracks from before ``t_ns`` and redo the scans since.

        The factors never see the advice: nothing is counted twice. Advice may be from ahead of a slow node; it waits.
        """
        past = [advice for advice in state.advice if advice.time_ns < t_ns]
        if not past:
            return state.tracks
        advice = sorted(past, key=lambda advice: advice.time_ns)[-1]  # of one time the one that came last
        tracks = state.tracks
        _, mine, given = np.intersect1d(tracks.ids, advice.ids, assume_unique=True, return_indices=True)
        # Of several models, the node's own opinion which one is in force stays.
        told, (_, _, ((x_a,), (P_a,))) = (
            self._recalled(take(tracks, mine), self._known(state, advice.time_ns)),
            self.filter.honest.start(Gaussian(advice.x[given], advice.P[given])),
        )
        told = told._replace(times_a_ns=np.full(len(mine), advice.time_ns), x_a=x_a, P_a=P_a)
        for look in state.recent:
            if look.time_ns > advice.time_ns and len(mine):
                told = self._redone(told, look)
        part = take(tracks, mine)
        return put(tracks, mine, told._replace(log_g=part.log_g, log_odds=part.log_odds))

    def _redone(self, tracks: Tracks, look: Look) -> Tracks:
        """Work a scan into association filters again; existence is for the factors to say."""
        honest, sight, dt = self.filter.honest, self.sights[look.number], _interval(tracks.times_a_ns, look.time_ns)
        prior = Mixture(tracks.log_w, tracks.log_w, Gaussian(tracks.x_a[None], tracks.P_a[None]))
        predicted, visible = honest.predict(prior, dt), self._still_visible(tracks.visible, dt)
        expected = sight.expect(honest, predicted, look.pose, visible[:, look.number])
        then = self._recalled(tracks, look.before)._replace(visible=visible)
        seen = sight.look(honest, then, predicted, expected, look)
        log_w, _, ((x_a,), (P_a,)) = seen.mixture
        times = np.full_like(tracks.times_a_ns, look.time_ns)
        return tracks._replace(log_w=log_w, x_a=x_a, P_a=P_a, times_a_ns=times, visible=seen.visible)

    def _fresh(self, start: Start) -> Tracks:
        """Tracks as they are told of."""
        network = len(self.sights) if self.schedule else 0
        both = Gaussian(np.stack([start.x, start.x_a]), np.stack([start.P, start.P_a]))
        log_w, log_g, (x, P) = self.filter.spread(both, start.log_p_bar)
        network_P = np.repeat(start.P[:, None], network, axis=1)
        models = (sight.sensor.visibility for sight in self.sights)
        visible = np.array([model.share if model is not None else 1.0 for model in models])
        return Tracks(
            ids=start.ids,
            times_ns=start.times_ns,
            log_w=log_w,
            log_g=log_g,
            x=x[0],
            P=P[0],
            times_a_ns=start.times_ns,
            x_a=x[1],
            P_a=P[1],
            log_odds=np.clip(start.log_p_bar, -SUREST, SUREST) if self.believing else np.zeros(len(start.ids)),
            visible=np.tile(visible, (len(start.ids), 1)),
            network_P=network_P,
        )

    def _expect(self, tracks: Tracks, time_ns: int, pose: SensorPose, number: int) -> tuple[Tracks, Mixture, Expected]:
        """Predict to a time, and what a sensor at a pose will see then."""
        mixture, network_P = self._predict(tracks, time_ns)
        now = np.full_like(tracks.times_ns, time_ns)
        visible = self._still_visible(tracks.visible, (time_ns - tracks.times_a_ns) / NS_PER_S)
        predicted = tracks._replace(times_ns=now, times_a_ns=now, visible=visible, network_P=network_P)
        expected = self.sights[number].expect(self.filter, mixture, pose, visible[:, number])
        return self._with(predicted, mixture), mixture, expected

    def _still_visible(self, visible: Array, dt: Array) -> Array:
        """Probabilities to be visible to each sensor after the time ``dt`` [s], shapes (T, S), (T,)."""
        visible = visible.copy()
        for sight in self.sights:
            if (model := sight.sensor.visibility) is not None:
                visible[:, sight.number] = model.predict(visible[:, sight.number], dt)
        return visible

    def _predict(self, tracks: Tracks, t_ns: int) -> tuple[Mixture, Array]:
        mixture = self._mixture(tracks)
        intervals = [_interval(times_ns, t_ns) for times_ns in (tracks.times_ns, tracks.times_a_ns)]
        if self.schedule is None:
            return self.filter.predict(mixture, *intervals), tracks.network_P
        (x, P), network_P = self._predict_globalised(tracks, self.schedule, t_ns)
        mixture = self.filter.predict(mixture, np.array(0.0), *intervals[1:])
        mixture.density.x[0, :, 0], mixture.density.P[0, :, 0] = x, P
        return mixture, network_P

    def _predict_globalised(self, tracks: Tracks, schedule: Schedule, t_ns: int) -> tuple[Gaussian, Array]:
        """Predict as ``dkf`` does: at every scan of any sensor, make all covariances equal before the prediction.

        What the other sensors' covariances are follows from the models and the schedule, never from data.
        """
        x, P, network_P, times = tracks.x[:, 0].copy(), tracks.P[:, 0].copy(), tracks.network_P.copy(), tracks.times_ns
        first = bisect_right(schedule.times_ns, int(times.min(initial=t_ns)))
        last = bisect_right(schedule.times_ns, t_ns)
        share, motion = self.filter.share, self.filter.motion
        for event_ns, scanning in zip(schedule.times_ns[first:last], schedule.sensors[first:last], strict=True):
            due = times < event_ns
            common = globalise(network_P[due])
            x_own = np.matvec(common.G[:, self.number], x[due])
            x[due], P[due] = share.predict(Gaussian(x_own, common.P), motion, _interval(times[due], event_ns))
            network_P[due] = P[due][:, None]
            for number in scanning:
                linear = self.sights[number].sensor.measurement.linearise(
                    Gaussian(x[due], P[due]), np.zeros(self.filter.motion.dimensions)
                )
                network_P[due, number] = shrink(P[due], linear.H, linear.R)
            times = np.where(due, event_ns, times)
        return Gaussian(x, P), network_P

    def _mixture(self, tracks: Tracks) -> Mixture:
        filters = [(tracks.x, tracks.P), (tracks.x_a, tracks.P_a)][: len(self.filter.shares)]
        return Mixture(tracks.log_w, tracks.log_g, Gaussian(*(np.stack(pair) for pair in zip(*filters, strict=True))))

    def _with(self, tracks: Tracks, mixture: Mixture) -> Tracks:
        """Tracks with other densities; where the factor associates for itself it is both filters."""
        x, P = mixture.density
        return tracks._replace(
            log_w=mixture.log_w,
            log_g=mixture.log_g,
            x=x[0],
            P=P[0],
            x_a=x[-1],
            P_a=P[-1],
            log_odds=self._believed(tracks, mixture.log_g),
        )

    def _believed(self, tracks: Tracks, log_g: Array) -> Array:
        """Log odds of existence after the evidence since, where they are asked for."""
        if not self.believing:
            return tracks.log_odds
        with np.errstate(invalid="ignore"):  # what was impossible stays so
            gain = log_sum_exp(log_g) - log_sum_exp(tracks.log_g)
        log_odds = np.clip(tracks.log_odds + np.where(np.isnan(gain), 0.0, gain), -SUREST, SUREST)
        # What has ended stays so.
        log_odds[tracks.log_odds == -np.inf] = -np.inf
        return log_odds


def _above(ids: IntArray, least: int) -> int:
    """The lowest id above all of ``ids``, and at least ``least``."""
    return int(ids.max(initial=least - 1)) + 1


def _rounding(scenario: Scenario, config: SensorConfig) -> Rounding:
    return Rounding(scenario.motion.dimensions, plots=config.kind == "position")


def _interval(times_ns: IntArray, t_ns: int) -> Array:
    """Seconds from ``times_ns`` to ``t_ns``, shape (T,); () when all are equal, which makes F one matrix for all."""
    dt: Array = (t_ns - times_ns) / NS_PER_S
    return dt[0, ...] if len(dt) and (dt == dt[0]).all() else dt
