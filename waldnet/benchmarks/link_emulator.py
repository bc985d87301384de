"""Hosts on one machine and the links between them: keeps network namespaces and carries their packets.

    python link_emulator.py < commands (needs root, /dev/net/tun, iproute2)

Started and spoken to by ``benchmarks.namespaces``: one JSON array a line, each answered by one line of JSON. The first
says what to build: ``["links", seed, {host: link, ...}]`` or ``["bridge", 0, {host: link, ...}]``. Then, for links, at
any time: ``["set", host, link]``, ``["cut", host]``, ``["heal", host]``, ``["stats", host]``.

The namespaces have no names: they are this process's, and vanish with it and the processes inside. Those are killed
when the input ends, so that nothing stays behind even if whoever started this is killed.
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import itertools
import json
import os
import random
import select
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

_TUNSETIFF, _IFF_TUN, _IFF_NO_PI, _CLONE_NEWNET = 0x400454CA, 0x0001, 0x1000, 0x40000000
_INTERFACE = "wire0"
_OWN = str(os.getpid())
_MTU = 1400
_libc = ctypes.CDLL(None, use_errno=True)


@dataclass
class Traffic:
    """What became of the packets that entered one direction of a link."""

    packets: int = 0
    bytes: int = 0
    lost: int = 0
    overflowed: int = 0


class Direction:
    """One direction of a link: a queue that the rate empties, then loss, then delay; order is kept."""

    def __init__(self, link: dict[str, float], chance: random.Random) -> None:
        self.link, self.chance, self.traffic, self.up = link, chance, Traffic(), True
        self._free = self._last = 0.0

    def due(self, size: int, now: float) -> float | None:
        """When a packet that comes now gets to the other end; None: never."""
        rate = self.link["rate_bit_s"] / 8
        waiting = max(0.0, self._free - now) * rate if rate else 0.0
        if waiting + size > self.link["queue_bytes"]:
            self.traffic.overflowed += 1
            return None
        self._free = max(self._free, now) + (size / rate if rate else 0.0)
        self.traffic.packets += 1
        self.traffic.bytes += size
        if not self.up or self.chance.random() < self.link["loss"]:
            self.traffic.lost += 1
            return None
        delay = self.link["delay_s"] + self.chance.uniform(-1.0, 1.0) * self.link["jitter_s"]
        self._last = max(self._last, self._free + delay)
        return self._last


class Host(NamedTuple):
    """One namespace: its handle, its TUN device, and the two directions of its link."""

    namespace: int
    tun: int
    sends: Direction
    hears: Direction


class Emulator:
    """All hosts reach each other: through the sender's link, then through the receiver's."""

    def __init__(self, seed: int, links: dict[str, dict[str, float]]) -> None:
        chance = random.Random(seed)
        self.hosts: dict[str, Host] = {}
        for (name, link), number in zip(links.items(), itertools.count(1)):
            sends, hears = Direction(link, chance), Direction(link, chance)
            namespace = new_namespace()
            self.hosts[name] = Host(namespace, open_tun(namespace, number), sends, hears)
        self._by_number = dict(enumerate(self.hosts.values(), 1))
        self._under_way: list[tuple[float, int, Host, bool, bytes]] = []
        self._count = itertools.count()

    def obey(self, what: str, name: str, *link: dict[str, float]) -> Any:
        """Change a host's link, or tell what went over it."""
        directions = {"sent": self.hosts[name].sends, "heard": self.hosts[name].hears}
        for direction in directions.values():
            if link:
                direction.link = link[0]
            elif what in ("cut", "heal"):
                direction.up = what == "heal"
        return {side: asdict(direction.traffic) for side, direction in directions.items()}

    def carry(self, answer: Callable[[bytes], None]) -> None:
        """Move packets until the input ends."""
        tuns = {host.tun: host for host in self.hosts.values()}
        while True:
            wait = max(0.0, self._under_way[0][0] - time.monotonic()) if self._under_way else None
            ready, _, _ = select.select([*tuns, 0], [], [], wait)
            for handle in ready:
                if handle in tuns:
                    self._take(tuns[handle])
                elif line := sys.stdin.buffer.readline():
                    answer(line)
                else:
                    return
            self._deliver()

    def _take(self, host: Host) -> None:
        now = time.monotonic()
        with suppress(BlockingIOError):
            for _ in range(64):
                packet = os.read(host.tun, 65536)
                to = self._by_number.get(packet[19]) if packet[0] >> 4 == 4 else None
                if to is not None:
                    self._pass(host.sends, to, packet, now, at_hub=True)

    def _pass(self, through: Direction, to: Host, packet: bytes, now: float, *, at_hub: bool) -> None:
        if (due := through.due(len(packet), now)) is not None:
            heapq.heappush(self._under_way, (due, next(self._count), to, at_hub, packet))

    def _deliver(self) -> None:
        while self._under_way and self._under_way[0][0] <= time.monotonic():
            due, _, to, at_hub, packet = heapq.heappop(self._under_way)
            if at_hub:
                self._pass(to.hears, to, packet, due, at_hub=False)
            else:
                with suppress(OSError):
                    os.write(to.tun, packet)


@contextmanager
def inside(namespace: int) -> Iterator[None]:
    """Act in another network namespace."""
    home = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    _enter(namespace)
    try:
        yield
    finally:
        _enter(home)
        os.close(home)


def _enter(namespace: int) -> None:
    if _libc.setns(namespace, _CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "cannot enter a network namespace")


def new_namespace() -> int:
    """A handle of a new network namespace, with the same congestion control everywhere, without IPv6's own chatter."""
    home = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    if _libc.unshare(_CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "cannot make a network namespace")
    namespace = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    for setting, value in (("ipv6/conf/default/disable_ipv6", "1"), ("ipv4/tcp_congestion_control", "reno")):
        with suppress(OSError):
            Path("/proc/sys/net", setting).write_text(value)
    _ip("link set lo up")
    _enter(home)
    os.close(home)
    return namespace


def _ip(words: str) -> None:
    subprocess.run(["ip", *words.split()], check=True)


def _set_up(number: int) -> None:
    _ip(f"addr add 10.77.0.{number}/24 dev {_INTERFACE}")
    _ip(f"link set {_INTERFACE} up")


def open_tun(namespace: int, number: int) -> int:
    """The handle of a new TUN device in a namespace."""
    with inside(namespace):
        tun = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH", _INTERFACE.encode(), _IFF_TUN | _IFF_NO_PI))
        _ip(f"link set {_INTERFACE} mtu {_MTU}")
        _set_up(number)
    return tun


def build_bridge(hosts: int) -> list[int]:
    """Namespaces joined by virtual cables to a switch, at the kernel's speed."""
    hub = new_namespace()
    namespaces = [new_namespace() for _ in range(hosts)]
    with inside(hub):
        _ip("link add hub type bridge mcast_snooping 0")
        _ip("link set hub up")
    for number, namespace in enumerate(namespaces, 1):
        with inside(hub):
            _ip(f"link add port{number} type veth peer name {_INTERFACE} netns /proc/{os.getpid()}/fd/{namespace}")
            _ip(f"link set port{number} master hub up")
        with inside(namespace):
            # Counted as on a cable: every packet with its headers, not the large ones that the kernel makes of them.
            _ip(f"link set {_INTERFACE} gso_max_segs 1")
            _set_up(number)
    return namespaces


def end_processes(namespaces: list[int]) -> None:
    """Kill whatever runs inside, and whatever is about to enter."""
    held = [os.dup(namespace) for namespace in namespaces]
    for namespace in namespaces:
        os.close(namespace)  # by its number others find it: from now on none does
    ours = {str(Path(f"/proc/self/fd/{namespace}").readlink()) for namespace in held}
    while inside_now := [pid for pid in _others() if not ours.isdisjoint(_namespaces_of(pid))]:
        for pid in inside_now:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def _others() -> list[int]:
    return [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit() and entry.name != _OWN]


def _namespaces_of(pid: int) -> Iterator[str]:
    """That a process holds, and then the one it is in: one that enters is seen either before or after."""
    process = Path(f"/proc/{pid}")
    with suppress(OSError):
        for held in (process / "fd").iterdir():
            with suppress(OSError):
                yield str(held.readlink())
    with suppress(OSError):
        yield str((process / "ns/net").readlink())


def main() -> None:
    """Build, say so, serve, and end what is inside."""

    def say(what: Any) -> None:
        print(json.dumps(what), flush=True)

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    kind, seed, hosts = json.loads(sys.stdin.buffer.readline())
    emulator = Emulator(seed, hosts) if kind == "links" else None
    namespaces = [host.namespace for host in emulator.hosts.values()] if emulator else build_bridge(len(hosts))
    try:
        say(namespaces)
        if emulator is None:
            sys.stdin.buffer.read()
        else:
            emulator.carry(lambda line: say(emulator.obey(*json.loads(line))))
    finally:
        end_processes(namespaces)


if __name__ == "__main__":
    main()
