"""The figure of an evaluation: GOSPA, OSPA(2) and numbers over time, and where tracks and targets were."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from waldnet.common.estimation.gaussian import Array
from waldnet.common.files import replacing
from waldnet.evaluation.evaluation import Evaluation
from waldnet.evaluation.paths import Paths
from waldnet.evaluation.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, QUIET, SETTINGS, SKY

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FALSE = "#b3261e"
#: Of runs, and of tracks by their id.
_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, "#8a6d1a", "#4b0082", "#7a7a00")
#: Of the parts of a measure.
_PARTS = {"localisation": BLUE, "missed": ORANGE, "false": _FALSE, "cardinality": PURPLE}
#: More tracks are not named in the plan.
_NAMED = 40
_DASHED = (0, (4, 2))
#: Crosses on a false track, about.
_MARKS = 12


def draw(evaluations: Sequence[Evaluation], cutoff_m: float, window_s: float, path: Path) -> None:
    """Write the figure of one run, or of several beside each other.

    Args:
        evaluations: of the runs, on the same times.
        cutoff_m: of the measures.
        window_s: of OSPA(2).
        path: PNG file to write.
    """
    rows = int(np.ceil(np.sqrt(len(evaluations))))
    columns = -(-len(evaluations) // rows)
    with mpl.rc_context(SETTINGS):
        figure = Figure(figsize=(14.5, 8.2), layout="constrained")
        FigureCanvasAgg(figure)
        over_time, plan = cast("Sequence[SubFigure]", figure.subfigures(1, 2, width_ratios=(1.0, 1.15), wspace=0.02))
        _draw_over_time(over_time, evaluations, cutoff_m, window_s)
        panels = plan.subplots(rows, columns, squeeze=False).ravel()
        corners = _extent(evaluations)
        for axes, evaluation in zip(panels, evaluations, strict=False):
            _draw_plan(axes, evaluation)
            axes.update_datalim(corners)
            axes.set_aspect("equal", adjustable="datalim")
        for axes in panels[len(evaluations) :]:
            axes.remove()
        plan.legend(handles=_plan_handles(), loc="outside lower center", ncols=3)
        with replacing(path) as file:
            figure.savefig(file, dpi=110, format=path.suffix.lstrip(".") or "png")


def _extent(evaluations: Sequence[Evaluation]) -> Array:
    """Lower left and upper right corner of all there is to show, so that plans of several runs have one scale."""
    paths = [paths for each in evaluations for paths in (each.targets, each.tracks)]
    points = np.concatenate([each.positions[each.there][:, :2] for each in paths])
    return np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) else np.zeros((2, 2))


def _draw_over_time(figure: SubFigure, evaluations: Sequence[Evaluation], cutoff_m: float, window_s: float) -> None:
    gospa, ospa2, numbers = figure.subplots(3, 1, sharex=True)
    names = [evaluation.run for evaluation in evaluations if not evaluation.centralised_of]
    only = len(names) == 1
    for evaluation in evaluations:
        # A centralised run has the colour of its network, dashed, if there are several.
        number = names.index((*evaluation.centralised_of, evaluation.run)[0])
        colour = (GREEN if evaluation.centralised_of else BLACK) if only else _COLOURS[number % len(_COLOURS)]
        alone, style = (False, _DASHED) if evaluation.centralised_of else (only, "-")
        for axes, measure in ((gospa, evaluation.gospa), (ospa2, evaluation.ospa2)):
            label = f"{evaluation.run}: mean {measure.total.mean():.1f} m"
            axes.plot(evaluation.times_s, measure.total, color=colour, ls=style, lw=2.6 if alone else 1.7, label=label)
            if alone:
                _draw_parts(axes, evaluation.times_s, measure._asdict())
        reported = evaluation.tracks.there.sum(axis=0)
        label = f"{evaluation.run}: confirmed tracks"
        numbers.step(evaluation.times_s, reported, where="post", color=colour, ls=style, label=label, zorder=3)
    first = evaluations[0]
    there = first.targets.there.sum(axis=0)
    numbers.step(first.times_s, there, where="post", color=QUIET, ls=(0, (1, 1)), label="targets", zorder=4)
    gospa.set(title=f"GOSPA, cutoff {cutoff_m:g} m", ylabel="m", ylim=(0.0, None))
    ospa2.set(title=f"OSPA(2), window {window_s:g} s", ylabel="m", ylim=(0.0, None))
    numbers.set(title="targets and confirmed tracks", xlabel="time [s]", ylim=(0.0, None))
    numbers.yaxis.set_major_locator(MaxNLocator(integer=True))
    for axes in (gospa, ospa2, numbers):
        axes.margins(x=0.01)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize=8.5, handlelength=1.8)


def _draw_parts(axes: Axes, times_s: Array, parts: dict[str, Array]) -> None:
    for name, colour in _PARTS.items():
        if name in parts:
            axes.plot(times_s, parts[name], color=colour, lw=1.1, label=name)


def _draw_plan(axes: Axes, evaluation: Evaluation) -> None:
    for number, (track, positions) in enumerate(zip(evaluation.tracks.ids, evaluation.tracks.positions, strict=True)):
        colour = _COLOURS[number % len(_COLOURS)]
        axes.plot(positions[:, 0], positions[:, 1], color=colour, lw=2.2, alpha=0.75, zorder=2)
        false = positions[evaluation.idle.false[number]]
        every = max(1, len(false) // _MARKS)
        axes.plot(false[:, 0], false[:, 1], ls="", marker="x", ms=6, color=_FALSE, markevery=every, zorder=4)
        if len(evaluation.tracks.ids) <= _NAMED:
            _name(axes, evaluation.tracks, number, f"{track}", colour)
    for target, positions in enumerate(evaluation.targets.positions):
        axes.plot(positions[:, 0], positions[:, 1], color=BLACK, lw=0.9, zorder=3)
        start = positions[evaluation.targets.there[target]][0]
        axes.plot(start[0], start[1], marker="o", ms=4, mfc="white", mec=BLACK, mew=0.9, zorder=5)
    axes.set(xlabel="east [m]", ylabel="north [m]", title=f"{evaluation.run}: plan view")


def _name(axes: Axes, tracks: Paths, row: int, text: str, colour: str) -> None:
    """Write a track's id where it ends."""
    end = tracks.positions[row, tracks.there[row]][-1, :2]
    style: dict[str, Any] = {"xytext": (5, 3), "textcoords": "offset points", "fontsize": 9, "zorder": 6}
    axes.annotate(text, (float(end[0]), float(end[1])), color=colour, **style)


def _plan_handles() -> list[Line2D]:
    return [
        Line2D([], [], color=BLACK, lw=0.9, marker="o", ms=4, mfc="white", label="targets, from the circle on"),
        Line2D([], [], color=BLUE, lw=2.2, alpha=0.75, label="confirmed tracks, a colour for each id"),
        Line2D([], [], color=_FALSE, ls="", marker="x", ms=6, label="near no target"),
    ]
