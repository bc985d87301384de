"""How far the sensors' clocks are from the center's, as the arrival of their reports tells."""

from __future__ import annotations

from collections import Counter, deque
from statistics import median

#: So many reports in a row must tell the same, and so many come before anything is said: others come meanwhile.
_REPORTS, _FIRST = 5, 8
#: From so many sensors on, what most of them show is the center's own fault.
_MAJORITY = 3
#: Stands for the center among the sensors.
CENTER = ""


class Punctuality:
    """Compares when reports come with when their scans were; for networks that run by the clock.

    A report comes after its scan: one that comes before it tells of a clock that is ahead, one that always comes long
    after it of a clock that is behind, or of a slow way. Reports of a while ago that come all at once tell nothing.
    """

    def __init__(self, tolerance_s: float) -> None:
        """Say nothing of offsets up to a tolerance [s]."""
        self._tolerance_s = tolerance_s
        self._lags_s: dict[str, deque[float]] = {}
        self._said_s: dict[str, float] = {}
        self._counts: Counter[str] = Counter()

    @property
    def offsets_s(self) -> dict[str, float]:
        """How long after their scans the reports of each sensor come [s]; negative: before."""
        return {name: median(lags) for name, lags in self._lags_s.items() if self._steady(lags)}

    def note(self, name: str, lag_s: float) -> list[tuple[str, str]]:
        """Note when a report came.

        Args:
            name: of the sensor.
            lag_s: from the time of its scan, by the center's clock, to the arrival [s].

        Returns:
            whose clock there is something to say of, ``CENTER`` for the center's, and what was not said before.
        """
        self._lags_s.setdefault(name, deque(maxlen=_REPORTS)).append(lag_s)
        self._counts[name] += 1
        if self._counts[name] < _FIRST or not self._steady(self._lags_s[name]):
            return []
        offsets = self.offsets_s
        common = median(offsets.values()) if len(offsets) >= _MAJORITY else 0.0
        return [*self._say(CENTER, common), *self._say(name, offsets[name] - common)]

    def _steady(self, lags_s: deque[float]) -> bool:
        return len(lags_s) == _REPORTS and max(lags_s) - min(lags_s) <= self._tolerance_s

    def _say(self, name: str, offset_s: float) -> list[tuple[str, str]]:
        wrong = abs(offset_s) > self._tolerance_s
        said = self._said_s.get(name)
        if wrong and (said is None or abs(offset_s - said) > self._tolerance_s):
            self._said_s[name] = offset_s
            return [(name, _described(name, offset_s))]
        if not wrong and said is not None:
            del self._said_s[name]
            who = f"the clock of {name} and the center's" if name else "the clocks of most sensors and the center's"
            return [(name, f"{who} agree again")]
        return []


def _described(name: str, offset_s: float) -> str:
    by = f"{abs(offset_s):.1f} s"
    if not name:
        than = "behind those" if offset_s < 0.0 else "ahead of those"
        return f"the center's clock is {by} {than} of most sensors" + (
            ", or all reports are slow" if offset_s > 0 else ""
        )
    if offset_s < 0.0:
        return f"the clock of {name} is {by} ahead of the center's"
    return f"the clock of {name} is {by} behind the center's, or its reports are so slow"
