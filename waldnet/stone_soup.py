"""Adapters to and from Stone Soup: detections become scans, tracks become Stone Soup's tracks.

Stone Soup is an extra: ``pip install 'waldnet[stonesoup]'``. Its times are instants without a time zone, taken as UTC.
Its states interleave: (east, v_east, north, v_north, ...). Plots are positions only, for other numbers stand in another
order and its bearings count from another direction.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta

import numpy as np
from stonesoup.types.array import CovarianceMatrix, StateVector
from stonesoup.types.detection import Detection
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track

from waldnet.common.config import Scenario
from waldnet.common.errors import ConfigError
from waldnet.library import Picture, Scan

__all__ = ["from_detections", "to_detections", "to_tracks"]


def from_detections(
    detections: Iterable[tuple[datetime, Iterable[Detection]]], sensor: str, scenario: Scenario
) -> Iterator[Scan]:
    """Make scans of the detections of one sensor.

    Args:
        detections: what a Stone Soup detector or reader yields: times, each with its detections, positions [m].
        sensor: name of the sensor in the scenario.
        scenario: gives the epoch of times.

    Yields:
        a scan for every time, plots of shape (M, d).

    Raises:
        ConfigError: when the sensor does not measure positions.
    """
    _check(sensor, scenario)
    for instant, found in detections:
        time = (_utc(instant) - scenario.epoch).total_seconds()
        yield Scan(sensor, time, [np.asarray(one.state_vector, np.float64).ravel() for one in found])


def to_detections(scans: Iterable[Scan], scenario: Scenario) -> Iterator[tuple[datetime, set[Detection]]]:
    """Make detections of scans, as a Stone Soup detector yields them.

    Args:
        scans: of sensors that measure positions, by time.
        scenario: gives the epoch of times.

    Yields:
        times, each with the detections of a scan, state vectors of shape (d, 1) [m]; the sensor is in ``metadata``.

    Raises:
        ConfigError: when a sensor does not measure positions.
    """
    for scan in scans:
        _check(scan.sensor, scenario)
        time = _instant(scan.time, scenario)
        metadata = {"sensor": scan.sensor}
        yield time, {Detection(StateVector(z), timestamp=time, metadata=metadata) for z in scan.plots}


def to_tracks(pictures: Iterable[Picture], scenario: Scenario, status: Iterable[str] = ("confirmed",)) -> set[Track]:
    """Make Stone Soup tracks of pictures.

    Args:
        pictures: from ``waldnet.replay``.
        scenario: gives the epoch of times.
        status: a track has a state at the times at which its status is one of these.

    Returns:
        the tracks, their ids those of waldnet as text; states of shape (n, 1), (n, n), position and velocity of each
        axis side by side [m, m/s].
    """
    wanted, tracks = set(status), dict[int, Track]()
    for picture in pictures:
        d = sum(not name.startswith(("v_", "a_")) for name in picture.state)
        order = np.arange(len(picture.state)).reshape(-1, d).T.ravel()
        for track in picture.tracks:
            if track.status in wanted:
                state = GaussianState(
                    StateVector(track.x[order]),
                    CovarianceMatrix(track.P[np.ix_(order, order)]),
                    timestamp=_instant(picture.time, scenario),
                )
                tracks.setdefault(track.id, Track(id=str(track.id))).append(state)
    return set(tracks.values())


def _check(sensor: str, scenario: Scenario) -> None:
    if (kind := scenario.sensor(sensor).kind) != "position":
        raise ConfigError(f"sensor {sensor}: measures {kind}, expected position: other plots are not taken over")


def _utc(instant: datetime) -> datetime:
    return instant.replace(tzinfo=UTC) if instant.tzinfo is None else instant


def _instant(time: float, scenario: Scenario) -> datetime:
    return (scenario.epoch + timedelta(seconds=time)).astimezone(UTC).replace(tzinfo=None)
