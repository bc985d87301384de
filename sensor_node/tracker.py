"""The local tracker of a sensor: pure steps from scans and commands to reports.

State and events go in, state and messages come out; no clock, no network. A live process, a replay and a study run
the same code.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from common.config import Scenario, SensorConfig
from common.estimation.association import Clutter, Expected, Plots, expect, pdaf, update
from common.estimation.batch import concatenate, put, take
from common.estimation.gaussian import Array, BoolArray, Gaussian
from common.estimation.motion import Motion
from common.estimation.representation import Share, globalise, shrink
from common.estimation.sensing import Sensor
from common.messages import Advice, IntArray, Report, Scan, Start, Stop
from common.quantities import NS_PER_S

#: The honest prior and noise of the association filter.
HONEST = Share(1.0)


class Tracks(NamedTuple):
    """What a node keeps of every track, one row a track.

    Attributes:
        ids: ascending, shape (T,).
        times_ns: of the factors, shape (T,).
        log_p_bar: cumulative since the start, shape (T,).
        x, P: factors, shapes (T, n), (T, n, n).
        times_a_ns: of the association filters, shape (T,).
        x_a, P_a: association filters.
        network_P: for ``dkf``, the covariances that all sensors' factors have by the models alone, shape
            (T, S, n, n); otherwise S = 0.
    """

    ids: IntArray
    times_ns: IntArray
    log_p_bar: Array
    x: Array
    P: Array
    times_a_ns: IntArray
    x_a: Array
    P_a: Array
    network_P: Array


class Ready(NamedTuple):
    """All of the next scan that its plots do not change.

    Attributes:
        tracks, advice: of the state that it was worked out from; it is of use as long as these are the same.
        time_ns, position: of the scan.
        advised: all tracks, advice followed.
        live: which of them started before the scan.
        predicted: those, at the time of the scan.
        expected: those, as the sensor will see them.
    """

    tracks: Tracks
    advice: tuple[Advice, ...]
    time_ns: int
    position: Array
    advised: Tracks
    live: BoolArray
    predicted: Tracks
    expected: Expected

    def fits(self, state: State, time_ns: int, position: Array) -> bool:
        """Whether it was worked out from the tracks and advice of a state, for the scan of that time and position."""
        same_state = self.tracks is state.tracks and self.advice is state.advice
        return same_state and self.time_ns == time_ns and np.array_equal(self.position, position)


class State(NamedTuple):
    """State of a node.

    Attributes:
        epoch: of the newest start message.
        sequence: number of the next report.
        tracks: the tracks.
        recent: scans of the last few seconds, oldest first, for tracks and advice that come late.
        advice: not followed yet, oldest first.
        ready: worked out ahead for the next scan, or None. It saves time and changes nothing.
    """

    epoch: int
    sequence: int
    tracks: Tracks
    recent: tuple[Scan, ...]
    advice: tuple[Advice, ...] = ()
    ready: Ready | None = None


class Schedule(NamedTuple):
    """Scan times of the whole network, which ``dkf`` must know beforehand.

    Attributes:
        times_ns: ascending.
        sensors: for every time, the numbers of the sensors that scan then.
    """

    times_ns: Sequence[int]
    sensors: Sequence[tuple[int, ...]]


@dataclass(frozen=True)
class LocalTracker:
    """The steps of one sensor's tracker.

    Attributes:
        motion: motion model.
        config: the sensor as the scenario describes it.
        sensor: the sensor model.
        sensors: models of all sensors of the network.
        number: of this sensor among them.
        share: its share of prior and process noise.
        tight: associate with a filter of its own (theory.md §5).
        advised: the fused track comes back as advice (theory.md §6).
        rounded: reports are in single precision.
        digest: of what the center must have in common with this node.
        gate_probability: that the target's plot is inside the gate.
        buffer_ns: how long scans are kept.
        schedule: scan times of the network, only for ``dkf``.
    """

    motion: Motion
    config: SensorConfig
    sensor: Sensor
    sensors: tuple[Sensor, ...]
    number: int
    share: Share
    tight: bool
    advised: bool
    rounded: bool
    digest: str
    gate_probability: float
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
        motion = scenario.motion.build()
        config = scenario.sensor(name)
        sensors = tuple(sensor.build(motion) for sensor in scenario.sensors)
        number = scenario.sensor_names.index(name)
        return cls(
            motion=motion,
            config=config,
            sensor=sensors[number],
            sensors=sensors,
            number=number,
            share=scenario.share,
            tight=scenario.fusion.association == "tight",
            advised=scenario.fusion.feedback == "advice",
            rounded=scenario.fusion.precision == "float32",
            digest=scenario.digest,
            gate_probability=scenario.fusion.gate_probability,
            buffer_ns=round(scenario.fusion.window * NS_PER_S),
            schedule=schedule if scenario.fusion.mode == "dkf" else None,
        )

    def initial(self) -> State:
        """A node that was told of no track yet."""
        n = self.motion.n
        network = len(self.sensors) if self.schedule else 0
        none, x, P = np.empty(0, np.int64), np.empty((0, n)), np.empty((0, n, n))
        tracks = Tracks(none, none, np.empty(0), x, P, none, x, P, np.empty((0, network, n, n)))
        return State(epoch=0, sequence=0, tracks=tracks, recent=())

    def prepare(self, state: State, time_ns: int, position: Array) -> State:
        """Work out ahead what the next scan will need: its time and the place of the sensor must be known, no more."""
        return state._replace(ready=self._ready(state, time_ns, position))

    def scan(self, state: State, scan: Scan, next_ns: int) -> tuple[State, Report]:
        """Filter one scan and report every track that started before it."""
        ready = self._ready(state, scan.time_ns, scan.position)
        filtered = self._update(ready.predicted, ready.expected, scan)
        tracks = filtered if ready.live.all() else put(ready.advised, ready.live, filtered)
        advice = tuple(later for later in state.advice if later.time_ns >= scan.time_ns)
        kept = tuple(old for old in state.recent if old.time_ns >= scan.time_ns - self.buffer_ns)
        x, P = filtered.x, filtered.P
        if self.rounded:
            x, P = x.astype(np.float32).astype(np.float64), P.astype(np.float32).astype(np.float64)
        report = Report(
            sensor=self.config.name,
            sequence=state.sequence,
            time_ns=scan.time_ns,
            next_ns=next_ns,
            epoch=state.epoch,
            ids=filtered.ids,
            terms=np.ones_like(filtered.ids),
            log_g=filtered.log_p_bar,
            x=x,
            P=P,
        )
        return State(state.epoch, state.sequence + 1, tracks, (*kept, scan), advice), report

    def start(self, state: State, start: Start) -> State:
        """Take over tracks, and catch up on the scans since their start; a higher epoch names all tracks there are."""
        if start.epoch > state.epoch:
            state = state._replace(tracks=self.initial().tracks)
        known = np.isin(start.ids, state.tracks.ids)
        fresh = self._fresh(start, ~known)
        for scan in state.recent:
            due = fresh.times_ns < scan.time_ns
            fresh = put(fresh, due, self._filter(take(fresh, due), scan))
        tracks = concatenate(state.tracks, fresh)
        tracks = take(tracks, np.argsort(tracks.ids))
        return state._replace(epoch=max(state.epoch, start.epoch), tracks=tracks)

    def stop(self, state: State, stop: Stop) -> State:
        """Forget tracks."""
        return state._replace(tracks=take(state.tracks, ~np.isin(state.tracks.ids, stop.ids)))

    def advise(self, state: State, advice: Advice) -> State:
        """Keep advice for the next scan after its time (theory.md §6)."""
        return state._replace(advice=(*state.advice, advice))

    def _ready(self, state: State, time_ns: int, position: Array) -> Ready:
        """What the scan of a time needs: as it was prepared, where that still holds."""
        ready = state.ready
        if ready is not None and ready.fits(state, time_ns, position):
            return ready
        advised = self._follow_advice(state, time_ns)
        live = advised.times_ns < time_ns
        predicted, expected = self._expect(take(advised, live), time_ns, position)
        return Ready(state.tracks, state.advice, time_ns, position, advised, live, predicted, expected)

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
        x_a, P_a, times = tracks.x_a.copy(), tracks.P_a.copy(), tracks.times_a_ns.copy()
        x_a[mine], P_a[mine], times[mine] = advice.x[given], advice.P[given], advice.time_ns
        for scan in state.recent:
            due = times < scan.time_ns
            if due.any():
                predicted = HONEST.predict(
                    Gaussian(x_a[due], P_a[due]), self.motion, _interval(times[due], scan.time_ns)
                )
                linear = self.sensor.measurement.linearise(predicted, scan.position)
                filtered = pdaf(predicted, self._plots(scan), linear, self._clutter(predicted, scan.position))
                (x_a[due], P_a[due]), times[due] = filtered.density, scan.time_ns
        return tracks._replace(x_a=x_a, P_a=P_a, times_a_ns=times)

    def _fresh(self, start: Start, rows: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Tracks:
        network = len(self.sensors) if self.schedule else 0
        network_P = np.repeat(start.P[:, None], network, axis=1)
        tracks = Tracks(
            start.ids,
            start.times_ns,
            start.log_p_bar,
            start.x,
            start.P,
            start.times_ns,
            start.x_a,
            start.P_a,
            network_P,
        )
        return take(tracks, rows)

    def _filter(self, tracks: Tracks, scan: Scan) -> Tracks:
        """Predict to the scan and filter it."""
        return self._update(*self._expect(tracks, scan.time_ns, scan.position), scan)

    def _expect(self, tracks: Tracks, time_ns: int, position: Array) -> tuple[Tracks, Expected]:
        """Predict to a time, and what the sensor will see from a position then."""
        now = np.full_like(tracks.times_ns, time_ns)
        factor, network_P = self._predict_factors(tracks, time_ns)
        filters, association = [factor], Gaussian(tracks.x_a, tracks.P_a)
        if self.tight:
            association = HONEST.predict(association, self.motion, _interval(tracks.times_a_ns, time_ns))
            filters.append(association)
        both = Gaussian(*(np.stack(arrays) for arrays in zip(*filters, strict=True)))
        linear = self.sensor.measurement.linearise(both, position)
        predicted = Tracks(tracks.ids, now, tracks.log_p_bar, *factor, now, *association, network_P)
        return predicted, expect(both, linear, self._clutter(filters[-1], position))

    def _update(self, predicted: Tracks, expected: Expected, scan: Scan) -> Tracks:
        """Filter a scan."""
        (x, P), log_p_bar = update(expected, self._plots(scan))
        tracks = predicted._replace(log_p_bar=predicted.log_p_bar + log_p_bar, x=x[0], P=P[0])
        return tracks._replace(x_a=x[1], P_a=P[1]) if self.tight else tracks

    def _plots(self, scan: Scan) -> Plots:
        return Plots(scan.z, log_relative=self.sensor.log_relative(scan.z, scan.position))

    def _clutter(self, density: Gaussian, position: Array) -> Clutter:
        p_d = self.sensor.detection_probability(density, position, self.config.view_center(position))
        return Clutter(p_d, np.array(self.sensor.log_rho_f), self.gate_probability)

    def _predict_factors(self, tracks: Tracks, t_ns: int) -> tuple[Gaussian, Array]:
        factor = Gaussian(tracks.x, tracks.P)
        if self.schedule is None:
            return self.share.predict(factor, self.motion, _interval(tracks.times_ns, t_ns)), tracks.network_P
        return self._predict_globalised(tracks, self.schedule, t_ns)

    def _predict_globalised(self, tracks: Tracks, schedule: Schedule, t_ns: int) -> tuple[Gaussian, Array]:
        """Predict as ``dkf`` does: at every scan of any sensor, make all covariances equal before the prediction.

        What the other sensors' covariances are follows from the models and the schedule, never from data.
        """
        x, P, network_P, times = tracks.x.copy(), tracks.P.copy(), tracks.network_P.copy(), tracks.times_ns.copy()
        first = bisect_right(schedule.times_ns, int(times.min(initial=t_ns)))
        last = bisect_right(schedule.times_ns, t_ns)
        for event_ns, scanning in zip(schedule.times_ns[first:last], schedule.sensors[first:last], strict=True):
            due = times < event_ns
            common = globalise(network_P[due])
            x_own = np.matvec(common.G[:, self.number], x[due])
            x[due], P[due] = self.share.predict(Gaussian(x_own, common.P), self.motion, _interval(times[due], event_ns))
            network_P[due] = P[due][:, None]
            for number in scanning:
                linear = self.sensors[number].measurement.linearise(
                    Gaussian(x[due], P[due]), np.zeros(self.motion.dimensions)
                )
                network_P[due, number] = shrink(P[due], linear.H, linear.R)
            times[due] = event_ns
        return Gaussian(x, P), network_P


def _interval(times_ns: IntArray, t_ns: int) -> Array:
    """Seconds from ``times_ns`` to ``t_ns``, shape (T,); () when all are equal, which makes F one matrix for all."""
    dt: Array = (t_ns - times_ns) / NS_PER_S
    return dt[0, ...] if len(dt) and (dt == dt[0]).all() else dt
