"""The center as a pure step: reports, joins and ticks in, messages out.

Reports are worked in by measurement time, never by arrival. The pictures of the last few seconds are kept, so that a
late report takes its place among the others and everything after it is computed anew: inside that window the result
does not depend on the order of arrival.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.estimation.batch import take
from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.estimation.pose import Outlook
from waldnet.common.estimation.sprt import DELETED
from waldnet.common.fusion_config import FusionConfig
from waldnet.common.messages import (
    NEVER,
    Advice,
    Begin,
    Clock,
    Decision,
    Join,
    Message,
    Picked,
    Rebase,
    Report,
    Start,
    Stop,
    Tracks,
)
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.factors import Fuser
from waldnet.fusion_center.initiation import Initiation, Unclaimed
from waldnet.fusion_center.life import Life
from waldnet.fusion_center.picture import Picture, corrections, fused, shown
from waldnet.fusion_center.refusal import Refusal
from waldnet.fusion_center.selected import SelectedFuser
from waldnet.fusion_center.state import (
    AnyExpected,
    AnyFuser,
    AnyHeard,
    Begun,
    Checkpoint,
    Counts,
    Event,
    Member,
    Presence,
    State,
    Told,
    Waiting,
)

#: Wall time between the clock's announcement and its start: nodes on a slow link hear of it in time.
_LEAD_NS = 50_000_000


@dataclass(frozen=True)
class Center:
    """The steps of the center.

    Attributes:
        names: of the sensors.
        fusion: hold-back, window, feedback.
        fuser: moves the picture.
        hypotheses: the tracks given by the scenario, as a picture.
        life: tests the tracks, and ends those that nobody sees.
        initiation: how further tracks start; None: they do not.
        epoch_ns: the instant of scenario time 0.
        speed: seconds of measurement time per second, 0: lockstep.
        wait_ns: how long to wait for the others, once a sensor has joined, before the clock starts.
        first_epoch: later centers should use higher ones; nodes tell a center of higher ones when they join.
        digest: of what node and center must have in common.
    """

    names: tuple[str, ...]
    fusion: FusionConfig
    fuser: AnyFuser
    hypotheses: Picture
    life: Life
    initiation: Initiation | None
    epoch_ns: int
    speed: float
    wait_ns: int
    first_epoch: int
    digest: str

    @classmethod
    def of(cls, scenario: Scenario, *, speed: float = 0.0, wait_s: float = 10.0, first_epoch: int = 1) -> Center:
        """The center of a scenario."""
        fuser: AnyFuser = SelectedFuser.of(scenario) if scenario.fusion.mode == "selected" else Fuser.of(scenario)
        return cls(
            names=scenario.sensor_names,
            fusion=scenario.fusion,
            fuser=fuser,
            hypotheses=given(scenario, fuser),
            life=Life.of(scenario),
            initiation=Initiation.of(scenario),
            epoch_ns=scenario.epoch_ns,
            speed=speed,
            wait_ns=round(wait_s * NS_PER_S),
            first_epoch=first_epoch,
            digest=scenario.digest,
        )

    def initial(self) -> State:
        """A center that waits for its sensors."""
        return State(
            first_join_ns=None,
            clock=None,
            members=tuple(Member() for _ in self.names),
            waiting={},
            base=self.hypotheses,
            base_ns=-NEVER,
            history=(),
            counts=Counts(),
            next_id=len(self.hypotheses.ids),
            base_outlooks=self.life.begin(),
        )

    def step(self, state: State, event: Event, now_ns: int) -> tuple[State, list[Message]]:
        """Work in one event.

        Args:
            state: before.
            event: what happened.
            now_ns: wall time.

        Returns:
            the state after, and messages to publish in this order.
        """
        messages: list[Message] = []
        match event:
            case Join() if (refusal := self._other_network(event)) is not None:
                state = state.refuse(event.sensor, refusal)
            case Join():
                state, messages = self._join(state, event, now_ns)
            case Presence() if event.sensor in self.names:
                number = self.names.index(event.sensor)
                state = state.with_member(number, state.members[number]._replace(alive=event.alive))
            case Report() | Picked():
                state, messages = self._receive(state, event, now_ns)
            case _:
                pass
        state, clock = self._begin(state, now_ns)
        state, released = self._release(state, now_ns)
        state, clear = self._clear(state)
        return state, [*messages, *clock, *released, *clear]

    def prepare(self, state: State) -> State:
        """Work out ahead what the next measurement time will need, if it is known and not too far ahead."""
        if state.clock is None:
            return state
        nexts = [member.next_ns for member in state.members if member.joined and member.alive]
        time_ns = min([*state.waiting, *nexts], default=NEVER)
        if not state.time_ns < time_ns <= max(state.time_ns, state.clock.time_ns) + self._window_ns:
            return state
        return state._replace(expected=self._expected(state, time_ns))

    def deadline_ns(self, state: State) -> int | None:
        """Wall time at which a tick will change something; None: nothing is waited for."""
        if state.clock is None:
            return None if state.first_join_ns is None else state.first_join_ns + self.wait_ns
        if not state.waiting or self.speed == 0.0:
            return None
        return state.waiting[min(state.waiting)].since_ns + self._hold_back_ns

    def awaited(self, state: State) -> dict[str, int]:
        """Sensors that are there and owe a report, and the wall time since which they do.

        In lockstep these are the sensors that nobody can go on without, at wall time 0: as soon as they can.
        """
        clock = state.clock
        if clock is None or state.finished:
            return {}
        members = zip(self.names, state.members, strict=True)
        due = {name: member.next_ns for name, member in members if member.joined and member.alive}
        due = {name: next_ns for name, next_ns in due.items() if next_ns != NEVER}
        if clock.speed > 0.0:
            return {name: clock.due_ns(next_ns) for name, next_ns in due.items()}
        first_ns = min([*state.waiting, *due.values()], default=NEVER)
        return {name: 0 for name, next_ns in due.items() if next_ns <= first_ns}

    @property
    def _hold_back_ns(self) -> int:
        return round(self.fusion.hold_back * NS_PER_S)

    @property
    def _delay_ns(self) -> int:
        return round(self.fusion.feedback_delay * NS_PER_S)

    @property
    def _window_ns(self) -> int:
        return round(self.fusion.window * NS_PER_S)

    def _join(self, state: State, join: Join, now_ns: int) -> tuple[State, list[Message]]:
        """Answer a sensor with the tracks; one whose process is new gets its own last factors back."""
        number = self.names.index(join.sensor)
        member = state.members[number]
        epoch, lineage = member.epoch, member.lineage
        if not member.joined or join.incarnation != member.incarnation:
            # Above what the node heard of from an earlier center, even if the clock was set back since.
            epoch, lineage = max(self._next_epoch(state), join.epoch + 1), state.lineage
        member = Member(
            joined=True,
            alive=True,
            incarnation=join.incarnation,
            epoch=epoch,
            next_ns=join.next_ns,
            lineage=lineage,
        )
        # Tracks of an earlier center keep their ids: those that begin from now on get others.
        state = state.with_member(number, member)._replace(next_id=max(state.next_id, join.next_id))
        answer: list[Message] = [self._start(state, number, epoch)]
        if state.clock is not None:
            advice = self._advice(state) if state.history else []
            to_come = [told.rebase for told in state.told if told.rebase.epoch > state.lineage]
            answer += [*advice, *to_come, _present(state.clock, now_ns)]
        return state, answer

    def _next_epoch(self, state: State) -> int:
        told = [told.rebase.epoch for told in state.told]
        return 1 + max(self.first_epoch, *(member.epoch for member in state.members), *told)

    def _start(self, state: State, number: int, epoch: int) -> Start:
        """The live tracks for one sensor."""
        picture = state.picture
        live = picture.status != DELETED
        backup = take(self.fuser.backup(picture, number), live)
        return Start(self.names[number], epoch, picture.ids[live], *backup, next_id=state.next_id)

    def _other_network(self, join: Join) -> Refusal | None:
        """Why a sensor cannot join, if it cannot."""
        if join.sensor not in self.names:
            return "unknown sensor"
        return "another scenario" if join.digest != self.digest else None

    def _receive(self, state: State, report: Report | Picked, now_ns: int) -> tuple[State, list[Message]]:
        """Take in a report, or count why not.

        A report of the right sensor and epoch always moves on what is still to be expected of its sensor: if it cannot
        be computed with, its scan is a silent one and nobody waits for it.
        """
        refusal = self._misplaced(state, report, now_ns)
        if refusal is not None:
            return state.refuse(report.sensor, refusal), []
        number = self.names.index(report.sensor)
        member = state.members[number]
        # It does not show that its sensor is there: the end of a token may overtake the last reports.
        state = state.with_member(number, member._replace(next_ns=max(member.next_ns, report.next_ns)))
        heard = self._fitting(report, number)
        if isinstance(heard, str):
            return state.refuse(report.sensor, heard), []
        return self._accept(_left_out(state, report, heard.report), heard, now_ns)

    def _misplaced(self, state: State, report: Report | Picked, now_ns: int) -> Refusal | None:
        """Why a report is not the next one of a sensor of this network, if it is not; its content does not matter."""
        if report.sensor not in self.names:
            return "unknown sensor"
        member = state.members[self.names.index(report.sensor)]
        if not member.joined:
            return "not joined"
        to_follow = (told.rebase for told in state.told if told.rebase.epoch > member.lineage)
        follows = any(report.epoch == rebase.epoch and report.time_ns > rebase.after_ns for rebase in to_follow)
        if not (report.epoch == member.epoch or follows):
            return "older epoch" if report.epoch <= max(member.epoch, state.lineage) else "epoch not in force"
        if report.next_ns <= report.time_ns:
            return "next scan not after this one"
        return "time too far ahead" if self._ahead(state.clock, report.time_ns, now_ns) else None

    def _fitting(self, report: Report | Picked, number: int) -> AnyHeard | Refusal:
        """A report taken apart, without the tracks and plots that cannot be used, or why none of it can be."""
        if self.initiation:
            if (fault := self.initiation.fault(report, number)) is not None:
                return fault
            report = self.initiation.usable(report, number)
        return self.fuser.heard(report)

    def _ahead(self, clock: Clock | None, time_ns: int, now_ns: int) -> bool:
        """Whether a time lies farther in the future than the window: one wrong clock must not make all others late."""
        if clock is None or clock.speed == 0.0:
            return False
        return time_ns > clock.present_ns(now_ns) + self._window_ns + NS_PER_S

    def _accept(self, state: State, heard: AnyHeard, now_ns: int) -> tuple[State, list[Message]]:
        report = heard.report
        number = self.names.index(report.sensor)
        heard = heard._replace(lineage=self._lineage(state, number, report))
        if report.time_ns <= state.time_ns:
            return self._late(state, number, heard)
        since_ns = now_ns
        if state.clock is not None and state.clock.speed > 0.0:
            # A sensor whose clock is ahead must not make all others late.
            since_ns = max(now_ns, state.clock.due_ns(report.time_ns))
        waiting = state.waiting.get(report.time_ns, Waiting({}, since_ns))
        if number in waiting.reports:
            return state.counted("repeated"), []
        waiting = waiting._replace(reports={**waiting.reports, number: heard})
        return state._replace(waiting={**state.waiting, report.time_ns: waiting}), []

    def _late(self, state: State, number: int, heard: AnyHeard) -> tuple[State, list[Message]]:
        """Give a late report its place and compute anew from there on."""
        report = heard.report
        if report.time_ns <= state.base_ns:
            return state.counted("too_late"), []
        at = bisect_left(state.history, report.time_ns, key=lambda checkpoint: checkpoint.time_ns)
        past = {checkpoint.time_ns: checkpoint for checkpoint in state.history[at:]}
        groups = {time_ns: checkpoint.reports for time_ns, checkpoint in past.items()}
        group = groups.get(report.time_ns, {})
        if number in group:
            return state.counted("repeated"), []
        groups[report.time_ns] = {**group, number: heard}
        before = [decision for checkpoint in past.values() for decision in checkpoint.decisions]
        state = state._replace(history=state.history[:at]).counted("late")
        pictures: list[Message] = []
        for time_ns in sorted(groups):
            # What the nodes were told has begun, and no more than that.
            begun = past[time_ns].begun if time_ns in past else self._nothing
            state = self._work_in(state, time_ns, groups[time_ns], begun)
            pictures += [self.tracks(state), *self._advice(state)]
        after = [decision for checkpoint in state.history[at:] for decision in checkpoint.decisions]
        return state, [*corrections(before, after), *pictures, *self._begun(state, after)]

    def _work_in(
        self, state: State, time_ns: int, reports: Mapping[int, AnyHeard], begun: Begun | None = None
    ) -> State:
        """Work in the reports of a measurement time; ``begun``: that have begun then already."""
        followed = self._followed(state, max(heard.lineage for heard in reports.values()))
        if followed is None:
            lineage, expected = state.lineage, self._expected(state, time_ns)
        else:
            rebase, then = followed
            lineage = rebase.epoch
            expected = self.fuser.expect(self.fuser.rebased(state.picture, then, rebase), time_ns)
        # A node that has not followed yet speaks of factors that are no more.
        heard = {number: heard for number, heard in reports.items() if heard.lineage == lineage}
        outlooks = self._outlooks(state, time_ns, reports)
        picture, decisions = self.life.judge(self.fuser.advance(expected, heard), time_ns, outlooks)
        pairs = state.pairs
        if self.initiation is not None:
            picture, pairs, merged = self.initiation.merged(state.picture, picture, pairs)
            decisions += merged
            begun = begun or self._seeds(state, self.initiation, picture, reports)
            picture = self.fuser.begin(picture, begun.ids, np.full(len(begun.ids), time_ns), begun.density)
            state = state._replace(next_id=max([state.next_id, *(begun.ids + 1).tolist()]))
        checkpoint = Checkpoint(time_ns, reports, picture, tuple(decisions), begun, lineage, outlooks, pairs)
        return state._replace(history=(*state.history, checkpoint))

    def _outlooks(self, state: State, time_ns: int, reports: Mapping[int, AnyHeard]) -> tuple[Outlook, ...]:
        """Of the sensors after the reports of a measurement time."""
        told = {number: heard.report.pose for number, heard in reports.items() if len(heard.report.position)}
        return self.life.look(state.outlooks, told, time_ns - state.time_ns)

    def _seeds(self, state: State, initiation: Initiation, picture: Picture, reports: Mapping[int, AnyHeard]) -> Begun:
        """The tracks that begin at the measurement time of a picture (theory.md §8)."""
        before = [scan for past in state.history for scan in _unclaimed(past.reports)]
        density = initiation.seeds(picture, _unclaimed(reports), before)
        return Begun(state.next_id + np.arange(len(density.x)), density)

    @property
    def _nothing(self) -> Begun | None:
        """Of late reports no track begins: the nodes, which went on without, have what they need to start it later."""
        n = self.hypotheses.x0.shape[1]
        return Begun(np.empty(0, np.int64), Gaussian(np.empty((0, n)), np.empty((0, n, n))))

    def _begun(self, state: State, decisions: Sequence[Decision]) -> list[Message]:
        """The tracks that began at the newest time, and those that were deleted; in lockstep nodes wait for word."""
        begun = state.history[-1].begun
        if begun is None:
            return []
        ended = np.unique([decision.track for decision in decisions if decision.kind in ("deleted", "lost", "merged")])
        if not len(begun.ids) and not len(ended) and self.speed > 0.0:
            return []
        times_ns = np.full(len(begun.ids), state.time_ns)
        return [Begin(self.first_epoch, state.time_ns, begun.ids, times_ns, *begun.density, ended.astype(np.int64))]

    def _lineage(self, state: State, number: int, report: Report | Picked) -> int:
        """Epoch of the rebase that a report's factors descend from."""
        followed = any(told.rebase.epoch == report.epoch for told in state.told)
        return report.epoch if followed else state.members[number].lineage

    def _followed(self, state: State, lineage: int) -> tuple[Rebase, Picture] | None:
        """The rebase of a lineage, if it is newer than that of the picture, and the picture of its time."""
        for rebase, then in state.told:
            if rebase.epoch == lineage > state.lineage:
                pictures = {past.time_ns: past.picture for past in state.history}
                picture = pictures.get(rebase.time_ns, then)
                return None if picture is None else (rebase, picture)
        return None

    def _expected(self, state: State, time_ns: int) -> AnyExpected:
        """The newest picture at a later time: as it was prepared, where that still holds."""
        expected = state.expected
        if expected is not None and expected.picture is state.picture and expected.t_ns == time_ns:
            return expected
        return self.fuser.expect(state.picture, time_ns)

    def _begin(self, state: State, now_ns: int) -> tuple[State, list[Message]]:
        """Start the clock once all sensors are there, or after the wait with those that are."""
        joined = [member for member in state.members if member.joined]
        if state.clock is not None or not joined:
            return state, []
        since_ns = now_ns if state.first_join_ns is None else state.first_join_ns
        if len(joined) < len(self.names) and now_ns - since_ns < self.wait_ns:
            return state._replace(first_join_ns=since_ns), []
        first_ns = min(member.next_ns for member in joined)
        start_ns = self.epoch_ns if first_ns == NEVER else first_ns
        # In lockstep nothing is worked in yet, or nodes would not wait for the feedback of the first measurement time.
        time_ns = start_ns if self.speed > 0.0 else start_ns - 1
        clock = Clock(time_ns=time_ns, wall_ns=now_ns + _LEAD_NS, speed=self.speed, clear_ns=start_ns)
        return state._replace(clock=clock), [clock]

    def _release(self, state: State, now_ns: int) -> tuple[State, list[Message]]:
        """Work in every measurement time for which nothing more is to be expected or waited for."""
        messages: list[Message] = []
        while state.clock is not None and state.waiting:
            time_ns = min(state.waiting)
            waiting = state.waiting[time_ns]
            expected = any(member.alive and member.next_ns <= time_ns for member in state.members if member.joined)
            overdue = self.speed > 0.0 and now_ns - waiting.since_ns >= self._hold_back_ns
            if expected and not overdue:
                break
            rest = {time: group for time, group in state.waiting.items() if time != time_ns}
            state = self._work_in(state._replace(waiting=rest), time_ns, waiting.reports)
            decisions, tracks = state.history[-1].decisions, self.tracks(state)
            told = [*self._begun(state, decisions), *self._advice(state)]
            state, rebase = self._rebase(state)
            state, stops = self._forget(state)
            # In lockstep a node goes on once it is told what begins or advised: tracks that end come before.
            messages += [*decisions, tracks, *stops, *told, *rebase]
        return state, messages

    def _forget(self, state: State) -> tuple[State, list[Message]]:
        """Let go of checkpoints older than the window; only now are their deletions final and the nodes told."""
        oldest_ns = state.time_ns - self._window_ns
        keep = bisect_left(state.history, oldest_ns, key=lambda checkpoint: checkpoint.time_ns)
        keep = min(keep, len(state.history) - 1)
        gone, state = state.history[:keep], state._replace(history=state.history[keep:])
        if not gone:
            return state, []
        base = gone[-1]
        pictures = {past.time_ns: past.picture for past in gone}
        # A node that was cut off longer than this follows the newest; the factors of now descend from their own.
        told = tuple(
            Told(rebase, pictures.get(rebase.time_ns, then))
            for rebase, then in state.told
            if rebase.epoch == base.lineage or rebase.after_ns > base.time_ns - self._window_ns
        )
        state = state._replace(
            base=base.picture,
            base_ns=base.time_ns,
            base_lineage=base.lineage,
            base_outlooks=base.outlooks,
            base_pairs=base.pairs,
            told=told,
        )
        deleted = [checkpoint.picture.ids[checkpoint.picture.status == DELETED] for checkpoint in gone]
        ids = np.unique(np.concatenate(deleted))
        if not len(ids):
            return state, []
        members = zip(self.names, state.members, strict=True)
        return state, [Stop(name, ids) for name, member in members if member.joined]

    def _clear(self, state: State) -> tuple[State, list[Message]]:
        """Tell the nodes how far they may go in lockstep, and, at any speed, that all is done."""
        if state.clock is None or state.waiting:
            return state, []
        joined = [member for member in state.members if member.joined]
        nexts = [member.next_ns for member in joined if member.alive]
        time_ns, clear_ns = state.clock.time_ns, state.clock.clear_ns
        if all(next_ns == NEVER for next_ns in nexts) and any(member.next_ns == NEVER for member in joined):
            clear_ns = NEVER
        elif self.speed == 0.0 and nexts:
            time_ns, clear_ns = max(time_ns, state.time_ns), max(clear_ns, min(nexts))
        if clear_ns == state.clock.clear_ns:
            return state, []
        clock = state.clock._replace(time_ns=time_ns, clear_ns=clear_ns)
        return state._replace(clock=clock), [clock]

    def _advice(self, state: State) -> list[Message]:
        """The fused tracks of the delay ago for the association filters, where that is wanted (theory.md §6)."""
        if self.fusion.feedback != "advice":
            return []
        at = bisect_right(state.history, state.time_ns - self._delay_ns, key=lambda checkpoint: checkpoint.time_ns)
        time_ns, picture = (state.history[at - 1].time_ns, state.history[at - 1].picture) if at else (0, state.base)
        return [Advice(state.time_ns, time_ns, *fused(picture, time_ns))]

    def _rebase(self, state: State) -> tuple[State, list[Message]]:
        """Let all factors begin anew from the fused tracks once the delay is over, where wanted (theory.md §3)."""
        if self.fusion.feedback != "reset":
            return state, []
        time_ns = state.time_ns
        rebase = Rebase(self._next_epoch(state), time_ns + self._delay_ns, time_ns, *fused(state.picture, time_ns))
        return state._replace(told=(*state.told, Told(rebase))), [rebase]

    def tracks(self, state: State) -> Tracks:
        """The newest picture as a message: all tracks that have started."""
        return shown(state.picture, state.time_ns, self.names)


def _present(clock: Clock, now_ns: int) -> Clock:
    """The same clock, told from now on: a node that joins learns the present without a look at its own clock."""
    if clock.speed == 0.0 or now_ns <= clock.wall_ns:
        return clock
    return clock._replace(time_ns=clock.present_ns(now_ns), wall_ns=now_ns)


def given(scenario: Scenario, fuser: AnyFuser) -> Picture:
    """The tracks that a scenario gives."""
    if not scenario.hypotheses:
        return fuser.empty()
    priors = [hypothesis.density for hypothesis in scenario.hypotheses]
    return fuser.begin(
        fuser.empty(),
        np.arange(len(priors)),
        np.array([scenario.to_ns(hypothesis.start) for hypothesis in scenario.hypotheses]),
        Gaussian(np.array([prior.x for prior in priors]), np.array([prior.P for prior in priors])),
    )


def _left_out(state: State, came: Report | Picked, used: Report | Picked) -> State:
    """The state with the tracks and plots counted that a report has lost because they cannot be computed with."""
    state = state.counted("unusable_tracks", len(came.ids) - len(used.ids))
    plots = len(came.unclaimed) - len(used.unclaimed)
    if isinstance(came, Picked) and isinstance(used, Picked):
        plots += len(came.z) - len(used.z)
    return state.counted("unusable_plots", plots)


def _unclaimed(reports: Mapping[int, AnyHeard]) -> list[Unclaimed]:
    """The plots of one measurement time that no track claims, by sensor."""
    return [Unclaimed.of(number, reports[number].report) for number in sorted(reports)]
