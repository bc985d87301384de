"""Logs: colour for people, JSON for containers; and complaints that do not flood them."""

from __future__ import annotations

import sys
import time
import warnings
from collections import Counter
from contextlib import suppress
from typing import Literal, NamedTuple, TextIO, TypeAlias, cast

import structlog

LogFormat: TypeAlias = Literal["auto", "console", "json"]

#: Between two lines about one kind of complaint: at first, and when it goes on and on.
_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0


def configure(log_format: LogFormat = "auto") -> None:
    """Log to standard error: for people on a terminal, as JSON elsewhere, unless told otherwise."""
    people = log_format == "console" or (log_format == "auto" and sys.stderr.isatty())
    renderer: structlog.typing.Processor = (
        structlog.dev.ConsoleRenderer() if people else structlog.processors.JSONRenderer()
    )
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            renderer,
        ],
        logger_factory=structlog.PrintLoggerFactory(cast(TextIO, _Unfailing(sys.stderr))),
        cache_logger_on_first_use=True,
    )
    warnings.showwarning = _log_warning


def _log_warning(message: Warning | str, category: type[Warning], *_where: object, **_place: object) -> None:
    """A warning of Python as a line of the log."""
    structlog.get_logger().warning(str(message), kind=category.__name__)


class _Unfailing:
    """A stream that loses what cannot be written: no process ends because the disk of its log is full."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        with suppress(OSError):
            return self._stream.write(text)
        return 0

    def flush(self) -> None:
        with suppress(OSError):
            self._stream.flush()


class Complaints:
    """Counts what was dropped, and logs it: at once, then ever more seldom while it goes on, at last every minute."""

    def __init__(self, log: structlog.typing.FilteringBoundLogger) -> None:
        """Log to ``log``."""
        self._log = log
        self._pauses: dict[tuple[str, ...], _Pause] = {}
        self.counts: Counter[str] = Counter()

    def add(self, kind: str, why: str, count: int = 1, **about: str) -> bool:
        """Count ``count`` events of a kind, and say why unless that was said a short while ago.

        Args:
            kind: of event.
            why: it happened.
            count: of events.
            about: further fields of the line, such as the sensor; a kind is said for each of them.

        Returns:
            whether it was said.
        """
        self.counts[kind] += count
        now, said = time.monotonic(), (kind, *about.values())
        pause = self._pauses.get(said, _Pause(now, 0.0))
        if now >= pause.until_s:
            self._pauses[said] = pause.next(now)
            self._log.warning(kind, why=why, count=self.counts[kind], **about)
            return True
        return False


class _Pause(NamedTuple):
    """A while in which nothing more is said of one matter."""

    until_s: float
    length_s: float

    def next(self, now_s: float) -> _Pause:
        """The one after it: twice as long, or as short as the first if nothing happened for as long as it took."""
        goes_on = now_s - self.until_s < self.length_s
        length_s = min(2.0 * self.length_s, _LONGEST_PAUSE_S) if goes_on else _PAUSE_S
        return _Pause(now_s + length_s, length_s)
