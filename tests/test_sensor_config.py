"""Sensors of all kinds in scenario files: what they become, and what is wrong with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from builders import scenario, sensor_table

from waldnet.common.config import SensorConfig, load_scenario
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.detection import Constant, Notch, Swerling
from waldnet.common.estimation.field_of_view import AllAround, Disc
from waldnet.common.estimation.polar import Bearing, Polar, PolarDoppler
from waldnet.common.estimation.sector import Sector
from waldnet.common.estimation.sensing import Measurement, Position, Sensor
from waldnet.common.estimation.sigma_points import SigmaPoint

RIGHT = 0.5 * np.pi
DISC = {"shape": "disc", "radius": 5000.0}
SECTOR = {"shape": "sector", "radius": 5000.0, "inner": 100.0, "direction": 0.5, "width": 1.2}
SWERLING = {"model": "swerling", "p_fa": 1e-4, "snr_db": 13.0, "at_range": 10_000.0}
EVERYWHERE = {"shape": "everywhere"}


def table(kind: str, sigma: list[float], **changes: Any) -> dict[str, Any]:
    return sensor_table("a", kind=kind, sigma=sigma, **{"field_of_view": DISC, **changes})


def built(entry: dict[str, Any], dimensions: int = 2) -> Sensor:
    motion = {"psd": 1.0, "dimensions": dimensions}
    plot = scenario(entry, motion=motion, hypothesis=[], target=[])
    return plot.sensors[0].build(plot.motion.build())


@pytest.mark.parametrize(
    ("dimensions", "kind", "sigma", "measurement"),
    [
        (2, "position", [5.0, 6.0], Position((5.0, 6.0), 4)),
        (2, "polar", [5.0, 0.1], Polar((5.0, 0.1), 4)),
        (3, "polar", [5.0, 0.1, 0.2], Polar((5.0, 0.1, 0.2), 6)),
        (2, "polar-doppler", [5.0, 0.1, 1.0], PolarDoppler((5.0, 0.1, 1.0), 4, 300.0)),
        (3, "polar-doppler", [5.0, 0.1, 0.2, 1.0], PolarDoppler((5.0, 0.1, 0.2, 1.0), 6, 300.0)),
        (2, "bearing", [0.1], Bearing((0.1,), 4, 2.0 * np.pi)),
        (3, "bearing", [0.1, 0.2], Bearing((0.1, 0.2), 6, 4.0 * np.pi)),
    ],
)
def test_kinds(dimensions: int, kind: str, sigma: list[float], measurement: Measurement) -> None:
    entry = table(kind, sigma, position=[0.0] * dimensions)
    assert built(entry, dimensions).measurement == measurement
    if kind != "position":
        points = built({**entry, "update": "sigma-point"}, dimensions).measurement
        assert points == SigmaPoint(measurement, dimensions, kind == "polar-doppler")


def test_numbers_of_a_plot_have_names() -> None:
    for kind, sigma, names in (
        ("position", [1.0, 1.0, 1.0], ("east", "north", "up")),
        ("polar", [1.0, 1.0], ("range", "azimuth")),
        ("polar-doppler", [1.0, 1.0, 1.0], ("range", "azimuth", "range rate")),
        ("polar-doppler", [1.0, 1.0, 1.0, 1.0], ("range", "azimuth", "elevation", "range rate")),
        ("bearing", [1.0], ("azimuth",)),
    ):
        assert SensorConfig.model_validate(table(kind, sigma)).numbers == names


def test_only_a_bearing_gives_no_position() -> None:
    kinds = get_args(SensorConfig.model_fields["kind"].annotation)
    sensors = [SensorConfig.model_validate(sensor_table(kind=kind)) for kind in kinds]
    assert {sensor.kind for sensor in sensors if not sensor.locates} == {"bearing"}


def test_a_sector_is_around_the_sensor() -> None:
    sensor = built(table("polar", [5.0, 0.1], field_of_view=SECTOR))
    assert sensor.field_of_view == Sector(5000.0, 100.0, 0.5, 1.2)
    config = SensorConfig.model_validate(table("polar", [5.0, 0.1], field_of_view=SECTOR))
    assert config.view_center(np.array([7.0, 8.0])).tolist() == [7.0, 8.0]
    high = built(table("polar", [5.0, 0.1, 0.1], position=[0.0] * 3, field_of_view={**SECTOR, "inner": 0.0}), 3)
    assert high.field_of_view == Sector(5000.0, 0.0, 0.5, 1.2, (-RIGHT, RIGHT))
    flat = {**SECTOR, "elevation": [-0.1, 0.3]}
    assert built(table("bearing", [0.1, 0.1], position=[0.0] * 3, field_of_view=flat), 3).measurement == Bearing(
        (0.1, 0.1), 6, 1.2 * (np.sin(0.3) - np.sin(-0.1))
    )


def test_a_bearing_sensor_may_see_all_around() -> None:
    entry = table("bearing", [0.1], field_of_view=EVERYWHERE)
    assert built(entry).field_of_view == AllAround(2)
    assert SensorConfig.model_validate(entry).view_center(np.array([7.0, 8.0])).tolist() == [7.0, 8.0]


def test_detection_models() -> None:
    plain = built(table("polar", [5.0, 0.1], p_d=0.7))
    assert (plain.p_d, plain.detection) == (0.7, Constant())
    swerling = table("polar", [5.0, 0.1], detection=SWERLING)
    del swerling["p_d"]
    assert (built(swerling).p_d, built(swerling).detection) == (1.0, Swerling(1e-4, 10.0**1.3, 10_000.0))
    notch = built(table("polar", [5.0, 0.1], p_d=0.7, detection={"model": "notch", "mdv": 3.0}))
    assert (notch.p_d, notch.detection) == (0.7, Notch(3.0))


def test_density_of_false_plots() -> None:
    """Per unit of plot space: a disc of 5 km, and what is left where a bearing or a speed is measured."""
    area = np.pi * 5000.0**2
    assert built(table("polar", [5.0, 0.1])).log_rho_f == pytest.approx(np.log(2.0 / area))
    fast = table("polar-doppler", [5.0, 0.1, 1.0], max_speed=100.0)
    assert built(fast).log_rho_f == pytest.approx(np.log(2.0 / area / 200.0))
    assert built(table("bearing", [0.1])).log_rho_f == pytest.approx(np.log(2.0 / (2.0 * np.pi)))
    assert built(table("bearing", [0.1], field_of_view=SECTOR)).log_rho_f == pytest.approx(np.log(2.0 / 1.2))
    assert built(table("polar", [5.0, 0.1])).field_of_view == Disc(5000.0, 2)


FROM_ITS_STAND = (
    "sensor.0.field_of_view: a bearing sensor sees from where it stands: a sector, a disc without center, or everywhere"
)
FAULTS: list[tuple[dict[str, Any], str]] = [
    ({"sigma": [5.0]}, "sensor.0.sigma: has 1 numbers, a polar plot in 2 dimensions has 2"),
    (
        {"kind": "polar-doppler"},
        "sensor.0.sigma: has 2 numbers, a polar-doppler plot in 2 dimensions has 3",
    ),
    ({"kind": "bearing"}, "sensor.0.sigma: has 2 numbers, a bearing plot in 2 dimensions has 1"),
    ({"p_d": None}, "sensor.0.p_d: is missing"),
    (
        {"detection": SWERLING},
        "sensor.0.p_d: detection 'swerling' says how probable a detection is; leave it out",
    ),
    (
        {"detection": {"model": "magic"}},
        "sensor.0.detection: model 'magic' is not one of 'constant', 'swerling', 'notch'",
    ),
    ({"detection": {"mdv": 3.0}}, "sensor.0.detection: model is missing"),
    ({"detection": {"model": "notch"}}, "sensor.0.detection.mdv: is missing"),
    ({"detection": {"model": "notch", "mdv": 0.0}}, "sensor.0.detection.mdv: 0 is not positive and finite"),
    (
        {"p_d": None, "detection": {**SWERLING, "p_fa": 1.0}},
        "sensor.0.detection.p_fa: 1 is not a probability strictly between 0 and 1",
    ),
    ({"update": "magic"}, "sensor.0.update: 'magic' is not one of 'ekf' or 'sigma-point'"),
    (
        {"kind": "position", "update": "sigma-point"},
        "sensor.0.update: 'sigma-point' is for plots that are not linear in the state; a position is",
    ),
    ({"max_speed": 10.0}, "sensor.0.max_speed: only a polar-doppler sensor has it, this one is polar"),
    ({"velocity": [1.0]}, "sensor.0.velocity: has 1 numbers, this scenario's dimensions need 2"),
    ({"heading": 90.0}, "sensor.0.heading: 90 is no angle in radians (-2 pi to 2 pi)"),
    ({"azimuth": "bow"}, "sensor.0.azimuth: 'bow' is not one of 'north' or 'heading'"),
    (
        {"kind": "position", "sigma": [5.0, 5.0], "azimuth": "heading"},
        "sensor.0.azimuth: a position has none; it is in the frame of the scenario",
    ),
    ({"field_of_view": EVERYWHERE}, "sensor.0.field_of_view.area: is missing"),
    (
        {"kind": "bearing", "sigma": [0.1], "field_of_view": {**EVERYWHERE, "area": 1.0}},
        "sensor.0.field_of_view.area: a bearing sensor has none: its false plots come from all directions alike",
    ),
    (
        {"kind": "bearing", "sigma": [0.1], "field_of_view": {**DISC, "center": [0.0, 0.0]}},
        FROM_ITS_STAND,
    ),
    (
        {"kind": "bearing", "sigma": [0.1], "field_of_view": {"shape": "box", "size": [1.0, 1.0]}},
        FROM_ITS_STAND,
    ),
    (
        {"field_of_view": {**SECTOR, "direction": 90.0}},
        "sensor.0.field_of_view.direction: 90 is no angle in radians (-2 pi to 2 pi)",
    ),
    (
        {"field_of_view": {**SECTOR, "width": 60.0}},
        "sensor.0.field_of_view.width: 60 is no span of azimuths in radians (above 0, up to 2 pi)",
    ),
    (
        {"field_of_view": {**SECTOR, "inner": 6000.0}},
        "sensor.0.field_of_view.inner: 6000 is not below the radius, 5000",
    ),
    ({"field_of_view": {**SECTOR, "center": [0.0, 0.0]}}, "sensor.0.field_of_view.center: is no known key"),
    (
        {"field_of_view": {**SECTOR, "elevation": [0.0, 0.1]}},
        "sensor.0.field_of_view.elevation: this scenario has two dimensions",
    ),
]


def toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(entry)}" for key, entry in value.items()) + " }"
    return json.dumps(value)


def faults(folder: Path, changes: dict[str, Any], head: str = "motion = { psd = 1.0 }") -> list[str]:
    """The faults of a file with one polar sensor, changed."""
    entry = {**table("polar", [5.0, 0.1]), **changes}
    path = folder / "bad.toml"
    lines = [f"{key} = {toml(value)}" for key, value in entry.items() if value is not None]
    path.write_text("\n".join(['name = "bad"', head, "[[sensor]]", *lines, ""]))
    with pytest.raises(ConfigError) as caught:
        load_scenario(path)
    return [line.removeprefix(f"{path}: ") for line in str(caught.value).split("\n")]


@pytest.mark.parametrize(("changes", "fault"), FAULTS, ids=[fault.split(": ")[0] for _, fault in FAULTS])
def test_a_fault_is_named(tmp_path: Path, changes: dict[str, Any], fault: str) -> None:
    assert faults(tmp_path, changes) == [fault]


def test_faults_of_elevations(tmp_path: Path) -> None:
    solid = {"sigma": [5.0, 0.1, 0.1], "position": [0.0, 0.0, 0.0]}
    head = "motion = { psd = 1.0, dimensions = 3 }"
    view = "sensor.0.field_of_view"
    found = faults(tmp_path, {**solid, "field_of_view": {**SECTOR, "elevation": [0.2, 0.1]}}, head)
    assert found == [f"{view}.elevation: 0.2 is not below 0.1"]
    found = faults(tmp_path, {**solid, "field_of_view": {**SECTOR, "elevation": [0.0, 45.0]}}, head)
    assert found == [f"{view}.elevation.1: 45 is no elevation in radians (-pi/2 to pi/2)"]


def test_dkf_needs_covariances_that_are_known_without_data(tmp_path: Path) -> None:
    head = 'motion = { psd = 1.0 }\nfusion = { mode = "dkf", association = "factor" }'
    assert faults(tmp_path, {}, head) == [
        "fusion.mode: 'dkf' needs covariances known without data; those of sensor.0, polar, are not"
    ]
    notch = {"kind": "position", "sigma": [5.0, 5.0], "detection": {"model": "notch", "mdv": 3.0}}
    assert faults(tmp_path, notch, head) == [
        "fusion.mode: 'dkf' needs a constant detection probability; sensor.0 has detection 'notch'"
    ]


def test_what_is_written_with_few_digits_is_a_full_circle() -> None:
    entry = table("polar", [5.0, 0.1], field_of_view={**SECTOR, "width": 6.2832})
    assert built(entry).field_of_view == Sector(5000.0, 100.0, 0.5, 2.0 * np.pi)
