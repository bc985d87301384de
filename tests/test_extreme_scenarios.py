"""Whatever numbers a scenario has, it is refused with a reason or it can be played: never a traceback."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cyclopts import App
from hypothesis import given, settings
from hypothesis import strategies as st

from waldnet.common.config import load_scenario
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.gaussian import are_positive_definite, settled_whitener
from waldnet.common.process import main
from waldnet.launch.cli import app

SCANS = 4


def to_toml(value: Any) -> str:
    """A value as TOML has it, in one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {to_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(to_toml, value)) + "]"
    return json.dumps(value) if not isinstance(value, float) else repr(value)


def write(folder: Path, tables: dict[str, Any]) -> Path:
    path = folder / "extreme.toml"
    path.write_text("".join(f"{key} = {to_toml(value)}\n" for key, value in tables.items()))
    return path


def magnitudes(low: float, high: float, *usual: float) -> st.SearchStrategy[float]:
    """The ends, what is usual, and everything between by its order."""
    orders = st.floats(np.log10(low), np.log10(high)).map(lambda order: float(np.clip(10.0**order, low, high)))
    return st.one_of(st.sampled_from([low, high, *usual]), st.sampled_from(usual or (low,)), orders)


SIZE = magnitudes(1e-6, 1e9, 1.0, 50.0)
SIGNED = st.builds(
    lambda size, sign: size * sign, magnitudes(1e-6, 1e9, 1.0, 1000.0), st.sampled_from([-1.0, 0.0, 1.0])
)
DURATION = magnitudes(1e-6, 4e9, 1.0, 10.0)
PROBABILITY = st.sampled_from([0.0, 1e-300, 1e-9, 0.5, 0.9, 1.0 - 2.0**-53, 1.0])
INNER = st.sampled_from([1e-300, 1e-9, 0.01, 0.5, 0.95, 1.0 - 2.0**-53])


@st.composite
def views(draw: st.DrawFn, kind: str, d: int) -> dict[str, Any]:
    shapes = ["disc"] + (["sector"] if d == 2 else []) + ([] if kind == "bearing" else ["box", "everywhere"])
    shape = draw(st.sampled_from(shapes))
    if shape == "disc":
        return {"shape": shape, "radius": draw(SIZE)}
    if shape == "box":
        return {"shape": shape, "size": [draw(SIZE) for _ in range(d)], "center": [draw(SIGNED) for _ in range(d)]}
    if shape == "everywhere":
        return {"shape": shape, "area": draw(magnitudes(1e-18, 1e27, 1e6))}
    angles = {"direction": draw(st.floats(-6.28, 6.28)), "width": draw(magnitudes(1e-300, 6.28, 1.0))}
    return {"shape": shape, "radius": draw(SIZE), **angles}


@st.composite
def sensors(draw: st.DrawFn, name: str, d: int, interval: float) -> dict[str, Any]:
    kind = draw(st.sampled_from(["position", "polar", "polar-doppler", "bearing"]))
    size = d + {"polar-doppler": 1, "bearing": -1}.get(kind, 0)
    table = {
        "name": name,
        "kind": kind,
        "sigma": [draw(SIZE) for _ in range(size)],
        "position": [draw(SIGNED) for _ in range(d)],
        "false_plots": draw(magnitudes(1e-12, 5.0, 1.0)),
        "scan_interval": interval,
        "field_of_view": draw(views(kind, d)),
    }
    match draw(st.sampled_from(["constant", "swerling", "notch"])):
        case "swerling":
            detection = {
                "p_fa": draw(INNER),
                "snr_db": draw(st.sampled_from([-300.0, -1.0, 10.0, 300.0])),
                "at_range": draw(SIZE),
            }
            return table | {"detection": {"model": "swerling", **detection}}
        case "notch":
            table["detection"] = {"model": "notch", "mdv": draw(SIZE)}
    table["p_d"] = draw(PROBABILITY)
    if kind == "polar-doppler":
        table["max_speed"] = draw(SIZE)
    if draw(st.booleans()):
        table["visibility"] = {"visible_for": draw(DURATION), "hidden_for": draw(DURATION)}
    if draw(st.booleans()):
        table["clutter_map"] = {
            "cell": draw(magnitudes(1e-6, 1.5, 1.0)),
            "memory": draw(DURATION),
            "shape": draw(magnitudes(1e-15, 1e15, 0.1)),
        }
    return table


@st.composite
def scenarios(draw: st.DrawFn) -> dict[str, Any]:
    d = draw(st.sampled_from([2, 2, 3]))
    model = draw(st.sampled_from(["cv", "ca", "ct"]))
    n = d * (3 if model == "ca" else 2)
    motion = {"model": model, "dimensions": d, "psd": draw(st.one_of(st.just(0.0), magnitudes(1e-15, 1e15, 1.0)))}
    if model == "ct":
        motion["turn_rate"] = draw(SIGNED)
    interval = draw(DURATION)
    fusion = draw(
        st.sampled_from(
            [
                {},
                {"mode": "naive"},
                {"mode": "selected"},
                {"association": "factor"},
                {"association": "mirrored", "terms": 3},
                {"feedback": "advice"},
                {"feedback": "reset"},
                {"precision": "float32"},
                {"mode": "selected", "precision": "float32"},
            ]
        )
    )
    states = [{"state": [draw(SIGNED) for _ in range(n)], "sigma": [draw(SIZE) for _ in range(n)]} for _ in range(2)]
    tables = {
        "name": "extreme",
        "motion": motion,
        "fusion": fusion,
        "decision": draw(st.sampled_from([{}, {"p0": 1e-300, "p1": 1.0 - 2.0**-53}, {"enabled": False}])),
        "simulation": {"duration": min(SCANS * interval, 4e9)},
        "sensor": [draw(sensors(name, d, interval)) for name in "ab"],
        "hypothesis": states,
        "target": [{"hypothesis": 0}, {"state": states[1]["state"]}],
    }
    if draw(st.booleans()):
        speeds = {"speed": draw(SIZE), "acceleration": draw(SIZE)}
        merging = {"merge": draw(magnitudes(1e-15, 1e15, 0.5)), "plots": draw(st.sampled_from([1, 2]))}
        tables["initiation"] = {**speeds, **merging, "within": min(5.0 * interval, 10.0), "tentative": 20}
    return tables


PLAIN = {
    "name": "extreme",
    "motion": {"psd": 1.0},
    "simulation": {"duration": 10.0},
    "sensor": [
        {
            "name": "a",
            "sigma": [10.0, 10.0],
            "p_d": 0.9,
            "false_plots": 1.0,
            "field_of_view": {"shape": "disc", "radius": 1000.0},
        }
    ],
    "hypothesis": [{"state": [0.0, 0.0, 1.0, 0.0], "sigma": [10.0, 10.0, 1.0, 1.0]}],
    "initiation": {"speed": 1.0},
}
BEYOND = [
    (("hypothesis", 0, "sigma", 0), 1e200, "hypothesis.0.sigma.0: 1e+200 is not between 1e-06 and 1e+09"),
    (("hypothesis", 0, "sigma", 1), 1e-200, "hypothesis.0.sigma.1: 1e-200 is not between 1e-06 and 1e+09"),
    (("hypothesis", 0, "state", 0), 1e200, "hypothesis.0.state.0: 1e+200 is not between -1e+09 and 1e+09"),
    (("motion", "psd"), 1e200, "motion.psd: 1e+200 is not between 0 and 1e+15"),
    (("sensor", 0, "sigma", 0), 2e9, "sensor.0.sigma.0: 2e+09 is not between 1e-06 and 1e+09"),
    (("sensor", 0, "position"), [0.0, -1e10], "sensor.0.position.1: -1e+10 is not between -1e+09 and 1e+09"),
    (("sensor", 0, "false_plots"), 6e4, "sensor.0.false_plots: 60000 is not between 1e-12 and 50000"),
    (("sensor", 0, "false_plots"), 1e-300, "sensor.0.false_plots: 1e-300 is not between 1e-12 and 50000"),
    (("sensor", 0, "scan_interval"), 1e-10, "sensor.0.scan_interval: 1e-10 is not between 1e-06 and 4e+09"),
    (
        ("simulation", "duration"),
        2e9,
        "sensor.0.scan_interval: 1 s makes 2e+09 scans in the 2e+09 s of the simulation, expected at most 1e+07",
    ),
    (
        ("sensor", 0, "field_of_view", "radius"),
        1e155,
        "sensor.0.field_of_view.radius: 1e+155 is not between 1e-06 and 1e+09",
    ),
    (
        ("sensor", 0, "field_of_view"),
        {"shape": "everywhere", "area": 1e30},
        "sensor.0.field_of_view.area: 1e+30 is not between 1e-18 and 1e+27",
    ),
    (("initiation", "speed"), 1e100, "initiation.speed: 1e+100 is not between 1e-06 and 1e+09"),
    (("initiation", "merge"), 1e300, "initiation.merge: 1e+300 is not between 0 and 1e+15"),
    (("fusion",), {"hold_back": 1e12}, "fusion.hold_back: 1e+12 is not between 0 and 4e+09"),
]


@pytest.mark.parametrize(("where", "value", "fault"), BEYOND)
def test_a_number_beyond_its_bounds_is_named(tmp_path: Path, where: tuple[Any, ...], value: Any, fault: str) -> None:
    tables = json.loads(json.dumps(PLAIN))
    table = tables
    for key in where[:-1]:
        table = table[key]
    table[where[-1]] = value
    path = write(tmp_path, tables)
    with pytest.raises(ConfigError) as caught:
        load_scenario(path)
    assert str(caught.value) == f"{path}: {fault}"


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@settings(deadline=None, derandomize=True, database=None, max_examples=60)
@given(scenarios())
def test_a_scenario_is_refused_or_played(tmp_path_factory: pytest.TempPathFactory, tables: dict[str, Any]) -> None:
    path = write(tmp_path_factory.mktemp("extreme"), tables)
    for command in (["check"], ["replay"], ["replay", "--centralised"]):
        errors = io.StringIO()
        with redirect_stdout(io.StringIO()), redirect_stderr(errors), pytest.raises(SystemExit) as ended:
            main(app, [*command, str(path)])
        assert ended.value.code in (None, 0, 1)
        assert (ended.value.code == 1) <= bool(errors.getvalue())
        assert "Traceback" not in errors.getvalue()


def test_densities_beyond_double_precision_are_said(capsys: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        raise np.linalg.LinAlgError("a matrix is not positive definite")

    failing = App()
    failing.default(fail)
    with pytest.raises(SystemExit) as ended:
        main(failing, [])
    assert ended.value.code == 1
    assert capsys.readouterr().err.startswith("a matrix is not positive definite: double precision cannot hold")


@pytest.mark.parametrize("count", [1, 3, 20])
def test_a_covariance_that_rounding_made_singular_is_settled(count: int) -> None:
    """A position known to a millimetre and a speed to a kilometre a second, after an hour: their correlation is 1."""
    F, sharp = np.array([[1.0, 3600.0], [0.0, 1.0]]), np.diag([1e-6, 1e6])
    P = np.tile(F @ sharp @ F.T, (count, 1, 1))
    P[0] = np.diag([4.0, 9.0])
    if count > 1:
        assert not are_positive_definite(P)[1:].any()
    settled, W, half = settled_whitener(P)
    assert np.array_equal(settled[0], P[0])
    np.testing.assert_allclose(settled, P, rtol=1e-12)
    np.testing.assert_allclose(W[0], np.diag([0.5, 1 / 3]))
    assert np.isfinite(half).all()
    with pytest.raises(np.linalg.LinAlgError):
        settled_whitener(np.diag([1.0, -1.0])[None])
