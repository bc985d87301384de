"""Bytes per track and scan: reports, plots that tracks may start from, and the centralised way of sending all plots.

Every sensor is a process that sends what a node sends, at scan rate, from a network namespace to a hub in another one.
Payload bytes are those of the messages; wire bytes are what the hub's interface counted, both directions, so with
Zenoh, TCP, IP and Ethernet around them: acknowledgements, heartbeats and keep-alives included.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from waldnet.benchmarks.crew import BenchError, Crew
from waldnet.benchmarks.namespaces import Namespaces
from waldnet.benchmarks.worlds import World

#: First scans, in which links are still set up, are left out.
_WARM_UP = 2
TRACKS, SENSORS, FALSE_PLOTS = (1, 10, 100, 1000), (2, 4, 8, 16, 32), (1, 10, 100, 1000)
#: What the other axes stand at while one varies.
_BASE = World(tracks=100, sensors=4, false_plots=10.0)


class Cost(NamedTuple):
    """Mean bytes of one sensor's one scan.

    Attributes:
        payload: of the message.
        wire: of all that crossed the hub's interface for it.
    """

    payload: float
    wire: float


def worlds(tracks: Sequence[int], sensors: Sequence[int], false_plots: Sequence[int]) -> list[World]:
    """Each axis in turn, the others at their base."""
    return list(
        dict.fromkeys(
            [
                *(replace(_BASE, tracks=number) for number in tracks),
                *(replace(_BASE, sensors=number) for number in sensors),
                *(replace(_BASE, false_plots=float(number)) for number in false_plots),
            ]
        )
    )


def measure(worlds: Iterable[World], scans: int, interval_s: float) -> Iterator[dict[str, Any]]:
    """Rows of the table, one per world and codec.

    Args:
        worlds: networks.
        scans: measured of every sensor.
        interval_s: between scans.

    Raises:
        BenchError: this machine cannot have network namespaces.
    """
    if lacking := Namespaces.lacking():
        raise BenchError(f"bytes on the wire are counted in network namespaces, for which this machine lacks {lacking}")
    for world in worlds:
        single = replace(world, interval_s=interval_s, scans=_WARM_UP + scans)
        runs = [(single, kind) for kind in ("reports", "proposals", "plots")]
        runs.append((replace(single, precision="float32"), "reports"))
        with ThreadPoolExecutor(len(runs)) as pool:
            double, proposals, plots, rounded = pool.map(lambda run: cost(*run), runs)
        for codec, reports in (("float64", double), ("float32", rounded)):
            yield {
                "codec": codec,
                "tracks": world.tracks,
                "sensors": world.sensors,
                "false_plots": round(world.false_plots),
                "scans": scans,
                "interval_s": interval_s,
                "payload_bytes_per_track_scan": round(reports.payload / world.tracks, 1),
                "wire_bytes_per_track_scan": round(reports.wire / world.tracks, 1),
                "reports_bytes_per_scan": round(reports.wire),
                "proposals_bytes_per_scan": round(proposals.wire),
                "plots_bytes_per_scan": round(plots.wire),
                "reports_payload_bytes_per_scan": round(reports.payload),
                "proposals_payload_bytes_per_scan": round(proposals.payload),
                "plots_payload_bytes_per_scan": round(plots.payload),
            }


def cost(world: World, kind: str) -> Cost:
    """What one kind of message costs in a network."""
    with Namespaces("hub", "sensors") as net, Crew() as crew:
        at = net.address("hub")
        hub = crew.start("waldnet.benchmarks.traffic", "hub", at, str(world.sensors), within=net.command("hub", []))
        hub.hear()
        senders = [
            crew.start(
                "waldnet.benchmarks.traffic", "sensor", str(world), name, kind, at, within=net.command("sensors", [])
            )
            for name in world.sensor_names
        ]
        sizes = np.array([sender.hear() for sender in senders])
        hub.hear()
        # Counted half an interval after the last message of a scan came, before the next one is sent: what belongs to
        # a scan has passed by then, however slow the machine is.
        counted = []
        for scan in range(world.scans):
            for sender in senders:
                sender.tell("send")
            hub.tell(str(expected := (scan + 1) * world.sensors))
            counts = hub.hear()
            if counts != {"came": expected, "lost": 0}:
                raise BenchError(f"{kind}: {expected} messages were sent, {counts['came']} came, {counts['lost']} lost")
            time.sleep(0.5 * world.interval_s)
            counters = net.bytes("hub")
            counted.append(counters.sent + counters.received)
            time.sleep(0.5 * world.interval_s)
    measured = sizes[:, _WARM_UP:]
    return Cost(float(measured.mean()), (counted[-1] - counted[_WARM_UP - 1]) / measured.size)


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows in Markdown."""
    lines = [
        "| codec | tracks | sensors | false plots | payload per track | wire per track "
        "| wire per scan: report | proposals | plots | reports / plots |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        report, plots = row["reports_bytes_per_scan"], row["plots_bytes_per_scan"]
        lines.append(
            f"| {row['codec']} | {row['tracks']} | {row['sensors']} | {row['false_plots']} "
            f"| {row['payload_bytes_per_track_scan']} | {row['wire_bytes_per_track_scan']} "
            f"| {report} | {row['proposals_bytes_per_scan']} | {plots} | {report / plots:.2f} |"
        )
    return "\n".join(lines)


def draw(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Where the distributed way wins: bytes per sensor and scan against tracks, sensors and false plots."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    titles = {"tracks": "tracks", "sensors": "sensors", "false_plots": "false plots per scan"}
    base = {"tracks": _BASE.tracks, "sensors": _BASE.sensors, "false_plots": round(_BASE.false_plots)}
    for axes, (axis, title) in zip(figure.subplots(1, 3, sharey=True), titles.items(), strict=True):
        rest = {key: value for key, value in base.items() if key != axis}
        along = sorted(
            (row for row in rows if all(row[key] == value for key, value in rest.items())), key=lambda row: row[axis]
        )
        for codec, style in (("float64", "-o"), ("float32", "-s")):
            mine = [row for row in along if row["codec"] == codec]
            at = [row[axis] for row in mine]
            axes.loglog(at, [row["reports_bytes_per_scan"] for row in mine], style, label=f"reports, {codec}")
        for what, style in (("plots", "--^"), ("proposals", ":v")):
            axes.loglog(at, [row[f"{what}_bytes_per_scan"] for row in mine], style, label=what)
        axes.set_xticks(values := sorted({row[axis] for row in along}), map(str, values), minor=False)
        axes.minorticks_off()
        axes.set(xlabel=title, title=", ".join(f"{titles[key]} {value}" for key, value in rest.items()))
        axes.grid(visible=True, which="major", alpha=0.3)
    figure.axes[0].set_ylabel("bytes on the wire per sensor and scan")
    figure.axes[0].legend(fontsize=9)
    figure.savefig(path, dpi=110)
