"""Tracks and decisions as JSON and as lines for people: what replay, watch and a run's report say."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.estimation.sprt import Status
from waldnet.common.messages import Decision, Tracks
from waldnet.fusion_center.lag import FixedLag, Past

_LARGEST = float(np.finfo(np.float64).max)
_STATUS = tuple(status.name.lower() for status in Status)


class TrackLines:
    """Turns pictures into lines: every track after every measurement time.

    Deleted tracks are repeated as they were at the end, so that every time has all; not where tracks start by
    themselves, which would be more and more.
    """

    def __init__(self, scenario: Scenario, lag_s: float | None = None) -> None:
        """For times in seconds since the scenario's epoch.

        Args:
            scenario: the network.
            lag_s: say also where the tracks were so many seconds ago, with everything known now.
        """
        self._scenario = scenario
        self._lag = None if lag_s is None else FixedLag.of(scenario, lag_s)
        self._past: Past = ()
        self._deleted: dict[int, dict[str, Any]] = {}

    def of(self, tracks: Tracks) -> Iterator[str]:
        """The lines of one measurement time, by track."""
        return (line for _, line in self.by_track(tracks))

    def by_track(self, tracks: Tracks) -> Iterator[tuple[int, str]]:
        """The lines of one measurement time, each with its track, by track."""
        time_s = self._scenario.to_seconds(tracks.time_ns)
        entries = dict(zip(tracks.ids.tolist(), _entries(tracks, self._scenario), strict=True))
        if self._lag is not None:
            self._past, lagged = self._lag.step(self._past, tracks)
            for entry in entries.values():
                entry.update(time_lag=None, x_lag=None, P_lag=None)
            then_s = self._scenario.to_seconds(lagged.time_ns)
            for track, x, P in zip(lagged.ids, lagged.x, lagged.P, strict=True):
                entries[int(track)].update(time_lag=then_s, x_lag=x.tolist(), P_lag=P.tolist())
        for track, entry in sorted({**self._deleted, **entries}.items()):
            if entry["status"] == "deleted" and self._scenario.initiation is None:
                self._deleted[track] = entry
            yield track, json.dumps({"time": time_s, "track": track, **entry}, allow_nan=False)


def _entries(tracks: Tracks, scenario: Scenario) -> Iterator[dict[str, Any]]:
    """What is said of each track."""
    log_lr, total = (np.clip(values, -_LARGEST, _LARGEST) for values in (tracks.log_lr, tracks.log_lr_total))
    columns = (tracks.status, log_lr, total, tracks.x, tracks.P, tracks.supported_ns)
    names = ("status", "log_lr", "log_lr_total", "x", "P", "supported")
    for status, *numbers, supported_ns in zip(*(column.tolist() for column in columns), strict=True):
        supported_s = scenario.to_seconds(supported_ns)
        yield dict(zip(names, (_STATUS[status], *numbers, supported_s), strict=True))


def decision_entry(decision: Decision, scenario: Scenario) -> dict[str, Any]:
    """A decision as JSON."""
    return {
        "kind": decision.kind,
        "track": decision.track,
        "time": scenario.to_seconds(decision.time_ns),
        "log_lr": finite(decision.log_lr),
        "log_lr_total": finite(decision.log_lr_total),
        "scans": decision.scans,
        **({"into": decision.into} if decision.kind == "merged" else {}),
    }


def decision_text(decision: Decision, scenario: Scenario) -> str:
    """A decision for people."""
    time_s = scenario.to_seconds(decision.time_ns)
    what = f"{decision.kind} into {decision.into}" if decision.kind == "merged" else decision.kind
    return f"{time_s:8.2f} s  track {decision.track} {what} after {decision.scans} scans, log LR {decision.log_lr:+.2f}"


def finite(value: float) -> float:
    """A logarithm as JSON can say it: -inf, of an event that h1 holds for impossible, as the lowest number."""
    return float(np.clip(value, -_LARGEST, _LARGEST))
