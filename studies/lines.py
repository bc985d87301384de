"""Tracks as JSON Lines: what ``waldnet replay --json`` prints and a run's report keeps."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from common.config import Scenario
from common.estimation.sprt import Status
from common.messages import Tracks

_LARGEST = float(np.finfo(np.float64).max)


class TrackLines:
    """Turns pictures into lines: every track after every measurement time, deleted ones as they were at the end."""

    def __init__(self, scenario: Scenario) -> None:
        """For times in seconds since the scenario's epoch."""
        self._scenario = scenario
        self._deleted: dict[int, dict[str, Any]] = {}

    def of(self, tracks: Tracks) -> Iterator[str]:
        """The lines of one measurement time, by track."""
        time_s = self._scenario.to_seconds(tracks.time_ns)
        entries = {int(track): _entry(tracks, row) for row, track in enumerate(tracks.ids)}
        for track, entry in sorted({**self._deleted, **entries}.items()):
            if entry["status"] == "deleted":
                self._deleted[track] = entry
            yield json.dumps({"time": time_s, "track": track, **entry}, allow_nan=False)


def _entry(tracks: Tracks, row: int) -> dict[str, Any]:
    return {
        "status": Status(tracks.status[row]).name.lower(),
        "log_lr": finite(tracks.log_lr[row]),
        "log_lr_total": finite(tracks.log_lr_total[row]),
        "x": tracks.x[row].tolist(),
        "P": tracks.P[row].tolist(),
    }


def finite(value: float) -> float:
    """A logarithm as JSON can say it: -inf, of an event that h1 holds for impossible, as the lowest number."""
    return float(np.clip(value, -_LARGEST, _LARGEST))
