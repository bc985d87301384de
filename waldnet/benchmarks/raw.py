"""The physical limit beside a measurement: the same two hops with nothing but Zenoh, or TCP, between them.

Senders put payloads as large as reports, a relay waits for one of each sender and puts one as large as the picture,
and whoever listens takes the time. Over Zenoh with its plain publisher and callback; over TCP with framed messages.

    python -m waldnet.benchmarks.raw relay zenoh|tcp SENDERS SIZE
    python -m waldnet.benchmarks.raw sender zenoh|tcp WHERE SIZE INTERVAL_NS COUNT

A sender is told on standard input at which nanosecond of the monotonic clock to start; with interval 0 it puts as soon
as the relay has answered the last one, as nodes do in lockstep. Its stamps are printed at the end.
"""

from __future__ import annotations

import json
import socket
import struct
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from queue import SimpleQueue

import zenoh

Deliver = Callable[[bytes], None]

_HEAD = struct.Struct("<IQ")  # size of what follows, number of the cycle
_SENDS, _LISTENS = b"S", b"L"  # the first byte of a TCP connection


def frame(number: int, size: int) -> bytes:
    """A message of ``size`` bytes that carries the number of its cycle."""
    return _HEAD.pack(size - 4, number).ljust(size, b"\0")


def number_of(message: bytes) -> int:
    """Number of the cycle of a message."""
    number: int = _HEAD.unpack_from(message)[1]
    return number


class Link(ABC):
    """A way to put messages and to have them delivered."""

    @abstractmethod
    def put(self, message: bytes) -> None:
        """Send."""

    @abstractmethod
    def close(self) -> None:
        """End."""


class ZenohLink(Link):
    """Plain Zenoh, with the settings that do not lose data."""

    def __init__(self, listen: str | None, connect: str | None, keys: tuple[str, str], deliver: Deliver | None) -> None:
        """Put on the first key, listen to the second if there is someone to deliver to."""
        config = {
            "mode": "peer",
            "listen": {"endpoints": [listen] if listen else []},
            "connect": {"endpoints": [connect] if connect else []},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "transport": {"shared_memory": {"enabled": False}},
        }
        self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        # Nothing may be lost, and nobody gets stuck here.
        self._publisher = self._session.declare_publisher(keys[0], congestion_control=zenoh.CongestionControl.BLOCK)
        if deliver is not None:
            self._session.declare_subscriber(keys[1], lambda sample: deliver(sample.payload.to_bytes()))

    def put(self, message: bytes) -> None:
        """Send."""
        self._publisher.put(message)

    def close(self) -> None:
        """End."""
        self._session.close()  # type: ignore[no-untyped-call]


class TcpHub(Link):
    """The relay's end of TCP: a thread for each connection, answers go to all that listen."""

    def __init__(self, deliver: Deliver) -> None:
        """Listen on a free port."""
        self._server = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"127.0.0.1:{self._server.getsockname()[1]}"
        self._connections: list[socket.socket] = []
        self._listeners: list[socket.socket] = []
        self._lock = threading.Lock()
        threading.Thread(target=self._accept, args=(deliver,), daemon=True).start()

    def _accept(self, deliver: Deliver) -> None:
        def locked(message: bytes) -> None:
            with self._lock:
                deliver(message)

        while True:
            try:
                connection, _ = self._server.accept()
            except OSError:
                return
            self._connections.append(_at_once(connection))
            if connection.recv(1) == _LISTENS:
                self._listeners.append(connection)
            threading.Thread(target=_read, args=(connection, locked), daemon=True).start()

    def put(self, message: bytes) -> None:
        """Send to all that listen."""
        for connection in self._listeners:
            connection.sendall(message)

    def close(self) -> None:
        """End."""
        for end in (self._server, *self._connections):
            end.close()


class TcpLink(Link):
    """Any other end of TCP."""

    def __init__(self, connect: str, deliver: Deliver | None) -> None:
        """Connect, and listen if there is someone to deliver to."""
        host, port = connect.split(":")
        self._connection = _at_once(socket.create_connection((host, int(port))))
        self._connection.sendall(_SENDS if deliver is None else _LISTENS)
        if deliver is not None:
            threading.Thread(target=_read, args=(self._connection, deliver), daemon=True).start()

    def put(self, message: bytes) -> None:
        """Send."""
        self._connection.sendall(message)

    def close(self) -> None:
        """End."""
        self._connection.close()


def _at_once(connection: socket.socket) -> socket.socket:
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def _read(connection: socket.socket, deliver: Deliver) -> None:
    with connection.makefile("rb") as stream:
        while head := stream.read(4):
            deliver(head + stream.read(struct.unpack("<I", head)[0]))


def link_to(kind: str, where: str, deliver: Deliver | None) -> Link:
    """A link to the relay, which hears what it puts if there is someone to deliver to."""
    if kind == "tcp":
        return TcpLink(where, deliver)
    return ZenohLink(None, where, ("raw/in", "raw/out"), deliver)


def relay(kind: str, senders: int, size: int) -> None:
    """Wait for one message of each sender, put one; until standard input closes."""
    came: Counter[int] = Counter()

    def deliver(message: bytes) -> None:
        number = number_of(message)
        came[number] += 1
        if came[number] == senders:
            link.put(frame(number, size))

    link: Link
    if kind == "tcp":
        link = hub = TcpHub(deliver)
        where = hub.endpoint
    else:
        # Zenoh does not tell which port it took.
        with socket.create_server(("127.0.0.1", 0)) as free:
            where = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        link = ZenohLink(where, None, ("raw/out", "raw/in"), deliver)
    print(json.dumps(where), flush=True)
    sys.stdin.read()
    link.close()


def sender(kind: str, where: str, size: int, interval_ns: int, count: int) -> None:
    """Put as told; print when each was put."""
    answered: SimpleQueue[int] = SimpleQueue()
    link = link_to(kind, where, None if interval_ns else lambda message: answered.put(number_of(message)))
    print(json.dumps("ready"), flush=True)
    start_ns = int(sys.stdin.readline())
    stamps = []
    for number in range(count):
        if interval_ns or not number:
            due_ns = start_ns + number * interval_ns
            time.sleep(max(0, due_ns - time.monotonic_ns()) / 1e9)
        message = frame(number, size)
        stamps.append(time.monotonic_ns())
        link.put(message)
        if not interval_ns:
            while answered.get() != number:
                pass
    print(json.dumps(stamps), flush=True)
    sys.stdin.read()
    link.close()


def main() -> None:
    """Play the part that the command line names."""
    role, kind, *rest = sys.argv[1:]
    if role == "relay":
        relay(kind, int(rest[0]), int(rest[1]))
    else:
        sender(kind, rest[0], *map(int, rest[1:]))


if __name__ == "__main__":
    main()
