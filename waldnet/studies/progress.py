"""What a study says while it runs, and at its end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.table import Table as Grid

from waldnet.studies.plan import Job
from waldnet.studies.tables import Table
from waldnet.studies.workers import Part

#: Columns of the table at the end: heading, column, format.
_SHOWN = (
    ("mode", "mode", "{}"),
    ("log LR", "log_lr_mean", "{:.1f}"),
    ("conf.", "p_confirmed", "{:.1%}"),
    ("del.", "p_deleted", "{:.1%}"),
    ("scans", "decision_scans_mean", "{:.2f}"),
    ("lost", "share_lost", "{:.1%}"),
    ("RMSE m", "rmse_m", "{:.1f}"),
    ("bytes", "bytes_per_track_scan", "{:.1f}"),
)


class Teller(AbstractContextManager["Teller"]):
    """A bar on a terminal; elsewhere a line for each variant that is done."""

    def __init__(self, console: Console, jobs: Iterable[Job]) -> None:
        """For the jobs that are to do."""
        self._console = console
        self._left = Counter[str]()
        for job in jobs:
            self._left[job.variant.name] += len(job.seeds) * len(job.modes)
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        self._bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task("runs x modes", total=self._left.total())

    def __enter__(self) -> Teller:
        """Show the bar."""
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Take it away."""
        self._bar.stop()

    def part(self, part: Part) -> None:
        """A part is done."""
        name, plays = part.job.variant.name, len(part.job.seeds)
        self._left[name] -= plays
        self._bar.update(self._task, advance=plays, description=f"{name}, {part.mode}")
        if not self._left[name]:
            self._console.print(f"{name}: done", soft_wrap=True)


def show(console: Console, summary: Table, files: Sequence[Path]) -> None:
    """The summary as a table for each variant, and where everything is."""
    for variant in dict.fromkeys(summary["variant"]):
        grid = Grid(title=f"{variant}, {summary['runs'][0]} runs", title_justify="left", box=None, pad_edge=False)
        for heading, column, _ in _SHOWN:
            grid.add_column(heading, justify="left" if column == "mode" else "right", no_wrap=True)
        for row in np.flatnonzero(summary["variant"] == variant):
            grid.add_row(*(figure(summary[column][row], form) for _, column, form in _SHOWN))
        console.print(grid)
        console.print()
    console.print("scans: until decided; bytes: per track and scan of a sensor, up and down")
    for file in files:
        console.print(str(file), soft_wrap=True)


def figure(value: object, form: str) -> str:
    """A figure for people; a dash for none."""
    return "-" if isinstance(value, float) and np.isnan(value) else form.format(value)
