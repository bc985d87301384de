"""Figures of a study: log LR, decisions, thresholds, accuracy, calibration; a row of panels for each variant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.sprt import Thresholds
from waldnet.evaluation.style import QUIET, bytes_axis, legend, line, look
from waldnet.studies.study import Outcome
from waldnet.studies.tables import Table, rows_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Panels beside each other where each mode has its own.
_BESIDE = 5
_THRESHOLD = {"color": QUIET, "lw": 1.0, "ls": (0, (2, 2)), "zorder": 1}


class Scene(NamedTuple):
    """What figures are of.

    Attributes:
        outcome: all tables.
        modes: in order.
        variants: names, in order, and whether each has a target.
        p0: accept h1 under h0, of the scenario.
        p1: accept h1 under h1, of the scenario.
        limits: thresholds of the scenario.
        n: size of the state.
        twins: for a variant without target, the one that differs in its target only, if it is there.
    """

    outcome: Outcome
    modes: Sequence[str]
    variants: dict[str, bool]
    p0: float
    p1: float
    limits: Thresholds
    n: int
    twins: dict[str, str]

    @property
    def with_target(self) -> list[str]:
        """Variants in which there is something to find."""
        return [name for name, has_target in self.variants.items() if has_target]


def panels(rows: int, columns: int, height: float = 2.9, **options: Any) -> tuple[Figure, Any]:
    """A figure with a row of panels for each variant."""
    figure = Figure(figsize=(12.5, 0.5 + height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    figure.set_layout_engine("constrained", h_pad=0.12, w_pad=0.08)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def draw_log_lr(scene: Scene) -> Figure:
    """Mean log LR over the scans: the stretch in which the test decides, and all of it."""
    figure, axes = panels(len(scene.variants), 2)
    for (near, whole), variant in zip(axes, scene.variants, strict=True):
        for mode in scene.modes:
            rows = rows_of(scene.outcome.curves, variant=variant, mode=mode)
            for panel in (near, whole):
                line(panel, mode, np.append(0, rows["scan"]), np.append(0.0, rows["log_lr_mean"]))
        for panel in (near, whole):
            panel.axhline(scene.limits.log_b, **_THRESHOLD)
            panel.axhline(scene.limits.log_a, **_THRESHOLD)
            panel.set(xlabel="scans of the network", xlim=(0, None))
            panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        near.set(title=f"{variant}: until decided", ylabel="mean log LR")
        whole.set(title="all scans")
        _zoom(near, scene, variant)
    legend(figure, scene.modes)
    return figure


def _zoom(axes: Axes, scene: Scene, variant: str) -> None:
    """To the stretch in which the means of most modes are between the thresholds."""
    log_a, log_b, _ = scene.limits
    lasts = []
    for mode in scene.modes:
        rows = rows_of(scene.outcome.curves, variant=variant, mode=mode)
        between = (rows["log_lr_mean"] > log_a) & (rows["log_lr_mean"] < log_b)
        lasts.append(int(rows["scan"][between].max(initial=2)) + 1)
    last = float(np.quantile(lasts, 0.8, method="inverted_cdf"))
    axes.set(xlim=(0, max(4, last)), ylim=(2.0 * log_a, 1.5 * log_b))
    for value, name, align in ((log_b, "log B: confirm", "bottom"), (log_a, "log A: delete", "top")):
        at: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
        shift = (-3, 4 if align == "bottom" else -4)
        behind = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
        axes.annotate(name, (1, value), shift, ha="right", va=align, color=QUIET, fontsize=8.5, bbox=behind, **at)


def draw_decided(scene: Scene) -> Figure:
    """Share of the runs that are decided by a scan."""
    figure, axes = panels(len(scene.variants), 2, sharey=True)
    for pair, variant in zip(axes, scene.variants, strict=True):
        for panel, column, title in zip(
            pair, ("confirmed_by", "deleted_by"), (f"{variant}: confirmed", "deleted"), strict=True
        ):
            for mode in scene.modes:
                rows = rows_of(scene.outcome.curves, variant=variant, mode=mode)
                line(panel, mode, np.append(0, rows["scan"]), np.append(0.0, rows[column]))
            panel.set(title=title, xlabel="scans of the network", xlim=(0, None), ylim=(-0.02, 1.03))
            panel.xaxis.set_major_locator(MaxNLocator(integer=True))
            panel.yaxis.set_major_formatter(PercentFormatter(1.0))
        pair[0].set_ylabel("share of runs")
    legend(figure, scene.modes)
    return figure


def draw_overview(scene: Scene) -> Figure:
    """Decision length, decisions, loss, and what is sent: a line for each mode."""
    figure, axes = panels(len(scene.variants), 4, 0.9 + 0.21 * len(scene.modes), sharey=True, width_ratios=(4, 3, 3, 3))
    for row, variant in zip(axes, scene.variants, strict=True):
        summary = rows_of(scene.outcome.summary, variant=variant)
        for at, mode in enumerate(summary["mode"]):
            _overview_line(row, at, {name: column[at] for name, column in summary.items()}, look(mode))
        row[0].set(yticks=range(len(scene.modes)), yticklabels=scene.modes, ylim=(len(scene.modes) - 0.5, -0.5))
        row[0].set(
            title=f"{variant}: scans to decide",
            xlabel="q10 to q90, | median, mean",
            xlim=(0, 1.04 * row[0].get_xlim()[1]),
        )
        row[0].xaxis.set_major_locator(MaxNLocator(integer=True))
        for panel, title in zip(row[1:3], ("confirmed", "lost"), strict=True):
            panel.set(title=title, xlabel="share of runs, 95 % bounds")
            panel.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=None))
        row[1].set_xlim(-0.02, 1.02)
        right = max(0.02, row[2].get_xlim()[1])
        row[2].set_xlim(-0.02 * right, right)
        row[3].set(title="sent per track and scan", xlabel="bytes, up and down")
        bytes_axis(row[3], summary["bytes_per_track_scan"])
        if not scene.variants[variant]:
            row[2].set_axis_off()
            row[2].set_title("")
        for panel in row:
            panel.tick_params(axis="y", length=0, colors="black")
    return figure


def _overview_line(row: Sequence[Axes], at: int, mode: dict[str, Any], drawn: Any) -> None:
    style = {"color": drawn.colour, "zorder": 3}
    row[0].plot([mode["decision_scans_q10"], mode["decision_scans_q90"]], [at, at], lw=2.2, alpha=0.45, **style)
    row[0].plot(mode["decision_scans_q50"], at, marker="|", ms=9, mew=1.6, **style)
    row[0].plot(mode["decision_scans_mean"], at, marker=drawn.marker, ms=drawn.size, **style)
    for panel, name in zip(row[1:3], ("p_confirmed", "share_lost"), strict=True):
        panel.plot([mode[f"{name}_low"], mode[f"{name}_high"]], [at, at], lw=2.2, alpha=0.45, **style)
        panel.plot(mode[name], at, marker=drawn.marker, ms=drawn.size, **style)
    row[3].plot(mode["bytes_per_track_scan"] or np.nan, at, marker=drawn.marker, ms=drawn.size, **style)


def draw_thresholds(scene: Scene) -> Figure:
    """What other thresholds would have given: decision length, and wrong decisions against what Wald promises."""
    figure, axes = panels(len(scene.variants), 3)
    for row, variant in zip(axes, scene.variants, strict=True):
        for mode in scene.modes:
            _threshold_lines(row, scene, variant, mode)
        row[0].set(title=f"{variant}: decision length", ylabel="mean scans", xlabel=f"p0, at p1 = {_p1(scene)}")
        row[1].set(title="decision length", xlabel=f"1 - p1, at p0 = {_p0(scene):g}")
        wrong = ("deleted", "1 - p1") if scene.variants[variant] else ("confirmed", "p0")
        row[2].set(title=f"wrongly {wrong[0]}", xlabel=f"{wrong[1]}: promised", ylabel="share of runs")
        row[2].plot([1e-6, 0.2], [1e-6, 0.2], **_THRESHOLD)
        row[2].set(yscale="log", ylim=(3e-5, 1.0))
        for panel in row:
            panel.set_xscale("log")
            panel.invert_xaxis()
        for panel in row[:2]:
            panel.set_ylim(0, None)
        row[2].set_xlim((0.3, 7e-4) if scene.variants[variant] else (0.2, 7e-7))
    legend(figure, scene.modes)
    return figure


def _p0(scene: Scene) -> float:
    """The p0 of the grid that is closest to the scenario's."""
    values = np.unique(scene.outcome.decisions["p0"])
    return float(values[np.abs(np.log(values / scene.p0)).argmin()])


def _p1(scene: Scene) -> float:
    """The p1 of the grid that is closest to the scenario's."""
    values = np.unique(scene.outcome.decisions["p1"])
    return float(values[np.abs(np.log((1.0 - values) / (1.0 - scene.p1))).argmin()])


def _threshold_lines(row: Sequence[Axes], scene: Scene, variant: str, mode: str) -> None:
    rows = rows_of(scene.outcome.decisions, variant=variant, mode=mode)
    over_p0 = _chosen(rows, rows["p1"] == _p1(scene))
    over_p1 = _chosen(rows, rows["p0"] == _p0(scene))
    dots = {"marker": look(mode).marker, "ms": 3.5}
    line(row[0], mode, over_p0["p0"], over_p0["decision_scans_mean"], **dots)
    line(row[1], mode, 1.0 - over_p1["p1"], over_p1["decision_scans_mean"], **dots)
    if scene.variants[variant]:
        promised, wrong = 1.0 - over_p1["p1"], over_p1["p_deleted"]
    else:
        promised, wrong = over_p0["p0"], over_p0["p_confirmed"]
    line(row[2], mode, promised, _positive(wrong), **dots)


def _chosen(rows: Table, where: Any) -> Table:
    return {name: column[where] for name, column in rows.items()}


def _positive(values: Array) -> Array:
    """What a logarithmic axis can show."""
    return np.where(values > 0.0, values, np.nan)


def draw_accuracy(scene: Scene) -> Figure:
    """Errors over the scans, of the tracks that are not lost in the end; GOSPA of the operator's picture, of all."""
    figure, axes = panels(len(scene.with_target), 3)
    panel_of: list[tuple[str, str]] = [
        ("rmse_m", "position RMSE [m]"),
        ("nees_mean", f"NEES, {scene.n} if honest"),
        ("gospa_mean_m", "GOSPA [m]"),
    ]
    for row, variant in zip(axes, scene.with_target, strict=True):
        for panel, (column, title) in zip(row, panel_of, strict=True):
            top = _draw_over_scans(panel, scene, variant, column)
            panel.set(title=f"{variant}: {title}" if panel is row[0] else title, xlabel="scans of the network")
            panel.xaxis.set_major_locator(MaxNLocator(integer=True))
            panel.set_ylim(0, 1.08 * top if np.isfinite(top) and top > 0.0 else None)
        row[1].axhline(scene.n, **_THRESHOLD)
    legend(figure, scene.modes)
    return figure


def _draw_over_scans(axes: Axes, scene: Scene, variant: str, column: str) -> float:
    """Curves of all modes.

    Returns:
        the height that shows all but a few outliers: one mode that fails must not flatten all others.
    """
    tops = []
    for mode in scene.modes:
        rows = rows_of(scene.outcome.curves, variant=variant, mode=mode)
        line(axes, mode, rows["scan"], rows[column])
        values = rows[column][np.isfinite(rows[column])]
        tops.append(float(values.max(initial=0.0)))
    return min(max(tops), 4.0 * float(np.median(tops)))


def draw_calibration(scene: Scene) -> Figure:
    """How often the LR of nothing reaches B, and 1/B, which an exact LR never exceeds: a panel for each mode."""
    names = [name for name, has_target in scene.variants.items() if not has_target]
    columns = min(_BESIDE, len(scene.modes))
    rows_each = -(-len(scene.modes) // columns)
    figure, axes = panels(rows_each * len(names), columns, 2.3, sharex=True, sharey=True)
    for variant, block in zip(names, np.split(axes, len(names)), strict=True):
        table = rows_of(scene.outcome.calibration, variant=variant, method="direct")
        floor = 0.3 / int(table["runs"][0])
        twin = scene.twins.get(variant, "")
        rare = rows_of(scene.outcome.calibration, variant=twin, method="importance") if twin else {}
        rare = rare if rare and len(rare["b"]) else {}
        lowest = 1e-7 if rare else floor
        for number, panel in enumerate(block.ravel()):
            if number >= len(scene.modes):
                panel.set_axis_off()
                continue
            mode = scene.modes[number]
            _draw_share(panel, rows_of(table, mode=mode), mode, floor)
            if rare:
                _draw_rare(panel, rows_of(rare, mode=mode), mode)
            panel.set(title=f"{variant}: {mode}" if number == 0 and len(names) > 1 else mode, ylim=(lowest, 1.2))
            if number + columns >= len(scene.modes):
                panel.set_xlabel("B")
                panel.tick_params(labelbottom=True)
        for panel in block[:, 0]:
            panel.set_ylabel("P(sup LR ≥ B)")
    return figure


def _draw_rare(axes: Axes, rows: Table, mode: str) -> None:
    """The same from runs with a target."""
    drawn = look(mode)
    axes.fill_between(rows["b"], np.maximum(rows["low"], 1e-9), rows["high"], color=QUIET, alpha=0.25, lw=0)
    axes.plot(rows["b"], rows["bound"], color=QUIET, lw=1.2)
    axes.plot(rows["b"], _positive(rows["share"]), color=drawn.colour, lw=1.2, ls="--")


def _draw_share(axes: Axes, rows: Table, mode: str, floor: float) -> None:
    drawn = look(mode)
    axes.set(xscale="log", yscale="log")
    axes.plot(rows["b"], rows["bound"], color=QUIET, lw=1.2)
    bounds = np.maximum(rows["low"], floor), rows["high"]
    axes.fill_between(rows["b"], *bounds, color=drawn.colour, alpha=0.22, lw=0)
    axes.plot(rows["b"], _positive(rows["share"]), color=drawn.colour, marker=drawn.marker, ms=0.7 * drawn.size)
