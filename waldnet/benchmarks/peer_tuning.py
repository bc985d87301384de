"""The search for the peer's settings: one after the other is varied, and the best kept, twice over.

What is best has the smallest mean GOSPA over all scenarios of a family together. Everything tried is judged per
scenario too, which says what the best setting for each of them would be in hindsight.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from waldnet.benchmarks.peer_tracker import Settings, run
from waldnet.benchmarks.real_truth import rules_of, times_of, truth_of
from waldnet.common.config import Scenario, load_scenario
from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import Scan
from waldnet.evaluation.ospa import gospa_over_time
from waldnet.evaluation.paths import targets_at, tracks_at
from waldnet.evaluation.runs import read_run
from waldnet.scenarios.catalogue import find
from waldnet.scenarios.truth import Whereabouts
from waldnet.sensor_node.sources import all_scans

#: Scenarios of a family.
FAMILIES = {
    "autoferry": tuple(f"autoferry-{number}-all" for number in (2, 3, 5, 13, 16)),
    "joyride": ("joyride",),
    "solent": ("solent",),
}

#: What is tried, in this order. A track of the ferry's radar alone (1.68 s) must outlive one scan interval.
_FERRY: dict[str, tuple[Any, ...]] = {
    "min_points": (4, 6, 8, 11, 15, 20, 30),
    "holding_s": (2.0, 3.0, 5.0, 8.0, 12.0),
    "deleter_s": (2.0, 3.5, 5.0, 8.0, 12.0),
    "gate": (0.95, 0.99, 0.999),
    "holding_gate": (2.0, 3.0, 4.0),
    "max_sigma_m": (10.0, 20.0, 30.0),
    "clutter": (0.3, 1.0, 3.0, 10.0, 100.0),
    "p_d": (0.6, 0.8, 1.0),
}
#: A ship's radar alone, every 2.5 s.
_SHIP: dict[str, tuple[Any, ...]] = {
    "min_points": (2, 3, 4, 6, 8, 11),
    "holding_s": (3.0, 6.0, 9.0, 12.0),
    "deleter_s": (6.0, 9.0, 12.0, 20.0),
    "gate": (0.95, 0.99, 0.999),
    "holding_gate": (2.0, 3.0, 4.0),
    "max_sigma_m": (30.0, 60.0, 120.0),
    "clutter": (0.3, 1.0, 3.0),
    "p_d": (0.8, 1.0),
}
#: Radars that see 20 km far are less sharp than a ferry's.
_SHIPS: dict[str, tuple[Any, ...]] = {
    "min_points": (2, 3, 4, 5, 8, 12),
    "holding_s": (2.0, 3.5, 5.0),
    "deleter_s": (6.0, 10.0, 20.0),
    "max_sigma_m": (60.0, 150.0),
    "gate": (0.95, 0.99),
}
GRID = {"autoferry": _FERRY, "joyride": _SHIP, "solent": _SHIPS}
_ROUNDS = 2


class Task(NamedTuple):
    """A scenario to tune on, judged when sensors scan that locate."""

    scenario: Scenario
    scans: Sequence[Scan]
    truth: dict[int, Whereabouts]
    times_s: Array


def tune(family: str, first: Settings, seconds: float | None, out: Path) -> None:
    """Search, and say what was found.

    Args:
        family: of the scenarios.
        first: settings to begin with.
        seconds: of each scenario; None: all.
        out: file of what was tried; what is in it already is not tried again.
    """
    tasks = [_task(name, seconds) for name in FAMILIES[family]]
    tried = _read(out)

    def score(settings: Settings) -> float:
        if settings not in tried:
            tried[settings] = [gospa(task, settings) for task in tasks]
            _write(out, tried)
            _say(settings, tried[settings], first)
        return float(np.mean(tried[settings]))

    best = first
    for _ in range(_ROUNDS):
        begin = best
        for name, values in GRID[family].items():
            best = min([best, *(best._replace(**{name: value}) for value in values)], key=score)
        if best == begin:
            break
    print(f"\nbest: {best}")
    _say(best, tried[best], first)
    for number, task in enumerate(tasks):
        alone = min(tried, key=lambda settings: tried[settings][number])
        print(f"best for {task.scenario.name} alone: {tried[alone][number]:.2f} m with {_difference(alone, best)}")


def _read(file: Path) -> dict[Settings, list[float]]:
    entries = json.loads(file.read_text(encoding="utf-8")) if file.exists() else []
    return {Settings(**entry["settings"]): entry["gospa_m"] for entry in entries}


def _write(file: Path, tried: dict[Settings, list[float]]) -> None:
    entries = [{"settings": settings._asdict(), "gospa_m": values} for settings, values in tried.items()]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")


def _task(name: str, seconds: float | None) -> Task:
    scenario = load_scenario(find(name))
    until = np.inf if seconds is None else seconds
    locating = {sensor.name for sensor in scenario.sensors if sensor.locates}
    scans = [scan for scan in all_scans(scenario) if scenario.to_seconds(scan.time_ns) <= until]
    known = truth_of(scenario)
    times_s = times_of(scenario, [scan for scan in scans if scan.sensor in locating], known)
    return Task(scenario, scans, known, times_s)


def gospa(task: Task, settings: Settings) -> float:
    """Mean GOSPA [m] of the peer with some settings."""
    scenario = task.scenario
    bearing = {sensor.name for sensor in scenario.sensors if sensor.kind == "bearing"}
    ignored = bearing if settings.bearings == "ignore" else set()
    scans = [scan for scan in task.scans if scan.sensor not in ignored]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "peer.jsonl"
        file.write_text("".join(json.dumps(line) + "\n" for line in run(scenario, scans, settings)))
        tracks = tracks_at(read_run(file, 2), task.times_s)
    rules = rules_of(scenario)
    targets = targets_at(task.truth, task.times_s, rules.gap_s, 2)
    return float(gospa_over_time(targets, tracks, rules.cutoff_m, rules.order).total.mean())


def _say(settings: Settings, values: Sequence[float], beside: Settings) -> None:
    listed = " ".join(f"{value:6.2f}" for value in values)
    print(f"{np.mean(values):6.2f} m = mean of {listed}  {_difference(settings, beside)}", flush=True)


def _difference(settings: Settings, beside: Settings) -> str:
    changes = {name: value for name, value in settings._asdict().items() if value != getattr(beside, name)}
    return ", ".join(f"{name} {value}" for name, value in changes.items()) or "nothing else"
