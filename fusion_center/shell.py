"""The shell of the fusion center: reads bus and clock, calls the pure step, writes the bus."""

from __future__ import annotations

import time

import structlog

from waldnet.common import notice
from waldnet.common.clock import now_ns, set_by_ns
from waldnet.common.codec import decode, encode
from waldnet.common.config import Network, Scenario
from waldnet.common.decision_filter import DecisionFilter
from waldnet.common.errors import DecodeError
from waldnet.common.health import Health, age_s
from waldnet.common.inbox import Asked, Heard, Inbox, Incoming, Missed, Present, Stopped
from waldnet.common.logs import Complaints
from waldnet.common.messages import (
    NEVER,
    Clock,
    Decision,
    Join,
    Keys,
    Message,
    Picked,
    Report,
    ToCenter,
    Tracks,
    sensor_of,
)
from waldnet.common.notice import Notice
from waldnet.common.transport import PEER_OF_ROUTER, Bus, Publisher
from waldnet.fusion_center.center import Center
from waldnet.fusion_center.punctuality import Punctuality
from waldnet.fusion_center.refusal import by_sensor
from waldnet.fusion_center.silence import PATIENCE_NS, Silence
from waldnet.fusion_center.state import Event, Presence, State, Tick

#: How long a finished center stays for nodes that have not heard of the end yet.
_LINGER_NS = 2_000_000_000
#: How often the center looks which sensors are silent.
_LOOK_NS = 1_000_000_000
#: Refusals of what is no report of a sensor that has joined this center, or was none yet.
_OF_ANOTHER_TIME = ("unknown sensor", "another scenario", "not joined", "older epoch", "epoch not in force")


class CenterShell:
    """The fusion center on a bus; ``run`` blocks, ``stop`` may be called from anywhere, a signal handler too."""

    def __init__(
        self,
        bus: Bus,
        network: Network,
        scenario: Scenario,
        center: Center,
        *,
        inbox: Inbox | None = None,
        verbose: bool = False,
    ) -> None:
        """Take part in a network.

        Args:
            bus: where everything is heard and said.
            network: for its name.
            scenario: for times in logs.
            center: the pure step.
            inbox: where somebody may have asked to stop already.
            verbose: log decisions on tracks that were never confirmed too.
        """
        self._bus, self._scenario, self._center = bus, scenario, center
        self._log: structlog.typing.FilteringBoundLogger = structlog.get_logger().bind(center=scenario.name)
        self.complaints = Complaints(self._log)
        self._inbox = inbox or Inbox()
        self._keys = Keys(network.name)
        self._state = center.initial()
        self._publishers: dict[str, Publisher] = {}
        self._picture: Tracks = center.tracks(self._state)
        self._filter = DecisionFilter(scenario, verbose=verbose)
        self._stopped = False
        names = center.names
        self._reported_s: dict[str, float | None] = dict.fromkeys(names)
        self._pictured_s: float | None = None
        self._heard_ns: dict[str, int] = dict.fromkeys(names, 0)
        self._progress_ns = self._look_ns = now_ns()
        self._lonely_ns = self._look_ns + PATIENCE_NS
        self._silence = Silence()
        self._told: list[Notice] = []
        self._punctuality = Punctuality(center.fusion.hold_back)

    def stop(self) -> None:
        """End ``run`` soon."""
        self._inbox.stop()

    def run(self) -> None:
        """Serve until all sources are exhausted or ``stop`` is called."""
        self._open()
        while not self._stopped and not self._state.finished:
            deadline_ns = self._center.deadline_ns(self._state)
            self._handle(self._inbox.receive(min(self._look_ns if deadline_ns is None else deadline_ns, self._look_ns)))
            if now_ns() >= self._look_ns:
                self._look_around()
        self._sum_up_refusals()
        linger_until = now_ns() + _LINGER_NS
        while not self._stopped and any(member.alive for member in self._state.members):
            if now_ns() >= linger_until:
                break
            self._handle(self._inbox.receive(linger_until))
        self._log.info(
            "ended",
            reports=self._state.counts._asdict(),
            refused=by_sensor(self._state.refused),
            dropped=dict(self.complaints.counts),
        )

    def _open(self) -> None:
        keys = self._keys
        commands = [keys.command(name) for name in self._center.names]
        for key in (*commands, keys.clock(), keys.advice(), keys.tracks(), keys.decision(), keys.notice()):
            self._publishers[key] = self._bus.publisher(key, cache=200)
        self._bus.answer(keys.picture(), lambda: encode(self._picture))
        self._bus.subscribe(keys.report(), self._inbox.heard, on_miss=self._inbox.missed)
        self._bus.subscribe(keys.join(), self._inbox.heard)
        self._bus.watch(keys.sensor_alive(), self._inbox.present)
        self._bus.announce(keys.center_alive())
        self._log.info("waiting for sensors", sensors=list(self._center.names), at=list(self._bus.endpoints()))

    def _handle(self, incoming: Incoming) -> None:
        match incoming:
            case Heard(key, payload):
                self._hear(key, payload)
            case Present(key, alive):
                self._step(Presence(sensor_of(key), alive))
                self._say_presence(sensor_of(key), alive)
            case Missed(key, number):
                self.complaints.add("lost reports", f"{key}: the next one restores their evidence", number)
            case Asked(answer):
                answer(self._health())
            case Stopped():
                self._stopped = True
            case _:
                self._step(Tick())

    def _health(self) -> Health:
        sensors = [name for name, member in zip(self._center.names, self._state.members, strict=True) if member.alive]
        ages = {name: age_s(at) for name, at in self._reported_s.items()}
        return {
            "role": "center",
            "linked": bool(sensors),
            "last_report_s": min([age for age in ages.values() if age is not None], default=None),
            "last_report_s_of": ages,
            "last_picture_s": age_s(self._pictured_s),
            "waiting_s_for": {name: round((now_ns() - since_ns) / 1e9, 3) for name, since_ns in self._owing().items()},
            "clock_offset_s_of": {name: round(-lag_s, 3) for name, lag_s in self._punctuality.offsets_s.items()},
            "sensors": sensors,
            "of": len(self._center.names),
            "tracks": len(self._picture.ids),
            "reports": self._state.counts._asdict(),
            "refused": by_sensor(self._state.refused),
            "dropped": dict(self.complaints.counts),
        }

    def _hear(self, key: str, payload: bytes) -> None:
        try:
            message = decode(key, payload)
        except DecodeError as error:
            self.complaints.add("bad bytes", str(error))
            return
        if isinstance(message, ToCenter):
            self._step(message)
        else:
            self.complaints.add("unexpected", f"{key}: a {type(message).__name__} from a sensor")

    def _step(self, event: Event) -> None:
        before, at_ns = self._state, now_ns()
        self._state, messages = self._center.step(before, event, at_ns)
        for message in messages:
            self._publish(message)
        if self._state.members != before.members or self._state.time_ns != before.time_ns:
            self._progress_ns = at_ns
        if self._state.counts.refused == before.counts.refused:
            self._note(event, before, at_ns)
        if self._state.counts != before.counts:
            self._complain(event, before, at_ns)
        if self._state.clock is not None and before.clock is None:
            absent = [n for n, m in zip(self._center.names, self._state.members, strict=True) if not m.joined]
            self._log.info("clock started", speed=self._center.speed or "lockstep", without=absent)
            for name in absent:
                self._publish_notice(Notice("silent", name, f"{name} has not joined: the clock starts without it"))
        if self._inbox.empty:
            self._state = self._center.prepare(self._state)

    def _note(self, event: Event, before: State, at_ns: int) -> None:
        """Note what was not refused."""
        match event:
            case Join():
                self._heard_ns[event.sensor] = at_ns
                if _epochs(before) != _epochs(self._state):
                    self._log.info("sensor joined", sensor=event.sensor, next_s=self._seconds(event.next_ns))
            case Report() | Picked():
                dropped = [(counts.too_late, counts.repeated) for counts in (before.counts, self._state.counts)]
                if dropped[0] == dropped[1]:
                    self._reported_s[event.sensor] = time.monotonic()
                self._note_arrival(event, at_ns)
            case _:
                pass

    def _note_arrival(self, report: Report | Picked, at_ns: int) -> None:
        """Note when a report came: sensors whose clocks are wrong are named."""
        self._heard_ns[report.sensor] = at_ns
        clock = self._state.clock
        if clock is None or clock.speed == 0.0:
            return
        for name, said in self._punctuality.note(report.sensor, (at_ns - clock.due_ns(report.time_ns)) / 1e9):
            self._say(Notice("clock", name, said))

    def _complain(self, event: Event, before: State, at_ns: int) -> None:
        """Say what did not go the straight way, and of which sensor."""
        now, what = self._state, "message" if isinstance(event, Join) else "report"
        sensor: str = getattr(event, "sensor", "")
        # Whoever reaches the network may invent names.
        about = {"sensor": sensor} if sensor in self._center.names else {}
        for kind, old, new in zip(now.counts._fields, before.counts, now.counts, strict=True):
            if new > old and kind.startswith("unusable"):
                named = kind.replace("_", " ")
                self.complaints.add(named, _summary(event), new - old, **about)
                self._publish_once(Notice("refused", sensor, f"{sensor}: {named} are left out of its reports"))
            elif new > old and kind != "refused":
                self.complaints.add(f"{kind} {what}", _summary(event), new - old, **about)
        refused = [key for key, number in now.refused.items() if number != before.refused.get(key)]
        for key in refused:
            said = self.complaints.add(f"refused {what}", f"{key[1]}: {_summary(event)}", 1, **about)
            match event:
                case Join() if said:
                    self._tell_of_scenario(event)
                case Report() | Picked() if key[1] not in _OF_ANOTHER_TIME:
                    self._note_arrival(event, at_ns)
                    self._publish_once(Notice("refused", sensor, f"{sensor}: a report was refused: {key[1]}"))
                case _:
                    pass

    def _sum_up_refusals(self) -> None:
        for (sensor, why), number in self._state.refused.items():
            if number > 1 and why not in _OF_ANOTHER_TIME:
                self._publish_notice(
                    Notice("refused", sensor, f"{sensor}: {number} reports in all were refused: {why}")
                )

    def _tell_of_scenario(self, join: Join) -> None:
        """Let a node know that its scenario is another one than the center's."""
        name = self._scenario.name
        text = f"{join.sensor} cannot join: its scenario differs from the center's, {name!r}"
        self._publish_notice(Notice("another scenario", join.sensor, text, join.digest, self._scenario.digests))

    def _owing(self) -> dict[str, int]:
        """Sensors whose report is due, and since when that is so."""
        lockstep = self._center.speed == 0.0
        owing = {}
        for name, due_ns in self._center.awaited(self._state).items():
            since_ns = self._progress_ns if lockstep else max(due_ns, self._heard_ns[name])
            if since_ns <= now_ns():
                owing[name] = since_ns
        return owing

    def _look_around(self) -> None:
        """Say which sensors are there and silent: in lockstep all wait for them, at other speeds nobody does."""
        self._look_ns = now_ns() + _LOOK_NS
        silent, again = self._silence.look(self._owing(), now_ns())
        consequence = "everybody waits for it" if self._center.speed == 0.0 else "the others go on without it"
        for name, length_s in silent.items():
            next_s = self._seconds(self._state.members[self._center.names.index(name)].next_ns)
            missing = f"its report of {next_s} s has been missing for {length_s:.0f} s"
            self._say(Notice("silent", name, f"{name} is there, but {missing}: {consequence}"))
        for name in again:
            self._log.info("heard again", sensor=name)
        lonely = not any(member.joined for member in self._state.members) and now_ns() >= self._lonely_ns
        if lonely and self._bus.peer_of_router:
            self._lonely_ns = NEVER
            self._say(Notice("router", "", f"no sensor reaches the center: it {PEER_OF_ROUTER}"))

    def _say(self, said: Notice) -> None:
        """Log a notice, and tell everybody."""
        about = {"sensor": said.sensor} if said.sensor else {}
        self._log.warning(said.kind, why=said.text, **about)
        self._publish_notice(said)

    def _publish_once(self, told: Notice) -> None:
        if told not in self._told:
            self._told.append(told)
            self._publish_notice(told)

    def _publish_notice(self, said: Notice) -> None:
        self._publishers[self._keys.notice()].put(notice.encode(said))

    def _say_presence(self, name: str, alive: bool) -> None:
        if name not in self._center.names:
            self.complaints.add("unknown sensor", f"{name!r} is there, but not in scenario {self._scenario.name}")
            return
        member = self._state.members[self._center.names.index(name)]
        if not alive and member.joined and member.next_ns != NEVER:
            self._log.warning("sensor lost; its factors stay, predicted, and the others go on", sensor=name)

    def _seconds(self, t_ns: int) -> float | str:
        return "never" if t_ns == NEVER else self._scenario.to_seconds(t_ns)

    def _publish(self, message: Message) -> None:
        match message:
            case Tracks():
                self._picture, self._pictured_s = message, time.monotonic()
                if not self._publishers[self._keys.tracks()].has_listeners:
                    return
            case Decision() if self._filter.passes(message):
                time_s = self._scenario.to_seconds(message.time_ns)
                self._log.info(message.kind, track=message.track, time_s=time_s, log_lr=round(message.log_lr, 2))
            case Clock():
                message = message._replace(wall_ns=message.wall_ns + set_by_ns())
            case _:
                pass
        self._publishers[self._keys.of(message)].put(encode(message))


def _summary(event: Event) -> str:
    match event:
        case Report() | Picked():
            return f"{event.sensor} at {event.time_ns} ns, epoch {event.epoch}, {len(event.ids)} tracks"
        case Join():
            return f"{event.sensor} asks to join with a scenario of digest {event.digest}"
        case _:
            return type(event).__name__


def _epochs(state: State) -> list[int]:
    """A sensor that joins gets a new epoch; one that only asks again keeps its own."""
    return [member.epoch for member in state.members]
