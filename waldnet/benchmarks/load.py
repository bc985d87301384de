"""Which share of its time a scenario keeps a machine busy.

Of the whole scenario, all steps in one process, codec included: CPU time of each scan. Of a part of it, a live network:
CPU time of every process from the start of the clock to its end, as Linux counts it, for a second of scenario time,
and what became of the reports.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from waldnet.benchmarks.crew import BenchError
from waldnet.benchmarks.scaling import Steps
from waldnet.common.config import load_scenario
from waldnet.common.messages import NEVER
from waldnet.scenarios.catalogue import find
from waldnet.scenarios.plots import write_plots
from waldnet.sensor_node.sources import all_scans

_EVERY_S = 0.1
_PATIENCE_S = 60.0


def steps(name: str) -> dict[str, Any]:
    """CPU time of the steps of a scenario: a scan of one sensor, and the center's step of the report of it."""
    scenario = load_scenario(find(name))
    scans = all_scans(scenario)
    network, parts = Steps(scenario), []
    network.join({scan.sensor: scan.time_ns for scan in reversed(scans)})
    following: dict[str, int] = {}
    later = [NEVER] * len(scans)
    for at in reversed(range(len(scans))):
        later[at] = following.get(scans[at].sensor, NEVER)
        following[scans[at].sensor] = scans[at].time_ns
    tracks = []
    for scan, next_ns in zip(scans, later, strict=True):
        parts.append(network.scan(scan, next_ns))
        tracks.append(0 if network.tracks is None else len(network.tracks.ids))
    seconds = (scans[-1].time_ns - scans[0].time_ns) / 1e9
    took = {part: np.array([row[part] for row in parts]) for part in ("node", "told", "center")}
    return {
        "what": "steps",
        "scenario": scenario.name,
        "seconds": round(seconds, 1),
        "scans": len(scans),
        "tracks": round(float(np.median(tracks))),
        "cpu_share": round(float((took["node"] + took["center"]).sum() + 3 * took["told"].sum()) / 1e3 / seconds, 4),
        **{f"{part}_p50_ms": round(float(np.quantile(took[part], 0.5)), 2) for part in ("node", "center")},
        **{f"{part}_p99_ms": round(float(np.quantile(took[part], 0.99)), 2) for part in ("node", "center")},
    }


def live(name: str, speed: str, seconds: float) -> dict[str, Any]:
    """CPU time of every process of a live network for a second of scenario time.

    Raises:
        BenchError: when the network does not start, or not well end.
    """
    path = find(name).resolve()
    scenario = load_scenario(path)
    with tempfile.TemporaryDirectory() as folder:
        out, plots = Path(folder) / "run", Path(folder) / "plots.jsonl"
        scans = [scan for scan in all_scans(scenario) if scenario.to_seconds(scan.time_ns) <= seconds]
        with plots.open("w", encoding="utf-8") as file:
            write_plots(file, scans, scenario)
        words = ["run", str(path), "--plots", str(plots), "--speed", speed, "--out", str(out)]
        launcher = subprocess.Popen(
            [sys.executable, "-c", "from waldnet.launch.cli import main; main()", *words], stdout=subprocess.DEVNULL
        )
        try:
            _wait_for_clock(launcher, out / "logs" / "center.log")
            began, first = time.monotonic(), _cpu_s(launcher.pid)
            last = dict(first)
            # What comes after the network's end is the report, which is no matter here.
            while len(now := _cpu_s(launcher.pid)) > 1:
                last |= now
                time.sleep(_EVERY_S)
            wall_s = time.monotonic() - began
        finally:
            launcher.terminate()
            launcher.wait()
        counts = _counts(out / "logs" / "center.log")
    spent = {who: round((last[who] - cpu_s) / seconds, 4) for who, cpu_s in first.items()}
    return {
        "what": f"live, speed {speed}",
        "scenario": scenario.name,
        "seconds": seconds,
        "scans": len(scans),
        "wall_s": round(wall_s, 1),
        "cpu_share": round(sum(spent.values()), 4),
        "cpu_share_each": dict(sorted(spent.items())),
        "reports": counts,
        "lost": sum(counts.get(kind, 0) for kind in ("too_late", "refused", "lost reports")),
    }


def _wait_for_clock(launcher: subprocess.Popen[bytes], log: Path) -> None:
    until = time.monotonic() + _PATIENCE_S
    while not (log.exists() and "clock started" in log.read_text()):
        if launcher.poll() is not None or time.monotonic() > until:
            raise BenchError(f"{log}: the clock did not start within {_PATIENCE_S:g} s")
        time.sleep(_EVERY_S)


def _cpu_s(launcher: int) -> dict[str, float]:
    """CPU time of the launcher and of its children so far [s]."""
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            # Fields after the name in brackets: state, parent, ..., user and system time as 12th and 13th.
            fields = (process / "stat").read_text().rpartition(")")[2].split()
            words = (process / "cmdline").read_text().split("\0")
        except OSError:
            continue
        if launcher in (int(process.name), int(fields[1])) and fields[0] != "Z":
            found[_name(int(process.name) == launcher, words)] = (int(fields[11]) + int(fields[12])) / _TICKS
    return found


_TICKS = os.sysconf("SC_CLK_TCK")


def _name(launches: bool, words: Sequence[str]) -> str:
    if launches:
        return "launcher"
    module = words.index("-m") if "-m" in words else 0
    return words[module + 3] if "waldnet.sensor_node" in words else "center"


def _counts(log: Path) -> dict[str, int]:
    """What the center said of reports at its end."""
    for line in reversed(log.read_text().splitlines()):
        entry: dict[str, Any] = json.loads(line)
        if entry.get("event") == "ended":
            return {**entry["reports"], **entry["dropped"]}
    raise BenchError(f"{log}: the center did not say how it ended")


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows for people."""
    return "\n".join(_lines(rows))


def _lines(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    first, *lives = rows
    yield (
        f"Steps of the whole scenario {first['scenario']} ({first['seconds']} s, {first['scans']} scans, "
        f"{first['tracks']} tracks at a time), CPU: a share of {first['cpu_share']:.1%} of scenario time; node "
        f"{first['node_p50_ms']} ms a scan (p99 {first['node_p99_ms']}), center {first['center_p50_ms']} ms "
        f"(p99 {first['center_p99_ms']})."
    )
    yield ""
    yield "| live network | scenario s | wall s | CPU s for a scenario s, all | each | late | lost |"
    yield "|---|---:|---:|---:|---|---:|---:|"
    for row in lives:
        each = ", ".join(f"{who} {share:.3f}" for who, share in row["cpu_share_each"].items())
        yield (
            f"| {row['what']} | {row['seconds']:g} | {row['wall_s']} | {row['cpu_share']:.3f} | {each} "
            f"| {row['reports'].get('late', 0)} | {row['lost']} |"
        )
