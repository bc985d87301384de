"""``waldnet bench``: what a network costs, measured on this machine."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, Parameter, validators
from rich.console import Console

bench = App(name="bench", help="Measure what a network costs on this machine: bandwidth, latency, load, precision.")

Numbers = Annotated[tuple[int, ...], Parameter(negative=(), validator=validators.Number(gte=1), consume_multiple=True)]
Count = Annotated[int, Parameter(validator=validators.Number(gte=1))]


@bench.command
def latency(
    *,
    tracks: Numbers = (1, 100, 1000),
    sensors: Numbers = (4, 16),
    scans: Count = 300,
    rate: Annotated[float, Parameter(validator=validators.Number(gt=0))] = 10.0,
    json_file: Annotated[Path | None, Parameter(name="--json")] = None,
) -> None:
    """From the last node's scan to the decision at a subscriber, at scan rate and flat out, beside raw Zenoh and TCP.

    Args:
        tracks: numbers of tracks.
        sensors: numbers of sensors.
        scans: measured cycles of a row; a fifth, at a fifth of the rate, for more than 4000 tracks times sensors. The
            99.9th percentile needs a thousand.
        rate: scans per second.
        json_file: file to write the rows to.
    """
    from waldnet.benchmarks.latency import Cell, measure, table

    _writable(json_file)
    rows = []
    for number in sensors:
        for many in tracks:
            slower = 5 if many * number > 4000 else 1
            cells = [Cell(many, number, pace, max(1, scans // slower)) for pace in (rate / slower, 0.0)]
            rows += [_say(measure(cell)) for cell in cells]
    _finish(rows, table(rows), json_file, "numpy", "eclipse-zenoh")


@bench.command
def bandwidth(
    *,
    tracks: Numbers = (1, 10, 100, 1000),
    sensors: Numbers = (2, 4, 8, 16, 32),
    false_plots: Numbers = (1, 10, 100, 1000),
    scans: Count = 10,
    interval: Annotated[float, Parameter(validator=validators.Number(gt=0))] = 1.0,
    json_file: Annotated[Path | None, Parameter(name="--json")] = None,
    figure: Path | None = None,
) -> None:
    """Bytes per track and scan of reports and proposals, and of sending all plots instead; needs root and Linux.

    Each axis is varied while the others stay at 100 tracks, 4 sensors, 10 false plots.

    Args:
        tracks: numbers of tracks.
        sensors: numbers of sensors.
        false_plots: mean numbers of false plots per sensor and scan.
        scans: measured of every sensor.
        interval: seconds between scans; heartbeats weigh more when scans are rare.
        json_file: file to write the rows to.
        figure: PNG file to draw to.
    """
    from waldnet.benchmarks.bandwidth import draw, measure, table, worlds

    _writable(json_file, figure)
    rows = [_say(row) for row in measure(worlds(tracks, sensors, false_plots), scans, interval)]
    if figure is not None:
        draw(rows, figure)
    _finish(rows, table(rows), json_file, "eclipse-zenoh")


@bench.command
def tracks(
    *,
    targets: Numbers = (10, 100, 1000),
    scans: Count = 8,
    json_file: Annotated[Path | None, Parameter(name="--json")] = None,
) -> None:
    """CPU time of a scan against the number of tracks, which start by themselves and share plots, beside Stone Soup.

    Args:
        targets: numbers of targets.
        scans: of every radar that are timed.
        json_file: file to write the rows to.
    """
    from waldnet.benchmarks.scaling import Cell, measure, table

    _writable(json_file)
    areas: tuple[Literal["grows", "same"], ...] = ("grows", "same")
    rows = [_say(measure(Cell(number, area, scans=scans))) for area in areas for number in targets]
    _finish(rows, table(rows), json_file, "numpy", "stonesoup")


@bench.command
def load(
    scenario: str = "solent",
    *,
    seconds: Annotated[float, Parameter(validator=validators.Number(gt=0))] = 300.0,
    speeds: Annotated[tuple[str, ...], Parameter(negative=(), consume_multiple=True)] = ("10", "max"),
    json_file: Annotated[Path | None, Parameter(name="--json")] = None,
) -> None:
    """Which share of its time a scenario keeps a machine busy: the steps in one process, and a live network.

    Args:
        scenario: scenario file, or name of one that comes along.
        seconds: of scenario time that the live network runs; the steps are those of the whole scenario.
        speeds: of the live networks, one after the other.
        json_file: file to write the rows to.
    """
    from waldnet.benchmarks.load import live, steps, table

    _writable(json_file)
    rows = [_say(steps(scenario)), *(_say(live(scenario, speed, seconds)) for speed in speeds)]
    _finish(rows, table(rows), json_file, "numpy", "eclipse-zenoh")


@bench.command
def precision(*, scans: Count = 1000, json_file: Annotated[Path | None, Parameter(name="--json")] = None) -> None:
    """What reports in single precision (fusion.precision = "float32") do to log LR after many scans.

    Args:
        scans: of every sensor; the scenario with 32 sensors takes a fifth.
        json_file: file to write the rows to.
    """
    from waldnet.benchmarks.precision import SCENARIOS, compare, table

    _writable(json_file)
    rows = [_say(compare(name, max(1, scans // 5) if name == "thirty-two" else scans)) for name in SCENARIOS]
    _finish(rows, table(rows), json_file, "numpy")


def _writable(*files: Path | None) -> None:
    """Fail now rather than after minutes of measuring."""
    for file in files:
        if file is not None:
            file.open("a").close()


def _say(row: dict[str, Any]) -> dict[str, Any]:
    """Tell people that another row is there."""
    Console(stderr=True, highlight=False).print(", ".join(f"{key} {value}" for key, value in row.items()), style="dim")
    return row


def _finish(rows: Sequence[dict[str, Any]], table: str, json_file: Path | None, *packages: str) -> None:
    from waldnet.benchmarks.machine import described

    if json_file is not None:
        json_file.write_text(json.dumps(rows, indent=2) + "\n")
    print(f"{described(*packages)}\n\n{table}")
