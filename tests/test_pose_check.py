"""Velocities of sensors that do not fit their positions: each mistake is found, nothing right is blamed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from builders import scenario, sensor_table

from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import Scan
from waldnet.launch.checks import findings
from waldnet.scenarios.pose_check import pose_findings

DISC = {"shape": "disc", "radius": 2000.0}
PLOT = scenario(sensor_table("a", kind="polar-doppler", sigma=[5.0, 0.01, 0.2], field_of_view=DISC))


def drive(change: Callable[[Array], Array] = np.copy, seconds: float = 60.0, noise_m: float = 0.05) -> list[Scan]:
    """A sensor on a car in a bend of 200 m radius, ten scans a second, its position known to some centimetres."""
    rng, t = np.random.default_rng(1), np.arange(0.0, seconds, 0.1)
    angle = 0.7 + 15.0 * t / 200.0
    places = 200.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1) + rng.normal(0.0, noise_m, (len(t), 2))
    velocities = change(15.0 * np.stack([-np.sin(angle), np.cos(angle)], axis=-1))
    nothing = np.empty((0, 3))
    return [
        Scan("a", PLOT.to_ns(time), *rest)
        for time, *rest in zip(t, places, [nothing] * len(t), velocities, strict=True)
    ]


@pytest.mark.parametrize(
    ("change", "reading"),
    [
        (
            lambda v: 3.6 * v,
            "its velocity says 54 m/s, and the two differ by 38.8 m/s (medians). Read as km/h it would fit",
        ),
        (lambda v: v / 0.514444, "Read as knots it would fit."),
        (lambda v: v[:, ::-1], "Read as north before east it would fit."),
        (lambda v: -v, "Read as of the ground relative to the sensor it would fit."),
        (lambda v: np.tile([0.0, 15.0], (len(v), 1)), "(medians). Range rates are read with the velocity"),
    ],
    ids=["km/h", "knots", "axes", "sign", "frame of the car"],
)
def test_a_velocity_that_does_not_fit(change: Callable[[Array], Array], reading: str) -> None:
    (found,) = pose_findings(PLOT, drive(change))
    assert str(found).startswith("sensor a: its positions move with 1")
    assert reading in str(found)
    assert found in findings(PLOT, drive(change))


@pytest.mark.parametrize(
    ("change", "seconds", "noise_m"),
    [
        (np.copy, 60.0, 0.05),
        (np.copy, 60.0, 2.0),
        (np.copy, 3.0, 0.05),
        (np.zeros_like, 60.0, 0.05),
        (lambda v: np.empty((len(v), 0)), 60.0, 0.05),
        (lambda v: v + 0.3, 60.0, 0.05),
    ],
    ids=["right", "positions of a bad receiver", "short", "over ground", "not told", "a little off"],
)
def test_a_velocity_that_fits(change: Callable[[Array], Array], seconds: float, noise_m: float) -> None:
    assert list(pose_findings(PLOT, drive(change, seconds, noise_m))) == []


def test_one_scan_is_no_way() -> None:
    assert list(pose_findings(PLOT, drive()[:1])) == []
