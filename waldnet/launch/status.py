"""The live status of a run: on a terminal a table that renews itself, elsewhere lines of what happens."""

from __future__ import annotations

from collections import Counter
from types import TracebackType
from typing import NamedTuple, Self

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from waldnet.common.config import Scenario
from waldnet.common.decision_filter import DecisionFilter
from waldnet.common.estimation.sprt import Status
from waldnet.common.messages import Decision, Tracks
from waldnet.common.quantities import NS_PER_S
from waldnet.recording.lines import decision_text

_STYLE = {Status.TENTATIVE: "yellow", Status.CONFIRMED: "bold green", Status.DELETED: "red", Status.COASTING: "cyan"}
#: What matters most comes first; any other status after the confirmed.
_RANK = {Status.CONFIRMED: 0, Status.TENTATIVE: 2, Status.DELETED: 3}
#: Half the width of the bar between log A and log B, at most and at least.
_BAR, _SHORT_BAR = 24, 8
#: Characters between the five columns of the table.
_GAPS = 4 * 3
#: Tracks shown at most, and lines that are not of tracks.
_ROWS, _OTHER_LINES = 30, 8
#: How long a track that has ended is still shown [ns of measurement time].
_ENDED_NS = 30 * NS_PER_S


class _Row(NamedTuple):
    """The newest of one track."""

    time_ns: int
    status: Status
    log_lr: float
    total: float


class LiveStatus:
    """Shows a run while it goes on; a context manager."""

    def __init__(self, scenario: Scenario, end_ns: int, console: Console, *, verbose: bool = False) -> None:
        """Show a run of ``scenario``.

        Args:
            scenario: what runs.
            end_ns: measurement time of the last scan.
            console: where to.
            verbose: tell decisions on tracks that were never confirmed too.
        """
        self._scenario, self._end_ns, self._console = scenario, end_ns, console
        self._filter = DecisionFilter(scenario, verbose=verbose)
        self._alive: set[str] = set()
        self._lost: set[str] = set()
        self._newest_ns: int | None = None
        self._rows: dict[int, _Row] = {}
        self._live = Live(console=console, refresh_per_second=8, get_renderable=self.render, transient=False)

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
        """Say what was decided, if it is on a given hypothesis or on a track that was confirmed."""
        if self._filter.passes(decision):
            style = {"confirmed": "green", "deleted": "red"}.get(decision.kind, "yellow")
            self.say(decision_text(decision, self._scenario), style)

    def present(self, sensor: str, alive: bool) -> None:
        """Note which sensors are there."""
        (self._alive.add if alive else self._alive.discard)(sensor)

    def lose(self, sensor: str) -> None:
        """Note that a sensor died."""
        self._lost.add(sensor)

    def picture(self, tracks: Tracks) -> None:
        """Note the newest picture; tracks that ended a while ago leave."""
        self._newest_ns = tracks.time_ns
        rows = {track: row for track, row in self._rows.items() if tracks.time_ns - row.time_ns <= _ENDED_NS}
        columns = (tracks.ids, tracks.status, tracks.log_lr, tracks.log_lr_total)
        for track, status, log_lr, total in zip(*(column.tolist() for column in columns), strict=True):
            rows[track] = _Row(tracks.time_ns, Status(status), log_lr, total)
        # The table is drawn on another thread: it sees the old rows or the new ones.
        self._rows = rows

    def __len__(self) -> int:
        """How many tracks are remembered."""
        return len(self._rows)

    def render(self) -> Group:
        """The table as it stands: tracks that matter most first, no line longer than the console is wide."""
        rows = sorted(self._rows.items(), key=lambda item: (_RANK.get(item[1].status, 1), -item[0]))
        shown = rows[: max(1, min(_ROWS, self._console.height - _OTHER_LINES))]
        return Group(self._table(shown), self._counts(len(rows) - len(shown)), self._sensors(), self._progress())

    def _table(self, rows: list[tuple[int, _Row]]) -> Table:
        limits = self._scenario.decision.thresholds
        cells = [(str(track), row.status.name.lower(), _number(row.log_lr), _number(row.total)) for track, row in rows]
        heads = ("track", "status", "log LR", "total")
        taken = sum(max(map(len, column)) for column in zip(heads, *cells, strict=True)) + _GAPS
        half = max(_SHORT_BAR, min(_BAR, (self._console.width - taken - 1) // 2))
        table = Table(
            title=self._scenario.name,
            title_justify="left",
            expand=False,
            box=box.SIMPLE_HEAD,
            pad_edge=False,
            show_edge=False,
        )
        for head in heads[:3]:
            table.add_column(head, justify="left" if head == "status" else "right", no_wrap=True)
        table.add_column(_scale(limits.log_a, limits.log_b, half), no_wrap=True)
        table.add_column("total", justify="right", no_wrap=True)
        for (track, status, log_lr, total), (_, row) in zip(cells, rows, strict=True):
            bar = _bar(row.log_lr, limits.log_a, limits.log_b, half)
            table.add_row(track, Text(status, _STYLE.get(row.status, "cyan")), log_lr, bar, total)
        return table

    def _counts(self, hidden: int) -> Text:
        counts = Counter(row.status for row in self._rows.values())
        told = ", ".join(f"{counts[status]} {status.name.lower()}" for status in Status if counts[status])
        more = f"; {hidden} not shown" if hidden else ""
        return _line(Text(f"tracks  {told or 'none'}{more}"))

    def _sensors(self) -> Text:
        """Those that are lost first, then those that are not there, for there may be more than a line can hold."""
        names = self._scenario.sensor_names
        text = Text(f"sensors {len(self._alive.intersection(names))} of {len(names)}  ")
        for name in sorted(names, key=lambda name: (name not in self._lost, name in self._alive)):
            lost = name in self._lost
            style = "red" if lost else "green" if name in self._alive else "dim"
            text.append(f"{name}{' lost' if lost else ''}  ", style)
        return _line(text)

    def _progress(self) -> Table:
        now_s = self._scenario.to_seconds(self._newest_ns) if self._newest_ns is not None else 0.0
        end_s = self._scenario.to_seconds(self._end_ns)
        told = f"{now_s:.1f} of {end_s:.1f} s"
        grid = Table.grid(padding=(0, 1))
        width = max(1, min(50, self._console.width - len(told) - 2))
        grid.add_row(ProgressBar(total=max(end_s, 1e-9), completed=max(now_s, 0.0), width=width), told)
        return grid


def _line(text: Text) -> Text:
    """One line, cut short where it is too long."""
    text.no_wrap, text.overflow = True, "ellipsis"
    return text


def _number(value: float) -> str:
    """A log LR in a few characters, however large it is."""
    return f"{value:+.2f}" if abs(value) < 1e5 else f"{value:+.1e}"


def _scale(log_a: float, log_b: float, half: int) -> str:
    """The bar's ends and middle."""
    left, right = (f"{name}{value:.1f}" for name, value in (("log A = ", log_a), ("log B = ", log_b)))
    if max(len(left), len(right)) >= half:
        left, right = f"{log_a:.1f}", f"{log_b:.1f}"
    return f"{left:<{half}}0{right:>{half}}"


def _bar(log_lr: float, log_a: float, log_b: float, half: int) -> Text:
    """Where log LR stands between log A (left end) and log B (right end)."""
    share = log_lr / log_b if log_lr >= 0.0 else -log_lr / log_a
    place = round(half + half * max(-1.0, min(1.0, share)))
    cells = ["·"] * (2 * half + 1)
    cells[half] = "|"
    low, high = min(place, half), max(place, half)
    for cell in range(low, high + 1):
        if cell != half:
            cells[cell] = "█"
    return Text("".join(cells), "green" if log_lr >= 0.0 else "red")
