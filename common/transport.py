"""The network behind one small interface: publish, subscribe, announce, watch, answer, ask.

``open_zenoh`` joins processes over a network. No other module imports zenoh; ``common.memory`` behaves alike in one
process.

Reports, commands and what else is reliable go before what is only displayed: it has Zenoh's lowest priority, every put
of it is numbered, and where the link's rate is known it takes only what the rest leaves over.
"""

from __future__ import annotations

import atexit
import json
import logging
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple, Protocol, Self

import zenoh
from zenoh import ext
from zenoh.handlers import FifoChannel

from waldnet.common.allowance import Allowance
from waldnet.common.config import Network
from waldnet.common.errors import TransportError

# Both are called on a transport thread and must only enqueue.
Deliver = Callable[[str, bytes], None]  # key, payload
DeliverPresence = Callable[[str, bool], None]  # liveliness key, alive
DeliverMiss = Callable[[str, int], None]  # key, number of samples

KeyExpr = zenoh.KeyExpr

#: What to tell of a process for which ``Bus.peer_of_router`` holds.
PEER_OF_ROUTER = (
    "is a peer of a router, and routers carry nothing from peer to peer: start everybody with --mode client"
)

CONNECT_TIMEOUT_S = 5.0  # so long a client waits for a router or center that starts at the same time

_RETRY_MS = 100
_LEASE_MS = 5000
# Zenoh's own threads fill the channels without Python's lock, so a busy process keeps its links moving. A full channel
# stalls the link; the sender then drops, and recovery or a miss report follows.
_CHANNEL_SIZE = 10_000
_DROP = zenoh.CongestionControl.DROP
#: What Zenoh itself can hold of one priority on a link, in batches: by default two, which the report of 1000 tracks
#: fills, so that some are dropped even on loopback. 16 is the most there is.
_QUEUE = {"data": 16, "background": 16}
# So often a publisher says how far it is: what was lost last is noticed then, after a cut too. A sporadic heartbeat
# would save these 60 bytes a second, but one that is lost with its link is not repeated.
_HEARTBEAT = ext.MissDetectionConfig(heartbeat=2.0, sporadic_heartbeat=None)
_RECOVERY = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
_ENDPOINT = re.compile(r"(tcp|udp|tls|quic)/(\[[^\s\]]+\]|[^\s/:\[\]?#]+):(?P<port>\d{1,5})([?#]\S*)?")

_log = logging.getLogger(__name__)


class Publisher(Protocol):
    """Publishes on one key."""

    def put(self, payload: bytes) -> bool:
        """Send without waiting: what a full link cannot take is dropped.

        Returns:
            False if display data was shed here, for the rest's sake; what Zenoh drops, only the receiver notices.
        """

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
            reliable: whether losses are repaired; display data needs no repair and comes after everything else.
        """

    def subscribe(
        self,
        key_expr: str,
        deliver: Deliver,
        *,
        reliable: bool = True,
        history: int = 0,
        on_miss: DeliverMiss | None = None,
    ) -> None:
        """Have every sample delivered from now on.

        Args:
            key_expr: what to listen to; ``*`` stands for one chunk, ``**`` for any number.
            deliver: takes key and payload.
            reliable: ask reliable publishers again for samples that were lost; False for display data.
            history: most samples to fetch from the cache of each reliable publisher, present or yet to come.
            on_miss: takes key and number of samples lost for good; ``key_expr`` if nothing of that publisher arrived.
                Of display data, the exact number shed between two samples, told just before the second.
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

    @property
    def peer_of_router(self) -> bool:
        """Whether this process is a peer that is linked to a router and to no other peer: see ``PEER_OF_ROUTER``."""

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
    return _ZenohBus(session, network.mode, _listening(session, network), Allowance(network.link_bit_s))


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
        "transport": {"link": _link_settings(network.link_bit_s), "shared_memory": {"enabled": False}},
    }


def _link_settings(bit_s: float | None) -> dict[str, Any]:
    """Buffers that hold about a second of a slow link: what is in them, no priority overtakes.

    A sending buffer alone does not bound what is on its way: the kernel lets the last packet grow. The receiver's does.
    """
    tx: dict[str, Any] = {"lease": _LEASE_MS, "queue": {"size": _QUEUE}}
    if bit_s is None:
        return {"tx": tx}
    second = min(max(round(bit_s / 8.0), 4096), 1 << 20)
    buffers = {"so_rcvbuf": second, "so_sndbuf": second // 2}
    return {"tx": {**tx, "batch_size": min(second // 4, 49152)}, "tcp": buffers, "tls": buffers}


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
def explained(doing: str) -> Iterator[None]:
    """Say what was being done when Zenoh refused.

    Raises:
        TransportError: in place of Zenoh's own error.
    """
    try:
        yield
    except zenoh.ZError as error:
        raise TransportError(f"cannot {doing}: {_reason(error)}") from error


class _ZenohPublisher(NamedTuple):
    key: str
    plain: zenoh.Publisher
    sender: ext.AdvancedPublisher
    allowance: Allowance

    def put(self, payload: bytes) -> bool:
        self.allowance.spend(len(payload))
        with explained(f"publish on {self.key}"):
            self.sender.put(payload)
        return True

    @property
    def has_listeners(self) -> bool:
        return _matching(self.plain)


class _DisplayPublisher:
    def __init__(self, key: str, plain: zenoh.Publisher, allowance: Allowance) -> None:
        self._key, self._plain, self._allowance, self._number = key, plain, allowance, 0

    def put(self, payload: bytes) -> bool:
        self._number += 1
        if not self._allowance.grants(len(payload)):
            return False
        with explained(f"publish on {self._key}"):
            self._plain.put(payload, attachment=self._number.to_bytes(4, "little"))
        return True

    @property
    def has_listeners(self) -> bool:
        return _matching(self._plain)


def _matching(publisher: zenoh.Publisher) -> bool:
    status: Any = publisher.matching_status  # the stub says bool; it is an object, always true
    return bool(status.matching)


class _ZenohBus(Bus):
    def __init__(self, session: zenoh.Session, mode: str, endpoints: tuple[str, ...], allowance: Allowance) -> None:
        self._mode = mode
        self._session, self._endpoints, self._allowance = session, endpoints, allowance
        # Zenoh withdraws what nobody refers to. Its close() ends publishers, even amid a put() where undeclare() fails,
        # but not advanced subscribers: the stack undeclares all else.
        self._publishers: list[Publisher] = []
        self._closing = ExitStack()
        self._closing.callback(session.close)
        # A process that ends by an error must not leave Zenoh's threads calling into a dying interpreter.
        atexit.register(self.close)
        self._closing.callback(atexit.unregister, self.close)

    def publisher(self, key: str, *, cache: int = 50, reliable: bool = True) -> Publisher:
        publisher: Publisher
        with explained(f"publish on {key}"):
            if reliable:
                # An advanced publisher cannot tell whether anyone listens: the plain one beside it does.
                plain = self._session.declare_publisher(key, congestion_control=_DROP)
                sender = ext.declare_advanced_publisher(
                    self._session,
                    key,
                    congestion_control=_DROP,
                    cache=ext.CacheConfig(max_samples=cache),
                    sample_miss_detection=_HEARTBEAT,
                    publisher_detection=True,
                )
                publisher = _ZenohPublisher(key, plain, sender, self._allowance)
            else:
                last = zenoh.Priority.BACKGROUND
                plain = self._session.declare_publisher(key, congestion_control=_DROP, priority=last)
                publisher = _DisplayPublisher(key, plain, self._allowance)
        self._publishers.append(publisher)
        return publisher

    def subscribe(
        self,
        key_expr: str,
        deliver: Deliver,
        *,
        reliable: bool = True,
        history: int = 0,
        on_miss: DeliverMiss | None = None,
    ) -> None:
        assert reliable or not history, "history needs reliable=True"
        with explained(f"subscribe to {key_expr}"):
            if reliable:
                self._subscribe_reliably(key_expr, deliver, history, on_miss)
            else:
                display = self._session.declare_subscriber(key_expr, FifoChannel(_CHANNEL_SIZE))
                self._serve(display, _Display(deliver, on_miss))

    def _subscribe_reliably(self, key_expr: str, deliver: Deliver, history: int, on_miss: DeliverMiss | None) -> None:
        keys: dict[tuple[str, int], str] = {}  # a miss names its publisher, not the key

        def on_sample(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            if on_miss is not None and sample.source_info is not None:
                keys[_identity(sample.source_info.source_id)] = key
            deliver(key, sample.payload.to_bytes())

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
        with explained(f"announce {key}"):
            self._closing.callback(self._session.liveliness().declare_token(key).undeclare)

    def watch(self, key_expr: str, deliver: DeliverPresence) -> None:
        def on_token(sample: zenoh.Sample) -> None:
            deliver(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        with explained(f"watch {key_expr}"):
            liveliness = self._session.liveliness()
            self._serve(liveliness.declare_subscriber(key_expr, FifoChannel(_CHANNEL_SIZE), history=True), on_token)

    def answer(self, key: str, reply: Callable[[], bytes]) -> None:
        def on_query(query: zenoh.Query) -> None:
            with query:
                query.reply(key, reply())

        with explained(f"answer {key}"):
            self._serve(self._session.declare_queryable(key, FifoChannel(_CHANNEL_SIZE)), on_query)

    def ask(self, key_expr: str, timeout_s: float) -> list[tuple[str, bytes]]:
        every_one = zenoh.ConsolidationMode.NONE
        with explained(f"ask {key_expr}"):
            replies = self._session.get(key_expr, consolidation=every_one, timeout=timeout_s)
            return [(str(r.ok.key_expr), r.ok.payload.to_bytes()) for r in replies if r.ok is not None]

    def endpoints(self) -> tuple[str, ...]:
        return self._endpoints

    @property
    def peer_of_router(self) -> bool:
        if self._mode != "peer":
            return False
        info = self._session.info
        return bool(info.routers_zid()) and not info.peers_zid()

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


class _Display:
    """Delivers display data, and tells of the gaps in its numbers; a publisher that begins anew has none."""

    def __init__(self, deliver: Deliver, on_miss: DeliverMiss | None) -> None:
        self._deliver, self._on_miss = deliver, on_miss
        self._numbers: dict[str, int] = {}

    def __call__(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if sample.attachment is not None:
            number = int.from_bytes(sample.attachment.to_bytes(), "little")
            missed = number - self._numbers.get(key, number) - 1
            if self._on_miss is not None and missed > 0:
                self._on_miss(key, missed)
            self._numbers[key] = number
        self._deliver(key, sample.payload.to_bytes())
