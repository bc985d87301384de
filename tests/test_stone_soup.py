"""Adapters to and from Stone Soup."""

from __future__ import annotations

import numpy as np
import pytest
from builders import scenario, sensor_table

import waldnet
from waldnet.stone_soup import from_detections, to_detections, to_tracks

PLOT = scenario(sensor_table("a"))


def sorted_plots(scan: waldnet.Scan) -> list[list[float]]:
    return sorted(scan.plots.tolist())


def test_scans_come_back_from_detections() -> None:
    """Detections of a time are a set; times are kept to the microsecond."""
    scans = waldnet.simulate(PLOT, seed=1)
    back = list(from_detections(to_detections(scans, PLOT), "a", PLOT))
    assert [scan.time for scan in back] == [scan.time for scan in scans]
    assert list(map(sorted_plots, back)) == list(map(sorted_plots, scans))
    assert any(len(scan.plots) for scan in scans)
    for time, detections in to_detections(scans, PLOT):
        assert time.tzinfo is None
        assert {one.metadata["sensor"] for one in detections} <= {"a"}


def test_tracks_have_the_states_of_the_pictures() -> None:
    pictures = list(waldnet.replay(PLOT, waldnet.simulate(PLOT, seed=1)))
    (track,) = to_tracks(pictures, PLOT)
    ours = [picture.tracks[0] for picture in pictures if picture.tracks[0].status == "confirmed"]
    assert (track.id, len(track)) == ("0", len(ours))
    for state, one in zip(track, ours, strict=True):
        np.testing.assert_array_equal(np.asarray(state.state_vector).ravel(), one.x[[0, 2, 1, 3]])
        assert state.covar[1, 1] == one.P[2, 2]
        assert state.covar[0, 1] == one.P[0, 2]
    every = to_tracks(pictures, PLOT, status=("tentative", "confirmed"))
    assert sum(map(len, every)) == len(pictures)


def test_plots_of_other_sensors_are_refused() -> None:
    plot = waldnet.load_scenario("mixed-sensors")
    other = next(sensor.name for sensor in plot.sensors if sensor.kind != "position")
    with pytest.raises(waldnet.ConfigError, match=f"sensor {other}: measures .*, expected position"):
        list(from_detections([], other, plot))
