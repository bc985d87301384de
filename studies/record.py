"""What was seen and decided in one run, and the folder that tells of it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from common.config import Scenario
from common.estimation.gaussian import Array
from common.estimation.sprt import Status
from common.messages import Decision, Message, Scan, Tracks
from studies.lines import TrackLines, decision_entry, finite


class History(NamedTuple):
    """One track over time.

    Attributes:
        times_s: measurement times, shape (K,).
        status: shape (K,).
        log_lr: since the last reset, shape (K,).
        log_lr_total: since the start, shape (K,).
        x, P: fused densities, shapes (K, n), (K, n, n).
    """

    times_s: Array
    status: Array
    log_lr: Array
    log_lr_total: Array
    x: Array
    P: Array


@dataclass
class Record:
    """Everything heard during one run.

    Attributes:
        scenario: what ran.
        pictures: of every measurement time; a late report replaces those from its time on.
        decisions: in the order they were made.
        scans: the plots as the sensors published them.
        lost: why sensors went before their end, by name.
        plots_shed: scans missing among those that came, by sensor: full links carry reports first.
    """

    scenario: Scenario
    pictures: dict[int, Tracks] = field(default_factory=dict)
    decisions: list[Decision] = field(default_factory=list)
    scans: list[Scan] = field(default_factory=list)
    lost: dict[str, str] = field(default_factory=dict)
    plots_shed: dict[str, int] = field(default_factory=dict)

    def note(self, message: Message) -> None:
        """Keep a message that belongs to the record."""
        match message:
            case Tracks():
                self.pictures[message.time_ns] = message
            case Decision():
                self.decisions.append(message)
            case Scan():
                self.scans.append(message)
            case _:
                pass

    def histories(self) -> dict[int, History]:
        """All tracks over time, by id."""
        rows: dict[int, list[tuple[Any, ...]]] = {}
        for time_ns in sorted(self.pictures):
            tracks = self.pictures[time_ns]
            for row, track in enumerate(tracks.ids):
                values = (tracks.status, tracks.log_lr, tracks.log_lr_total, tracks.x, tracks.P)
                entry = (self.scenario.to_seconds(time_ns), *(value[row] for value in values))
                rows.setdefault(int(track), []).append(entry)
        return {
            track: History(*(np.array(column, dtype=np.float64) for column in zip(*entries, strict=True)))
            for track, entries in sorted(rows.items())
        }

    def standing(self) -> list[Decision]:
        """Decisions that were not withdrawn."""
        kept: list[Decision] = []
        for decision in self.decisions:
            if decision.kind == "withdrawn":
                kept = [d for d in kept if (d.track, d.time_ns) != (decision.track, decision.time_ns)]
            else:
                kept.append(decision)
        return kept

    def summary(self, extra: Mapping[str, Any]) -> dict[str, Any]:
        """Decisions and outcome as JSON."""
        limits = self.scenario.decision.thresholds
        decisions: dict[int, list[dict[str, Any]]] = {}
        for decision in self.standing():
            decisions.setdefault(decision.track, []).append(decision_entry(decision, self.scenario))
        times = [self.scenario.to_seconds(time_ns) for time_ns in self.pictures]
        return {
            "scenario": self.scenario.name,
            **extra,
            "first_time": min(times, default=None),
            "last_time": max(times, default=None),
            "thresholds": {"log_a": limits.log_a, "log_b": limits.log_b},
            "tracks": [
                {
                    "track": track,
                    "status": Status(int(history.status[-1])).name.lower(),
                    "log_lr": finite(history.log_lr[-1]),
                    "log_lr_total": finite(history.log_lr_total[-1]),
                    "last_time": float(history.times_s[-1]),
                    "x": history.x[-1].tolist(),
                    "decisions": decisions.get(track, []),
                }
                for track, history in self.histories().items()
            ],
            "withdrawn": [decision_entry(d, self.scenario) for d in self.decisions if d.kind == "withdrawn"],
            "sensors_lost": dict(self.lost),
            "plots_shed": dict(self.plots_shed),
        }


def write_report(record: Record, folder: Path, extra: Mapping[str, Any]) -> Sequence[Path]:
    """Write decisions, tracks and figures of a run.

    Args:
        record: what was heard.
        folder: must exist.
        extra: further entries of decisions.json, such as the seed.

    Returns:
        the files written.
    """
    from studies.figures import draw_log_lr, draw_plan  # Matplotlib takes a second to import; only reports need it.

    files = [folder / name for name in ("decisions.json", "tracks.jsonl", "log_lr.png", "plan.png")]
    files[0].write_text(json.dumps(record.summary(extra), indent=2) + "\n")
    lines = TrackLines(record.scenario)
    with files[1].open("w") as file:
        for time_ns in sorted(record.pictures):
            file.writelines(line + "\n" for line in lines.of(record.pictures[time_ns]))
    draw_log_lr(record, files[2])
    draw_plan(record, files[3])
    return files
