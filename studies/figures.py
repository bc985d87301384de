"""Figures of a run: log LR over time with both thresholds, and the plan view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Patch, Rectangle, Wedge
from matplotlib.text import Annotation

from common.config import BoxConfig, DiscConfig, SectorConfig, SensorConfig
from common.estimation.gaussian import Array
from common.estimation.sprt import Status
from common.messages import Decision

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from studies.record import History, Record

COLOUR = {Status.TENTATIVE: "#8a6d1a", Status.CONFIRMED: "#0b7a3b", Status.DELETED: "#b3261e"}
_SENSOR = "#1f4e9e"
#: Covariance ellipses of a track, at most.
_ELLIPSES = 12
#: Of more tracks only those that were ever confirmed are drawn: most others are of false plots.
_MOST_TRACKS = 200
#: Rays of bearings, as a share of the picture.
_RAY = 0.2
#: 95 % of a 2-D Gaussian lie within this many standard deviations.
_RADIUS_95 = 2.4477


def draw_log_lr(record: Record, path: Path) -> None:
    """Log LR of every track over time, as the test sees it: with its resets, between log A and log B."""
    figure = Figure(figsize=(13, 6), layout="constrained")
    FigureCanvasAgg(figure)
    decided, whole = figure.subplots(1, 2, sharey=True)
    histories = record.histories()
    curves = {track: (*_with_resets(record, track, h), h) for track, h in _drawn(histories).items()}
    # A run that was cut short may have heard of a decision and not of its track.
    standing = [decision for decision in record.standing() if decision.track in curves]
    first = {d.track: record.scenario.to_seconds(d.time_ns) for d in reversed(standing)}
    for track, (times, log_lr, history) in curves.items():
        colour = COLOUR[Status(int(history.status[-1]))]
        # The value that decided stands before the reset at the same time.
        until = int(np.searchsorted(times, first[track])) + 1 if track in first else len(times)
        decided.plot(times[:until], log_lr[:until], color=colour, lw=1.5)
        _label(decided, f" {track}", (times[:until][-1], log_lr[:until][-1]), colour)
        whole.plot(times, log_lr, color=colour, lw=0.7)
    for axes in (decided, whole):
        _draw_test(axes, record, standing)
    decided.set(ylabel="log LR since the last reset", title=f"{record.scenario.name}: until the first decision")
    whole.set(title="the whole run: confirmed tracks are monitored, their LR reset at log B")
    if first:
        start_s = min(times[0] for times, _, _ in curves.values())
        decided.set_xlim(start_s, start_s + 1.15 * (max(first.values()) - start_s))
    decided.legend(handles=_status_handles(histories), fontsize=9, loc="upper left")
    figure.savefig(path, dpi=110)


def _drawn(histories: Mapping[int, History]) -> dict[int, History]:
    """The tracks to draw."""
    few = len(histories) <= _MOST_TRACKS
    return {track: h for track, h in histories.items() if few or (h.status == Status.CONFIRMED).any()}


def _draw_test(axes: Axes, record: Record, decisions: Sequence[Decision]) -> None:
    """Thresholds and decisions."""
    limits = record.scenario.decision.thresholds
    for decision in decisions:
        confirmed = decision.kind == "confirmed"
        colour = COLOUR[Status.CONFIRMED if confirmed else Status.DELETED]
        time_s = record.scenario.to_seconds(decision.time_ns)
        axes.plot(time_s, max(decision.log_lr, -1e3), marker="^" if confirmed else "v", color=colour, ms=8)
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


def draw_plan(record: Record, path: Path) -> None:
    """Sensors with their fields of view, plots, tracks with 95 % ellipses, east and north."""
    figure = Figure(figsize=(9, 9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    _draw_plots(axes, record)
    for sensor in record.scenario.sensors:
        _draw_sensor(axes, record, sensor)
    histories = record.histories()
    for track, history in _drawn(histories).items():
        _draw_track(axes, track, history)
    handles = [*axes.get_legend_handles_labels()[0], *_status_handles(histories)]
    axes.legend(handles=handles, fontsize=9, loc="upper right")
    axes.set(xlabel="east [m]", ylabel="north [m]", title=f"{record.scenario.name}: plan view, 95 % ellipses")
    axes.set_aspect("equal", adjustable="datalim")
    figure.savefig(path, dpi=120)


def _draw_plots(axes: Axes, record: Record) -> None:
    """Plots where they lie; of those without a range the first part of the way."""
    motion = record.scenario.motion.build()
    places, rays = [], []
    for sensor in record.scenario.sensors:
        measurement = sensor.build(motion).measurement
        for scan in record.scans:
            if scan.sensor == sensor.name and len(scan.z):
                stand, at = scan.position[:2], measurement.locate(scan.z, scan.position)[:, :2]
                if sensor.kind == "bearing":
                    rays += [(stand, point - stand) for point in at]
                else:
                    places.append(at)
    if places:
        points = np.concatenate(places)
        axes.plot(points[:, 0], points[:, 1], ".", ms=2.5, color="0.72", label=f"{len(points)} plots", zorder=1)
    if rays:
        length = _RAY * _extent(record)
        lines = LineCollection(
            [(stand, stand + length * way) for stand, way in rays],
            colors="0.72",
            linewidths=0.5,
            alpha=0.5,
            label=f"{len(rays)} bearings (rays cut short)",
            zorder=1,
        )
        axes.add_collection(lines)


def _extent(record: Record) -> float:
    """How far tracks and sensors lie apart [m]."""
    tracks = [history.x[:, :2] for history in record.histories().values()]
    stands = [scan.position[None, :2] for scan in record.scans]
    points = np.concatenate([*tracks, *stands, np.zeros((1, 2))])
    return float(np.ptp(points, axis=0).max()) or 1000.0


def _with_resets(record: Record, track: int, history: History) -> tuple[Array, Array]:
    """Times and log LR with the value that each reset, at a confirmation, threw away."""
    before = np.concatenate([[0.0], history.log_lr[:-1]])
    start_s = record.scenario.hypotheses[track].start if track < len(record.scenario.hypotheses) else history.times_s[0]
    with np.errstate(invalid="ignore"):
        step = np.diff(history.log_lr_total, prepend=0.0)
        reached = np.nan_to_num(before + step, nan=-1e3, neginf=-1e3)
    times = np.concatenate([[start_s], np.repeat(history.times_s, 2)])
    values = np.stack([reached, np.maximum(history.log_lr, -1e3)], axis=-1).ravel()
    return times, np.concatenate([[0.0], values])


def _draw_sensor(axes: Axes, record: Record, sensor: SensorConfig) -> None:
    stands = np.array([scan.position[:2] for scan in record.scans if scan.sensor == sensor.name])
    if not len(stands):
        stands = sensor.stand(record.scenario.motion.dimensions)[None, :2]
    axes.plot(stands[:, 0], stands[:, 1], color=_SENSOR, lw=1.5)
    label = "sensors" if sensor is record.scenario.sensors[0] else None
    axes.plot(*stands[-1], marker="s", color=_SENSOR, ms=7, ls="", zorder=5, label=label)
    if len(record.scenario.sensors) <= 8:
        offset = (0, 8 + 11 * _namesakes(record, sensor, stands[-1]))
        axes.annotate(sensor.name, stands[-1], xytext=offset, textcoords="offset points", color=_SENSOR, ha="center")
    center = sensor.view_center(stands[-1])[:2]
    style: dict[str, Any] = {"fill": False, "ec": _SENSOR, "alpha": 0.35, "ls": ":"}
    view = sensor.field_of_view
    # Matplotlib counts degrees counter-clockwise from east.
    turned = -np.degrees(_last_heading(record, sensor))
    if isinstance(view, BoxConfig):
        size, angle = np.array(view.size[:2]), turned if view.center is None else 0.0
        axes.add_patch(Rectangle(tuple(center - size / 2), *size, angle=angle, rotation_point="center", **style))
    elif isinstance(view, DiscConfig):
        axes.add_patch(Circle(tuple(center), view.radius, **style))
    elif isinstance(view, SectorConfig):
        middle, half = 90.0 + turned - np.degrees(view.direction), 0.5 * np.degrees(view.width)
        ring = view.radius - view.inner if view.inner else None
        axes.add_patch(Wedge(tuple(center), view.radius, middle - half, middle + half, width=ring, **style))


def _last_heading(record: Record, sensor: SensorConfig) -> float:
    """Which way the platform of a sensor points at the end [rad]."""
    return next((scan.heading for scan in reversed(record.scans) if scan.sensor == sensor.name), sensor.heading or 0.0)


def _namesakes(record: Record, sensor: SensorConfig, stand: Array) -> int:
    """How many earlier sensors stand at nearly the same place: their names must not cover each other."""
    before = record.scenario.sensors[: record.scenario.sensors.index(sensor)]
    last = {scan.sensor: scan.position[:2] for scan in record.scans}
    dimensions = record.scenario.motion.dimensions
    places = [last.get(other.name, other.stand(dimensions)[:2]) for other in before]
    return sum(bool(np.hypot(*(place - stand)) < 50.0) for place in places)


def _draw_track(axes: Axes, track: int, history: History) -> None:
    colour = COLOUR[Status(int(history.status[-1]))]
    axes.plot(history.x[:, 0], history.x[:, 1], color=colour, lw=1.5, zorder=3)
    ellipses = min(_ELLIPSES, max(2, len(history.x) // 3))
    for k in np.unique(np.linspace(0, len(history.x) - 1, ellipses).astype(int)):
        axes.add_patch(_ellipse(history.x[k, :2], history.P[k, :2, :2], colour))
    axes.annotate(f" {track}", tuple(history.x[-1, :2]), color=colour, fontsize=10, zorder=6)


def _ellipse(center: Array, P: Array, colour: str) -> Ellipse:
    variances, axes = np.linalg.eigh(P)
    width, height = 2.0 * _RADIUS_95 * np.sqrt(variances)
    angle = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
    return Ellipse(tuple(center), width, height, angle=angle, fill=False, ec=colour, alpha=0.6, zorder=4)


def _status_handles(histories: Mapping[int, History]) -> list[Patch]:
    there = [Status(int(history.status[-1])) for history in histories.values()]
    hidden = len(histories) - len(_drawn(histories))
    rest = [Patch(color="none", label=f"{hidden} never confirmed, not drawn")] if hidden else []
    return rest + [
        Patch(color=COLOUR[status], label=f"{there.count(status)} {status.name.lower()}")
        for status in (Status.CONFIRMED, Status.TENTATIVE, Status.DELETED)
        if status in there
    ]
