"""Time that nobody can set: the wall clock as it was when the process began, and the monotonic clock since.

A process paces itself, waits and judges by ``now_ns``. Only what processes tell each other is wall time, converted with
``set_by_ns`` when it is sent and when it comes in, so that a clock set in between moves nothing.
"""

from __future__ import annotations

import time

_AT_START_NS = time.time_ns() - time.monotonic_ns()


def now_ns() -> int:
    """Wall time of now, as if the clock had not been set since this process began."""
    return _AT_START_NS + time.monotonic_ns()


def set_by_ns() -> int:
    """How far the wall clock has been set since this process began: what to add to ``now_ns`` for wall time."""
    return time.time_ns() - now_ns()
