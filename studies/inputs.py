"""What a run had to go on, kept beside what came of it: the scenario and the plots, in the folder ``input``.

``waldnet replay RUN/input/scenario.toml RUN/input/plots.jsonl`` works through them again.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from common.config import Scenario, load_scenario
from common.messages import Scan
from scenarios.plots import read_plots, write_plots
from studies.record import Record

_FOLDER, _SCENARIO, _PLOTS = "input", "scenario.toml", "plots.jsonl"


class Input(NamedTuple):
    """A network and what it looked at.

    Attributes:
        scenario: the network.
        scans: by time.
    """

    scenario: Scenario
    scans: list[Scan]


def looked_at(record: Record, scans: Iterable[Scan]) -> list[Scan]:
    """The plots that a run went on.

    The sources tell them all, whatever links shed of what the sensors show: those up to the last measurement time that
    was worked in; of a sensor that died, up to the last scan that it showed.

    Args:
        record: of the run.
        scans: of its sources, by time.
    """
    until_ns = dict.fromkeys(record.scenario.sensor_names, max(record.pictures, default=0))
    for name in record.lost:
        shown = (scan.time_ns for scan in record.scans if scan.sensor == name)
        until_ns[name] = min(until_ns[name], max(shown, default=0))
    return [scan for scan in scans if scan.time_ns <= until_ns[scan.sensor]]


def keep(folder: Path, text: bytes, of: Input) -> Path:
    """Write what a run went on into its folder.

    Args:
        folder: of the run; must exist.
        text: of the scenario's file.
        of: the run.

    Returns:
        the folder written to.
    """
    inside = folder / _FOLDER
    inside.mkdir(exist_ok=True)
    (inside / _SCENARIO).write_bytes(text)
    with (inside / _PLOTS).open("w", encoding="utf-8") as file:
        write_plots(file, of.scans, of.scenario)
    return inside


def kept(folder: Path) -> Input | None:
    """What the run of a folder went on; None where that was not kept.

    Raises:
        ConfigError: when the scenario is wrong.
        PlotsError: when the plots are.
    """
    scenario, plots = (folder / _FOLDER / name for name in (_SCENARIO, _PLOTS))
    if not (scenario.is_file() and plots.is_file()):
        return None
    loaded = load_scenario(scenario)
    return Input(loaded, read_plots(plots, loaded) if plots.stat().st_size else [])
