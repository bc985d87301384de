"""The network within one process: what ``common.transport`` does over Zenoh, without any."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from waldnet.common.errors import TransportError
from waldnet.common.transport import Bus, Deliver, DeliverMiss, DeliverPresence, KeyExpr, Publisher, explained


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
        expr = KeyExpr(key_expr)
        with self.lock:
            return [d for d in self.declared if d.kind == kind and d.key_expr.intersects(expr)]

    def tell(self, key: str, *, alive: bool) -> None:
        """Tell every watch of a token."""
        for watch in self.matching("watch", key):
            watch.item(key, alive)


class _Declaration(NamedTuple):
    bus: Bus
    kind: str
    key_expr: KeyExpr
    item: Any  # a publisher's cache, a callback, or nothing for a token


class _MemoryPublisher(NamedTuple):
    bus: _MemoryBus
    key: str
    cache: deque[bytes]

    def put(self, payload: bytes) -> bool:
        with self.bus.doing(f"publish on {self.key}") as network:
            self.cache.append(payload)
            for subscriber in network.matching("subscriber", self.key):
                subscriber.item(self.key, payload)
        return True

    @property
    def has_listeners(self) -> bool:
        return not self.bus.closed and bool(self.bus.network.matching("subscriber", self.key))


class _MemoryBus(Bus):
    def __init__(self, network: MemoryNetwork) -> None:
        self.network = network
        self.closed = False

    @contextmanager
    def doing(self, what: str) -> Iterator[MemoryNetwork]:
        with self.network.lock, explained(what):
            if self.closed:
                raise TransportError(f"cannot {what}: session closed")
            yield self.network

    def _declare(self, kind: str, key_expr: str, item: Any = None) -> None:
        with self.doing(f"declare {kind} {key_expr}") as network:
            network.declared.append(_Declaration(self, kind, KeyExpr(key_expr), item))

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
        on_miss: DeliverMiss | None = None,  # noqa: ARG002 (nothing is ever lost)
    ) -> None:
        assert reliable or not history, "history needs reliable=True"
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

    @property
    def peer_of_router(self) -> bool:
        return False

    def close(self) -> None:
        with self.network.lock:
            self.closed = True
            mine = [d for d in self.network.declared if d.bus is self]
            self.network.declared = [d for d in self.network.declared if d.bus is not self]
            for key in {str(d.key_expr) for d in mine if d.kind == "token"}:
                if not self.network.matching("token", key):
                    self.network.tell(key, alive=False)
