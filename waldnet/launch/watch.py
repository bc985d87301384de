"""``waldnet watch``: prints what a running network decides, and who comes and goes."""

from __future__ import annotations

import json
import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import structlog

from waldnet.common import notice
from waldnet.common.clock import now_ns
from waldnet.common.codec import decode
from waldnet.common.config import Network, Scenario
from waldnet.common.decision_filter import DecisionFilter
from waldnet.common.errors import DecodeError
from waldnet.common.estimation.sprt import Status
from waldnet.common.health import Health, age_s, answering
from waldnet.common.inbox import Asked, Heard, Inbox, Incoming, Present, Stopped
from waldnet.common.logs import Complaints
from waldnet.common.messages import NEVER, Clock, Decision, Keys, Tracks, sensor_of
from waldnet.common.process import stopped_by_signals
from waldnet.common.quantities import NS_PER_S
from waldnet.common.transport import PEER_OF_ROUTER, Bus, open_zenoh
from waldnet.recording.lines import decision_entry, decision_text, finite

CENTER = "center"
#: So long nobody need be there before that is worth a word.
_QUIET_NS = 5_000_000_000
_ASK_S = 2.0


class Watch:
    """Hears one network; ``run`` blocks until told to stop, or until the network is done."""

    def __init__(
        self,
        bus: Bus,
        scenario: Scenario,
        network: Network,
        inbox: Inbox,
        *,
        as_json: bool = False,
        verbose: bool = False,
    ) -> None:
        """Set up; nothing is heard yet.

        Args:
            bus: where it is heard.
            scenario: for times.
            network: for its name, and for what to say while nobody is there.
            inbox: where somebody may have asked to stop already.
            as_json: say everything as JSON lines.
            verbose: say to people, too, what was decided on tracks that were never confirmed; JSON lines always do.
        """
        self._bus, self._scenario, self._network, self._inbox = bus, scenario, network, inbox
        self._as_json = as_json
        self._filter = DecisionFilter(scenario, verbose=verbose or as_json)
        self._keys = Keys(network.name)
        self._there: set[str] = set()
        self._heard_s: float | None = None
        self._ended = self._stopped = False
        self._complaints = Complaints(structlog.get_logger())

    def run(self, *, until_end: bool) -> None:
        """Listen, and say what happens."""
        for key, history in ((self._keys.decision(), 200), (self._keys.clock(), 1), (self._keys.notice(), 1)):
            self._bus.subscribe(key, self._inbox.heard, history=history)
        for key in (self._keys.sensor_alive(), self._keys.center_alive()):
            self._bus.watch(key, self._inbox.present)
        quiet_ns: int | None = now_ns() + _QUIET_NS
        while not (self._stopped or (until_end and self._ended)):
            self._handle(self._inbox.receive(quiet_ns))
            if CENTER in self._there:
                quiet_ns = None
            elif quiet_ns is not None and now_ns() >= quiet_ns:
                quiet_ns = None
                self._nobody()
        # Keys are read side by side: the end may overtake the last decision.
        self._bus.close()
        while not self._inbox.empty:
            if isinstance(incoming := self._inbox.receive(None), Heard):
                self._handle(incoming)

    def _handle(self, incoming: Incoming) -> None:
        match incoming:
            case Heard(key, payload):
                self._hear(key, payload)
            case Present(key, alive):
                self._present(sensor_of(key) or CENTER, alive)
            case Asked(answer):
                answer(self._health())
            case Stopped():
                self._stopped = True
            case _:
                pass

    def _hear(self, key: str, payload: bytes) -> None:
        try:
            if key == self._keys.notice():
                told = notice.decode(key, payload)
                self._say(told.text, "notice", about=told.kind, sensor=told.sensor, why=told.text)
                return
            message = decode(key, payload)
        except DecodeError as error:
            self._complaints.add("bad bytes", str(error))
            return
        self._heard_s = time.monotonic()
        match message:
            case Decision() if self._filter.passes(message):
                entry = decision_entry(message, self._scenario)
                text = f"{clock_text(message.time_ns)} {decision_text(message, self._scenario)}"
                self._say(text, "decision", **entry)
            case Clock() if message.clear_ns == NEVER and not self._ended:
                self._ended = True
                self._say("all sources are exhausted", "end")
            case Clock():
                self._ended = message.clear_ns == NEVER
            case _:
                pass

    def _present(self, name: str, alive: bool) -> None:
        (self._there.add if alive else self._there.discard)(name)
        who = "the center" if name == CENTER else name
        self._say(f"{who} is {'there' if alive else 'gone'}", "there" if alive else "gone", name=name)
        if name == CENTER and alive:
            self._fetch_picture()

    def _fetch_picture(self) -> None:
        """How the tracks stand, for whoever comes late."""
        for key, payload in self._bus.ask(self._keys.picture(), _ASK_S):
            try:
                picture = decode(key, payload)
            except DecodeError as error:
                self._complaints.add("bad bytes", str(error))
                continue
            if isinstance(picture, Tracks) and len(picture.ids):
                self._show(picture)

    def _show(self, picture: Tracks) -> None:
        self._filter.learn(picture)
        time_s = self._scenario.to_seconds(picture.time_ns)
        names = [Status(status).name.lower() for status in picture.status]
        counted = ", ".join(f"{number} {name}" for name, number in sorted(Counter(names).items()))
        rows = zip(picture.ids, names, picture.log_lr, picture.log_lr_total, strict=True)
        tracks = [
            {"track": int(track), "status": name, "log_lr": finite(log_lr), "log_lr_total": finite(total)}
            for track, name, log_lr, total in rows
        ]
        text = f"{clock_text(picture.time_ns)} {time_s:8.2f} s  tracks: {counted}"
        self._say(text, "picture", time=time_s, tracks=tracks)

    def _nobody(self) -> None:
        where = ", ".join((*self._network.connect, *self._network.listen)) or "no endpoint"
        routed = self._bus.peer_of_router
        why = (
            f"no center of network {self._network.name!r} is there ({self._network.mode} at {where}); waiting for one. "
            + (f"This watcher {PEER_OF_ROUTER}" if routed else "Is it running, and is the network's name the same?")
        )
        self._say(why, "waiting", why=why)

    def _health(self) -> Health:
        there = sorted(self._there)
        return {"role": "watch", "linked": CENTER in there, "last_report_s": age_s(self._heard_s), "there": there}

    def _say(self, text: str, event: str, **entry: Any) -> None:
        print(json.dumps({"event": event, **entry}) if self._as_json else text, flush=True)


def clock_text(time_ns: int) -> str:
    """An instant as a clock in UTC shows it."""
    whole_s, rest_ns = divmod(time_ns, NS_PER_S)
    return f"{datetime.fromtimestamp(whole_s, UTC):%Y-%m-%d %H:%M:%S}.{rest_ns // 10_000_000:02}Z"


def watch(
    scenario: Scenario, network: Network, *, until_end: bool, as_json: bool, verbose: bool, health: Path | None
) -> None:
    """Watch a network until stopped, or until it is done.

    Raises:
        TransportError: an endpoint is malformed or taken, or nothing answers a client.
    """
    inbox = Inbox()
    with stopped_by_signals(inbox.stop), answering(health, inbox.asked), open_zenoh(network) as bus:
        Watch(bus, scenario, network, inbox, as_json=as_json, verbose=verbose).run(until_end=until_end)
