"""Sensors that send one kind of message at scan rate, and a hub that takes them: what bandwidth is measured on.

    python -m waldnet.benchmarks.traffic hub ADDRESS SENSORS
    python -m waldnet.benchmarks.traffic sensor WORLD NAME KIND ADDRESS

Messages, codec, keys and the settings of the network are the product's; kinds are ``reports``, ``proposals`` (reports
without tracks, of the plots that none claims) and ``plots``, the last as a centralised tracker needs them: none may be
lost. A sensor says how large its payloads are, and sends the next one at every line of its standard input.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree

from waldnet.benchmarks.worlds import World
from waldnet.common.codec import Rounding, encode
from waldnet.common.config import Network
from waldnet.common.messages import Keys, Message, Report, Scan
from waldnet.common.transport import open_zenoh
from waldnet.fusion_center.center import Center
from waldnet.offline.loopback import Loopback
from waldnet.sensor_node.tracker import LocalTracker

PORT = 7447
#: A message that has not come by then is lost.
_PATIENCE_S = 60.0
#: Plots this far from every target are no track's.
_UNCLAIMED_M = 300.0
_KEYS = Keys("bench")


def messages(world: World, name: str, kind: str) -> Iterator[Message]:
    """What a sensor of a world sends, one message a scan."""
    scans = world.seen_by(name)
    if kind == "plots":
        yield from scans
    elif kind == "proposals":
        yield from (_proposals(world, scan) for scan in scans)
    else:
        yield from _reports(world, name, scans)


def _reports(world: World, name: str, scans: list[Scan]) -> Iterator[Message]:
    scenario = world.scenario()
    network = Loopback(Center.of(scenario), [LocalTracker.of(scenario, name)])
    network.join(name, scans[0].time_ns)
    for scan in scans:
        yield network.report(scan, _next_ns(world, scan))


def _proposals(world: World, scan: Scan) -> Report:
    """A report without tracks, of the plots that no target explains."""
    states = world.states()
    time_s = world.scenario().to_seconds(scan.time_ns)
    distances, _ = KDTree(states[:, :2] + time_s * states[:, 2:]).query(scan.z)
    none, n = np.empty(0, np.int64), states.shape[-1]
    return Report(
        sensor=scan.sensor,
        sequence=0,
        time_ns=scan.time_ns,
        next_ns=_next_ns(world, scan),
        epoch=1,
        ids=none,
        terms=none,
        log_g=np.empty(0),
        x=np.empty((0, n)),
        P=np.empty((0, n, n)),
        position=scan.position,
        velocity=scan.velocity,
        heading=scan.heading,
        unclaimed=scan.z[distances > _UNCLAIMED_M],
    )


def _next_ns(world: World, scan: Scan) -> int:
    return scan.time_ns + round(1e9 * world.interval_s)


def sensor(world: World, name: str, kind: str, address: str) -> None:
    """Send all messages of one kind, one at every line of standard input."""
    payloads, key = [], ""
    for message in messages(world, name, kind):
        key = _KEYS.of(message)
        payloads.append(encode(message, rounding=Rounding(2, plots=True) if world.precision == "float32" else None))
    with open_zenoh(Network(name="bench", connect=(f"tcp/{address}:{PORT}",))) as bus:
        here = threading.Event()
        bus.watch(_KEYS.center_alive(), lambda *_: here.set())
        publisher = bus.publisher(key)
        bus.announce(_KEYS.sensor_alive(name))
        here.wait()
        print(json.dumps([len(payload) for payload in payloads]), flush=True)
        for payload, _ in zip(payloads, sys.stdin, strict=False):
            publisher.put(payload)
        sys.stdin.read()


def hub(address: str, sensors: int) -> None:
    """Take what the sensors send; every line of standard input asks how much came and was lost of so many messages."""
    counts = {"came": 0, "lost": 0}
    there: set[str] = set()
    complete, changed = threading.Event(), threading.Condition()

    def count(what: str, number: int) -> None:
        with changed:
            counts[what] += number
            changed.notify_all()

    def came(key: str, payload: bytes) -> None:  # noqa: ARG001
        count("came", 1)

    def missed(key: str, number: int) -> None:  # noqa: ARG001
        count("lost", number)

    def present(key: str, alive: bool) -> None:
        if alive:
            there.add(key)
        if len(there) == sensors:
            complete.set()

    with open_zenoh(Network(name="bench", listen=(f"tcp/{address}:{PORT}",))) as bus:
        for key in (_KEYS.report(), _KEYS.plots()):
            bus.subscribe(key, came, on_miss=missed)
        bus.watch(_KEYS.sensor_alive(), present)
        bus.announce(_KEYS.center_alive())
        print(json.dumps("listening"), flush=True)
        complete.wait()
        print(json.dumps("complete"), flush=True)

        def wait_for(expected: int) -> None:
            with changed:
                changed.wait_for(lambda: sum(counts.values()) >= expected, _PATIENCE_S)

        for line in sys.stdin:
            wait_for(int(line))
            print(json.dumps(counts), flush=True)


def main() -> None:
    """Play the part that the command line names."""
    role, *rest = sys.argv[1:]
    if role == "hub":
        hub(rest[0], int(rest[1]))
    else:
        sensor(World.of(rest[0]), *rest[1:])


if __name__ == "__main__":
    main()
