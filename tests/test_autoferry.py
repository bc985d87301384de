"""The converter of the recorded ferry: the format traps of its source, on a dataset of three scans."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from scenarios.autoferry.convert import main

SHIP = [-16.0, -390.0]  # north, east


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
