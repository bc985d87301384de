"""What ``waldnet evaluate`` says to people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table as Grid

from waldnet.evaluation.evaluation import Evaluation, Rules
from waldnet.evaluation.holding import TargetFate

#: Rows of the summary: what it says, and how it is said of a summary.
SUMMARY = (
    ("GOSPA [m]", "{gospa_m[total]:.1f}"),
    ("  localisation", "{gospa_m[localisation]:.1f}"),
    ("  missed", "{gospa_m[missed]:.1f}"),
    ("  false", "{gospa_m[false]:.1f}"),
    ("OSPA(2) [m]", "{ospa2_m[total]:.1f}"),
    ("  localisation", "{ospa2_m[localisation]:.1f}"),
    ("  cardinality", "{ospa2_m[cardinality]:.1f}"),
    ("targets confirmed", "{confirmed_targets} of {targets}"),
    ("  after [s], mean", "{confirmed_after_s:.2f}"),
    ("held share", "{held_share:.1%}"),
    ("RMSE while held [m]", "{rmse_m:.1f}"),
    ("breaks", "{breaks}"),
    ("swaps", "{swaps}"),
    ("confirmed tracks", "{confirmed_tracks}"),
    ("  duplicates", "{duplicates}"),
    ("  false", "{false_tracks}"),
    ("  false per minute", "{false_tracks_per_minute:.2f}"),
    ("  near no target", "{near_no_target:.1%}"),
)

#: Columns of the targets: heading, and how a fate is said.
_FATE = (
    ("target", "{target}"),
    ("from s", "{first_s:.2f}"),
    ("to s", "{last_s:.2f}"),
    ("confirmed s", "{confirmed_after_s:.2f}"),
    ("scans", "{confirmed_after_scans}"),
    ("held", "{held_share:.1%}"),
    ("breaks", "{breaks}"),
    ("swaps", "{swaps}"),
    ("RMSE m", "{rmse_m:.1f}"),
    ("tracks", "{tracks}"),
)


def show(console: Console, evaluations: Sequence[Evaluation], rules: Rules) -> None:
    """The runs side by side, and the targets of each."""
    times_s = evaluations[0].times_s
    console.print(
        f"{times_s[0]:.2f} s to {times_s[-1]:.2f} s, {len(times_s)} times; cutoff {rules.cutoff_m:g} m, "
        f"order {rules.order:g}, window {rules.window_s:g} s; means over time",
        soft_wrap=True,
    )
    grid = Grid(box=None, pad_edge=False)
    grid.add_column("", no_wrap=True)
    for evaluation in evaluations:
        grid.add_column(evaluation.run, justify="right")
    summaries = [evaluation.summary() for evaluation in evaluations]
    for heading, form in SUMMARY:
        grid.add_row(heading, *(said(form, summary) for summary in summaries))
    console.print(grid)
    for evaluation in evaluations:
        if evaluation.fates:
            console.print()
            console.print(_targets(evaluation.run, evaluation.fates))


def _targets(run: str, fates: Sequence[TargetFate]) -> Grid:
    grid = Grid(title=f"targets of {run}", title_justify="left", box=None, pad_edge=False)
    for heading, _ in _FATE:
        grid.add_column(heading, justify="right")
    for fate in fates:
        values = {**fate._asdict(), "tracks": ", ".join(map(str, fate.ids)) or None}
        grid.add_row(*(said(form, values) for _, form in _FATE))
    return grid


def said(form: str, values: dict[str, Any]) -> str:
    """A value for people; a dash for none."""
    name = form[1:].partition(":")[0].rstrip("}")
    return "-" if name in values and values[name] is None else form.format(**values)
