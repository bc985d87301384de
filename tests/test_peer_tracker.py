"""The peer of the benchmarks: it sees what we see, and writes tracks that are judged as ours are."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import scenario, sensor_table
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.types.state import GaussianState

from waldnet.benchmarks.peer_models import detections_of, eyes_of, instant, start_of, x_of
from waldnet.benchmarks.peer_tracker import PeerTracker, Settings, changed, run, tuned
from waldnet.benchmarks.real_runs import shorter, table, track, variants
from waldnet.benchmarks.real_truth import rules_of, times_of, truth_of
from waldnet.common.config import Scenario, load_scenario
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import Scan
from waldnet.evaluation.evaluation import Rules, judge
from waldnet.evaluation.paths import targets_at
from waldnet.evaluation.runs import read_run
from waldnet.scenarios.catalogue import find
from waldnet.scenarios.truth import Whereabouts
from waldnet.sensor_node.sources import all_scans

SETTINGS = Settings(min_points=4, holding_s=5.0, deleter_s=6.0, max_sigma_m=100.0)
#: A sensor stands here, and a target is there.
STAND, X = np.array([100.0, -50.0]), np.array([-300.0, 450.0, 7.0, -3.0])
VIEW = {"shape": "disc", "radius": 5000.0}
KINDS = {"position": [7.0, 9.0], "polar": [7.0, 0.02], "bearing": [0.02]}


def watched(kind: str, **changes: Any) -> Scenario:
    table = sensor_table("a", kind=kind, sigma=KINDS[kind], field_of_view=VIEW, position=STAND.tolist(), **changes)
    return scenario(table, motion={"psd": 0.1}, initiation={"speed": 5.0})


def seen(network: Scenario, x: Array, time_s: float = 2.0) -> Scan:
    """A scan with a plot of each state, without noise."""
    measurement = network.sensors[0].build(network.motion.build()).measurement
    return Scan("a", network.to_ns(time_s), STAND, measurement.observe(np.atleast_2d(x), STAND))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("way", range(8))
def test_a_plot_without_noise_is_where_the_peer_expects_it(kind: str, way: int) -> None:
    """In all directions: the conventions of angles and the order of numbers agree."""
    network = watched(kind)
    angle = way * np.pi / 4.0 + 0.1
    x = np.array([*(STAND + 300.0 * np.array([np.cos(angle), np.sin(angle)])), 7.0, -3.0])
    eye, scan = eyes_of(network)["a"], seen(network, x)
    (detection,) = detections_of(eye, scan, instant(network, scan.time_ns))
    state = GaussianState(x[[0, 2, 1, 3], None], np.diag([400.0, 4.0, 400.0, 4.0]), timestamp=detection.timestamp)
    expected = eye.updater.predict_measurement(state, detection.measurement_model)
    innovation = (detection.state_vector - expected.state_vector).astype(float)
    np.testing.assert_allclose(innovation, 0.0, atol=1e-9)
    prediction = GaussianStatePrediction(state.state_vector, state.covar, timestamp=detection.timestamp)
    updated = eye.updater.update(SingleHypothesis(prediction, detection, expected))
    np.testing.assert_allclose(x_of(updated), x, atol=1e-6)


def test_a_bearing_moves_a_track_across_the_line_of_sight_only() -> None:
    """The plot is a little clockwise of where the track is expected, north of the sensor: the track moves east."""
    network = watched("bearing")
    eye = eyes_of(network)["a"]
    scan = Scan("a", network.to_ns(2.0), STAND, np.array([[0.02]]))
    (detection,) = detections_of(eye, scan, instant(network, scan.time_ns))
    at = np.array([STAND[0], 0.0, STAND[1] + 400.0, 0.0])[:, None]
    prediction = GaussianStatePrediction(at, np.diag([100.0, 4.0, 100.0, 4.0]), timestamp=detection.timestamp)
    east, north, *_ = x_of(eye.updater.update(SingleHypothesis(prediction, detection)))
    assert 2.0 < east - STAND[0] < 8.0
    assert abs(north - at[2, 0]) < 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_false_plots_are_as_dense_as_the_scenario_says(kind: str) -> None:
    """The density over the space of plots sums up to the false plots of a scan."""
    network = watched(kind, false_plots=3.0)
    eye = eyes_of(network)["a"]
    r, azimuth = np.meshgrid(np.linspace(12.5, 4987.5, 200), np.linspace(-np.pi, np.pi, 8, endpoint=False))
    z = {"position": STAND + np.zeros((1, 2)), "bearing": azimuth[:, :1]}
    z["polar"] = np.stack([r, azimuth], axis=-1).reshape(-1, 2)
    cell = {"position": np.pi * 5000.0**2, "bearing": np.pi / 4.0, "polar": 25.0 * np.pi / 4.0}[kind]
    scan = Scan("a", network.to_ns(2.0), STAND, z[kind])
    density = [each.metadata["density"] for each in detections_of(eye, scan, instant(network, scan.time_ns))]
    assert np.sum(density) * cell == pytest.approx(3.0, rel=1e-3)


def straight(network: Scenario, starts: Array, scans: int = 25) -> Iterator[Scan]:
    """Plots of targets that go straight, each missed now and then, and two false ones a scan."""
    rng = np.random.default_rng(1)
    measurement = network.sensors[0].build(network.motion.build()).measurement
    for k in range(1, scans + 1):
        x = starts + k * np.concatenate([starts[:, 2:], np.zeros((len(starts), 2))], axis=-1)
        true = measurement.observe(x[rng.random(len(x)) < 0.9], STAND)
        noisy = true + rng.normal(0.0, network.sensors[0].sigma, true.shape)
        false = measurement.observe(rng.uniform(-2000.0, 2000.0, (2, 4)), STAND)
        yield Scan("a", network.to_ns(float(k)), STAND, np.concatenate([noisy, false]))


@pytest.mark.parametrize("kind", ["position", "polar"])
def test_two_targets_are_found_and_judged(kind: str, tmp_path: Path) -> None:
    network = watched(kind)
    starts = np.array([[-300.0, 450.0, 7.0, -3.0], [500.0, -400.0, -5.0, 5.0]])
    lines = list(run(network, list(straight(network, starts)), SETTINGS))
    file = tmp_path / "peer.jsonl"
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    found = read_run(file, 2)
    times_s = np.arange(1.0, 26.0)
    truth = {number: Whereabouts(times_s, x[:2] + times_s[:, None] * x[2:]) for number, x in enumerate(starts)}
    summary = judge(found, targets_at(truth, times_s, 5.0, 2), times_s, Rules(30.0)).summary()
    assert summary["confirmed_targets"] == 2
    assert summary["held_share"] > 0.7
    assert summary["rmse_m"] < 12.0
    assert (summary["breaks"], summary["swaps"], summary["false_tracks"]) == (0, 0, 0)
    assert {line["status"] for line in lines} == {"tentative", "confirmed"}


def test_a_track_is_where_it_goes_between_scans_and_ends() -> None:
    network = watched("position")
    tracker = PeerTracker(network, SETTINGS)
    for k in range(1, 7):
        tracker.scan(seen(network, X + k * np.array([*X[2:], 0.0, 0.0]), float(k)))
    (line,) = tracker.lines(network.to_ns(6.5))
    assert line["status"] == "confirmed"
    np.testing.assert_allclose(line["x"][:2], X[:2] + 6.5 * X[2:], atol=4.0)
    nothing = (Scan("a", network.to_ns(float(k)), STAND, np.empty((0, 2))) for k in count(7))
    for scan in nothing:
        tracker.scan(scan)
        if not list(tracker.lines(scan.time_ns)):
            break
    assert network.to_seconds(scan.time_ns) == pytest.approx(6.0 + SETTINGS.deleter_s, abs=1.0)


def test_outside_the_field_of_view_a_track_is_not_missed() -> None:
    """A track whose sensor cannot see it is as sure as it was."""
    near = sensor_table("b", sigma=[7.0, 9.0], field_of_view={"shape": "disc", "radius": 50.0}, p_d=0.99)
    wide = sensor_table("a", sigma=[7.0, 9.0], field_of_view=VIEW)
    network = scenario(wide, near, motion={"psd": 0.1}, initiation={"speed": 5.0})
    with_b, without_b = PeerTracker(network, SETTINGS), PeerTracker(network, SETTINGS)
    for k in range(1, 9):
        plot = (X + k * np.array([*X[2:], 0.0, 0.0]))[None, :2]
        for tracker in (with_b, without_b):
            tracker.scan(Scan("a", network.to_ns(float(k)), STAND, plot))
        with_b.scan(Scan("b", network.to_ns(k + 0.5), STAND, np.empty((0, 2))))
    (one,), (other,) = (list(tracker.lines(network.to_ns(9.0))) for tracker in (with_b, without_b))
    np.testing.assert_allclose(one["x"], other["x"], atol=1e-6)


def test_settings_are_told_on_the_command_line() -> None:
    assert changed(Settings(), ["min_points=7", "bearings=steer", "p_d=0.5"]) == Settings(
        min_points=7, bearings="steer", p_d=0.5
    )
    assert tuned(watched("position")) == tuned(load_scenario(find("autoferry-2-all")))


def test_what_the_peer_cannot_is_said() -> None:
    network = watched("position")
    doppler = sensor_table("a", kind="polar-doppler", sigma=[7.0, 0.02, 1.0], field_of_view=VIEW)
    with pytest.raises(ConfigError, match="a: the peer knows no plots of kind 'polar-doppler'"):
        eyes_of(scenario(doppler))
    faster = network.model_copy(update={"motion": network.motion.model_copy(update={"model": "ca"})})
    with pytest.raises(ConfigError, match="test: the peer tracks with constant velocity in two dimensions"):
        eyes_of(faster)
    assert start_of(network).covar[1, 1] == 25.0


def test_the_ferry_in_other_ways(tmp_path: Path) -> None:
    whole = load_scenario(find("autoferry-2-all"))
    others = {name: load_scenario(path) for name, path in variants(whole, find("autoferry-2-all"), tmp_path).items()}
    assert others.pop("waldnet") == whole
    assert [sensor.clutter_map for sensor in others["waldnet, no clutter maps"].sensors] == [None] * 4
    assert [others[f"waldnet, {name}"].decision.p0 for name in ("late", "latest")] == [1e-10, 1e-30]
    assert all(len(all_scans(other)) for other in others.values())
    bare = others["waldnet, no bearings"]
    assert bare.sensor_names == ("radar", "lidar")
    assert bare.recording is not None
    assert bare.recording.ignore == ("daylight", "infrared")


def test_simulated_scenarios_are_shortened(tmp_path: Path) -> None:
    assert shorter(find("autoferry-2-all"), tmp_path) == find("autoferry-2-all")
    short = load_scenario(shorter(find("solent"), tmp_path))
    assert short.simulation is not None
    assert short.simulation.duration == 600.0
    assert short.sensors == load_scenario(find("solent")).sensors
    assert short.name == "solent"


def test_truths_of_recorded_and_of_simulated_scenarios() -> None:
    ferry, ships = load_scenario(find("autoferry-2-all")), load_scenario(find("solent"))
    assert sorted(truth_of(ferry)) == [1, 2]
    known = truth_of(ships)
    assert len(known) > 36
    assert (rules_of(ferry).cutoff_m, rules_of(ships).cutoff_m) == (30.0, 100.0)
    scans = [Scan("calshot", ships.to_ns(t), np.zeros(2), np.empty((0, 2))) for t in (2.0, 1.0, 2.0, 1e6)]
    assert times_of(ships, scans, known).tolist() == [1.0, 2.0]


def test_tracks_are_kept_as_long_as_they_hold(tmp_path: Path) -> None:
    """A tracker's lines are written anew, unless they depend on what they did."""

    def said(text: str, kept_for: str | None) -> str:
        file, cpu_s = track("Stone Soup, early", [sys.executable, "-c", f"print({text!r})"], tmp_path, kept_for)
        assert file.name == "stone-soup-early.jsonl"
        assert cpu_s > 0.0
        return file.read_text().strip()

    assert said("one", "a") == "one"
    assert said("two", "a") == "one"
    assert said("three", "b") == "three"
    assert said("four", None) == "four"


def test_a_table_says_all_measures_and_a_dash_for_none() -> None:
    nothing = dict.fromkeys(("confirmed_after_s", "confirmed_after_radar_scans", "held_share", "rmse_m"))
    parts = dict.fromkeys(("total", "localisation", "missed", "false", "cardinality"), 1.0)
    counts = dict.fromkeys(("targets", "confirmed_targets", "breaks", "swaps", "confirmed_tracks"), 0)
    tracks = {"false_tracks": 0, "duplicates": 0, "false_tracks_per_minute": 0.5, "near_no_target": 0.25, "cpu_s": 12.0}
    summary = {**nothing, **counts, **tracks, "gospa_m": parts, "ospa2_m": parts}
    head, _, *rows = table({"one": summary, "two": {**summary, "rmse_m": 3.25}})
    assert head == "| | one | two |"
    assert "| RMSE while held [m] | - | 3.2 |" in rows
    assert "| &nbsp;&nbsp;after [radar scans] | - | - |" in rows
    assert rows[-1] == "| computing time [s] | 12 | 12 |"
