"""What a run had to go on, kept beside what came of it: the scenario and the plots, in the folder ``input``.

``waldnet replay RUN/input/scenario.toml RUN/input/plots.jsonl`` works through them again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import NamedTuple

from waldnet.common.config import Scenario, load_scenario
from waldnet.common.files import LinesFile, write_atomically
from waldnet.common.messages import Scan
from waldnet.scenarios.plots import plots_line, read_plots

_FOLDER, _SCENARIO, _PLOTS = "input", "scenario.toml", "plots.jsonl"


class Input(NamedTuple):
    """A network and what it looked at.

    Attributes:
        scenario: the network.
        scans: by time.
    """

    scenario: Scenario
    scans: list[Scan]


class Source(NamedTuple):
    """What a run will go on.

    Attributes:
        text: of the scenario's file.
        scans: of all sources, by time.
    """

    text: bytes
    scans: Iterable[Scan]


class InputFolder:
    """Writes the plots that a run goes on, as it goes on.

    The sources tell them all, whatever links shed of what the sensors show: those up to the last measurement time that
    was worked in; of a sensor that died, up to the last scan that it showed.
    """

    def __init__(self, folder: Path, source: Source, scenario: Scenario) -> None:
        """Write the scenario into the folder of a run.

        Raises:
            OSError: a file cannot be written, or the plots are there already.
        """
        self.path = folder / _FOLDER
        self.path.mkdir(exist_ok=True)
        write_atomically(self.path / _SCENARIO, source.text)
        self._plots = LinesFile(self.path / _PLOTS)
        self._scenario = scenario
        self._to_come = deque(source.scans)
        self._shown_ns: dict[str, int] = {}
        self.end_ns = self._to_come[-1].time_ns if self._to_come else scenario.epoch_ns

    def show(self, scan: Scan) -> None:
        """Note what a sensor showed: it was alive until then."""
        self._shown_ns[scan.sensor] = max(scan.time_ns, self._shown_ns.get(scan.sensor, 0))

    def write_until(self, time_ns: int, lost: Collection[str]) -> None:
        """Write the plots up to a measurement time, as far as their sensors are known to have seen them.

        Args:
            time_ns: of a picture that is final.
            lost: the sensors that died.
        """
        while self._to_come and (scan := self._to_come[0]).time_ns <= time_ns:
            if not self._seen(scan):
                if scan.sensor not in lost:
                    return
            else:
                self._plots.append([plots_line(scan, self._scenario)])
            self._to_come.popleft()

    def finish(self, time_ns: int, lost: Collection[str]) -> None:
        """Write what is left up to the last measurement time; ``lost``: the sensors that died."""
        with self._plots:
            for scan in self._to_come:
                if scan.time_ns <= time_ns and (scan.sensor not in lost or self._seen(scan)):
                    self._plots.append([plots_line(scan, self._scenario)])

    def _seen(self, scan: Scan) -> bool:
        return scan.time_ns <= self._shown_ns.get(scan.sensor, 0)


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
