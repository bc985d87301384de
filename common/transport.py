"""The network behind one small interface: publish, subscribe, announce, watch, answer, ask.

Two implementations behave alike: ``open_zenoh`` joins processes over a network, ``MemoryNetwork`` joins buses within
one process. No other module imports zenoh.
"""

from __future__ import annotations

import atexit
import json
import logging
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple, Protocol, Self

import zenoh
from zenoh import ext
from zenoh.handlers import FifoChannel

from common.config import Network
from common.errors import TransportError

# Both are called on a transport thread and must only enqueue.
Deliver = Callable[[str, bytes], None]  # key, payload
DeliverPresence = Callable[[str, bool], None]  # liveliness key, alive

CONNECT_TIMEOUT_S = 5.0  # so long a client waits for a router or center that starts at the same time

_RETRY_MS = 100
_LEASE_MS = 5000
# Zenoh's own threads fill the channels without Python's lock, so a busy process keeps its links moving. A full channel
# stalls the link; the sender then drops, and recovery or a miss report follows.
_CHANNEL_SIZE = 10_000
_DROP = zenoh.CongestionControl.DROP
_HEARTBEAT = ext.MissDetectionConfig(heartbeat=0.5, sporadic_heartbeat=None)
_RECOVERY = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
_ENDPOINT = re.compile(r"(tcp|udp|tls|quic)/(\[[^\s\]]+\]|[^\s/:\[\]?#]+):(?P<port>\d{1,5})([?#]\S*)?")

_log = logging.getLogger(__name__)


class Publisher(Protocol):
    """Publishes on one key."""

    def put(self, payload: bytes) -> None:
        """Send without waiting: what a full link cannot take is dropped."""

    @property
    def has_listeners(self) -> bool:
        """Whether anyone in reach subscribes to the key now."""


class Bus(Protocol):
    """One process's part in a network; a context manager that closes.

    Samples of one publisher arrive in order, and once. Between publishers, and between samples and presence, no order
    is promised. A bus hears its own publications and tokens. A bad key or a closed bus raises ``TransportError``.
    """

    def publisher(self, key: str, *, cache: int = 50, reliable: bool = True) -> Publisher:
        """Declare a publication.

        Args:
            key: what to publish on.
            cache: samples kept for recovery and for late subscribers, if reliable.
            reliable: whether losses are noticed and repaired; display data needs neither, its next sample will do.
        """

    def subscribe(
        self,
        key_expr: str,
        deliver: Deliver,
        *,
        reliable: bool = True,
        history: int = 0,
        on_miss: Callable[[str, int], None] | None = None,
    ) -> None:
        """Have every sample delivered from now on.

        Args:
            key_expr: what to listen to; ``*`` stands for one chunk, ``**`` for any number.
            deliver: takes key and payload.
            reliable: ask reliable publishers again for samples that were lost.
            history: most samples to fetch from the cache of each reliable publisher, present or yet to come.
            on_miss: takes key and number of samples lost for good; ``key_expr`` if nothing of that publisher arrived.
        """

    def announce(self, key: str) -> None:
        """Declare a liveliness token until this bus closes or its process dies.

        Who sees the token reaches all that this bus subscribed to and answers before, so announce last.
        """

    def watch(self, key_expr: str, deliver: DeliverPresence) -> None:
        """Have the tokens delivered that are there, then every change."""

    def answer(self, key: str, reply: Callable[[], bytes]) -> None:
        """Answer queries for a key; ``reply`` is called on a transport thread."""

    def ask(self, key_expr: str, timeout_s: float) -> list[tuple[str, bytes]]:
        """Return every answer as (key, payload), as soon as all have answered or the time is over."""

    def endpoints(self) -> tuple[str, ...]:
        """Return where this bus listens, with the actual port where port 0 was asked for."""

    def close(self) -> None:
        """Withdraw everything and leave; what has arrived is still delivered. Closing again does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_zenoh(network: Network) -> Bus:
    """Open a Zenoh session.

    A peer opens at once and keeps looking for its endpoints; a client waits ``CONNECT_TIMEOUT_S`` for one to answer.

    Args:
        network: the process's mode and endpoints; without ``listen`` it listens on nothing.

    Returns:
        The open bus.

    Raises:
        TransportError: an endpoint is malformed or taken, or nothing answers a client.
    """
    _check_endpoints(network)
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]  # silent unless RUST_LOG is set
    session = _open_session(network)
    return _ZenohBus(session, _listening(session, network))


def _port(endpoint: str) -> int:
    match = _ENDPOINT.fullmatch(endpoint)
    return int(match["port"]) if match else -1


def _check_endpoints(network: Network) -> None:
    """Refuse what Zenoh would accept and then retry forever."""
    for name, endpoints, lowest_port in (("listen", network.listen, 0), ("connect", network.connect, 1)):
        for endpoint in endpoints:
            if not lowest_port <= _port(endpoint) <= 65535:
                expected = "<tcp|udp|tls|quic>/<host>:<port>, such as tcp/127.0.0.1:7447"
                raise TransportError(f"network.{name}: {endpoint!r} is no endpoint: expected {expected}")
    if network.mode == "client" and not network.connect and not network.multicast:
        raise TransportError("network.connect: got no endpoint, expected at least one for a client")


def _open_session(network: Network) -> zenoh.Session:
    config = zenoh.Config.from_json5(json.dumps(_settings(network)))
    started = time.monotonic()
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            if not re.search("Unable to connect|timeout", str(error)):
                raise TransportError(_cannot_open(network, _reason(error))) from error
            # Zenoh's own connect timeout would spend itself on the first of several endpoints.
            if (waited_s := time.monotonic() - started) >= CONNECT_TIMEOUT_S:
                where = " or ".join(network.connect) or "any scouted address"
                hint = "is the router or center running?"
                raise TransportError(f"nothing answers at {where} within {waited_s:.1f} s; {hint}") from error
            time.sleep(_RETRY_MS / 1e3)


def _settings(network: Network) -> dict[str, Any]:
    retry = {"period_init_ms": _RETRY_MS, "period_max_ms": 5 * _RETRY_MS, "period_increase_factor": 2}
    return {
        "mode": network.mode,
        "listen": {"endpoints": network.listen},
        "connect": {"endpoints": network.connect, "retry": retry},
        "scouting": {"delay": 0, "multicast": {"enabled": network.multicast}, "gossip": {"enabled": False}},
        "open": {"return_conditions": {"connect_scouted": False}},
        # The one way to learn a port the system chose; everyone in reach can read it, so fixed ports leave it off.
        "adminspace": {"enabled": 0 in map(_port, network.listen)},
        "transport": {"link": {"tx": {"lease": _LEASE_MS}}, "shared_memory": {"enabled": False}},
    }


def _listening(session: zenoh.Session, network: Network) -> tuple[str, ...]:
    if 0 not in map(_port, network.listen):
        return network.listen
    replies = session.get(f"@/{session.zid()}/{network.mode}", timeout=CONNECT_TIMEOUT_S)
    (state,) = [json.loads(reply.ok.payload.to_string()) for reply in replies if reply.ok is not None]
    return tuple(state["locators"])


def _cannot_open(network: Network, reason: str) -> str:
    where = ", ".join([endpoint for endpoint in network.listen if endpoint in reason] or network.listen)
    if system_error := re.search(r"([A-Z][^:\[\]]*) \(os error \d+\)", reason):
        reason = system_error[1].lower()
    if "already in use" in reason:
        reason += "; expected a free one (is another center or router running?)"
    return f"cannot listen on {where}: {reason}" if where else f"cannot open the network: {reason}"


def _reason(error: zenoh.ZError) -> str:
    """Return Zenoh's words without the places in its sources."""
    return re.sub(r"\s+at /\S+\.rs:\d+\.?", "", str(error))


@contextmanager
def _explained(doing: str) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise TransportError(f"cannot {doing}: {_reason(error)}") from error


class _ZenohPublisher(NamedTuple):
    key: str
    plain: zenoh.Publisher
    sender: zenoh.Publisher | ext.AdvancedPublisher

    def put(self, payload: bytes) -> None:
        with _explained(f"publish on {self.key}"):
            self.sender.put(payload)

    @property
    def has_listeners(self) -> bool:
        status: Any = self.plain.matching_status  # the stub says bool; it is an object, always true
        return bool(status.matching)


class _ZenohBus(Bus):
    def __init__(self, session: zenoh.Session, endpoints: tuple[str, ...]) -> None:
        self._session = session
        self._endpoints = endpoints
        # Zenoh withdraws what nobody refers to. Its close() ends publishers, even amid a put() where undeclare() fails,
        # but not advanced subscribers: the stack undeclares all else.
        self._publishers: list[Publisher] = []
        self._closing = ExitStack()
        self._closing.callback(session.close)
        # A process that ends by an error must not leave Zenoh's threads calling into a dying interpreter.
        atexit.register(self.close)
        self._closing.callback(atexit.unregister, self.close)

    def publisher(self, key: str, *, cache: int = 50, reliable: bool = True) -> Publisher:
        with _explained(f"publish on {key}"):
            plain = self._session.declare_publisher(key, congestion_control=_DROP)
            sender: zenoh.Publisher | ext.AdvancedPublisher = plain
            if reliable:
                # An advanced publisher cannot tell whether anyone listens: the plain one beside it does.
                sender = ext.declare_advanced_publisher(
                    self._session,
                    key,
                    congestion_control=_DROP,
                    cache=ext.CacheConfig(max_samples=cache),
                    sample_miss_detection=_HEARTBEAT,
                    publisher_detection=True,
                )
        self._publishers.append(publisher := _ZenohPublisher(key, plain, sender))
        return publisher

    def subscribe(
        self,
        key_expr: str,
        deliver: Deliver,
        *,
        reliable: bool = True,
        history: int = 0,
        on_miss: Callable[[str, int], None] | None = None,
    ) -> None:
        assert reliable or (not history and on_miss is None), "history and misses need reliable=True"
        keys: dict[tuple[str, int], str] = {}  # a miss names its publisher, not the key

        def on_sample(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            if on_miss is not None and sample.source_info is not None:
                keys[_identity(sample.source_info.source_id)] = key
            deliver(key, sample.payload.to_bytes())

        with _explained(f"subscribe to {key_expr}"):
            if not reliable:
                self._serve(self._session.declare_subscriber(key_expr, FifoChannel(_CHANNEL_SIZE)), on_sample)
                return
            subscriber = ext.declare_advanced_subscriber(
                self._session,
                key_expr,
                FifoChannel(_CHANNEL_SIZE),
                history=ext.HistoryConfig(detect_late_publishers=True, max_samples=history) if history else None,
                recovery=_RECOVERY,
            )
            self._serve(subscriber, on_sample)
            if on_miss is not None:
                misses = subscriber.sample_miss_listener(FifoChannel(_CHANNEL_SIZE))
                self._serve(misses, lambda miss: on_miss(keys.get(_identity(miss.source), key_expr), miss.nb))

    def announce(self, key: str) -> None:
        with _explained(f"announce {key}"):
            self._closing.callback(self._session.liveliness().declare_token(key).undeclare)

    def watch(self, key_expr: str, deliver: DeliverPresence) -> None:
        def on_token(sample: zenoh.Sample) -> None:
            deliver(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        with _explained(f"watch {key_expr}"):
            liveliness = self._session.liveliness()
            self._serve(liveliness.declare_subscriber(key_expr, FifoChannel(_CHANNEL_SIZE), history=True), on_token)

    def answer(self, key: str, reply: Callable[[], bytes]) -> None:
        def on_query(query: zenoh.Query) -> None:
            with query:
                query.reply(key, reply())

        with _explained(f"answer {key}"):
            self._serve(self._session.declare_queryable(key, FifoChannel(_CHANNEL_SIZE)), on_query)

    def ask(self, key_expr: str, timeout_s: float) -> list[tuple[str, bytes]]:
        every_one = zenoh.ConsolidationMode.NONE
        with _explained(f"ask {key_expr}"):
            replies = self._session.get(key_expr, consolidation=every_one, timeout=timeout_s)
            return [(str(r.ok.key_expr), r.ok.payload.to_bytes()) for r in replies if r.ok is not None]

    def endpoints(self) -> tuple[str, ...]:
        return self._endpoints

    def close(self) -> None:
        self._closing.close()

    def _serve(self, declared: Any, act: Callable[[Any], None]) -> None:
        """Drain a declaration's channel on a thread of its own until it is undeclared."""
        items = iter(declared)

        def run() -> None:
            for item in items:
                try:
                    act(item)
                except Exception:  # one bad item must not deafen the process
                    _log.exception("a callback failed")

        thread = threading.Thread(target=run, name="transport", daemon=True)
        thread.start()
        self._closing.callback(thread.join)
        self._closing.callback(declared.undeclare)


def _identity(source: zenoh.EntityGlobalId) -> tuple[str, int]:
    return str(source.zid), source.eid


class MemoryNetwork:
    """Joins buses within one process; what is sent is delivered on the sender's thread before it goes on."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.declared: list[_Declaration] = []

    def bus(self) -> Bus:
        """Return a new bus that reaches all the others."""
        return _MemoryBus(self)

    def matching(self, kind: str, key_expr: str) -> list[_Declaration]:
        """Return what open buses have declared, oldest first."""
        expr = zenoh.KeyExpr(key_expr)
        with self.lock:
            return [d for d in self.declared if d.kind == kind and d.key_expr.intersects(expr)]

    def tell(self, key: str, *, alive: bool) -> None:
        """Tell every watch of a token."""
        for watch in self.matching("watch", key):
            watch.item(key, alive)


class _Declaration(NamedTuple):
    bus: Bus
    kind: str
    key_expr: zenoh.KeyExpr
    item: Any  # a publisher's cache, a callback, or nothing for a token


class _MemoryPublisher(NamedTuple):
    bus: _MemoryBus
    key: str
    cache: deque[bytes]

    def put(self, payload: bytes) -> None:
        with self.bus.doing(f"publish on {self.key}") as network:
            self.cache.append(payload)
            for subscriber in network.matching("subscriber", self.key):
                subscriber.item(self.key, payload)

    @property
    def has_listeners(self) -> bool:
        return not self.bus.closed and bool(self.bus.network.matching("subscriber", self.key))


class _MemoryBus(Bus):
    def __init__(self, network: MemoryNetwork) -> None:
        self.network = network
        self.closed = False

    @contextmanager
    def doing(self, what: str) -> Iterator[MemoryNetwork]:
        with self.network.lock, _explained(what):
            if self.closed:
                raise zenoh.ZError("session closed")
            yield self.network

    def _declare(self, kind: str, key_expr: str, item: Any = None) -> None:
        with self.doing(f"declare {kind} {key_expr}") as network:
            network.declared.append(_Declaration(self, kind, zenoh.KeyExpr(key_expr), item))

    def publisher(self, key: str, *, cache: int = 50, reliable: bool = True) -> Publisher:
        publisher = _MemoryPublisher(self, key, deque(maxlen=cache if reliable else 0))
        self._declare("publisher", key, publisher.cache)
        return publisher

    def subscribe(
        self,
        key_expr: str,
        deliver: Deliver,
        *,
        reliable: bool = True,
        history: int = 0,
        on_miss: Callable[[str, int], None] | None = None,
    ) -> None:
        assert reliable or (not history and on_miss is None), "history and misses need reliable=True"
        with self.network.lock:
            self._declare("subscriber", key_expr, deliver)
            for publisher in self.network.matching("publisher", key_expr):
                for payload in list(publisher.item)[-history:] if history else ():
                    deliver(str(publisher.key_expr), payload)

    def announce(self, key: str) -> None:
        with self.network.lock:
            self._declare("token", key)
            if len(self.network.matching("token", key)) == 1:
                self.network.tell(key, alive=True)

    def watch(self, key_expr: str, deliver: DeliverPresence) -> None:
        with self.network.lock:
            self._declare("watch", key_expr, deliver)
            for key in dict.fromkeys(str(token.key_expr) for token in self.network.matching("token", key_expr)):
                deliver(key, True)  # noqa: FBT003

    def answer(self, key: str, reply: Callable[[], bytes]) -> None:
        self._declare("answer", key, reply)

    def ask(self, key_expr: str, timeout_s: float) -> list[tuple[str, bytes]]:  # noqa: ARG002
        with self.doing(f"ask {key_expr}") as network:
            answers = network.matching("answer", key_expr)
        return [(str(answer.key_expr), answer.item()) for answer in answers]

    def endpoints(self) -> tuple[str, ...]:
        return ()

    def close(self) -> None:
        with self.network.lock:
            self.closed = True
            mine = [d for d in self.network.declared if d.bus is self]
            self.network.declared = [d for d in self.network.declared if d.bus is not self]
            for key in {str(d.key_expr) for d in mine if d.kind == "token"}:
                if not self.network.matching("token", key):
                    self.network.tell(key, alive=False)
