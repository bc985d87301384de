"""The recorded radar of a ship under way: what is shipped, how it is measured, and that its network finds the boat."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from builders import live_as_replayed

from waldnet.benchmarks.real_halves import changed
from waldnet.common.config import load_scenario
from waldnet.common.estimation.sprt import CONFIRMED
from waldnet.common.messages import Tracks
from waldnet.offline.replay import Replay
from waldnet.scenarios import catalogue
from waldnet.scenarios.joyride import measure
from waldnet.scenarios.truth import read_truth
from waldnet.sensor_node.sources import all_scans

FOLDER = catalogue.FOLDER / "joyride"
FILES = {"joyride.jsonl": "joyride.jsonl", "joyride-truth.jsonl": "joyride-truth.jsonl", "LICENSE": "LICENSE-CC0"}


@pytest.mark.skipif("WALDNET_DATA" not in os.environ, reason="WALDNET_DATA is the folder of the source data")
@pytest.mark.parametrize("name", FILES)
def test_the_shipped_files_are_those_of_the_source(name: str) -> None:
    source = Path(os.environ["WALDNET_DATA"]) / "joyride" / FILES[name]
    assert (FOLDER / name).read_bytes() == source.read_bytes()


def test_the_tables_are_what_is_measured() -> None:
    assert measure.tables(FOLDER) in (FOLDER / "README.md").read_text()


def test_the_settings_are_those_of_the_first_half() -> None:
    first = measure.parts(measure.compare(FOLDER))["first half"]
    (radar,) = load_scenario(catalogue.find("joyride")).sensors
    assert {key: getattr(radar, key) for key in ("sigma", "p_d", "false_plots")} == measure.settings(first)


def test_the_radar_is_measured_beside_the_boat(tmp_path: Path) -> None:
    """The ship goes east, the boat north, 300 m north of where the ship began."""
    truth = [{"target": 1, "time": t, "position": [0.0, 300.0 + t]} for t in (0.0, 10.0)]
    plots = [[[3.0, 296.0], [900.0, 0.0]], [[-40.0, 300.0], [5.0, 304.0]], [[49.0, 302.0]], [[51.0, 303.0]], []]
    scans = [
        {"sensor": "radar", "time": float(k), "position": [float(10 * k), 0.0], "plots": seen}
        for k, seen in enumerate(plots)
    ]
    for name, lines in (("joyride-truth.jsonl", truth), ("joyride.jsonl", scans)):
        (tmp_path / name).write_text("".join(json.dumps(line) + "\n" for line in lines))
    seen = measure.compare(tmp_path)
    np.testing.assert_allclose(seen.errors[:3], [[3.0, -4.0], [5.0, 3.0], [49.0, 0.0]])
    assert seen.found.tolist() == [True, True, True, False, False]
    np.testing.assert_allclose(seen.boat[1], [-10.0, 301.0])
    np.testing.assert_allclose(seen.ranges[0], [np.hypot(3.0, 296.0), 900.0])
    sigma = tuple(np.sqrt([(9.0 + 25.0 + 49.0**2) / 3.0, (16.0 + 9.0) / 3.0]).round().tolist())
    assert measure.settings(seen) == {"sigma": sigma, "p_d": 0.6, "false_plots": 0.6}
    assert [len(part.times_s) for part in measure.parts(seen).values()] == [2, 3, 5]


def test_a_plot_to_the_right_of_the_boat_has_a_positive_azimuth_error() -> None:
    east = measure.Comparison(
        np.arange(2.0), np.array([[0.0, 100.0]] * 2), np.array([[2.0, 0.0]] * 2), (np.ones(1),) * 2
    )
    assert measure._errors(east)[-1] == "0.020"


def test_the_network_finds_the_boat_and_holds_it() -> None:
    """Within five turns of the radar a confirmed track is nearer than 50 m, and after that nearly always."""
    plot = load_scenario(catalogue.find("joyride"))
    (boat,) = read_truth(FOLDER / "joyride-truth.jsonl").values()
    near = {}
    for picture in Replay(plot, all_scans(plot)).run():
        if isinstance(picture, Tracks):
            time_s = plot.to_seconds(picture.time_ns)
            there = [np.interp(time_s, boat.times_s, axis) for axis in boat.positions.T]
            offsets = picture.x[picture.status == CONFIRMED, :2] - there
            near[time_s] = bool((np.linalg.vector_norm(offsets, axis=-1) < 50.0).any())
    assert any(held for time_s, held in near.items() if time_s <= 12.6)
    assert np.mean([held for time_s, held in near.items() if time_s > 12.6]) > 0.8


def test_a_node_on_a_moving_ship_says_what_the_replay_says() -> None:
    plot = load_scenario(catalogue.find("joyride"))
    scans = [scan for scan in all_scans(plot) if scan.time_ns <= plot.to_ns(150.0)]
    assert len({tuple(scan.position) for scan in scans}) > 40
    assert len(live_as_replayed(plot, scans).pictures) == len(scans)


def test_settings_are_changed_for_one_half_and_nothing_else() -> None:
    plot = load_scenario(catalogue.find("joyride"))
    other = changed(plot, 7.0, {"sigma": (1.0, 2.0), "p_d": 0.5, "false_plots": 2.0})
    assert other.motion.psd == 7.0
    assert (other.sensors[0].sigma, other.sensors[0].p_d, other.sensors[0].false_plots) == ((1.0, 2.0), 0.5, 2.0)
    same = {key: getattr(plot.sensors[0], key) for key in ("sigma", "p_d", "false_plots")}
    assert changed(other, plot.motion.psd, same) == plot
