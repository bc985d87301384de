"""The table of theory.md §12 again: what an independent prototype found, beside what this program finds.

    python -m waldnet.benchmarks.prototype [--runs 1000] [--workers N]

The prototype's targets begin in the middle of the false plots and leave a square of 10 km after 33 s; so they do
here. The scenarios that come along keep theirs among the false plots, where log LR is what the model says.
"""

from __future__ import annotations

import argparse
import os
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from waldnet.common.config import Scenario
from waldnet.scenarios.catalogue import find
from waldnet.studies.plan import Order, check
from waldnet.studies.study import Outcome, Study
from waldnet.studies.tables import rows_of

PDAF = "centralised"
TIGHT = "federated-tight"
MIRRORED = ("federated-mirrored-1", "federated-mirrored-3", "federated-mirrored-8")


class Network(NamedTuple):
    """A row of theory.md §12: sensors that see everywhere, their false plots in a square around the origin."""

    sensors: int
    side_km: float
    false_plots: float
    p_d: float
    sigma: float
    psd: float = 10.0
    interval: float = 2.0
    scans: int = 30

    @property
    def title(self) -> str:
        """As §12 names it."""
        more = f", q = {self.psd:g}, T = {self.interval:g} s" if self.psd != 10.0 else ""
        return f"{self.sensors}, {self.side_km:g} km, {self.false_plots:g}, {self.p_d:g}, {self.sigma:g} m{more}"

    @property
    def scenario(self) -> Scenario:
        """One target, drawn from its hypothesis: at the origin, 100 m and 20 m/s."""
        content: dict[str, Any] = tomllib.loads(find("heavy-clutter").read_text(encoding="utf-8"))
        sensor = content["sensor"][0] | {
            "sigma": [self.sigma, self.sigma],
            "p_d": self.p_d,
            "false_plots": self.false_plots,
            "field_of_view": {"shape": "everywhere", "area": (1e3 * self.side_km) ** 2},
            "scan_interval": self.interval,
        }
        content["sensor"] = [sensor | {"name": f"sensor-{number}"} for number in range(self.sensors)]
        content["motion"]["psd"] = self.psd
        content["simulation"]["duration"] = self.interval * self.scans
        content["hypothesis"] = [content["hypothesis"][0] | {"state": [0.0, 0.0, 150.0, 0.0]}]
        return Scenario.model_validate(content)


EASY = Network(4, 40.0, 5.0, 0.2, 50.0)
DENSE = Network(4, 10.0, 50.0, 0.5, 50.0)
HEAVY = Network(4, 10.0, 100.0, 0.5, 100.0)
MANY = Network(32, 20.0, 20.0, 0.3, 50.0, scans=20)
RARE = Network(4, 10.0, 50.0, 0.2, 50.0)
FAST = Network(4, 10.0, 50.0, 0.9, 100.0, psd=100.0, interval=5.0)

#: Mean log LR and tracks lost, as §12 has them.
LOG_LR = {
    EASY: {PDAF: "135 / 0.3%", "federated": "123 / 0", TIGHT: "128 / 0", "federated-tight-reset": "136 / 0.3%"},
    DENSE: {PDAF: "127 / 0.3%", "federated": "76 / 0.3%", TIGHT: "97 / 0", "federated-tight-reset": "124 / 3%"},
    HEAVY: {PDAF: "32 / 2%", "federated": "-17 / 44%", TIGHT: "4 / 5%", "federated-tight-reset": "26 / 9%"},
    MANY: {PDAF: "772 / 0", "federated": "228 / 0", TIGHT: "601 / 0", "federated-tight-reset": "783 / 0"},
}
#: Lost, confirmed, mean decision length.
DECISIONS = {
    RARE: ("12% / 73% / 14.8", "36% / 20% / 20.5", "8% / 42% / 18.2", "5% / 57% / 15.8", "5% / 63% / 15.9"),
    FAST: ("5% / 98% / 2.35", "8% / 100% / 2.1", "2% / 98% / 2.42", "2% / 100% / 2.37", "0 / 98% / 2.30"),
    HEAVY: ("0 / 94% / 7.8", "5% / 85% / 8.0", "2% / 90% / 8.0", "", ""),
}
#: Scans to the deletion of a track without a target.
DELETIONS = {RARE: ("11.0", "", "12.7", "11.2", "9.1"), FAST: ("1.22", "", "1.45", "1.20", "1.18")}
#: P(sup LR >= 100 | h0) at 100 false plots.
FALSE_ALARMS = {PDAF: "0.5%", "federated": "1.0%", TIGHT: "2.1%", MIRRORED[0]: "0.75%", MIRRORED[1]: "0.42%"}
DECIDING = (PDAF, TIGHT, *MIRRORED)


class Studies:
    """Studies of networks, each done once."""

    def __init__(self, runs: int, workers: int) -> None:
        """So many runs of each."""
        self.runs, self.workers = runs, workers

    def outcome(self, network: Network, modes: tuple[str, ...], *, no_target: bool = False) -> Outcome:
        """Tables of a network's study."""
        scenario = network.scenario
        if no_target:
            scenario = scenario.model_copy(update={"targets": ()})
        order = Order(modes, self.runs, seed=12)
        check(scenario, order, modes)
        folder = Path("runs/prototype") / f"{network.title}{', no target' if no_target else ''}"
        opened = Study(scenario, order, folder)
        opened.play(self.workers, None, lambda _: None)
        return opened.judge()


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    studies = Studies(arguments.runs, arguments.workers)
    print(f"{arguments.runs} runs each; in brackets the prototype's (60 to 400 runs).\n")
    print("Mean log LR (± standard error) / tracks lost:\n")
    _table("sensors, square, false plots, p_d, sigma", ("centralised", "federated", "tight", "tight + reset"))
    for network, found in LOG_LR.items():
        outcome = studies.outcome(network, tuple(found))
        _row(network.title, [f"{_log_lr(outcome, mode)} ({theirs})" for mode, theirs in found.items()])
    print("\nTracks lost / confirmed / scans to decide:\n")
    heads = ("centralised PDAF", "tight", "mirrored K=1", "K=3", "K=8")
    _table("", heads)
    for network, listed in DECISIONS.items():
        outcome = studies.outcome(network, DECIDING)
        _row(network.title, [_told(_decided(outcome, m), t) for m, t in zip(DECIDING, listed, strict=True)])
    print("\nScans to decide where there is no target:\n")
    _table("", heads)
    for network, listed in DELETIONS.items():
        outcome = studies.outcome(network, DECIDING, no_target=True)
        _row(network.title, [_told(_scans(outcome, m), t) for m, t in zip(DECIDING, listed, strict=True)])
    print(f"\nP(sup LR >= 100 | no target), {HEAVY.title}; at most 1 % if LR is exact:\n")
    _table("", tuple(FALSE_ALARMS))
    outcome = studies.outcome(HEAVY, tuple(FALSE_ALARMS), no_target=True)
    _row("", [_told(_reached(outcome, mode), theirs) for mode, theirs in FALSE_ALARMS.items()])


def _log_lr(outcome: Outcome, mode: str) -> str:
    row = rows_of(outcome.summary, mode=mode)
    return f"{row['log_lr_mean'][0]:.0f} ± {row['log_lr_se'][0]:.0f} / {row['share_lost'][0]:.1%}"


def _decided(outcome: Outcome, mode: str) -> str:
    row = rows_of(outcome.summary, mode=mode)
    return f"{row['share_lost'][0]:.1%} / {row['p_confirmed'][0]:.0%} / {row['decision_scans_mean'][0]:.2f}"


def _scans(outcome: Outcome, mode: str) -> str:
    return f"{rows_of(outcome.summary, mode=mode)['decision_scans_mean'][0]:.2f}"


def _reached(outcome: Outcome, mode: str) -> str:
    return f"{np.mean(rows_of(outcome.runs, mode=mode)['log_lr_sup'] >= np.log(100.0)):.2%}"


def _told(ours: str, theirs: str) -> str:
    return f"{ours} ({theirs})" if theirs else ours


def _table(corner: str, heads: tuple[str, ...]) -> None:
    print(f"| {corner} | {' | '.join(heads)} |\n{'|---' * (len(heads) + 1)}|")


def _row(head: str, cells: list[str]) -> None:
    print(f"| {head} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
