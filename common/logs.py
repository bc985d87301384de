"""Logs: colour for people, JSON for containers; and complaints that do not flood them."""

from __future__ import annotations

import sys
import time
from collections import Counter
from typing import Literal, TypeAlias

import structlog

LogFormat: TypeAlias = Literal["auto", "console", "json"]


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
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
        cache_logger_on_first_use=True,
    )


class Complaints:
    """Counts what was dropped, and logs it once per kind and second."""

    def __init__(self, log: structlog.typing.FilteringBoundLogger) -> None:
        """Log to ``log``."""
        self._log = log
        self._logged_at: dict[tuple[str, ...], float] = {}
        self.counts: Counter[str] = Counter()

    def add(self, kind: str, why: str, count: int = 1, **about: str) -> bool:
        """Count ``count`` events of a kind, and say why unless that was said within the last second.

        Args:
            kind: of event.
            why: it happened.
            count: of events.
            about: further fields of the line, such as the sensor; a kind is said once a second for each of them.

        Returns:
            whether it was said.
        """
        self.counts[kind] += count
        now, said = time.monotonic(), (kind, *about.values())
        if now - self._logged_at.get(said, -1.0) >= 1.0:
            self._logged_at[said] = now
            self._log.warning(kind, why=why, count=self.counts[kind], **about)
            return True
        return False
