"""How well one run found its targets: all measures, and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import Array
from waldnet.evaluation.holding import Holding, Idle, TargetFate, fates, hold, idle
from waldnet.evaluation.ospa import Gospa, Ospa2, gospa_over_time, ospa2_over_time
from waldnet.evaluation.paths import Paths, tracks_at
from waldnet.evaluation.runs import Run


class Rules(NamedTuple):
    """How runs are judged.

    Attributes:
        cutoff_m: farther from a target, a track is not of it.
        order: p of GOSPA and OSPA(2).
        window_s: of OSPA(2).
        gap_s: points of the truth that are farther apart are not joined.
    """

    cutoff_m: float = 100.0
    order: float = 2.0
    window_s: float = 10.0
    gap_s: float = 5.0


class Evaluation(NamedTuple):
    """Of one run.

    Attributes:
        run: its name.
        centralised_of: of a centralised run, names of the runs whose plots it had; else none.
        times_s: at which was judged, shape (K,).
        targets: that truly were there.
        tracks: confirmed tracks.
        gospa: over time.
        ospa2: over time.
        holding: who held whom.
        idle: tracks that held no target.
        fates: of the targets.
    """

    run: str
    centralised_of: Sequence[str]
    times_s: Array
    targets: Paths
    tracks: Paths
    gospa: Gospa
    ospa2: Ospa2
    holding: Holding
    idle: Idle
    fates: Sequence[TargetFate]

    def summary(self) -> dict[str, Any]:
        """The measures over the whole time; None where there is nothing to measure."""
        held = np.isfinite(self.holding.error_m)
        confirmed_s = [fate.confirmed_after_s for fate in self.fates if fate.confirmed_after_s is not None]
        minutes = float(np.ptp(self.times_s)) / 60.0
        false = len(self.idle.false_tracks)
        return {
            "targets": len(self.fates),
            "confirmed_targets": len(confirmed_s),
            "confirmed_after_s": float(np.mean(confirmed_s)) if confirmed_s else None,
            "held_share": float(held.sum() / self.targets.there.sum()) if self.fates else None,
            "breaks": sum(fate.breaks for fate in self.fates),
            "swaps": sum(fate.swaps for fate in self.fates),
            "rmse_m": float(np.sqrt((self.holding.error_m[held] ** 2).mean())) if held.any() else None,
            "confirmed_tracks": len(self.tracks.ids),
            "false_tracks": false,
            "false_tracks_per_minute": false / minutes if minutes else None,
            "near_no_target": float(self.idle.false.sum() / self.tracks.there.sum()) if len(self.tracks.ids) else None,
            "duplicates": len(self.idle.duplicates),
            "false_mean": float(self.idle.false.sum(axis=0).mean()),
            "duplicate_mean": float(self.idle.duplicate.sum(axis=0).mean()),
            "gospa_m": _means(self.gospa),
            "ospa2_m": _means(self.ospa2),
        }

    def entry(self) -> dict[str, Any]:
        """All of it as JSON."""
        return {
            "run": self.run,
            "centralised_of": list(self.centralised_of),
            **self.summary(),
            "each_target": [fate._asdict() for fate in self.fates],
            "duplicate_ids": self.idle.duplicates.tolist(),
            "false_ids": self.idle.false_tracks.tolist(),
            "over_time": {
                "time": self.times_s.tolist(),
                "targets": self.targets.there.sum(axis=0).tolist(),
                "confirmed_tracks": self.tracks.there.sum(axis=0).tolist(),
                "gospa_m": {name: part.tolist() for name, part in self.gospa._asdict().items()},
                "ospa2_m": {name: part.tolist() for name, part in self.ospa2._asdict().items()},
            },
        }


def _means(measure: Gospa | Ospa2) -> dict[str, float]:
    return {name: float(part.mean()) for name, part in measure._asdict().items()}


def judge(run: Run, targets: Paths, times_s: Array, rules: Rules) -> Evaluation:
    """Compare the confirmed tracks of a run with the truth.

    Args:
        run: to judge.
        targets: at the times, each there at some time.
        times_s: at which to judge, ascending, shape (K,), K > 0.
        rules: how.
    """
    tracks = tracks_at(run, times_s)
    cutoff_m, p = rules.cutoff_m, rules.order
    holding = hold(targets, tracks, cutoff_m, p)
    return Evaluation(
        run=run.name,
        centralised_of=run.centralised_of,
        times_s=times_s,
        targets=targets,
        tracks=tracks,
        gospa=gospa_over_time(targets, tracks, cutoff_m, p),
        ospa2=ospa2_over_time(targets, tracks, times_s, rules.window_s, cutoff_m, p),
        holding=holding,
        idle=idle(holding, tracks),
        fates=fates(holding, targets, tracks, times_s, run.times_s),
    )
