"""Latency of the steps that the processes take: a scan at a node, the last report of a time at the center.

    python waldnet/benchmarks/steps.py [--scenario NAME] [--mode MODE] [--json FILE]

A scenario (four-radars) after four scans of each radar, with one of its hypotheses, all five, or many more: from the
scan to the report (``LocalTracker.scan``), and from the last of four reports to tracks and decisions (``Center.step``),
without codec and bus. "Ahead" is with all that plots and reports do not change prepared while waiting; "prepares" is
how long that takes. Microseconds a step; the columns are measured in turns, the figures are medians. Machines differ
and are noisy.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from waldnet.benchmarks.machine import machine
from waldnet.common.config import DecisionConfig, Scenario, load_scenario
from waldnet.common.fusion_config import FusionConfig
from waldnet.common.messages import Scan
from waldnet.offline.loopback import Loopback
from waldnet.scenarios.catalogue import find
from waldnet.scenarios.world import simulate

TRACKS = (1, 5, 10, 100, 1000)
SCANS = 5
ROUNDS, SLICE_S = 25, 0.005


#: Keys of ``[fusion]``, as a live network would have them.
MODES: dict[str, dict[str, Any]] = {
    "tight": {},
    "mirrored-3": {"association": "mirrored", "terms": 3},
    "selected": {"mode": "selected"},
}


def network(name: str, mode: str, tracks: int) -> Scenario:
    """A scenario with so many hypotheses; where there are more than five nothing is decided, so that all stay."""
    scenario = load_scenario(find(name))
    fusion = FusionConfig.model_validate(MODES[mode])
    first, rng = scenario.hypotheses[0], np.random.default_rng(1)
    drawn = [(*rng.uniform(-1.5e4, 1.5e4, 2).tolist(), *rng.normal(0.0, 100.0, 2).tolist()) for _ in range(tracks)]
    more = [first.model_copy(update={"state": state}) for state in drawn[5:]]
    decision = scenario.decision if tracks <= 5 else DecisionConfig(enabled=False)
    hypotheses = [*scenario.hypotheses, *more][:tracks]
    return scenario.model_copy(update={"hypotheses": hypotheses, "decision": decision, "fusion": fusion})


def steps(scenario: Scenario) -> dict[str, Callable[[], object]]:
    """The last radar's last scan and the center's last report of it, as calls that can be repeated."""
    scans: dict[str, list[Scan]] = {name: simulate(scenario, name, 1) for name in scenario.sensor_names}
    network = Loopback.of(scenario)
    for name, own in scans.items():
        network.join(name, own[0].time_ns)
    for at in range(SCANS):
        for name, own in scans.items():
            scan, next_ns = own[at], own[at + 1].time_ns
            before, waiting = network.nodes[name], network.state
            report = network.report(scan, next_ns)
            network.fuse(report)
    tracker, center = network.trackers[name], network.center
    ready, expecting = tracker.prepare(before, scan.time_ns, scan.pose), center.prepare(waiting)
    return {
        "node": lambda: tracker.scan(before, scan, next_ns),
        "node, ahead": lambda: tracker.scan(ready, scan, next_ns),
        "node prepares": lambda: tracker.prepare(before, scan.time_ns, scan.pose),
        "center": lambda: center.step(waiting, report, 0),
        "center, ahead": lambda: center.step(expecting, report, 0),
        "center prepares": lambda: center.prepare(waiting),
    }


def microseconds(works: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Median time of one call of each, all in turns."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(ROUNDS):
        for name, work in works.items():
            calls, start = 0, time.perf_counter()
            while time.perf_counter() - start < SLICE_S:
                work()
                calls += 1
            times[name].append(1e6 * (time.perf_counter() - start) / calls)
    return {name: round(statistics.median(values)) for name, values in times.items()}


def main() -> None:
    """Print a table, and write JSON if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="four-radars")
    parser.add_argument("--mode", choices=tuple(MODES), default="tight")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    arguments = parser.parse_args()
    about, rows = machine("numpy"), []
    for tracks in TRACKS:
        works = steps(network(arguments.scenario, arguments.mode, tracks))
        rows.append({"tracks": tracks, **microseconds(works)})
    if arguments.json:
        arguments.json.write_text(json.dumps({"machine": about, "rows": rows}, indent=2) + "\n")
    print(", ".join(f"{key} {value}" for key, value in about.items()))
    print("\nmicroseconds a step, medians")
    print(f"| {' | '.join(rows[0])} |\n|{'---:|' * len(rows[0])}")
    for row in rows:
        print(f"| {' | '.join(map(str, row.values()))} |")


if __name__ == "__main__":
    main()
