"""Performance against bandwidth: one marker a mode, with its name beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from waldnet.common.estimation.gaussian import Array
from waldnet.evaluation.style import QUIET, bytes_axis, look
from waldnet.studies.report_figures import Scene, panels
from waldnet.studies.tables import Table, rows_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_REFERENCE = "centralised"
#: Between the lines of two labels, in points.
_LINE = 10.5
#: What title and axis take of the height of a panel, in points.
_AROUND = 55.0


class Measure(NamedTuple):
    """What is better or worse.

    Attributes:
        title: what it is.
        better: in which direction.
        values: one a mode, shape (M,).
        share: whether it is a share of one.
    """

    title: str
    better: str
    values: Array
    share: bool = False


def draw_frontier(scene: Scene) -> Figure:
    """Decision length, tracks lost, and log LR relative to all plots at the center, over bytes per track and scan."""
    height = max(2.8, 1.3 + 0.27 * len(scene.modes))
    figure, axes = panels(len(scene.with_target), 3, height)
    for row, variant in zip(axes, scene.with_target, strict=True):
        summary = rows_of(scene.outcome.summary, variant=variant)
        for panel, measure in zip(row, _measures(summary), strict=True):
            title = f"{measure.title}; {measure.better} is better"
            panel.set(title=f"{variant}: {title}" if panel is row[0] else title, xlabel="bytes per track and scan")
            if measure.share:
                panel.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=None))
            _scatter(panel, summary, measure, 72.0 * height - _AROUND)
    return figure


def _measures(summary: Table) -> list[Measure]:
    log_lr, is_reference = summary["log_lr_mean"], summary["mode"] == _REFERENCE
    if is_reference.any() and float(log_lr[is_reference][0]) > 0.0:
        evidence = Measure("log LR, % of centralised", "higher", log_lr / log_lr[is_reference][0], share=True)
    else:
        evidence = Measure("mean log LR", "higher", log_lr)
    return [
        Measure("scans to decide", "lower", summary["decision_scans_mean"]),
        Measure("tracks lost", "lower", summary["share_lost"], share=True),
        evidence,
    ]


def _scatter(axes: Axes, summary: Table, measure: Measure, height: float) -> None:
    """Markers, and names beside the panel, moved apart where they would cover each other."""
    sent = summary["bytes_per_track_scan"]
    shown = np.isfinite(measure.values) & (sent > 0.0)
    if not shown.any():
        return
    modes, x, y = summary["mode"][shown], sent[shown], measure.values[shown]
    for mode, at, value in zip(modes, x, y, strict=True):
        drawn = look(mode)
        axes.plot(
            at, value, marker=drawn.marker, color=drawn.colour, ms=drawn.size * 1.3, mec="white", mew=0.6, zorder=3
        )
    spread = max(float(np.ptp(y)), 0.05 if measure.share else 1.0)
    axes.set_ylim(y.min() - (0.12 if y.min() else 0.05) * spread, max(y.max(), y.min() + spread) + 0.12 * spread)
    bytes_axis(axes, x)
    _name(axes, modes, x, y, height)


def _name(axes: Axes, modes: Any, x: Array, y: Array, height: float) -> None:
    low, high = axes.get_ylim()
    wanted = (y - low) / (high - low) * height
    order = np.argsort(wanted, kind="stable")
    places = spaced(wanted[order], _LINE, height)
    for number, place in zip(order, places / height, strict=True):
        axes.annotate(
            modes[number],
            (x[number], y[number]),
            xytext=(1.02, place),
            textcoords="axes fraction",
            va="center",
            fontsize=8.5,
            color=look(modes[number]).colour,
            arrowprops={
                "arrowstyle": "-",
                "color": QUIET,
                "lw": 0.5,
                "alpha": 0.6,
                "shrinkA": 1,
                "shrinkB": 4,
                "relpos": (0, 0.5),
            },
        )


def spaced(wanted: Array, gap: float, height: float) -> Array:
    """Places as close to the wanted ones as may be, in their order and at least ``gap`` apart.

    Args:
        wanted: ascending, shape (M,).
        gap: between neighbours; less where they would not fit.
        height: of the space, which begins at 0.

    Returns:
        places, ascending, shape (M,).
    """
    count = len(wanted)
    gap = min(gap, height / max(count - 1, 1))
    # Without the gaps, places need only ascend: from below, then held back from above.
    steps = gap * np.arange(count)
    free = np.clip(wanted - steps, 0.0, max(height - gap * (count - 1), 0.0))
    return _ascending(free) + steps


def _ascending(values: Array) -> Array:
    """The closest ascending values, by pooling neighbours that are out of order."""
    pools: list[list[float]] = []
    for value in values:
        pools.append([float(value)])
        while len(pools) > 1 and np.mean(pools[-2]) > np.mean(pools[-1]):
            last = pools.pop()
            pools[-1] += last
    return np.concatenate([np.full(len(pool), np.mean(pool)) for pool in pools])
