"""The benchmarks measure what they say, and write what others read; how fast it is, no test asks."""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import scenario
from process_helpers import Processes

from waldnet.benchmarks.bandwidth import draw, measure, table, worlds
from waldnet.benchmarks.crew import BenchError, Crew
from waldnet.benchmarks.latency import parts_of
from waldnet.benchmarks.namespaces import Namespaces
from waldnet.benchmarks.precision import compare
from waldnet.benchmarks.traffic import messages
from waldnet.benchmarks.worlds import World
from waldnet.common.messages import Report, Scan
from waldnet.offline.network import run_in_memory
from waldnet.offline.replay import Replay
from waldnet.sensor_node.sources import all_scans

SMALL = World(tracks=7, sensors=2, false_plots=3.0, interval_s=0.5, scans=4)


def rows_of(path: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads(path.read_text())
    return rows


def test_a_world_reads_as_it_is_written() -> None:
    assert World.of(str(SMALL)) == SMALL


def test_the_targets_of_a_world_are_found() -> None:
    final = list(Replay(SMALL.scenario(), sorted_scans(SMALL)).run())[-1]
    assert list(final.status) == SMALL.tracks * [1]  # confirmed


def sorted_scans(world: World) -> list[Scan]:
    return sorted((scan for name in world.sensor_names for scan in world.seen_by(name)), key=lambda scan: scan.time_ns)


def test_what_is_sent_is_what_nodes_send() -> None:
    reports, proposals, plots = (list(messages(SMALL, "radar-0", kind)) for kind in ("reports", "proposals", "plots"))
    assert len(reports) == len(proposals) == len(plots) == SMALL.scans
    for report, proposal, scan in zip(reports, proposals, plots, strict=True):
        assert isinstance(report, Report)
        assert isinstance(proposal, Report)
        assert isinstance(scan, Scan)
        assert report.time_ns == proposal.time_ns == scan.time_ns
        assert len(report.ids) == SMALL.tracks
        assert not len(proposal.ids)
        assert {tuple(plot) for plot in proposal.unclaimed} < {tuple(plot) for plot in scan.z}
    assert sum(len(message.unclaimed) for message in proposals if isinstance(message, Report)) > 0
    assert any((one.x != two.x).any() for one, two in pairwise(reports) if isinstance(one, Report))


def test_latency_has_its_parts() -> None:
    """From the last node's begin to the arrival; what neither node nor center took, the wire did."""
    early, late = {10: (1_000, 9_000), 20: (31_000, 33_000)}, {10: (2_000, 5_000), 20: (30_000, 39_000)}
    parts = parts_of({10: 12_000, 20: 50_000}, [early, late], {10: 9_500, 20: 40_000}, {10: 10_000, 20: 44_000})
    assert parts == {"total": [10.0, 19.0], "node": [3.0, 2.0], "center": [0.5, 4.0], "wire": [6.5, 13.0]}


def test_latency_is_measured_of_all_ways(processes: Processes, tmp_path: Path) -> None:
    out = tmp_path / "latency.json"
    options = ("--tracks", "1", "--sensors", "2", "--scans", "20", "--rate", "20", "--json", out)
    printed = processes.output("bench", "latency", *options)
    rows = rows_of(out)
    assert [(row["tracks"], row["sensors"], row["rate"]) for row in rows] == [(1, 2, 20.0), (1, 2, "max")]
    for row in rows:
        for way in ("", "raw_zenoh_", "raw_tcp_"):
            assert row[f"{way}p50_us"] <= row[f"{way}p99_us"] <= row[f"{way}p999_us"]
        assert row["scans"] == 20
    assert sum(line.startswith("| 1 | 2 |") for line in printed) == 2


@pytest.mark.netns
def test_bandwidth_counts_payload_and_wire(processes: Processes, tmp_path: Path) -> None:
    out, figure = tmp_path / "bandwidth.json", tmp_path / "bandwidth.png"
    axes = ("--tracks", "100", "--sensors", "4", "--false-plots", "10")
    processes.output(
        "bench", "bandwidth", *axes, "--scans", "4", "--interval", "0.5", "--json", out, "--figure", figure
    )
    rows = rows_of(out)
    assert [(row["codec"], row["sensors"]) for row in rows] == [("float64", 4), ("float32", 4)]
    for row in rows:
        payload, wire = row["payload_bytes_per_track_scan"], row["wire_bytes_per_track_scan"]
        assert payload <= {"float64": 140, "float32": 72}[row["codec"]]
        assert payload == pytest.approx(row["reports_payload_bytes_per_scan"] / 100, abs=0.1)
        assert payload < wire < 1.3 * payload
        # 0.9 of 100 targets and 10 false plots of 16 bytes.
        assert row["plots_payload_bytes_per_scan"] == pytest.approx(100 * 16, rel=0.15)
        assert row["plots_payload_bytes_per_scan"] < row["plots_bytes_per_scan"] < 2.5 * 1600
        assert row["proposals_payload_bytes_per_scan"] < row["proposals_bytes_per_scan"]
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert table(rows).count("float32") == 1
    draw([], tmp_path / "empty.png")


def test_bandwidth_varies_one_axis_at_a_time() -> None:
    found = [(world.tracks, world.sensors, world.false_plots) for world in worlds((1, 100), (2, 4), (10, 1000))]
    assert found == [(1, 4, 10.0), (100, 4, 10.0), (100, 2, 10.0), (100, 4, 1000.0)]


def test_a_machine_without_namespaces_is_told_what_it_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Namespaces, "lacking", lambda: "root, nsenter")
    with pytest.raises(BenchError, match="network namespaces, for which this machine lacks root, nsenter"):
        next(measure([SMALL], scans=1, interval_s=0.1))


def test_a_process_of_a_benchmark_that_fails_says_why() -> None:
    with Crew() as crew, pytest.raises(BenchError, match=r"benchmarks\.raw relay: ended with exit code 1: .*Error"):
        crew.start("waldnet.benchmarks.raw", "relay").hear()


def test_figures_are_put_where_the_document_names_their_command(tmp_path: Path) -> None:
    document = tmp_path / "figures.md"
    places = [f"<!-- figures: echo {word} -->\nold\n<!-- end -->" for word in ("one", "two")]
    document.write_text("\n\n".join(places))
    subprocess.run([sys.executable, "-m", "waldnet.benchmarks.figures", document, "one"], check=True)
    text = document.read_text()
    assert "<!-- figures: echo one -->\n\none\n\n<!-- end -->" in text
    assert places[1] in text


def test_float32_reports_hardly_change_log_lr_in_1000_scans() -> None:
    row = compare("four-radars", 1000)
    assert row["scans"] == 1000
    assert row["largest_log_lr"] > 1000.0
    # Hypotheses without a target go on for ever here, and log LR of some falls to -100,000.
    assert 0.0 < row["log_lr_difference"] < 1e-5 * row["largest_log_lr"]
    # And their positions are known to some hundred metres only.
    assert 0.0 < row["position_difference_m"] < 5.0


def test_a_network_with_float32_reports_says_what_replay_says(tmp_path: Path) -> None:
    plot = scenario(fusion={"precision": "float32"})
    scans = all_scans(plot)
    record = run_in_memory(plot, scans)
    replayed = Replay(plot, scans).run()
    log_lr = {m.time_ns: m.log_lr_total for m in replayed if not hasattr(m, "kind")}
    assert len(log_lr) == 10
    for time_ns, values in log_lr.items():
        np.testing.assert_array_equal(record.pictures[time_ns].log_lr_total, values)
    double = Replay(scenario(), scans).run()
    assert any((m.log_lr_total != log_lr[m.time_ns]).any() for m in double if not hasattr(m, "kind"))
