"""The recorded ferry: the format traps of its source on a dataset of three scans, and how its sensors are measured."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from builders import live_as_replayed

from waldnet.common.config import Scenario, load_scenario
from waldnet.common.messages import Tracks
from waldnet.offline.replay import Replay
from waldnet.scenarios import catalogue
from waldnet.scenarios.autoferry import measure
from waldnet.scenarios.autoferry.convert import SCENARIOS, main
from waldnet.scenarios.truth import read_truth
from waldnet.sensor_node.sources import all_scans

FOLDER = catalogue.FOLDER / "autoferry"
SHIP = [-16.0, -390.0]  # north, east
SQUARE = {1: [10.0, 120.0], 2: [110.0, 20.0]}


def dataset(folder: Path, *measurements: object, sensor: int = 2) -> Path:
    scans = [
        {
            "sensorID": sensor,
            "time": 1000.5 + k,
            "ownshipPosition": SHIP,
            "measurements": [],
            "measurement": measurement,
        }
        for k, measurement in enumerate(measurements)
    ]
    truth = [[{"targetID": 1, "position": [84.0, -354.0, 0], "time": 1000.25}] for _ in scans]
    (folder / "scenario7_detections.json").write_text(json.dumps(scans))
    (folder / "scenario7_groundTruth.json").write_text(json.dumps(truth))
    return folder


def convert(folder: Path) -> list[dict[str, object]]:
    assert main([str(folder), "--scenario", "7", "--out", str(folder)]) == 0
    return [json.loads(line) for line in (folder / "scenario7.jsonl").read_text().splitlines()]


def test_plots_come_in_three_forms(tmp_path: Path) -> None:
    """Two rows of norths and easts, a flat pair for one plot, and nothing for none: a miss, not a gap."""
    scans = convert(dataset(tmp_path, [[1.0, 2.0, 3.0], [10.0, 20.0, 30.0]], [5.0, -7.0], []))
    assert [scan["plots"] for scan in scans] == [
        [[-380.0, -15.0], [-370.0, -14.0], [-360.0, -13.0]],
        [[-397.0, -11.0]],
        [],
    ]
    assert [scan["time"] for scan in scans] == [0.5, 1.5, 2.5]
    assert {scan["sensor"] for scan in scans} == {"radar"}
    assert all(scan["position"] == [-390.0, -16.0] for scan in scans)


def test_two_plots_are_no_flat_pair(tmp_path: Path) -> None:
    (scan,) = convert(dataset(tmp_path, [[1.0, 2.0], [10.0, 20.0]], sensor=1))
    assert scan["sensor"] == "lidar"
    assert scan["plots"] == [[-380.0, -15.0], [-370.0, -14.0]]


def test_truth_is_there_once(tmp_path: Path) -> None:
    convert(dataset(tmp_path, [], []))
    lines = (tmp_path / "scenario7-truth.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == [{"target": 1, "time": 0.25, "position": [-354.0, 84.0]}]


def test_a_wrong_measurement_is_named_and_nothing_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset(tmp_path, [[1.0, 2.0], [10.0]])
    assert main([str(tmp_path), "--scenario", "7", "--out", str(tmp_path)]) == 1
    assert "scenario7_detections.json: entry 0: " in capsys.readouterr().err
    assert not (tmp_path / "scenario7.jsonl").exists()


@pytest.mark.parametrize(("number", "name"), [(3, "daylight"), (4, "infrared")])
def test_bearings_come_in_three_forms(tmp_path: Path, number: int, name: str) -> None:
    """A list, a bare number for one bearing, and an empty list for none: a miss, not a gap."""
    scans = convert(dataset(tmp_path, [0.4212120053, -2.1709064241], -2.2054613959, [], sensor=number))
    assert [scan["plots"] for scan in scans] == [[[0.42121], [-2.17091]], [[-2.20546]], []]
    assert {scan["sensor"] for scan in scans} == {name}


@pytest.mark.parametrize("measurement", [121.0, [0.1, "0.2"], [[0.1], [0.2]], None])
def test_a_wrong_bearing_is_named(tmp_path: Path, measurement: object, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(dataset(tmp_path, measurement, sensor=3)), "--scenario", "7", "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "scenario7_detections.json: entry 0: measurement: " in said
    assert "expected radians" in said


@pytest.mark.skipif("WALDNET_DATA" not in os.environ, reason="WALDNET_DATA is the folder of the source data")
def test_the_shipped_files_come_from_the_dataset(tmp_path: Path) -> None:
    assert main([str(Path(os.environ["WALDNET_DATA"]) / "autoferry"), "--out", str(tmp_path)]) == 0
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert made == {path.name: path.read_bytes() for path in FOLDER.glob("*.jsonl")}


def test_the_tables_are_what_is_measured() -> None:
    assert measure.tables(FOLDER) in (FOLDER / "README.md").read_text()


def test_a_boat_is_measured_where_it_is(tmp_path: Path) -> None:
    """Two boats 100 m away, north and east: the camera sees the eastern one, beside it and nothing."""
    truth = [{"target": n, "time": t, "position": place} for n, place in SQUARE.items() for t in (0.0, 3.0)]
    bearings = [[[1.58], [0.8]], [[1.60], [-3.0]], []]
    scans = [
        {"sensor": "infrared", "time": 1.0 + k, "position": [10.0, 20.0], "plots": plots}
        for k, plots in enumerate(bearings)
    ]
    for name, lines in (("scenario7-truth.jsonl", truth), ("scenario7.jsonl", scans)):
        (tmp_path / name).write_text("".join(json.dumps(line) + "\n" for line in lines))
    looks = measure.compare(tmp_path, 7, "infrared")
    assert [look.false_plots for look in looks] == [1, 1, 0]
    north, east = zip(*(look.boats for look in looks), strict=True)
    assert [boat.error for boat in north] == [None] * 3
    assert east[2].error is None
    errors = [boat.error.item() for boat in east[:2] if boat.error is not None]
    assert errors == pytest.approx([1.58 - math.pi / 2, 1.60 - math.pi / 2])
    assert {boat.range for boat in (*north, *east)} == {100.0}


def test_bearings_point_at_the_boats() -> None:
    """Mirrored or turned, they would find the boats by chance only."""
    found = [boat.error for look in measure.compare(FOLDER, 5, "infrared") for boat in look.boats if boat.number == 2]
    errors = [float(error[0]) for error in found if error is not None]
    assert len(errors) > 0.8 * len(found)
    assert abs(sum(errors) / len(errors)) < 0.02


@pytest.mark.parametrize("number", SCENARIOS)
def test_all_four_sensors_are_there(number: int) -> None:
    loaded = load_scenario(catalogue.find(f"autoferry-{number}-all"))
    assert loaded.sensor_names == ("radar", "lidar", "daylight", "infrared")
    assert {scan.sensor for scan in all_scans(loaded)} == set(loaded.sensor_names)


def nearness(plot: Scenario, number: int, until_s: float) -> Iterator[dict[int, list[bool]]]:
    """After every measurement time, which boats each confirmed track is closer to than 30 m."""
    boats = read_truth(FOLDER / f"scenario{number}-truth.jsonl").values()
    scans = [scan for scan in all_scans(plot) if scan.time_ns <= plot.to_ns(until_s)]
    for picture in Replay(plot, scans).run():
        if isinstance(picture, Tracks):
            time_s, confirmed = plot.to_seconds(picture.time_ns), picture.status == 1
            there = np.array([[np.interp(time_s, boat.times_s, axis) for axis in boat.positions.T] for boat in boats])
            near = np.linalg.norm(picture.x[confirmed, None, :2] - there, axis=-1) < 30.0
            yield dict(zip(picture.ids[confirmed].tolist(), near.tolist(), strict=True))


def most_held(pictures: Iterable[dict[int, list[bool]]]) -> int:
    """How many boats are held at a time."""
    return max(sum(map(any, zip(*near.values(), strict=True))) for near in pictures)


@pytest.mark.parametrize("number", [2, 3, 5])
def test_in_open_water_the_network_finds_both_boats_itself(number: int) -> None:
    """Within ten scans of the radar, 17 s, both are held by confirmed tracks at the same time."""
    plot = load_scenario(catalogue.find(f"autoferry-{number}-all"))
    assert most_held(nearness(plot, number, 17.0)) == 2


def test_in_the_canal_maps_leave_less_than_a_third_of_the_false_tracks() -> None:
    """And both boats are held at the same time, as without them."""
    plot = load_scenario(catalogue.find("autoferry-13-all"))
    bare = tuple(sensor.model_copy(update={"clutter_map": None}) for sensor in plot.sensors)
    false = []
    for variant in (plot, plot.model_copy(update={"sensors": bare})):
        pictures = list(nearness(variant, 13, 118.0))
        assert most_held(pictures) == 2
        held = {track for near in pictures for track, boats in near.items() if any(boats)}
        false.append(len({track for near in pictures for track in near} - held))
    assert false[0] < false[1] / 3


def test_four_nodes_on_a_bus_say_what_the_replay_says() -> None:
    """In lockstep, with all that this scenario has: starts, maps, visibility, bearings, advice."""
    plot = load_scenario(catalogue.find("autoferry-13-all"))
    scans = [scan for scan in all_scans(plot) if scan.time_ns <= plot.to_ns(45.0)]
    live = live_as_replayed(plot, scans)
    assert len(live.pictures) > 50
