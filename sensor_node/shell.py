"""The shell of a sensor node: reads bus and clock, calls the tracker's pure steps, writes the bus."""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Sequence

import structlog

from waldnet.common import notice
from waldnet.common.clock import now_ns, set_by_ns
from waldnet.common.codec import decode, encode
from waldnet.common.config import Network
from waldnet.common.errors import ConfigError, DecodeError, TransportError, VersionError
from waldnet.common.health import Health, age_s
from waldnet.common.inbox import Asked, Heard, Inbox, Incoming, Missed, Present, Stopped
from waldnet.common.logs import Complaints
from waldnet.common.messages import NEVER, Advice, Begin, Clock, Keys, Message, Rebase, Scan, Start, ToNode, ToNodes
from waldnet.common.notice import Notice
from waldnet.common.transport import PEER_OF_ROUTER, Bus, Publisher
from waldnet.sensor_node.tracker import LocalTracker

#: Between two requests to join while no center answers.
_JOIN_EVERY_NS = 1_000_000_000
#: So long before a scan the work ahead of it is done: not while a center on the same machine is busy, and late enough
#: that its results are still in the caches.
_AHEAD_NS = 10_000_000
#: By so much this host's clock may seem to be off before that is worth a word.
_CLOCK_TOLERANCE_S = 1.0
#: With all scans sent, how long a center that is gone may take to come back for the last reports.
_FAREWELL_NS = 5_000_000_000


class NodeShell:
    """One sensor node on a bus; ``run`` blocks, ``stop`` may be called from anywhere, a signal handler too."""

    def __init__(
        self,
        bus: Bus,
        network: Network,
        tracker: LocalTracker,
        scans: Sequence[Scan],
        *,
        inbox: Inbox | None = None,
        patience_s: float = 30.0,
    ) -> None:
        """Take part in a network.

        Args:
            bus: where everything is heard and said.
            network: for its name, and for errors.
            tracker: the pure steps.
            scans: what the sensor will see, by time.
            inbox: where somebody may have asked to stop already.
            patience_s: how long to wait for the first answer of a center.
        """
        self._bus, self._network, self._tracker, self._scans = bus, network, tracker, scans
        self._patience_ns = round(patience_s * 1e9)
        self._name = tracker.name
        self._log: structlog.typing.FilteringBoundLogger = structlog.get_logger().bind(sensor=self._name)
        self.complaints = Complaints(self._log)
        self._inbox = inbox or Inbox()
        self._incarnation = secrets.randbits(62)
        self._state = tracker.initial()
        self._position = 0
        self._clock: Clock | None = None
        self._advised_ns: int | None = None
        self._center = self._new_center = False
        self._answered = self._stopped = False
        self._epoch: int | None = None
        self._began_ns = self._ask_ns = 0
        self._clock_offset_s: float | None = None
        self._gone_ns: int | None = None
        self._reported_s: float | None = None
        self._keys = Keys(network.name)
        self._publishers: dict[str, Publisher] = {}

    def stop(self) -> None:
        """End ``run`` soon."""
        self._inbox.stop()

    def run(self) -> None:
        """Follow the center's clock through all scans, until they are worked in or ``stop`` is called.

        Raises:
            TransportError: no center answered within the patience.
            VersionError: the center speaks another wire version.
            ConfigError: the center runs another scenario; the parts that differ are named.
        """
        self._open()
        while not self._stopped and not self._done():
            due = self._due_ns()
            if self._inbox.empty:
                if due is not None and due <= now_ns():
                    self._process(self._scans[self._position])
                    continue
                due = self._work_ahead(due)
            self._handle(self._inbox.receive(self._wake_ns(due)))
        self._log.info("ended", scans=self._position, of=len(self._scans), dropped=dict(self.complaints.counts))

    def _open(self) -> None:
        for key in (self._keys.command(self._name), self._keys.clock(), self._keys.advice(), self._keys.notice()):
            self._bus.subscribe(key, self._inbox.heard, on_miss=self._inbox.missed)
        self._publishers = {
            self._keys.report(self._name): self._bus.publisher(self._keys.report(self._name)),
            self._keys.join(self._name): self._bus.publisher(self._keys.join(self._name)),
            self._keys.plots(self._name): self._bus.publisher(self._keys.plots(self._name), reliable=False),
        }
        about = json.dumps(self._tracker.sights[self._tracker.number].config.model_dump(mode="json")).encode()
        self._bus.answer(self._keys.about(self._name), lambda: about)
        self._bus.announce(self._keys.sensor_alive(self._name))
        self._bus.watch(self._keys.center_alive(), self._inbox.present)
        self._began_ns = now_ns()
        self._ask_ns = self._began_ns + _JOIN_EVERY_NS

    def _wake_ns(self, due_ns: int | None) -> int | None:
        """When to look up from the inbox; None: not before something comes in."""
        if not self._answered or self._untold:
            return self._ask_ns
        if self._exhausted and self._gone_ns is not None:
            return self._gone_ns + _FAREWELL_NS
        return due_ns

    def _handle(self, incoming: Incoming) -> None:
        match incoming:
            case Heard(key, payload):
                self._hear(key, payload)
            case Present(_, alive):
                self._center_changed(alive)
            case Missed(key, number):
                # What the center said last comes with its answer.
                self.complaints.add("lost messages", key, number)
                self._join()
            case Asked(answer):
                answer(self._health())
            case Stopped():
                self._stopped = True
            case _:
                self._ask_again()

    def _health(self) -> Health:
        return {
            "role": "node",
            "sensor": self._name,
            "linked": self._center,
            "last_report_s": age_s(self._reported_s),
            "clock_offset_s": None if self._clock_offset_s is None else round(self._clock_offset_s, 3),
            "scans": self._position,
            "of": len(self._scans),
            "tracks": len(self._state.tracks.ids),
            "dropped": dict(self.complaints.counts),
        }

    def _center_changed(self, alive: bool) -> None:
        if self._center and not alive:
            self._log.warning("the center is gone; waiting for it to come back")
        self._center, self._gone_ns = alive, None if alive else now_ns()
        if alive:
            self._new_center = True
            self._join()

    @property
    def _untold(self) -> bool:
        """Whether the center said something that has not come: the first message on a key may be lost without a trace.

        That is the clock, or in lockstep the feedback of the measurement time that the clock names.
        """
        if not self._answered or self._exhausted:
            return False
        return self._clock is None or (self._clock.speed == 0.0 and not self._advised)

    @property
    def _advised(self) -> bool:
        """Whether the feedback of the time that the clock names is there."""
        return self._clock is None or self._advised_ns is None or self._advised_ns >= self._clock.time_ns

    def _ask_again(self) -> None:
        """While no center has answered: ask again, and give up in the end; what got lost comes with another answer."""
        now = now_ns()
        if now < self._ask_ns or not (self._untold or not self._answered):
            return
        self._ask_ns = now + _JOIN_EVERY_NS
        if self._answered:
            # Advice and rebases come again with the answer; what has begun is in its start message.
            self._new_center = self._new_center or not self._tracker.advised
            self._join()
            return
        waited = now - self._began_ns
        if waited > self._patience_ns:
            where = ", ".join((*self._network.connect, *self._network.listen)) or "no endpoint"
            why = "is it running, with the same scenario, and is the network's name the same?"
            if self._bus.peer_of_router:
                why = f"this node {PEER_OF_ROUTER}"
            raise TransportError(
                f"no center of network {self._network.name!r} answered {self._name!r} within {waited / 1e9:.0f} s "
                f"({self._network.mode} at {where}): {why}"
            )
        if self._center:
            self._join()

    def _join(self) -> None:
        self._publish(self._tracker.join(self._state, self._incarnation, self._next_ns()))

    def _next_ns(self) -> int:
        return self._scans[self._position].time_ns if self._position < len(self._scans) else NEVER

    def _hear(self, key: str, payload: bytes) -> None:
        if self._answered:  # a center that speaks may be about to say it
            self._ask_ns = now_ns() + _JOIN_EVERY_NS
        try:
            if key == self._keys.notice():
                self._heed(notice.decode(key, payload))
                return
            message = decode(key, payload)
        except DecodeError as error:
            if isinstance(error, VersionError) and not self._answered:
                raise VersionError(f"the center of this network and this node do not fit together: {error}") from None
            self.complaints.add("bad bytes", str(error))
            return
        match message:
            case Start() | Begin() | Advice() | Rebase() if message.x.shape[-1] != self._tracker.filter.motion.n:
                raise ConfigError(
                    f"{key}: states of {message.x.shape[-1]} numbers, "
                    f"this node's have {self._tracker.filter.motion.n}: do center and node run the same scenario?"
                )
            case _ if isinstance(message, ToNode | ToNodes):
                self._state = self._tracker.told(self._state, message)
                self._note(message)
            case Clock():
                self._set_clock(message)
            case _:
                self.complaints.add("unexpected", f"{key}: a {type(message).__name__} from the center")

    def _heed(self, told: Notice) -> None:
        """Follow a notice of the center, if it is about this node."""
        if told.sensor != self._name:
            return
        if told.kind != "another scenario":
            self._log.warning("notice", why=told.text)
        elif told.digest == self._tracker.digest:
            parts = [part for part, mine in self._tracker.digests.items() if told.digests.get(part) != mine]
            differ = f" ({', '.join(parts)} {'differs' if len(parts) == 1 else 'differ'})" if parts else ""
            raise ConfigError(f"{told.text}{differ}; all processes of a network need the same scenario file")

    def _note(self, message: ToNode | ToNodes) -> None:
        """Up to which measurement time the center has told what the node waits for in lockstep."""
        match message:
            case Start():
                self._answered = True
                if message.epoch != self._epoch:  # a node on a bad link asks for the same again and again
                    self._log.info("tracks started", tracks=len(message.ids), epoch=message.epoch)
                self._epoch = message.epoch
                return
            case Begin() if not self._tracker.advised:
                given_ns = message.given_ns
            case Advice():
                given_ns = message.given_ns
            case Rebase():
                given_ns = message.time_ns
            case _:
                return
        self._advised_ns = max(given_ns, self._advised_ns or given_ns)

    def _set_clock(self, clock: Clock) -> None:
        first, clock = self._clock is None, clock._replace(wall_ns=clock.wall_ns - set_by_ns())
        self._clock = clock
        if clock.speed > 0.0 and (first or self._new_center):
            self._compare(clock)
        if self._tracker.feedback and self._new_center:
            self._advised_ns = clock.time_ns
        self._new_center = False
        if not first:
            return
        # Whoever asked before the clock began sees everything; whoever comes later is told the present.
        present_ns = clock.time_ns if clock.speed > 0.0 else clock.clear_ns
        while self._position < len(self._scans) and self._scans[self._position].time_ns < present_ns:
            self._position += 1
        if self._position:
            self._log.warning("joined late", skipped_scans=self._position)
            self._join()

    def _compare(self, clock: Clock) -> None:
        """Compare this host's clock with the center's: what it tells a node that joins is its own time of then."""
        self._clock_offset_s = (now_ns() - clock.wall_ns) / 1e9
        by = f"{abs(self._clock_offset_s):.1f} s"
        if self._clock_offset_s < -_CLOCK_TOLERANCE_S:
            self._log.warning("clock", why=f"the clock of this host is {by} behind the center's")
        elif self._clock_offset_s > _CLOCK_TOLERANCE_S:
            self._log.warning("clock", why=f"the clock of this host is {by} ahead of the center's, or its link is slow")

    def _due_ns(self) -> int | None:
        """Wall time at which the next scan may be processed; None: not known yet."""
        # Start and clock come on different keys, in any order: a report needs both.
        if self._clock is None or not self._answered or self._position == len(self._scans):
            return None
        time_ns = self._scans[self._position].time_ns
        if self._clock.speed > 0.0:
            return self._clock.due_ns(time_ns)
        return 0 if self._advised and time_ns <= self._clock.clear_ns else None

    def _work_ahead(self, due_ns: int | None) -> int | None:
        """Prepare the next scan if it is near; returns when there is something to do next."""
        if self._clock is None or not self._answered or self._exhausted:
            return due_ns
        if due_ns is None and self._tracker.feedback:  # what is to come would undo it
            return None
        if due_ns is not None and due_ns - now_ns() > _AHEAD_NS:
            return due_ns - _AHEAD_NS
        scan = self._scans[self._position]
        self._state = self._tracker.prepare(self._state, scan.time_ns, scan.pose)
        return due_ns

    def _process(self, scan: Scan) -> None:
        self._position += 1
        unusable = self._state.unusable
        self._state, report = self._tracker.scan(self._state, scan, self._next_ns())
        if more := self._state.unusable - unusable:
            self.complaints.add("unusable plots", "left out: numbers that no sensor can mean", more)
        self._publish(report)
        self._reported_s = time.monotonic()
        if self._publishers[self._keys.plots(self._name)].has_listeners and not self._publish(scan):
            self.complaints.add("plots shed", "the link is full: reports go first, these plots are not shown")

    def _done(self) -> bool:
        """All scans are sent, and the center has them all or is no more."""
        if not self._exhausted or self._clock is None:
            return False
        farewell = self._gone_ns is not None and now_ns() >= self._gone_ns + _FAREWELL_NS
        return self._clock.clear_ns == NEVER or farewell

    @property
    def _exhausted(self) -> bool:
        return self._position == len(self._scans)

    def _publish(self, message: Message) -> bool:
        payload = encode(message, rounding=self._tracker.rounding)
        return self._publishers[self._keys.of(message)].put(payload)
