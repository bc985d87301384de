"""Benchmarks of many tracks and of the load of a scenario: what they measure is there, and is of what it should be."""

from __future__ import annotations

import numpy as np
import pytest

from waldnet.benchmarks import load, scaling
from waldnet.benchmarks.crew import BenchError
from waldnet.benchmarks.scaling import Cell
from waldnet.scenarios.world import truth


@pytest.mark.parametrize("area", ["grows", "same"])
def test_targets_are_as_dense_as_the_area_says(area: scaling.Area) -> None:
    few, many = (Cell(targets, area).scenario for targets in (10, 1000))
    spread = [np.ptp(truth(plot, 1).x[:, 0, :2], axis=0).mean() for plot in (few, many)]
    assert len(many.targets) == 1000
    assert (spread[1] > 5.0 * spread[0]) == (area == "grows")
    assert spread[1] == pytest.approx(30_000.0, rel=0.05)


def test_a_scan_has_its_parts_and_a_peer() -> None:
    cells = [Cell(targets, "grows", warm_up=4, scans=1) for targets in (4, 8)]
    rows = [scaling.measure(cell, peer_up_to=4) for cell in cells]
    for cell, row in zip(cells, rows, strict=True):
        assert row["confirmed"] == cell.targets <= row["live"]
        parts = [row[f"{part}_ms"] for part in ("node", "told", "center", "lines")]
        assert min(parts) > 0.0
        assert row["total_ms"] > max(parts)
    assert rows[0]["stone_soup_ms"] > 0.0
    assert rows[1]["stone_soup_ms"] is None
    assert [line.count("|") for line in scaling.table(rows).splitlines()] == [14] * 4


def test_the_steps_of_a_scenario_are_those_of_all_its_scans() -> None:
    row = load.steps("parallel")
    assert row["scans"] == 3 * 60
    assert 0.0 < row["node_p50_ms"] <= row["node_p99_ms"]
    assert 0.0 < row["center_p50_ms"] <= row["center_p99_ms"]
    assert row["cpu_share"] > 0.0


@pytest.mark.processes
def test_a_live_network_says_what_each_process_took_and_what_was_lost() -> None:
    row = load.live("parallel", "max", 10.0)
    assert set(row["cpu_share_each"]) <= {"launcher", "center", "radar-1", "radar-2", "radar-3"}
    assert row["scans"] == 3 * 5
    assert (row["lost"], row["reports"]["late"]) == (0, 0)
    steps = {"what": "steps", **dict.fromkeys(("scenario", "seconds", "scans", "tracks"), 1), "cpu_share": 0.1}
    quantiles = {f"{part}_{p}_ms": 1.0 for part in ("node", "center") for p in ("p50", "p99")}
    assert "| live, speed max | 10 |" in load.table([steps | quantiles, row])


@pytest.mark.processes
def test_a_network_that_does_not_run_is_no_figure() -> None:
    with pytest.raises(BenchError, match="the clock did not start"):
        load.live("parallel", "no speed", 10.0)
