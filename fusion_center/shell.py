"""The shell of the fusion center: reads bus and clock, calls the pure step, writes the bus."""

from __future__ import annotations

import time

import structlog

from common.codec import decode, encode
from common.config import Network, Scenario
from common.errors import DecodeError
from common.health import Health, age_s
from common.inbox import Asked, Heard, Inbox, Incoming, Missed, Present, Stopped
from common.logs import Complaints
from common.messages import NEVER, Decision, Join, Keys, Message, Picked, Report, Tracks, sensor_of
from common.transport import Bus, Publisher
from fusion_center.center import Center
from fusion_center.refusal import by_sensor
from fusion_center.state import Event, Presence, State, Tick

#: How long a finished center stays for nodes that have not heard of the end yet.
_LINGER_NS = 2_000_000_000


class CenterShell:
    """The fusion center on a bus; ``run`` blocks, ``stop`` may be called from anywhere, a signal handler too."""

    def __init__(
        self, bus: Bus, network: Network, scenario: Scenario, center: Center, *, inbox: Inbox | None = None
    ) -> None:
        """Take part in a network.

        Args:
            bus: where everything is heard and said.
            network: for its name.
            scenario: for times in logs.
            center: the pure step.
            inbox: where somebody may have asked to stop already.
        """
        self._bus, self._scenario, self._center = bus, scenario, center
        self._log: structlog.typing.FilteringBoundLogger = structlog.get_logger().bind(center=scenario.name)
        self.complaints = Complaints(self._log)
        self._inbox = inbox or Inbox()
        self._keys = Keys(network.name)
        self._state = center.initial()
        self._publishers: dict[str, Publisher] = {}
        self._picture: Tracks = center.tracks(self._state)
        self._stopped = False
        self._reported_s: float | None = None

    def stop(self) -> None:
        """End ``run`` soon."""
        self._inbox.stop()

    def run(self) -> None:
        """Serve until all sources are exhausted or ``stop`` is called."""
        self._open()
        while not self._stopped and not self._state.finished:
            self._handle(self._inbox.receive(self._center.deadline_ns(self._state)))
        linger_until = time.time_ns() + _LINGER_NS
        while not self._stopped and any(member.alive for member in self._state.members):
            if time.time_ns() >= linger_until:
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
        for key in (*commands, keys.clock(), keys.advice(), keys.tracks(), keys.decision()):
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
        return {
            "role": "center",
            "linked": bool(sensors),
            "last_report_s": age_s(self._reported_s),
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
        if isinstance(message, Report | Picked | Join):
            if not isinstance(message, Join):
                self._reported_s = time.monotonic()
            self._step(message)
        else:
            self.complaints.add("unexpected", f"{key}: a {type(message).__name__} from a sensor")

    def _step(self, event: Event) -> None:
        before = self._state
        self._state, messages = self._center.step(before, event, time.time_ns())
        for message in messages:
            self._publish(message)
        if isinstance(event, Join) and self._state.counts.refused == before.counts.refused:
            self._log.info("sensor joined", sensor=event.sensor, next_s=self._seconds(event.next_ns))
        if self._state.clock is not None and before.clock is None:
            absent = [n for n, m in zip(self._center.names, self._state.members, strict=True) if not m.joined]
            self._log.info("clock started", speed=self._center.speed or "lockstep", without=absent)
        if before.counts != self._state.counts:
            self._complain(event, before)
        if self._inbox.empty:
            self._state = self._center.prepare(self._state)

    def _complain(self, event: Event, before: State) -> None:
        """Say what did not go the straight way, and of which sensor."""
        now, what = self._state, "message" if isinstance(event, Join) else "report"
        sensor = getattr(event, "sensor", "")
        # Whoever reaches the network may invent names.
        about = {"sensor": sensor} if sensor in self._center.names else {}
        reasons = [key[1] for key, number in now.refused.items() if number != before.refused.get(key)]
        for kind, old, new in zip(now.counts._fields, before.counts, now.counts, strict=True):
            if new > old:
                why = ": ".join([*(reasons if kind == "refused" else []), _summary(event)])
                named = kind.replace("_", " ") if kind.startswith("unusable") else f"{kind} {what}"
                self.complaints.add(named, why, new - old, **about)

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
                self._picture = message
                if not self._publishers[self._keys.tracks()].has_listeners:
                    return
            case Decision():
                time_s = self._scenario.to_seconds(message.time_ns)
                self._log.info(message.kind, track=message.track, time_s=time_s, log_lr=round(message.log_lr, 2))
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
