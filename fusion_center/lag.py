"""Fixed lag: where the tracks were a few seconds ago, seen from now (theory.md §9)."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.motion import Motion, predict
from waldnet.common.estimation.retrodiction import backward
from waldnet.common.messages import Tracks
from waldnet.common.quantities import NS_PER_S

#: Pictures as far back as they are needed, oldest first.
Past: TypeAlias = tuple[Tracks, ...]


@dataclass(frozen=True)
class FixedLag:
    """Smooths the center's pictures by Rauch-Tung-Striebel.

    The fused track is taken for what a filter with the whole process noise would say. With one sensor and no clutter
    it is; where factors are relaxed, or it is open which plots were the target's, this is an approximation.

    Attributes:
        motion: motion model.
        lag_ns: how far back to look.
        window_ns: how far back a late report may reach, whose pictures are told anew.
    """

    motion: Motion
    lag_ns: int
    window_ns: int

    @classmethod
    def of(cls, scenario: Scenario, lag_s: float) -> FixedLag:
        """For the pictures of a scenario's center."""
        window_ns = round(scenario.fusion.window * NS_PER_S)
        return cls(scenario.motion.build(), round(lag_s * NS_PER_S), window_ns)

    def step(self, past: Past, tracks: Tracks) -> tuple[Past, Tracks]:
        """Work in a picture.

        Args:
            past: pictures so far, at first empty.
            tracks: the newest picture, or one that a late report has changed: it replaces those from its time on.

        Returns:
            the past from now on; and the picture of the lag ago with everything known now: time and densities are of
            then, status and log LR of now. Tracks that were not there yet are missing.
        """
        past = (*(picture for picture in past if picture.time_ns < tracks.time_ns), tracks)
        then_ns = tracks.time_ns - self.lag_ns
        needed = self._at(past, then_ns)
        return past[max(self._at(past, then_ns - self.window_ns), 0) :], self._smoothed(past, needed, then_ns)

    @staticmethod
    def _at(past: Past, time_ns: int) -> int:
        """Number of the picture that was the newest at a time; -1: there was none."""
        return bisect_right(past, time_ns, key=lambda picture: picture.time_ns) - 1

    def _smoothed(self, past: Past, first: int, then_ns: int) -> Tracks:
        """From the newest picture back to a time between the picture ``first`` and the next."""
        tracks = past[-1]
        ids, later_ns, later = tracks.ids, tracks.time_ns, Gaussian(tracks.x, tracks.P)
        if first < 0:
            ids = ids[:0]
        for before in reversed(past[max(first, 0) : -1]):
            ids, mine, theirs = np.intersect1d(ids, before.ids, assume_unique=True, return_indices=True)
            now_ns, filtered = before.time_ns, Gaussian(before.x[theirs], before.P[theirs])
            if now_ns < then_ns:
                filtered, now_ns = predict(filtered, *self._moved(then_ns - now_ns)), then_ns
            later = backward(filtered, *self._moved(later_ns - now_ns), Gaussian(later.x[mine], later.P[mine]))
            later_ns = now_ns
        rows = np.isin(tracks.ids, ids)
        return Tracks(
            time_ns=then_ns,
            sensors=tracks.sensors,
            ids=tracks.ids[rows],
            status=tracks.status[rows],
            scans=tracks.scans[rows],
            contributing=tracks.contributing[rows],
            log_lr=tracks.log_lr[rows],
            log_lr_total=tracks.log_lr_total[rows],
            x=later.x[: len(ids)],
            P=later.P[: len(ids)],
            supported_ns=tracks.supported_ns[rows],
        )

    def _moved(self, interval_ns: int) -> tuple[Array, Array]:
        """F and Q over an interval."""
        dt = np.array(interval_ns / NS_PER_S)
        return self.motion.transition(dt), self.motion.noise(dt)
