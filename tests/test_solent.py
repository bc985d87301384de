"""The recorded ships: from their reports to trajectories."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

from waldnet.common.config import load_scenario
from waldnet.common.estimation.gaussian import Array
from waldnet.scenarios import catalogue
from waldnet.scenarios.solent.convert import LATITUDE, LONGITUDE, Report, main, read, smooth, to_local, trajectories
from waldnet.scenarios.trajectories import read_trajectories

FOLDER = catalogue.FOLDER / "solent"
HEAD = "Time,MMSI,Latitude_degrees,Longitude_degrees,COG_degrees,SOG_knots"
GOOD = "2016-01-12 13:02:11.218,235070762,50.7730133333333,-1.092935,157.8,5.9"
#: Metres of a degree of latitude at the origin, about.
DEGREE_M = 111_240.0


def reports(times_s: Array, metres_north: Array) -> list[Report]:
    """Reports of a ship that is so far north of the origin."""
    places = LATITUDE + metres_north / DEGREE_M
    return [Report(float(t), float(place), LONGITUDE) for t, place in zip(times_s, places, strict=True)]


def test_metres_are_those_on_the_ellipsoid() -> None:
    """Along the meridian and the parallel of the origin, 30 km away."""
    a, e2 = 6_378_137.0, 6.69437999014e-3

    def meridian(latitude: float) -> float:
        return float(a * (1.0 - e2) / (1.0 - e2 * np.sin(latitude) ** 2) ** 1.5)

    end = LATITUDE + 0.27
    arc, _ = quad(meridian, np.radians(LATITUDE), np.radians(end))
    east, north = to_local(np.array(end), np.array(LONGITUDE))
    assert arc > 30_000.0
    assert north == pytest.approx(arc, abs=0.2)
    assert east == pytest.approx(0.0, abs=1e-6)
    parallel = a / np.sqrt(1.0 - e2 * np.sin(np.radians(LATITUDE)) ** 2) * np.cos(np.radians(LATITUDE))
    east, north = to_local(np.array(LATITUDE), np.array(LONGITUDE + 0.43))
    assert east == pytest.approx(parallel * np.radians(0.43), abs=0.3)
    assert 0.0 < north < 100.0  # the parallel bends to the north


def test_a_path_is_smoothed_and_needs_few_legs() -> None:
    rng = np.random.default_rng(1)
    t = np.sort(rng.uniform(0.0, 600.0, 120))
    seconds, path = smooth(t, np.stack([5.0 * t, -3.0 * t], axis=-1) + rng.normal(0.0, 10.0, (120, 2)))
    assert len(seconds) < 60
    assert np.all(seconds == np.round(seconds))
    assert t[0] <= seconds[0] < t[0] + 1.0
    assert t[-1] - 1.0 < seconds[-1] <= t[-1]
    off = np.linalg.vector_norm(path - np.outer(seconds, [5.0, -3.0]), axis=-1)
    assert np.sqrt(np.mean(off**2)) < 7.0  # half of what the positions are off


def test_a_long_silence_ends_a_trajectory() -> None:
    t = np.concatenate([np.arange(0.0, 300.0, 10.0), np.arange(600.0, 900.0, 10.0)])
    first, second = trajectories("7", reports(t, 4.0 * t), 0.0)
    assert (first.target, second.target) == (7, 1_000_000_007)
    assert (first.times_s[0], first.times_s[-1], second.times_s[0], second.times_s[-1]) == (0.0, 290.0, 600.0, 890.0)
    np.testing.assert_allclose(second.positions[0], [0.0, 2400.0], atol=3.0)


def test_a_ship_that_stays_where_it_is_may_be_silent() -> None:
    t = np.concatenate([np.arange(0.0, 300.0, 10.0), np.arange(1200.0, 1500.0, 10.0)])
    (only,) = trajectories("7", reports(t, np.minimum(4.0 * t, 1160.0)), 0.0)
    assert only.times_s[-1] == 1490.0


def test_moored_ships_are_left_out() -> None:
    t = np.arange(0.0, 3600.0, 180.0)
    assert list(trajectories("7", reports(t, 20.0 * np.sin(t)), 0.0)) == []


def test_a_jump_is_not_believed() -> None:
    t = np.arange(0.0, 600.0, 10.0)
    north = 4.0 * t
    (clean,) = trajectories("7", reports(np.delete(t, 30), np.delete(north, 30)), 0.0)
    north[30] = 1e6
    (jumped,) = trajectories("7", reports(t, north), 0.0)
    np.testing.assert_array_equal(jumped.positions, clean.positions)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            f"{HEAD}\n{GOOD}\n{GOOD.replace('50.77', '500.77')}\n",
            ":3: Latitude_degrees: '500.7730133333333', expected deg",
        ),
        (
            f"{HEAD}\n{GOOD.replace('-1.092935', 'west')}\n",
            ":2: Longitude_degrees: 'west', expected degrees from -180 to",
        ),
        (
            f"{HEAD}\n{GOOD.replace('2016-01-12', 'noon')}\n",
            ":2: Time: 'noon 13:02:11.218', expected one like 2016-01-12",
        ),
        (f"{HEAD}\n{GOOD.replace('235070762', 'Queen')}\n", ":2: MMSI: 'Queen', expected a ship's number"),
        (f"{HEAD}\n2016-01-12 13:02:11.218,235070762\n", ":2: Latitude_degrees: None, expected degrees"),
        (f"{HEAD.replace('MMSI', 'Name')}\n{GOOD}\n", ":1: no column MMSI, expected Time, MMSI, "),
        (f"{HEAD}\n", ": no reports, expected one a line"),
    ],
)
def test_a_wrong_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, reason: str) -> None:
    path, out = tmp_path / "ships.csv", tmp_path / "truth.jsonl"
    path.write_text(text)
    assert main([str(path), "--out", str(out)]) == 1
    assert capsys.readouterr().err.startswith(f"{path}{reason}")
    assert not out.exists()


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="No such file or directory; expected ship reports as CSV"):
        read(tmp_path / "ships.csv")


@pytest.mark.skipif("WALDNET_DATA" not in os.environ, reason="WALDNET_DATA is the folder of the source data")
def test_the_shipped_file_comes_from_the_reports(tmp_path: Path) -> None:
    source = Path(os.environ["WALDNET_DATA"]) / "solent" / "SolentAIS_20160112_130211.csv"
    assert main([str(source), "--out", str(tmp_path / "truth.jsonl")]) == 0
    assert (tmp_path / "truth.jsonl").read_bytes() == (FOLDER / "truth.jsonl").read_bytes()


def test_34_ships_and_more_are_there_at_once() -> None:
    """From the third minute on, when all have reported, to the end of the scenario; no ship is faster than a ferry."""
    loaded = load_scenario(catalogue.find("solent"))
    assert loaded.simulation is not None
    times_ns = np.array([loaded.to_ns(t) for t in np.arange(180.0, loaded.simulation.duration)])
    x = np.array([trajectory.states(times_ns, 4) for trajectory in read_trajectories(loaded)])
    near = [np.linalg.vector_norm(x[..., :2] - sensor.stand(2), axis=-1) < 20_000.0 for sensor in loaded.sensors]
    assert np.any(near, axis=0).sum(axis=0).min() >= 34
    assert np.nanmax(np.linalg.vector_norm(x[..., 2:], axis=-1)) < 20.0
