"""From the last node's scan to the decision at a subscriber, beside raw Zenoh and raw TCP in the same run.

All processes are real and on this machine: the nodes, the center, a subscriber. A cycle begins when the last of the
nodes starts to work on its scan and ends when the picture of that measurement time, decisions taken, is in the
subscriber's hands. It is split into ``node`` (plots to report handed over), ``center`` (last report in to picture
handed over) and the rest: the wire with its wake-ups. At scan rate the three ways take turns within every interval, so
that they share whatever else the machine does; flat out (lockstep: the next scan as soon as the center allows) one
follows the other.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from waldnet.benchmarks.crew import BenchError, Crew, Member
from waldnet.benchmarks.raw import link_to, number_of
from waldnet.benchmarks.worlds import World
from waldnet.common.codec import decode, encode
from waldnet.common.config import Network
from waldnet.common.messages import NEVER, Clock, Keys, Report, Tracks
from waldnet.common.transport import open_zenoh

#: First cycles, in which caches and buffers fill, are left out.
_WARM_UP = 10
_PEERS = ("zenoh", "tcp")
_PATIENCE_S = 120.0


@dataclass(frozen=True)
class Cell:
    """One line of the table.

    Attributes:
        tracks: all alive.
        sensors: nodes.
        rate: scans per second; 0: flat out.
        scans: cycles measured.
    """

    tracks: int
    sensors: int
    rate: float
    scans: int

    @property
    def world(self) -> World:
        """What the nodes see; flat out it is that of 10 scans per second."""
        interval_s = 1.0 / (self.rate or 10.0)
        return World(self.tracks, self.sensors, interval_s=interval_s, scans=self.scans + _WARM_UP)


class Watch:
    """When what arrived at the subscriber."""

    def __init__(self, last: int) -> None:
        """Wait for the cycle or time ``last``."""
        self.arrivals: dict[int, int] = {}
        self._last, self._done = last, threading.Event()

    def note(self, which: int, at_ns: int) -> None:
        """Something arrived."""
        self.arrivals[which] = at_ns
        if which == self._last:
            self._done.set()

    def wait(self, seconds: float) -> None:
        """Wait for the last one.

        Raises:
            BenchError: it does not come.
        """
        if not self._done.wait(seconds):
            raise BenchError(f"the last of {len(self.arrivals) + 1} cycles did not arrive within {seconds:.0f} s")


def measure(cell: Cell) -> dict[str, Any]:
    """One line of the table: times in microseconds."""
    if cell.rate:
        with Crew() as crew:
            network = Ours(crew, cell)
            raw = [Raw(crew, cell, kind) for kind in _PEERS]
            # Whoever is not measured just now sleeps: each begins its turn a third of an interval later.
            start_ns = network.start()
            turn_ns = round(1e9 / cell.rate / (1 + len(raw)))
            for number, peer in enumerate(raw, start=1):
                peer.start(start_ns + number * turn_ns)
            peers = {peer.kind: peer.finish() for peer in raw}
            ours = network.finish()
    else:
        with Crew() as crew:
            network = Ours(crew, cell)
            network.start()
            ours = network.finish()
        peers = {}
        for kind in _PEERS:
            with Crew() as crew:
                peer = Raw(crew, cell, kind)
                peer.start(time.monotonic_ns())
                peers[kind] = peer.finish()
    return {
        "tracks": cell.tracks,
        "sensors": cell.sensors,
        "rate": cell.rate or "max",
        "scans": cell.scans,
        **_percentiles("", ours["total"]),
        **_percentiles("raw_zenoh_", peers["zenoh"]),
        **_percentiles("raw_tcp_", peers["tcp"]),
        **{f"{part}_us": round(float(np.median(ours[part]))) for part in ("node", "wire", "center")},
    }


def _percentiles(prefix: str, values_us: Sequence[float]) -> dict[str, int]:
    levels = {"p50": 50.0, "p99": 99.0, "p999": 99.9}
    return {f"{prefix}{name}_us": round(float(np.percentile(values_us, level))) for name, level in levels.items()}


class Ours:
    """A network of the product's own shells."""

    def __init__(self, crew: Crew, cell: Cell) -> None:
        """Start the processes."""
        self._cell, self._scenario = cell, cell.world.scenario()
        world = str(cell.world)
        speed = 1.0 if cell.rate else 0.0
        self._center = crew.start("waldnet.benchmarks.participants", "center", world, str(speed))
        self._at = str(self._center.hear()["listening"][0])
        self._started = threading.Event()
        self._clock: Clock | None = None
        self._watch = Watch(self._scenario.to_ns(cell.world.interval_s * cell.world.scans))
        self._bus = open_zenoh(Network(name=self._scenario.network.name, connect=(self._at,)))
        crew.will(self._bus.close)
        keys = Keys(self._scenario.network.name)
        self._bus.subscribe(keys.clock(), self._hear_clock)
        self._bus.subscribe(keys.tracks(), self._hear_tracks)
        names = self._scenario.sensor_names
        self._nodes = [crew.start("waldnet.benchmarks.participants", "node", world, name, self._at) for name in names]

    def start(self) -> int:
        """Wait for the network's clock; returns the instant of the first scan on the monotonic clock."""
        if not self._started.wait(_PATIENCE_S):
            raise BenchError(f"the network did not start within {_PATIENCE_S:.0f} s")
        assert self._clock is not None
        return time.monotonic_ns() + self._clock.wall_ns - time.time_ns()

    def finish(self) -> Mapping[str, Sequence[float]]:
        """Wait for the end; returns microseconds of every cycle: total, node, wire, center."""
        cell = self._cell
        self._watch.wait(_PATIENCE_S + (2.0 * cell.scans / cell.rate if cell.rate else 0.2 * cell.scans))
        nodes: list[dict[int, tuple[int, int]]] = [
            {time_ns: (began, out) for time_ns, began, out in node.hear()["node"]} for node in self._nodes
        ]
        stamps = self._center.hear()
        arrivals = dict(sorted(self._watch.arrivals.items())[_WARM_UP:])
        return parts_of(arrivals, nodes, dict(stamps["came"]), dict(stamps["center"]))

    def _hear_clock(self, key: str, payload: bytes) -> None:
        message = decode(key, payload)
        if isinstance(message, Clock) and message.clear_ns != NEVER:
            self._clock = self._clock or message
            self._started.set()

    def _hear_tracks(self, key: str, payload: bytes) -> None:
        at = time.monotonic_ns()
        message = decode(key, payload)
        assert isinstance(message, Tracks)
        self._watch.note(message.time_ns, at)


def parts_of(
    arrivals: Mapping[int, int],
    nodes: Sequence[Mapping[int, tuple[int, int]]],
    came: Mapping[int, int],
    published: Mapping[int, int],
) -> dict[str, list[float]]:
    """The parts of every cycle: total, node, wire, center [us].

    Args:
        arrivals: when the picture of a measurement time was in the subscriber's hands [ns].
        nodes: of each node, when it began to work on its scan of that time and when its report was handed over [ns].
        came: when the last report of that time was in the center's hands [ns].
        published: when the center handed the picture over [ns].
    """
    parts: dict[str, list[float]] = {"total": [], "node": [], "wire": [], "center": []}
    for time_ns, arrived in arrivals.items():
        began, out = max(node[time_ns] for node in nodes)
        total, node, center = arrived - began, out - began, published[time_ns] - came[time_ns]
        values = {"total": total, "node": node, "center": center, "wire": total - node - center}
        for part, value in values.items():
            parts[part].append(value / 1e3)
    return parts


class Raw:
    """The same number of senders, payloads of the same sizes, the same two hops."""

    def __init__(self, crew: Crew, cell: Cell, kind: str) -> None:
        """Start the processes."""
        self.kind = kind
        world = cell.world
        report, picture = _sizes(cell)
        self._cycles = world.scans
        self._relay = crew.start("waldnet.benchmarks.raw", "relay", kind, str(cell.sensors), str(picture))
        where = str(self._relay.hear())
        self._watch = Watch(self._cycles - 1)
        self._link = link_to(kind, where, lambda message: self._watch.note(number_of(message), time.monotonic_ns()))
        crew.will(self._link.close)
        interval_ns = round(1e9 / cell.rate) if cell.rate else 0
        arguments = (kind, where, str(report), str(interval_ns), str(self._cycles))
        self._senders: list[Member] = [
            crew.start("waldnet.benchmarks.raw", "sender", *arguments) for _ in range(cell.sensors)
        ]
        for sender in self._senders:
            sender.hear()

    def start(self, at_ns: int) -> None:
        """Begin at an instant of the monotonic clock."""
        for sender in self._senders:
            sender.tell(str(at_ns))

    def finish(self) -> list[float]:
        """Wait for the end; returns microseconds of every cycle."""
        stamps = [sender.hear() for sender in self._senders]
        self._watch.wait(_PATIENCE_S)
        began = np.max(stamps, axis=0)
        arrivals = sorted(self._watch.arrivals.items())[_WARM_UP:]
        return [(at - int(began[number])) / 1e3 for number, at in arrivals]


def _sizes(cell: Cell) -> tuple[int, int]:
    """Bytes of a report and of a picture."""
    tracks, names = cell.tracks, cell.world.scenario().sensor_names
    ids, zeros, x, P = np.arange(tracks), np.zeros(tracks), np.zeros((tracks, 4)), np.zeros((tracks, 4, 4))
    now = time.time_ns()
    report = Report(names[0], 1, now, now, now, ids, np.ones_like(ids), zeros, x, P)
    who = np.zeros((tracks, len(names)), np.bool_)
    picture = Tracks(now, names, ids, zeros.astype(np.uint8), ids, who, zeros, zeros, x, P, ids)
    return len(encode(report)), len(encode(picture))


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows in Markdown, milliseconds."""
    lines = [
        "| tracks | sensors | scans/s | p50 | p99 | p99.9 | raw Zenoh p50 / p99 | raw TCP p50 / p99 "
        "| node | wire | center | p50 over raw Zenoh |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        ms = {key: f"{value / 1e3:.2f}" for key, value in row.items() if key.endswith("_us")}
        rate = row["rate"] if row["rate"] == "max" else f"{row['rate']:g}"
        lines.append(
            f"| {row['tracks']} | {row['sensors']} | {rate} | {ms['p50_us']} | {ms['p99_us']} | {ms['p999_us']} "
            f"| {ms['raw_zenoh_p50_us']} / {ms['raw_zenoh_p99_us']} | {ms['raw_tcp_p50_us']} / {ms['raw_tcp_p99_us']} "
            f"| {ms['node_us']} | {ms['wire_us']} | {ms['center_us']} "
            f"| {row['p50_us'] / row['raw_zenoh_p50_us']:.1f} |"
        )
    return "\n".join(lines)
