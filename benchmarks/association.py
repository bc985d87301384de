"""Who associates matters: the factor itself or the honest filter beside it (theory.md §12), on the same plots.

    python benchmarks/association.py [--runs N]

Mean log LR after the last scan and share of tracks lost (more than 1 km from the truth) in seeded runs; the intervals
hold 95 %.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.stats import binomtest

from common.config import load_scenario
from scenarios.catalogue import find
from studies.loss import Outcome, outcome, variant

SCENARIOS = ("four-radars-0.2", "heavy-clutter", "thirty-two")


def cells(result: Outcome) -> str:
    """Mean log LR and share lost, with intervals."""
    runs = len(result.lost)
    spread = 1.96 * result.log_lr.std(ddof=1) / np.sqrt(runs)
    interval = binomtest(int(result.lost.sum()), runs).proportion_ci(method="wilson")
    lost = f"{result.lost.mean():.1%} ({interval.low:.1%} to {interval.high:.1%})"
    return f"{result.log_lr.mean():.0f} ± {spread:.0f} | {lost}"


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=150)
    arguments = parser.parse_args()
    print("| scenario | factor: log LR | lost | tight: log LR | lost |\n|---|---|---|---|---|")
    for name in SCENARIOS:
        scenario = load_scenario(find(name))
        results = [outcome(variant(scenario, kind), range(arguments.runs)) for kind in ("factor", "tight")]
        print(f"| {name} | {' | '.join(cells(result) for result in results)} |", flush=True)


if __name__ == "__main__":
    main()
