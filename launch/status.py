"""The live status of a run: on a terminal a table that renews itself, elsewhere lines of what happens."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from common.estimation.sprt import Status
from common.messages import Decision, Tracks
from studies.lines import decision_text
from studies.record import Record

_STYLE = {Status.TENTATIVE: "yellow", Status.CONFIRMED: "bold green", Status.DELETED: "red"}
#: Half the width of the bar between log A and log B.
_BAR = 24
_ROWS = 30


class LiveStatus:
    """Shows a run while it goes on; a context manager."""

    def __init__(self, record: Record, end_ns: int, console: Console) -> None:
        """Show ``record``.

        Args:
            record: filled by somebody else.
            end_ns: measurement time of the last scan.
            console: where to.
        """
        self._record, self._end_ns, self._console = record, end_ns, console
        self._alive: set[str] = set()
        self._last: Tracks | None = None
        self._seen: dict[int, tuple[Status, float, float]] = {}
        self._live = Live(console=console, refresh_per_second=8, get_renderable=self._render, transient=False)

    def __enter__(self) -> Self:
        """Begin to show."""
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop, leaving the last state on the screen."""
        if self._console.is_terminal:
            self._live.stop()

    def say(self, text: str, style: str = "") -> None:
        """Print one line, above the table."""
        self._console.print(Text(text, style=style), soft_wrap=True)

    def decided(self, decision: Decision) -> None:
        """Say what was decided."""
        style = {"confirmed": "green", "deleted": "red"}.get(decision.kind, "yellow")
        self.say(decision_text(decision, self._record.scenario), style)

    def present(self, sensor: str, alive: bool) -> None:
        """Note which sensors are there."""
        (self._alive.add if alive else self._alive.discard)(sensor)

    def picture(self, tracks: Tracks) -> None:
        """Note the newest picture."""
        self._last = tracks
        for row, track in enumerate(tracks.ids):
            entry = (Status(tracks.status[row]), float(tracks.log_lr[row]), float(tracks.log_lr_total[row]))
            self._seen[int(track)] = entry

    def _render(self) -> Group:
        limits = self._record.scenario.decision.thresholds
        table = Table(title=self._record.scenario.name, title_justify="left", expand=False)
        table.add_column("track", justify="right")
        table.add_column("status")
        table.add_column("log LR", justify="right")
        table.add_column(f"log A = {limits.log_a:.1f}{'0':^{2 * _BAR - 22}}log B = {limits.log_b:.1f}")
        table.add_column("total", justify="right")
        rows = sorted(self._seen.items())
        for track, (status, log_lr, total) in rows[:_ROWS]:
            bar = _bar(log_lr, limits.log_a, limits.log_b)
            table.add_row(str(track), Text(status.name.lower(), _STYLE[status]), f"{log_lr:+.2f}", bar, f"{total:+.1f}")
        more = [Text(f"... and {len(rows) - _ROWS} more tracks")] if len(rows) > _ROWS else []
        return Group(table, *more, self._sensors(), self._progress())

    def _sensors(self) -> Text:
        text = Text("sensors ")
        for name in self._record.scenario.sensor_names:
            lost = name in self._record.lost
            style = "red" if lost else "green" if name in self._alive else "dim"
            text.append(f"{name}{' lost' if lost else ''}  ", style)
        return text

    def _progress(self) -> Table:
        scenario = self._record.scenario
        now_s = scenario.to_seconds(self._last.time_ns) if self._last is not None else 0.0
        end_s = scenario.to_seconds(self._end_ns)
        grid = Table.grid(padding=(0, 1))
        grid.add_row(
            ProgressBar(total=max(end_s, 1e-9), completed=max(now_s, 0.0), width=50), f"{now_s:.1f} of {end_s:.1f} s"
        )
        return grid


def _bar(log_lr: float, log_a: float, log_b: float) -> Text:
    """Where log LR stands between log A (left end) and log B (right end)."""
    share = log_lr / log_b if log_lr >= 0.0 else -log_lr / log_a
    place = round(_BAR + _BAR * max(-1.0, min(1.0, share)))
    cells = ["·"] * (2 * _BAR + 1)
    cells[_BAR] = "|"
    low, high = min(place, _BAR), max(place, _BAR)
    for cell in range(low, high + 1):
        if cell != _BAR:
            cells[cell] = "█"
    return Text("".join(cells), "green" if log_lr >= 0.0 else "red")
