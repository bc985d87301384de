"""What reports in single precision do to log LR: the same plots replayed with both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from waldnet.common.config import load_scenario
from waldnet.common.messages import Tracks
from waldnet.offline.replay import Replay
from waldnet.scenarios.catalogue import find
from waldnet.scenarios.world import simulate_all

SCENARIOS = ("four-radars", "four-radars-0.2", "thirty-two")


def compare(name: str, scans: int, seed: int = 1) -> dict[str, Any]:
    """Replay a scenario for so many scans with float64 and float32 reports, nothing being decided or deleted.

    Returns:
        the largest |log LR| of any track at any time, the largest difference of the two, and that of positions [m].
    """
    base = load_scenario(find(name))
    assert base.simulation is not None
    duration = scans * base.sensors[0].scan_interval
    changes = {
        "simulation": base.simulation.model_copy(update={"duration": duration}),
        "decision": base.decision.model_copy(update={"enabled": False}),
    }
    double = base.model_copy(update=changes)
    single = double.model_copy(update={"fusion": double.fusion.model_copy(update={"precision": "float32"})})
    plots = simulate_all(double, seed)
    pictures = [[m for m in Replay(s, plots).run() if isinstance(m, Tracks)] for s in (double, single)]
    log_lr = np.array([[picture.log_lr_total for picture in run] for run in pictures])
    position = np.array([[picture.x[:, : base.motion.dimensions] for picture in run] for run in pictures])
    return {
        "scenario": name,
        "scans": len(pictures[0]),
        "sensors": len(base.sensors),
        "largest_log_lr": float(np.abs(log_lr[0]).max()),
        "log_lr_difference": float(np.abs(log_lr[0] - log_lr[1]).max()),
        "position_difference_m": float(np.abs(position[0] - position[1]).max()),
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows in Markdown."""
    lines = [
        "| scenario | sensors | scans | largest abs log LR | largest difference of log LR | of position [m] |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    lines += [
        f"| {row['scenario']} | {row['sensors']} | {row['scans']} | {row['largest_log_lr']:.0f} "
        f"| {row['log_lr_difference']:.1e} | {row['position_difference_m']:.1e} |"
        for row in rows
    ]
    return "\n".join(lines)
