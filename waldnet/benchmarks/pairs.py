"""Two targets that cross, and two side by side: how often each keeps its track, distributed and centralised.

    python -m waldnet.benchmarks.pairs [--runs 200] [--workers 2] [--ways WAY ...] [--out runs/pairs.jsonl] [--played]

Both ways see the same plots of every seed. From 20 s on each target must be held by one track, the same to the end: a
track holds a target while it is closer than 1.5 sigma of a plot, half of what lies between targets side by side. A run
is *swapped* where a track came to hold another target than before, *lost* where a target was never held, is not at the
end, or is by another track than at first. Shares with Clopper-Pearson bounds at 95 %. Every run that was played is a
line of the file, which is of one version of the program: stopped, the command goes on where it was; ``--played``: no
more is played.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np

from waldnet.benchmarks.machine import described
from waldnet.common.config import load_scenario
from waldnet.scenarios.catalogue import find
from waldnet.studies.pairs import Outcome, Way, play
from waldnet.studies.shares import share_of

PACKAGES = ("waldnet", "numpy")
SCENARIOS = ("crossing", "parallel")
#: 1.5 sigma of a plot of these scenarios, and ten scans of every sensor.
CUTOFF_M, SETTLED_S = 75.0, 20.0


class Job(NamedTuple):
    """One run."""

    scenario: str
    way: Way
    seed: int


def work(job: Job) -> Outcome:
    """Play one run."""
    return play(load_scenario(find(job.scenario)), job.way, job.seed, CUTOFF_M, SETTLED_S)


def play_all(jobs: Sequence[Job], workers: int, file: Path) -> None:
    """Play what the file does not have yet, in processes of their own with one thread each."""
    for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(threads, "1")
    done = played(file)
    to_do = [job for job in jobs if job not in done]
    file.parent.mkdir(parents=True, exist_ok=True)
    with multiprocessing.get_context("spawn").Pool(workers) as pool, file.open("a", encoding="utf-8") as lines:
        for job, outcome in zip(to_do, pool.imap(work, to_do), strict=True):
            print(json.dumps({**job._asdict(), **outcome._asdict()}), file=lines, flush=True)


def played(file: Path) -> dict[Job, Outcome]:
    """The runs of a file."""
    found: dict[Job, Outcome] = {}
    for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
        entry = json.loads(line)
        found[Job(*map(entry.get, Job._fields))] = Outcome(*map(entry.get, Outcome._fields))
    return found


def rows(outcomes: Mapping[Job, Outcome]) -> Iterator[dict[str, Any]]:
    """What the runs of each scenario and way came to."""
    for scenario in SCENARIOS:
        for way in get_args(Way):
            own = [(job.seed, outcome) for job, outcome in sorted(outcomes.items()) if job[:2] == (scenario, way)]
            if not own:
                continue
            kept = share_of(sum(outcome.kept for _, outcome in own), len(own))
            yield {
                "scenario": scenario,
                "way": way,
                "runs": len(own),
                "kept": kept.share,
                "low": kept.low,
                "high": kept.high,
                "swapped": [seed for seed, outcome in own if outcome.swapped],
                "lost": [seed for seed, outcome in own if outcome.lost],
                "breaks": sum(outcome.breaks for _, outcome in own),
                "false_tracks": sum(outcome.false_tracks for _, outcome in own),
                "rmse_m": float(np.nanmean([outcome.rmse_m for _, outcome in own])),
            }


def table(found: Sequence[dict[str, Any]]) -> str:
    """The rows for people."""
    lines = [
        "| scenario | way | runs | kept | 95 % bounds | swapped | lost | breaks | false tracks | RMSE [m] |",
        "|---|---" + "|---:" * 8 + "|",
    ]
    lines += [
        f"| {row['scenario']} | {row['way']} | {row['runs']} | {row['kept']:.1%} "
        f"| {row['low']:.1%} to {row['high']:.1%} "
        f"| {len(row['swapped'])} | {len(row['lost'])} | {row['breaks']} | {row['false_tracks']} "
        f"| {row['rmse_m']:.1f} |"
        for row in found
    ]
    return "\n".join(lines)


def main() -> None:
    """Print a table, and write JSON if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/pairs.jsonl"))
    parser.add_argument("--ways", nargs="+", choices=get_args(Way), default=get_args(Way))
    parser.add_argument("--played", action="store_true", help="only tell of the runs of the file")
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.runs)
    if not arguments.played:
        jobs = [Job(name, way, seed) for seed in seeds for name in SCENARIOS for way in arguments.ways]
        play_all(jobs, arguments.workers, arguments.out)
    found = list(rows(played(arguments.out)))
    print(f"{described(*PACKAGES)}\n\n{table(found)}")
    for row in found:
        failed = sorted({*row["swapped"], *row["lost"]})
        if failed:
            print(f"\n{row['scenario']}, {row['way']}: seeds {', '.join(map(str, failed))}")


if __name__ == "__main__":
    main()
