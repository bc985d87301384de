"""Which sensors owe a report for so long that it is worth a word."""

from __future__ import annotations

from collections.abc import Mapping

#: So long nobody says anything.
PATIENCE_NS = 5_000_000_000


class Silence:
    """Knows which silent sensors were named already: each is named again whenever it has been twice as long."""

    def __init__(self) -> None:
        """Nobody is silent."""
        self._said_ns: dict[str, int] = {}

    def look(self, owing: Mapping[str, int], now_ns: int) -> tuple[dict[str, float], list[str]]:
        """Look who is silent.

        Args:
            owing: sensors whose report is due, and since when.
            now_ns: on the same clock.

        Returns:
            sensors to name now, with the length of their silence [s], and those that are silent no more.
        """
        silent = {name: now_ns - since_ns for name, since_ns in owing.items() if now_ns - since_ns >= PATIENCE_NS}
        again = [name for name in self._said_ns if name not in silent]
        for name in again:
            del self._said_ns[name]
        new = {name: length for name, length in silent.items() if length >= 2 * self._said_ns.get(name, 0)}
        self._said_ns.update(new)
        return {name: length / 1e9 for name, length in new.items()}, again
