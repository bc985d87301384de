"""The plan of a real scenario: plots, truth and confirmed tracks, a panel for each tracker."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Array, BoolArray
from waldnet.common.messages import Scan
from waldnet.evaluation.evaluation import Evaluation
from waldnet.evaluation.holding import NONE
from waldnet.evaluation.style import BLACK, BLUE, ORANGE, QUIET, SETTINGS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FALSE, _PLOT = "#b3261e", "0.66"
#: What a track does, and its colour.
_COLOURS = {"holds a target": BLUE, "near a target that another track holds": ORANGE, "near no target": _FALSE}
#: Beyond what is shown of targets and tracks, as a share of it.
_MARGIN = 0.06
#: More tracks are not named.
_NAMED = 25


def draw(scenario: Scenario, scans: Sequence[Scan], evaluations: Sequence[Evaluation], path: Path) -> None:
    """Write the figure.

    Args:
        scenario: the network.
        scans: all of them.
        evaluations: one for each tracker, on the same times.
        path: PNG file to write.
    """
    plots, stands = _plots(scenario, scans), _stands(scans)
    low, high = _extent(evaluations, stands)
    columns = len(evaluations) if len(evaluations) < 4 else -(-len(evaluations) // 2)
    rows = -(-len(evaluations) // columns)
    width = 5.2 * columns
    height = 5.2 * rows * float(np.clip((high - low)[1] / (high - low)[0], 0.55, 1.5)) + 1.3
    with mpl.rc_context(SETTINGS):
        figure = Figure(figsize=(max(width, 7.0), height), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
        for axes, evaluation in zip(panels, evaluations, strict=False):
            axes.plot(plots[:, 0], plots[:, 1], ".", ms=_dot(len(plots)), mew=0, color=_PLOT, zorder=1)
            _draw_truth(axes, evaluation, stands)
            _draw_tracks(axes, evaluation)
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            axes.set_title(f"{evaluation.run}: GOSPA {evaluation.gospa.total.mean():.1f} m")
            axes.set_aspect("equal", adjustable="box")
        for axes in panels[::columns]:
            axes.set_ylabel("north [m]")
        for axes in panels[len(evaluations) :]:
            axes.remove()
        for axes in panels[: len(evaluations)][-columns:]:
            axes.set_xlabel("east [m]")
            axes.tick_params(labelbottom=True)
        figure.suptitle(scenario.name, x=0.01, ha="left", fontweight="bold")
        figure.legend(handles=_handles(stands), loc="outside lower left", ncols=min(columns, 3), fontsize=9)
        figure.savefig(path, dpi=110)


def _plots(scenario: Scenario, scans: Sequence[Scan]) -> Array:
    """Where all plots lie whose sensors tell it, shape (M, 2)."""
    motion = scenario.motion.build()
    located = {each.name: each.build(motion).measurement for each in scenario.sensors if each.locates}
    seen = (scan for scan in scans if scan.sensor in located)
    places = [located[scan.sensor].locate(scan.z, scan.position)[:, :2] for scan in seen]
    return np.concatenate([np.empty((0, 2)), *places])


def _stands(scans: Sequence[Scan]) -> Array:
    """Where sensors stood, each place once, in order of time."""
    stands = np.array([scan.position[:2] for scan in scans])
    _, first = np.unique(stands, axis=0, return_index=True)
    return stands[np.sort(first)]


def _extent(evaluations: Sequence[Evaluation], stands: Array) -> tuple[Array, Array]:
    """Lower left and upper right corner of targets, tracks and sensors, and some more."""
    paths = [each for evaluation in evaluations for each in (evaluation.targets, evaluation.tracks)]
    points = np.concatenate([stands, *(each.positions[each.there][:, :2] for each in paths)])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = _MARGIN * (high - low).max()
    return low - margin, high + margin


def _dot(count: int) -> float:
    """Size of a plot: smaller where there are many."""
    return 3.0 if count < 5000 else 1.0


def _draw_truth(axes: Axes, evaluation: Evaluation, stands: Array) -> None:
    if len(stands) > 10:
        axes.plot(stands[:, 0], stands[:, 1], color=QUIET, lw=1.0, ls=":", zorder=2)
    else:
        axes.plot(stands[:, 0], stands[:, 1], color=QUIET, ls="", marker="s", ms=5, zorder=2)
    for there, positions in zip(evaluation.targets.there, evaluation.targets.positions, strict=True):
        axes.plot(positions[:, 0], positions[:, 1], color=BLACK, lw=4.5, alpha=0.28, solid_capstyle="butt", zorder=3)
        start = positions[there][0]
        axes.plot(start[0], start[1], marker="o", ms=5, mfc="white", mec=BLACK, mew=1.0, zorder=6)


def _draw_tracks(axes: Axes, evaluation: Evaluation) -> None:
    tracks, idle = evaluation.tracks, evaluation.idle
    named = len(tracks.ids) <= _NAMED
    for row, (number, positions) in enumerate(zip(tracks.ids, tracks.positions, strict=True)):
        doing = (evaluation.holding.target[row] != NONE, idle.duplicate[row], idle.false[row])
        for when, colour, order in zip(doing, _COLOURS.values(), (4, 5, 5), strict=True):
            part = np.where(_with_next(when)[:, None], positions, np.nan)
            axes.plot(part[:, 0], part[:, 1], color=colour, lw=1.4, zorder=order)
        there = np.flatnonzero(tracks.there[row])
        false = bool(idle.false[row, there[-1]])
        end = positions[there[-1]]
        axes.plot(end[0], end[1], marker="x", ms=5, mew=1.3, color=_FALSE if false else BLUE, zorder=6)
        if named:
            at = (float(end[0]), float(end[1]))
            style: dict[str, Any] = {
                "xytext": (4, 3),
                "textcoords": "offset points",
                "fontsize": 8,
                "color": _FALSE if false else BLUE,
            }
            axes.annotate(f"{number}", at, zorder=7, clip_on=True, **style)


def _with_next(when: BoolArray) -> BoolArray:
    """And the time after each, so that pieces of a line join."""
    joined: BoolArray = when | np.append(False, when[:-1])
    return joined


def _handles(stands: Array) -> list[Line2D]:
    moving = len(stands) > 10
    ship = Line2D([], [], color=QUIET, lw=1.0, ls=":", label="the ship with its sensors")
    fixed = Line2D([], [], color=QUIET, ls="", marker="s", ms=5, label="sensors")
    return [
        Line2D([], [], color=BLACK, lw=4.5, alpha=0.28, marker="", label="true paths, from the circle on"),
        *(
            Line2D([], [], color=colour, lw=1.4, label=f"confirmed track: {doing}")
            for doing, colour in _COLOURS.items()
        ),
        Line2D([], [], color=_PLOT, marker=".", ls="", ms=6, label="plots of sensors that tell a position"),
        ship if moving else fixed,
    ]
