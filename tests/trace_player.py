"""Plays the protocol traces of ``tests/traces``: text files of commands, each followed by the messages it causes.

A line that begins with ``#`` says why. A line that begins with ``>`` is a command. The indented lines below a command
are what was sent; the player writes them anew. The commands:

    > [scenario] KEY = VALUE           a key of the scenario (TOML), before all other commands
    > pace 1                           real time; otherwise the network runs in lockstep
    > join a 2                         sensor a joins, its first scan is due at 2 s
    > scan a 2 4: (300, 0) (80, -20)   a scans at 2 s, its next scan is due at 4 s (-: never); plots in metres
    > hold a 2 4: (300, 0)             the same, but the report stays on the way
    > arrive a                         the oldest report of a that is on the way arrives
    > gone a                           the liveliness token of a ends
    > restart a 4                      the process of a starts anew and joins, its next scan is due at 4 s
    > wall 2.7                         the wall clock shows 2.7 s
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator
from functools import cached_property
from typing import Any

import numpy as np
from builders import scenario, sensor_table

from waldnet.common.config import Scenario
from waldnet.common.estimation.sprt import Status
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
    Scan,
    Start,
    Stop,
    Tracks,
)
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.state import Event, Presence, State, Tick
from waldnet.offline.loopback import Loopback, Sent


def play(text: str) -> str:
    """The trace with what its commands cause now."""
    player, lines = Player(), list[str]()
    for line in text.splitlines():
        if line.startswith("  "):
            continue
        lines.append(line)
        if line.startswith(">"):
            lines += [f"  {said}" for said in player.play(line[1:].strip())]
    return "\n".join(lines) + "\n"


class Player:
    """A network that follows commands."""

    def __init__(self) -> None:
        self._tables: dict[str, Any] = {}
        self._speed, self._now_ns = 0.0, 0
        self._sent: list[Sent] = []
        self._on_the_way: dict[str, list[Report | Picked]] = {}
        self._incarnations: dict[str, int] = {}

    @cached_property
    def scenario(self) -> Scenario:
        """Two sensors and one hypothesis, unless the trace says more."""
        sensor = self._tables.pop("sensor", {})
        few = {"false_plots": 1.0, **sensor}
        return scenario(sensor_table("a", **few), sensor_table("b", **few), **self._tables)

    @cached_property
    def network(self) -> Loopback:
        """Made when the first command needs it."""
        return Loopback.of(self.scenario, speed=self._speed, tap=self._sent.append)

    def play(self, command: str) -> Iterator[str]:
        """Follow a command; yields what was sent, and what the center refused or counted."""
        if command.startswith("["):
            table, _, line = command[1:].partition("]")
            keys = tomllib.loads(line)
            self._tables |= keys if table == "scenario" else {table: self._tables.get(table, {}) | keys}
            return
        word, _, words = command.partition(" ")
        if word == "pace":
            self._speed = float(words)
            return
        before = self.network.state
        self._sent.clear()
        getattr(self, f"_{word}")(words)
        for sent in self._sent:
            head, *rows = describe(self.scenario, sent.message)
            yield f"{sent.sender} -> {sent.receiver}: {head}"
            yield from (f"    {row}" for row in rows)
        yield from self._counted(before)

    def _counted(self, before: State) -> Iterator[str]:
        after = self.network.state
        for (name, why), number in after.refused.items():
            if number > before.refused.get((name, why), 0):
                yield f"(refused, report of {name}: {why})"
        for kind in ("late", "too_late", "repeated"):
            if getattr(after.counts, kind) > getattr(before.counts, kind):
                yield f"(counted: {kind.replace('_', ' ')})"

    def _join(self, words: str) -> None:
        name, next_s = words.split()
        incarnation = self._incarnations.setdefault(name, 1)
        self.network.join(name, self._ns(next_s), incarnation=incarnation, now_ns=self._now_ns)

    def _restart(self, words: str) -> None:
        name, _ = words.split()
        self._incarnations[name] += 1
        self.network.nodes[name] = self.network.trackers[name].initial()
        self._join(words)

    def _scan(self, words: str) -> None:
        self._deliver(self._report(words))

    def _hold(self, words: str) -> None:
        report = self._report(words)
        self._on_the_way.setdefault(report.sensor, []).append(report)

    def _arrive(self, name: str) -> None:
        self._deliver(self._on_the_way[name].pop(0))

    def _gone(self, name: str) -> None:
        self._deliver(Presence(name, alive=False))

    def _wall(self, time_s: str) -> None:
        self._now_ns = round(float(time_s) * NS_PER_S)
        self._deliver(Tick())

    def _deliver(self, event: Event) -> None:
        self.network.deliver(event, self._now_ns)

    def _report(self, words: str) -> Report | Picked:
        head, _, tail = words.partition(":")
        name, time_s, next_s = head.split()
        network = self.network
        numbers = [float(number) for number in re.findall(r"-?[\d.]+", tail)]
        position = np.array(self.scenario.sensor(name).position)
        scan = Scan(name, self._ns(time_s), position, np.reshape(numbers, (-1, 2)))
        return network.report(scan, self._ns(next_s))

    def _ns(self, time_s: str) -> int:
        return NEVER if time_s == "-" else self.scenario.to_ns(float(time_s))


def describe(plot: Scenario, message: Message) -> list[str]:
    """What a reader needs of a message: a head, and a row for each of its tracks."""
    describer = Describer(plot)
    return list(getattr(describer, type(message).__name__.lower())(message))


class Describer:
    """A method for each type of message, named like it: the numbers that a reader needs."""

    def __init__(self, plot: Scenario) -> None:
        self._plot = plot

    def join(self, message: Join) -> Iterator[str]:
        yield f"Join, process {message.incarnation}, next scan {self._at(message.next_ns)}"

    def start(self, message: Start) -> Iterator[str]:
        yield f"Start, epoch {message.epoch}"
        for row, track in enumerate(message.ids):
            factor = _factor(message.x[row], message.P[row], message.log_p_bar[row])
            yield f"track {track} {self._at(message.times_ns[row])}: {factor}"

    def stop(self, message: Stop) -> Iterator[str]:
        yield f"Stop, tracks: {_listed(message.ids)}"

    def clock(self, message: Clock) -> Iterator[str]:
        pace = f"speed {message.speed:g}" if message.speed else "lockstep"
        until = "to the end" if message.clear_ns == NEVER else f"up to {self._plot.to_seconds(message.clear_ns):g} s"
        yield f"Clock, {pace}, clear {until}"

    def scan(self, message: Scan) -> Iterator[str]:
        yield f"Scan {self._at(message.time_ns)}, plots: {_plots(message.z)}"

    def report(self, message: Report) -> Iterator[str]:
        yield self._head(message)
        ends = np.cumsum(message.terms)
        for track, terms, end in zip(message.ids, message.terms, ends, strict=True):
            best = end - terms + int(np.argmax(message.log_g[end - terms : end]))
            yield f"track {track}: {_factor(message.x[best], message.P[best], message.log_g[best])}"

    def picked(self, message: Picked) -> Iterator[str]:
        yield self._head(message)
        ends = np.cumsum(message.plots)
        for track, number, end in zip(message.ids, message.plots, ends, strict=True):
            yield f"track {track}: {_plots(message.z[message.which[end - number : end]])}"

    def begin(self, message: Begin) -> Iterator[str]:
        ended = f", ended: {_listed(message.ended)}" if len(message.ended) else ""
        yield f"Begin {self._at(message.given_ns)}{'' if len(message.ids) else ', no track'}{ended}"
        yield from self._densities(message)

    def advice(self, message: Advice) -> Iterator[str]:
        yield f"Advice, fused tracks {self._at(message.time_ns)}"
        yield from self._densities(message)

    def rebase(self, message: Rebase) -> Iterator[str]:
        yield f"Rebase, epoch {message.epoch}, for scans after {self._plot.to_seconds(message.after_ns):g} s"
        yield from self._densities(message)

    def tracks(self, message: Tracks) -> Iterator[str]:
        yield f"Tracks {self._at(message.time_ns)}{'' if len(message.ids) else ', none'}"
        for row, track in enumerate(message.ids):
            status, log_lr = Status(message.status[row]).name.lower(), message.log_lr[row]
            by = _listed(name for name, there in zip(message.sensors, message.contributing[row], strict=True) if there)
            place = _place(message.x[row], message.P[row])
            yield f"track {track}: {status}, log LR {_signed(log_lr)}, {place}, reported by {by}"

    def decision(self, message: Decision) -> Iterator[str]:
        into = f" into {message.into}" if message.kind == "merged" else ""
        at = self._at(message.time_ns)
        yield f"Decision, track {message.track} {message.kind}{into} {at}, log LR {_signed(message.log_lr)}"

    def _head(self, report: Report | Picked) -> str:
        head = f"{type(report).__name__} {self._at(report.time_ns)}, epoch {report.epoch}"
        unclaimed = f", unclaimed plots: {_plots(report.unclaimed)}" if len(report.unclaimed) else ""
        return f"{head}, next scan {self._at(report.next_ns)}{unclaimed}"

    def _densities(self, message: Begin | Advice | Rebase) -> Iterator[str]:
        for row, track in enumerate(message.ids):
            yield f"track {track}: {_place(message.x[row], message.P[row])}"

    def _at(self, time_ns: int) -> str:
        return "never" if time_ns == NEVER else f"at {self._plot.to_seconds(int(time_ns)):g} s"


def _place(x: Any, P: Any) -> str:
    sigma = np.sqrt(np.linalg.eigvalsh(P[:2, :2])[-1])
    return f"{_plots([x[:2]])} within {sigma:.0f} m"


def _plots(z: Any) -> str:
    return " ".join("({:.0f}, {:.0f})".format(*(np.round(plot) + 0.0)) for plot in z) or "none"


def _factor(x: Any, P: Any, log_g: float) -> str:
    return f"{_place(x, P)}, log evidence {_signed(log_g)}"


def _signed(value: float) -> str:
    return f"{round(float(value), 1) + 0.0:+.1f}"


def _listed(values: Iterable[Any]) -> str:
    return ", ".join(map(str, values)) or "nobody"
