"""What reaches a process, in one queue: transport threads only put, the process's own thread works it off."""

from __future__ import annotations

from queue import Empty, SimpleQueue
from typing import NamedTuple, TypeAlias

from waldnet.common.clock import now_ns
from waldnet.common.health import Answer


class Heard(NamedTuple):
    """Bytes came in on a key."""

    key: str
    payload: bytes


class Present(NamedTuple):
    """A liveliness token came or went."""

    key: str
    alive: bool


class Missed(NamedTuple):
    """Messages on a key are lost for good."""

    key: str
    number: int


class Said(NamedTuple):
    """A child process said where it listens."""

    name: str
    listening: tuple[str, ...]


class Exited(NamedTuple):
    """A child process ended."""

    name: str
    code: int


class Asked(NamedTuple):
    """Somebody asks how the process is."""

    answer: Answer


class Stopped(NamedTuple):
    """The process shall end."""


class Elapsed(NamedTuple):
    """Nothing came in until the time asked for."""


Incoming: TypeAlias = Heard | Present | Missed | Said | Exited | Asked | Stopped | Elapsed


class Inbox:
    """A queue with one reader; everything else may be called from any thread, and from a signal handler."""

    def __init__(self) -> None:
        """Empty."""
        self._queue: SimpleQueue[Incoming] = SimpleQueue()

    def heard(self, key: str, payload: bytes) -> None:
        """Put bytes."""
        self._queue.put(Heard(key, payload))

    def present(self, key: str, alive: bool) -> None:
        """Put a change of liveliness."""
        self._queue.put(Present(key, alive))

    def missed(self, key: str, number: int) -> None:
        """Put a loss."""
        self._queue.put(Missed(key, number))

    def said(self, name: str, listening: tuple[str, ...]) -> None:
        """Put where a child process listens."""
        self._queue.put(Said(name, listening))

    def exited(self, name: str, code: int) -> None:
        """Put the end of a child process."""
        self._queue.put(Exited(name, code))

    def asked(self, answer: Answer) -> None:
        """Put the question how the process is."""
        self._queue.put(Asked(answer))

    def stop(self) -> None:
        """Put the request to end."""
        self._queue.put(Stopped())

    @property
    def empty(self) -> bool:
        """Whether nothing waits."""
        return self._queue.empty()

    def receive(self, until_ns: int | None) -> Incoming:
        """The next thing that happens, at the latest at ``until_ns`` of ``now_ns``; None: however long it takes."""
        try:
            timeout = None if until_ns is None else max(0.0, (until_ns - now_ns()) / 1e9)
            return self._queue.get(timeout=timeout)
        except Empty:
            return Elapsed()
