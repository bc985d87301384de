"""Recorded trajectories as the truth of a simulation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import all_same, scenario, sensor_table

from waldnet.common.config import Scenario, load_scenario
from waldnet.common.errors import TruthError
from waldnet.scenarios.trajectories import read_trajectories
from waldnet.scenarios.world import simulate, simulate_all, truth

LINE: dict[str, Any] = {"target": 1, "time": 2.0, "position": [1.0, 2.0]}
#: A target that turns a corner, and one that is there for a moment.
SHIPS = [
    {"target": 1, "time": 3.0, "position": [100.0, 50.0]},
    {"target": 7, "time": 9.0, "position": [900.0, 0.0]},
    {"target": 1, "time": 7.0, "position": [140.0, 50.0]},
    {"target": 1, "time": 12.0, "position": [140.0, 0.0]},
    {"target": 7, "time": 11.0, "position": [902.0, -4.0]},
]


def recorded(tmp_path: Path, *lines: Any, **tables: Any) -> Scenario:
    """A scenario of 20 s whose simulation has the given trajectories."""
    path = tmp_path / "ships.jsonl"
    path.write_text("".join((line if isinstance(line, str) else json.dumps(line)) + "\n" for line in lines))
    return scenario(**{"simulation": {"duration": 20.0, "truth": path}, **tables})


def refusal(tmp_path: Path, *lines: Any) -> str:
    """Why a file is refused, without the file's folder."""
    with pytest.raises(TruthError) as caught:
        read_trajectories(recorded(tmp_path, *lines))
    return str(caught.value).removeprefix(f"{tmp_path}/")


def test_targets_go_straight_from_point_to_point(tmp_path: Path) -> None:
    plot = recorded(tmp_path, *SHIPS)
    ship, other = read_trajectories(plot)
    times_ns = np.array([plot.to_ns(time_s) for time_s in (2.999, 3.0, 4.0, 7.0, 9.5, 12.0, 12.001)])
    nowhere = [np.nan] * 4
    np.testing.assert_allclose(
        ship.states(times_ns, 4),
        [
            nowhere,
            [100.0, 50.0, 10.0, 0.0],
            [110.0, 50.0, 10.0, 0.0],
            [140.0, 50.0, 0.0, -10.0],
            [140.0, 25.0, 0.0, -10.0],
            [140.0, 0.0, 0.0, -10.0],
            nowhere,
        ],
        atol=1e-9,
    )
    there = ~np.isnan(other.states(times_ns, 4)).any(axis=-1)
    assert there.tolist() == [False] * 4 + [True, False, False]
    assert other.states(times_ns[4:5], 6).tolist() == [[900.5, -1.0, 1.0, -2.0, 0.0, 0.0]]


def test_recorded_targets_come_after_those_of_the_file(tmp_path: Path) -> None:
    plot = recorded(tmp_path, *SHIPS)
    alone, world = truth(scenario(), 5), truth(plot, 5)
    np.testing.assert_array_equal(world.x[:1], alone.x)
    assert world.times_ns.tolist() == alone.times_ns.tolist()
    for states, trajectory in zip(world.x[1:], read_trajectories(plot), strict=True):
        np.testing.assert_array_equal(states, trajectory.states(world.times_ns, 4))


def test_every_process_sees_its_part_of_the_same_world(tmp_path: Path) -> None:
    plot = recorded(tmp_path, *SHIPS, target=[])
    whole = simulate_all(plot, 5)
    for name in reversed(plot.sensor_names):
        assert all_same(simulate(plot, name, 5), [scan for scan in whole if scan.sensor == name])
    assert not all_same(whole, simulate_all(plot, 6))


def test_recorded_targets_are_seen_where_they_are(tmp_path: Path) -> None:
    sensor = sensor_table(p_d=1.0, false_plots=1e-9, sigma=[1e-3, 1e-3], scan_interval=1.0)
    plot = recorded(tmp_path, *SHIPS, target=[], sensor=[sensor])
    seen = {plot.to_seconds(scan.time_ns): scan.z[scan.z[:, 0].argsort()] for scan in simulate_all(plot, 5)}
    assert [time_s for time_s, z in seen.items() if len(z)] == [float(k) for k in range(3, 13)]
    np.testing.assert_allclose(seen[10.0], [[140.0, 20.0], [901.0, -2.0]], atol=0.01)


def test_the_file_is_beside_the_scenario(tmp_path: Path) -> None:
    path = tmp_path / "coast.toml"
    path.write_text(
        'name = "coast"\n[motion]\nmodel = "cv"\npsd = 1.0\n[simulation]\nduration = 9.0\ntruth = "ships.jsonl"\n'
        '[[sensor]]\nname = "a"\nsigma = [1.0, 1.0]\np_d = 0.9\nfalse_plots = 1.0\n'
        'field_of_view = { shape = "disc", radius = 9.0 }\n'
    )
    simulation = load_scenario(path).simulation
    assert simulation is not None
    assert simulation.truth == tmp_path / "ships.jsonl"


def test_without_a_file_nothing_is_recorded() -> None:
    assert read_trajectories(scenario()) == []
    assert read_trajectories(scenario(simulation=None)) == []


BAD = [
    ({**LINE, "target": "ship"}, ":2: target: 'ship' is not a whole number between -1e+15 and 1e+15"),
    ({**LINE, "position": [1.0, 2.0, 3.0]}, ":2: position: [1.0, 2.0, 3.0] is not a list of 2 finite numbers"),
    ({**LINE, "time": 1}, ":2: target 1 has a position at 1.0 s already, line 1"),
    ({**LINE, "target": 2}, ": target 2 has one position, expected two or more"),
]


@pytest.mark.parametrize(("line", "reason"), BAD, ids=[reason for _, reason in BAD])
def test_what_is_no_trajectory_is_named(tmp_path: Path, line: Any, reason: str) -> None:
    """Of the rest of what can be wrong with a file of truth: test_evaluate_cli."""
    assert refusal(tmp_path, {**LINE, "time": 1.0}, line, {**LINE, "time": 5.0}) == f"ships.jsonl{reason}"


def test_a_file_without_lines(tmp_path: Path) -> None:
    assert refusal(tmp_path, "") == "ships.jsonl: has no position, expected one a line"
