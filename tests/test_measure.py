"""What is measured of sensors is what a simulated world was made with, and false tracks are no more than the bound."""

from __future__ import annotations

import json
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import hypothesis_table, scenario, sensor_table
from scipy.stats import binom, poisson

from waldnet.common.config import Scenario
from waldnet.common.errors import ConfigError, TruthError
from waldnet.common.messages import Scan, Tracks
from waldnet.evaluation.false_tracks import false_tracks
from waldnet.launch.measuring import measure, measured, suggested
from waldnet.offline.centralised import Centralised
from waldnet.scenarios import catalogue
from waldnet.scenarios.measure import Figure, SensorFigures, assign, measure_sensor, true_paths
from waldnet.scenarios.trajectories import Trajectory
from waldnet.scenarios.truth import write_truth
from waldnet.scenarios.world import simulate_all
from waldnet.scenarios.world import truth as true_states

FERRY = catalogue.FOLDER / "autoferry"
VIEW = {"shape": "disc", "radius": 6000.0}
TRUE: dict[str, dict[str, Any]] = {
    "position": {"sigma": [30.0, 60.0]},
    "dense false plots": {"sigma": [150.0, 150.0], "false_plots": 120.0},
    "polar": {"kind": "polar", "sigma": [25.0, 0.012]},
    "polar-doppler": {"kind": "polar-doppler", "sigma": [25.0, 0.012, 2.0], "max_speed": 60.0},
    "bearing": {"kind": "bearing", "sigma": [0.01], "false_plots": 0.7},
}
STATES = [[2000.0, 500.0, 3.0, -8.0], [-2500.0, 2000.0, 5.0, 5.0], [-500.0, -3000.0, -9.0, 2.0]]


def world(kind: str, claims: bool = False, **changes: Any) -> Scenario:
    """One sensor and three targets that go straight on; ``claims``: a scenario file that is wrong about the sensor."""
    sensor = {"position": [100.0, 50.0], "p_d": 0.8, "false_plots": 3.0, "field_of_view": VIEW, **TRUE[kind], **changes}
    if claims:
        sensor |= {"sigma": [1.6 * s for s in sensor["sigma"]], "p_d": 0.95, "false_plots": 1.0}
    return scenario(
        sensor_table(**sensor),
        motion={"psd": 1e-6},
        target=[{"state": state} for state in STATES],
        hypothesis=[],
        simulation={"duration": 240.0},
    )


def seen(plot: Scenario, seed: int) -> tuple[list[Scan], dict[int, Trajectory]]:
    times_ns, x = true_states(plot, seed)
    known = {target: Trajectory(times_ns, path[:, :2]) for target, path in enumerate(x)}
    return simulate_all(plot, seed), known


def of_world(plot: Scenario, claimed: Scenario, seed: int) -> SensorFigures:
    scans, known = seen(plot, seed)
    return measure_sensor(claimed, "a", scans, true_paths(known, scans, 4))


@pytest.mark.parametrize("kind", TRUE)
def test_what_a_world_was_made_with_is_measured(kind: str) -> None:
    """All figures of ten worlds: their 95 % intervals hold the truth as often as that says, to 1 in 10,000."""
    plot, claimed = world(kind), world(kind, claims=True)
    config, held = plot.sensors[0], []
    for seed in range(10):
        found = of_world(plot, claimed, seed)
        assert found.p_d is not None
        assert found.false_plots is not None
        assert found.looks > 250
        pairs = [(found.p_d, config.p_d), (found.false_plots, config.false_plots)]
        pairs += [(figure, 0.0) for figure in found.bias] + list(zip(found.sigma, config.sigma, strict=True))
        held += [figure.low <= value <= figure.high for figure, value in pairs]
        assert found.p_d.high - found.p_d.low < 0.1
        assert all(figure.high - figure.low < 0.2 * figure.value for figure in found.sigma)
    assert sum(held) > binom.ppf(1e-4, len(held), 0.95), (sum(held), len(held))


def test_a_bias_is_measured_and_worked_into_the_sigma_that_is_suggested() -> None:
    plot = world("position")
    scans, known = seen(plot, 1)
    shifted = [scan._replace(z=scan.z + np.array([50.0, -20.0])) for scan in scans]
    found = measure_sensor(plot, "a", shifted, true_paths(known, scans, 4))
    assert found.bias[0].low < 50.0 < found.bias[0].high
    assert found.bias[1].low < -20.0 < found.bias[1].high
    assert suggested(found, plot.sensors[0])["sigma"] == pytest.approx([np.hypot(50, 30), np.hypot(20, 60)], rel=0.1)


@pytest.mark.parametrize("factor", [0.2, 3.0], ids=["five times too large", "three times too small"])
def test_a_sigma_that_is_far_off(factor: float) -> None:
    """The gate, made of what the scenario claims, is widened where errors reach its edge."""
    plot = world("position", sigma=[20.0 * factor, 20.0 * factor], false_plots=1.0)
    found = of_world(plot, world("position", sigma=[20.0, 20.0]), 3)
    assert [figure.value for figure in found.sigma] == pytest.approx([20.0 * factor] * 2, rel=0.12)
    assert found.p_d is not None
    assert found.p_d.low < 0.8 < found.p_d.high


def test_misses_in_rows_are_told_from_misses_alone() -> None:
    rows = world("position", p_d=0.95, visibility={"visible_for": 40.0, "hidden_for": 15.0}, scan_interval=0.5)
    found = of_world(rows, rows, 2)
    assert found.visible is not None
    p_d, visible_s, hidden_s = found.visible
    # About 13 times visible and hidden: a third off is one standard deviation.
    assert 0.93 < p_d < 0.97
    assert 20.0 < visible_s < 80.0
    assert 8.0 < hidden_s < 30.0
    keys = suggested(found, rows.sensors[0])
    assert keys["p_d"] == pytest.approx(p_d, abs=0.01)
    assert keys["visibility"]["hidden_for"] == pytest.approx(hidden_s, rel=0.1)
    alone = world("position", p_d=0.7, scan_interval=0.5)
    assert of_world(alone, alone, 2).visible is None


def test_errors_that_last() -> None:
    """Errors of a first-order Gauss-Markov process: half of one is left after 6 s, in the mean."""
    plot, rng = world("position", false_plots=0.01, scan_interval=1.0), np.random.default_rng(4)
    scans, known = seen(plot, 1)
    path = known[0].states(np.array([scan.time_ns for scan in scans]), 4)
    error, keep = np.zeros(2), 0.5 ** (1.0 / 6.0)
    lasting = []
    for scan, x in zip(scans, path, strict=True):
        error = keep * error + np.sqrt(1.0 - keep**2) * rng.normal(size=2) * [30.0, 60.0]
        lasting.append(scan._replace(z=(x[:2] + error)[None]))
    only = {0: known[0]}
    found = measure_sensor(plot, "a", lasting, true_paths(only, scans, 4))
    assert found.errors_last_s is not None
    assert 3.0 < found.errors_last_s < 12.0
    fresh = measure_sensor(plot, "a", scans, true_paths(only, scans, 4))
    assert fresh.errors_last_s is None


def test_targets_at_one_place_are_left_out_and_their_plots_are_not_false() -> None:
    plot = world("position", p_d=1.0, false_plots=0.5)
    scans, known = seen(plot, 1)
    beside = Trajectory(known[0].times_ns, known[0].positions + 20.0)
    twice = [scan._replace(z=np.concatenate([scan.z, beside.positions[k : k + 1]])) for k, scan in enumerate(scans)]
    found = measure_sensor(plot, "a", twice, true_paths({**known, 9: beside}, scans, 4))
    assert (found.looks, found.near_another) == (240, 240)
    assert found.false_plots is not None
    assert found.false_plots.low < 0.5 < found.false_plots.high


def test_a_target_outside_the_view_is_no_miss() -> None:
    plot = world("position", p_d=1.0, field_of_view={"shape": "disc", "radius": 2700.0})
    found = of_world(plot, plot, 1)
    assert found.p_d is not None
    assert 60 < found.looks < 240
    assert found.p_d.value == pytest.approx(1.0, abs=1e-6)


def test_without_targets_there_is_only_clutter_to_measure() -> None:
    plot = world("position")
    scans = simulate_all(plot.model_copy(update={"targets": ()}), 1)
    found = measure_sensor(plot, "a", scans, [])
    assert (found.looks, found.p_d, found.sigma, found.visible) == (0, None, (), None)
    assert found.false_plots is not None
    assert found.false_plots.low < 3.0 < found.false_plots.high
    nothing = measure_sensor(plot, "a", [], [])
    assert (nothing.scans, nothing.false_plots) == (0, None)
    assert suggested(nothing, plot.sensors[0]) == {}


def test_pairs_are_the_best_of_all() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        distances = rng.uniform(0.0, 2.0, (3, 3))
        rows, columns = assign(distances, 1.0)
        assert (distances[rows, columns] < 1.0).all()
        ways = [[(i, j) for i, j in enumerate(order) if distances[i, j] < 1.0] for order in permutations(range(3))]
        most = max(map(len, ways))
        assert len(rows) == most
        least = min(sum(distances[i, j] for i, j in way) for way in ways if len(way) == most)
        assert distances[rows, columns].sum() == pytest.approx(least)


def test_from_tracks_alone() -> None:
    """A centralised run finds the targets; what it tells of three sensors is near what they were made with."""
    sensors = [
        sensor_table(name, sigma=[40.0, 40.0], p_d=p_d, false_plots=false, first_scan=first)
        for name, p_d, false, first in (("a", 0.9, 2.0, 2.0), ("b", 0.6, 4.0, 1.4), ("c", 0.8, 0.5, 0.8))
    ]
    hypotheses = [hypothesis_table(state=state, sigma=[100.0, 100.0, 10.0, 10.0]) for state in STATES]
    plot = scenario(
        *sensors,
        motion={"psd": 0.1},
        hypothesis=hypotheses,
        target=[{"hypothesis": k} for k in range(3)],
        simulation={"duration": 200.0},
        decision={"p1": 0.999},
    )
    found = measured(plot, simulate_all(plot, 1), None)
    for one, config in zip(found, plot.sensors, strict=True):
        assert one.p_d is not None
        assert one.false_plots is not None
        assert config.p_d is not None
        assert one.looks > 200
        assert one.p_d.value == pytest.approx(config.p_d, abs=0.07)
        # The plots of targets that are not confirmed yet count as false.
        assert config.false_plots * 0.85 < one.false_plots.value < config.false_plots * 1.15 + 0.2
    sigmas = [figure.value for one in found for figure in one.sigma]
    assert np.mean(sigmas) == pytest.approx(40.0, rel=0.06)
    assert sigmas == pytest.approx([40.0] * 6, rel=0.2)


# The command ----------------------------------------------------------------------------------------------------------


def test_the_ferry_measured(capsys: pytest.CaptureFixture[str]) -> None:
    """As its README has it, beside what the scenario claims."""
    measure("autoferry-13-all", truth=FERRY / "scenario13-truth.jsonl", as_json=True)
    entry = json.loads(capsys.readouterr().out)
    by_name = {sensor["name"]: sensor for sensor in entry["sensors"]}
    assert by_name["infrared"]["false_plots"]["value"] == pytest.approx(12.4, rel=0.03)
    assert by_name["lidar"]["p_d"]["value"] == pytest.approx(0.61, abs=0.03)
    assert by_name["radar"]["sigma"][0]["value"] == pytest.approx(3.7, rel=0.2)
    assert by_name["radar"]["claimed"]["sigma"] == [7.0, 7.0]
    assert set(by_name["daylight"]["suggested"]) >= {"p_d", "visibility", "sigma", "false_plots"}
    assert entry["false_tracks_per_day"]["confirmed"] > 1.0
    measure("autoferry-13-all", truth=FERRY / "scenario13-truth.jsonl")
    said = capsys.readouterr().out
    assert "bias of east" in said
    assert "suggested: p_d = " in said
    assert max(map(len, said.splitlines())) <= 120


def test_a_simulated_world_is_measured_by_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plot = catalogue.find("four-radars")
    measure(str(plot))
    said = capsys.readouterr().out
    assert said.count("looks at targets in view") == 4
    assert "Targets are the confirmed tracks of a centralised run" in said


def test_what_there_is_nothing_to_measure_with(tmp_path: Path) -> None:
    plot = world("position")
    with pytest.raises(ConfigError, match="so no tracks: give --truth"):
        measured(plot, simulate_all(plot, 1), None)
    empty = tmp_path / "truth.jsonl"
    empty.write_text("")
    with pytest.raises(TruthError, match="has no position"):
        measured(plot, simulate_all(plot, 1), empty)
    with empty.open("w") as file:
        write_truth(file, *true_states(plot, 1), plot)
    assert measured(plot, simulate_all(plot, 1), empty)[0].looks > 250


def test_suggestions_are_keys_that_a_scenario_takes() -> None:
    figures = SensorFigures("a", 10, 5, 0, Figure(1.0, 0.6, 1.0), Figure(0.0, 0.0, 0.3), (), (), None, None)
    keys = suggested(figures, world("position").sensors[0])
    assert keys == {"p_d": pytest.approx(0.86), "false_plots": 0.05}
    assert scenario(sensor_table(**keys)).sensors[0].p_d == keys["p_d"]


# False tracks a day ---------------------------------------------------------------------------------------------------


def clutter(plots: int, **changes: Any) -> Scenario:
    """Two sensors that see false plots only."""
    table = {"sigma": [30.0, 30.0], "position": [0.0, 0.0], "false_plots": 5.0, "field_of_view": VIEW, **changes}
    sensors = [sensor_table(name, first_scan=first, **table) for name, first in (("a", 2.0), ("b", 1.0))]
    return scenario(
        *sensors,
        motion={"psd": 1.0},
        initiation={"speed": 20.0, "plots": plots, "within": 5.0},
        decision={"p0": 0.2, "p1": 0.95},
        hypothesis=[],
        target=[],
        simulation={"duration": 200.0},
    )


def test_how_many_tracks_start_from_pairs_of_false_plots() -> None:
    """By hand, in 2-D: a false plot lies in an earlier one's gate with rho pi gamma (2 s^2 + v^2 t^2 + q t^3/3)."""
    plot = clutter(2)
    gamma, rho = -2.0 * np.log(0.01), 5.0 / (np.pi * 6000.0**2)
    dt = np.array([2.0, 4.0, 1.0, 3.0, 5.0])
    pairs = (5.0 * rho * np.pi * gamma * (2.0 * 30.0**2 + (20.0 * dt) ** 2 + dt**3 / 3.0)).sum()
    by_hand = 2.0 * 5.0 * -np.expm1(-pairs / 5.0) * 86_400.0 / 2.0
    found = false_tracks(plot)
    assert found is not None
    # Gates that reach over the edge of the view count less.
    assert 0.97 * by_hand < found.started < by_hand
    one = false_tracks(clutter(1))
    assert one is not None
    assert one.started == pytest.approx(10.0 * 43_200.0)
    assert one.confirmed == pytest.approx(one.started * 0.2 / 0.95)
    assert one.p0_for_one == pytest.approx(0.95 / one.started)
    assert false_tracks(world("position")) is None


def started_and_confirmed(plot: Scenario) -> tuple[int, int]:
    """How many tracks of a simulated world start, and how many of them are ever confirmed."""
    started, confirmed = set[int](), set[int]()
    for message in Centralised.of(plot).run(simulate_all(plot, 7)):
        if isinstance(message, Tracks):
            started.update(message.ids.tolist())
        elif message.kind == "confirmed":
            confirmed.add(message.track)
    return len(started), len(confirmed)


@pytest.mark.parametrize("plots", [1, 2])
def test_as_many_false_tracks_start_as_the_formula_says(plots: int) -> None:
    """In a world without targets; fewer where tracks claim plots, no more at 1 in 10,000."""
    plot = clutter(plots)
    bound = false_tracks(plot)
    assert bound is not None
    expected = bound.started * 200.0 / 86_400.0
    started, _ = started_and_confirmed(plot)
    assert started > 30
    assert 0.6 * expected < started <= poisson.ppf(1.0 - 1e-4, expected)


def test_no_more_false_tracks_are_confirmed_than_the_bound() -> None:
    """At 1 in 10,000, where a false plot lies in the gate of a track in every fourth scan."""
    plot = clutter(1, field_of_view={"shape": "disc", "radius": 600.0}, p_d=0.6)
    decision = plot.decision.model_copy(update={"p0": 0.02, "p1": 0.999})
    started, confirmed = started_and_confirmed(plot.model_copy(update={"decision": decision}))
    assert started > 500
    assert confirmed <= binom.ppf(1.0 - 1e-4, started, 0.02 / 0.999)


def test_a_sensor_that_tells_no_place_starts_no_track() -> None:
    plot = clutter(1)
    camera = sensor_table("camera", kind="bearing", sigma=[0.01], field_of_view=VIEW)
    with_camera = scenario(
        *(sensor.model_dump(exclude_none=True) for sensor in plot.sensors),
        camera,
        initiation={"speed": 20.0},
        hypothesis=[],
        target=[],
    )
    assert false_tracks(with_camera) == false_tracks(with_camera.model_copy(update={"sensors": plot.sensors}))
