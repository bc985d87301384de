"""How much of a slow link what is only displayed may take: what the rest leaves over."""

from __future__ import annotations

import time
from collections.abc import Callable

#: Of a rate, what payloads may take: the remainder is for headers, keys and repetitions.
_USABLE = 0.7


class Allowance:
    """Counts what is sent and grants what is left; without a rate it grants everything.

    Two seconds' worth are saved up at most, so that regular reports leave display data its share.
    """

    def __init__(self, bit_s: float | None, clock: Callable[[], float] = time.monotonic) -> None:
        """Start with all that can be saved up.

        Args:
            bit_s: rate of the link, None if it does not matter.
            clock: seconds from any origin.
        """
        self._bytes_s = 1e15 if bit_s is None else _USABLE * bit_s / 8.0
        self._left, self._clock, self._at_s = 2.0 * self._bytes_s, clock, clock()

    def spend(self, size: int) -> None:
        """Note what is sent in any case."""
        now_s = self._clock()
        self._left = min(2.0 * self._bytes_s, self._left + (now_s - self._at_s) * self._bytes_s) - size
        self._at_s = now_s

    def grants(self, size: int) -> bool:
        """Whether display data may be sent now; what is larger than a second's worth needs only that."""
        self.spend(0)
        if self._left < min(size, self._bytes_s):
            return False
        self.spend(size)
        return True
