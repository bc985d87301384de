"""Figures of a run: log LR over time with both thresholds, and the plan view."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Patch, Rectangle, Wedge
from matplotlib.text import Annotation

from waldnet.common.config import BoxConfig, DiscConfig, SectorConfig, SensorConfig
from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.sprt import Status
from waldnet.recording.sketch import History, Sketch

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: The decisions of every track that stand, as the summary of a run tells them.
Decisions: TypeAlias = Mapping[int, Sequence[Mapping[str, Any]]]

_COLOUR = {
    Status.CONFIRMED: "#0b7a3b",
    Status.COASTING: "#6a3d9a",
    Status.TENTATIVE: "#8a6d1a",
    Status.DELETED: "#b3261e",
}
_SENSOR = "#1f4e9e"
#: Covariance ellipses of a track, at most.
_ELLIPSES = 12
#: Rays of bearings, as a share of the picture.
_RAY = 0.2
#: 95 % of a 2-D Gaussian lie within this many standard deviations.
_RADIUS_95 = 2.4477


def draw_log_lr(sketch: Sketch, decisions: Decisions) -> bytes:
    """Log LR of every track over time, as the test sees it: with its resets, between log A and log B; a PNG file."""
    figure = Figure(figsize=(13, 6), layout="constrained")
    FigureCanvasAgg(figure)
    decided, whole = figure.subplots(1, 2, sharey=True)
    curves = {track: (*_with_resets(sketch, track, h), h) for track, h in sketch.histories().items()}
    standing = sorted((one for track in curves for one in decisions.get(track, ())), key=lambda one: one["time"])
    first: dict[int, float] = {one["track"]: one["time"] for one in reversed(standing)}
    for track, (times, log_lr, history) in curves.items():
        colour = colour_of(history.status)
        # The value that decided stands before the reset at the same time.
        until = int(np.searchsorted(times, first[track])) + 1 if track in first else len(times)
        decided.plot(times[:until], log_lr[:until], color=colour, lw=1.5)
        _label(decided, f" {track}", (times[:until][-1], log_lr[:until][-1]), colour)
        whole.plot(times, log_lr, color=colour, lw=0.7)
    for axes in (decided, whole):
        _draw_test(axes, sketch, standing)
    decided.set(ylabel="log LR", title=f"{sketch.scenario.name}: until the first decision")
    monitored = "their LR reset at log B" if sketch.scenario.life is None else "log odds that the target is there now"
    whole.set(title=f"the whole run: confirmed tracks are monitored, {monitored}")
    if first:
        start_s = min(times[0] for times, _, _ in curves.values())
        decided.set_xlim(start_s, start_s + 1.15 * (max(first.values()) - start_s))
    decided.legend(handles=_status_handles(sketch), fontsize=9, loc="upper left")
    return _png(figure, dpi=110)


def colour_of(status: Status) -> str:
    """Of everything that is drawn of a track."""
    return _COLOUR[status]


def _png(figure: Figure, dpi: int) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, dpi=dpi, format="png")
    return file.getvalue()


def _draw_test(axes: Axes, sketch: Sketch, decisions: Sequence[Mapping[str, Any]]) -> None:
    """Thresholds and decisions."""
    limits = sketch.scenario.decision.thresholds
    for decision in decisions:
        confirmed = decision["kind"] == "confirmed"
        colour = colour_of(Status.CONFIRMED if confirmed else Status.DELETED)
        axes.plot(decision["time"], max(decision["log_lr"], -1e3), marker="^" if confirmed else "v", color=colour, ms=8)
    for value, name in ((limits.log_b, "log B: confirm"), (limits.log_a, "log A: delete")):
        axes.axhline(value, color="black", ls="--", lw=1)
        axes.annotate(name, (1, value), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=9)
    axes.axhline(0, color="0.8", lw=0.8, zorder=0)
    axes.set(xlabel="time [s]")


def _label(axes: Axes, text: str, at: tuple[float, float], colour: str) -> None:
    """Annotate a point; labels at one and the same point are joined."""
    for other in axes.texts:
        if isinstance(other, Annotation) and np.allclose(other.xy, at, rtol=0.0, atol=0.25):
            other.set_text(f"{other.get_text()},{text}")
            return
    axes.annotate(text, at, color=colour, fontsize=9, va="center")


def draw_plan(sketch: Sketch) -> bytes:
    """Sensors with their fields of view, plots, tracks with 95 % ellipses, east and north; a PNG file."""
    figure = Figure(figsize=(9, 9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    _draw_plots(axes, sketch)
    for sensor in sketch.scenario.sensors:
        _draw_sensor(axes, sketch, sensor)
    for track, history in sketch.histories().items():
        _draw_track(axes, track, history)
    handles = [*axes.get_legend_handles_labels()[0], *_status_handles(sketch)]
    axes.legend(handles=handles, fontsize=9, loc="upper right")
    axes.set(xlabel="east [m]", ylabel="north [m]", title=f"{sketch.scenario.name}: plan view, 95 % ellipses")
    axes.set_aspect("equal", adjustable="datalim")
    return _png(figure, dpi=120)


def _draw_plots(axes: Axes, sketch: Sketch) -> None:
    """Plots where they lie; of those without a range the first part of the way."""
    plots, count = sketch.plots(rays=False)
    if count:
        at = plots[:, :2] + plots[:, 2:]
        axes.plot(at[:, 0], at[:, 1], ".", ms=2.5, color="0.72", label=_counted(len(at), count, "plots"), zorder=1)
    rays, count = sketch.plots(rays=True)
    if count:
        length = _RAY * _extent(sketch)
        lines = LineCollection(
            [(ray[:2], ray[:2] + length * ray[2:]) for ray in rays],
            colors="0.72",
            linewidths=0.5,
            alpha=0.5,
            label=f"{_counted(len(rays), count, 'bearings')} (rays cut short)",
            zorder=1,
        )
        axes.add_collection(lines)


def _counted(drawn: int, count: int, what: str) -> str:
    return f"{count} {what}" if drawn == count else f"{drawn} of {count} {what}"


def _extent(sketch: Sketch) -> float:
    """How far tracks and sensors lie apart [m]."""
    tracks = [history.x for history in sketch.histories().values()]
    stands = [sketch.stands(sensor) for sensor in sketch.scenario.sensor_names]
    points = np.concatenate([*tracks, *stands, np.zeros((1, 2))])
    return float(np.ptp(points, axis=0).max()) or 1000.0


def _with_resets(sketch: Sketch, track: int, history: History) -> tuple[Array, Array]:
    """Times and log LR with the value that each reset, at a confirmation, threw away; with a life nothing is reset."""
    given = sketch.scenario.hypotheses
    start_s = given[track].start if track < len(given) else history.times_s[0]
    times = np.concatenate([[start_s], np.repeat(history.times_s, 2)])
    reached = history.reached if sketch.scenario.life is None else history.log_lr
    values = np.stack([reached, history.log_lr], axis=-1).ravel()
    return times, np.concatenate([[0.0], values])


def _draw_sensor(axes: Axes, sketch: Sketch, sensor: SensorConfig) -> None:
    stands = _stands(sketch, sensor)
    axes.plot(stands[:, 0], stands[:, 1], color=_SENSOR, lw=1.5)
    label = "sensors" if sensor is sketch.scenario.sensors[0] else None
    axes.plot(*stands[-1], marker="s", color=_SENSOR, ms=7, ls="", zorder=5, label=label)
    if len(sketch.scenario.sensors) <= 8:
        offset = (0, 8 + 11 * _namesakes(sketch, sensor, stands[-1]))
        axes.annotate(sensor.name, stands[-1], xytext=offset, textcoords="offset points", color=_SENSOR, ha="center")
    center = sensor.view_center(stands[-1])[:2]
    style: dict[str, Any] = {"fill": False, "ec": _SENSOR, "alpha": 0.35, "ls": ":"}
    view = sensor.field_of_view
    # Matplotlib counts degrees counter-clockwise from east.
    turned = -np.degrees(sketch.headings.get(sensor.name, sensor.heading or 0.0))
    if isinstance(view, BoxConfig):
        size, angle = np.array(view.size[:2]), turned if view.center is None else 0.0
        axes.add_patch(Rectangle(tuple(center - size / 2), *size, angle=angle, rotation_point="center", **style))
    elif isinstance(view, DiscConfig):
        axes.add_patch(Circle(tuple(center), view.radius, **style))
    elif isinstance(view, SectorConfig):
        middle, half = 90.0 + turned - np.degrees(view.direction), 0.5 * np.degrees(view.width)
        ring = view.radius - view.inner if view.inner else None
        axes.add_patch(Wedge(tuple(center), view.radius, middle - half, middle + half, width=ring, **style))


def _stands(sketch: Sketch, sensor: SensorConfig) -> Array:
    """Where a sensor stood, shape (K, 2); where it will, if none of its scans was seen."""
    stands = sketch.stands(sensor.name)
    return stands if len(stands) else sensor.stand(sketch.scenario.motion.dimensions)[None, :2]


def _namesakes(sketch: Sketch, sensor: SensorConfig, stand: Array) -> int:
    """How many earlier sensors stand at nearly the same place: their names must not cover each other."""
    before = sketch.scenario.sensors[: sketch.scenario.sensors.index(sensor)]
    return sum(bool(np.hypot(*(_stands(sketch, other)[-1] - stand)) < 50.0) for other in before)


def _draw_track(axes: Axes, track: int, history: History) -> None:
    colour = colour_of(history.status)
    for coasting, style in ((False, "-"), (True, ":")):
        x = np.where((history.coasting == coasting)[:, None], history.x, np.nan)
        axes.plot(x[:, 0], x[:, 1], color=colour, lw=1.5, ls=style, zorder=3)
    ellipses = min(_ELLIPSES, max(2, len(history.x) // 3))
    for k in np.unique(np.linspace(0, len(history.x) - 1, ellipses).astype(int)):
        axes.add_patch(_ellipse(history.x[k], history.P[k], colour))
    seen = f", last plot at {history.supported_s:.0f} s" if history.status == Status.COASTING else ""
    axes.annotate(f" {track}{seen}", tuple(history.x[-1]), color=colour, fontsize=10, zorder=6)


def _ellipse(center: Array, P: Array, colour: str) -> Ellipse:
    variances, axes = np.linalg.eigh(P)
    width, height = 2.0 * _RADIUS_95 * np.sqrt(variances)
    angle = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
    return Ellipse(tuple(center), width, height, angle=angle, fill=False, ec=colour, alpha=0.6, zorder=4)


def _status_handles(sketch: Sketch) -> list[Patch]:
    there, drawn = sketch.outcome, sketch.histories()
    hidden = {
        "earlier, not drawn": sketch.omitted[True],
        "never confirmed, not drawn": there.total() - len(drawn) - sketch.omitted[True],
    }
    rest = [Patch(color="none", label=f"{number} {what}") for what, number in hidden.items() if number]
    return rest + [
        Patch(color=colour_of(status), label=f"{there[status]} {status.name.lower()}")
        for status in sorted(there, key=list(_COLOUR).index)
    ]
