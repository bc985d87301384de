"""The motion table: every model is built, and every combination of keys that says nothing is named."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from waldnet.common.config import load_scenario
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.imm import Imm
from waldnet.common.estimation.motion import ConstantAcceleration, ConstantVelocity, CoordinatedTurn, Motion
from waldnet.scenarios.world import truth

REST = """
name = "motions"
[[sensor]]
name = "a"
sigma = [5.0, 5.0]
p_d = 0.9
false_plots = 1.0
field_of_view = { shape = "disc", radius = 1000.0 }
[simulation]
duration = 20.0
"""
TURNS = """
model = "imm"
psd = 30.0
sojourn = 25.0
[[motion.models]]
psd = 0.5
[[motion.models]]
model = "ct"
psd = 1.5
turn_rate = 0.1
"""


def file(tmp_path: Path, motion: str, rest: str = REST) -> Path:
    path = tmp_path / "scenario.toml"
    path.write_text(f"{rest}\n[motion]\n{motion}")
    return path


def faults(tmp_path: Path, motion: str, rest: str = REST) -> list[str]:
    path = file(tmp_path, motion, rest)
    with pytest.raises(ConfigError) as caught:
        load_scenario(path)
    return [line.removeprefix(f"{path}: ") for line in str(caught.value).split("\n")]


def target(count: int) -> str:
    return f"{REST}\n[[target]]\nstate = {[0.0] * count}"


@pytest.mark.parametrize(
    ("motion", "expected"),
    [
        ("psd = 3", ConstantVelocity(2, 3.0)),
        ('model = "ca"\npsd = 0.5', ConstantAcceleration(2, 0.5)),
        ('model = "ct"\npsd = 0.5\nturn_rate = -0.1', CoordinatedTurn(2, 0.5, -0.1)),
        ('model = "ct"\npsd = 0.5\nturn_rate = 0', CoordinatedTurn(2, 0.5, 0.0)),
        (
            'model = "imm"\nsojourn = 9.0\nmodels = [{ psd = 1.0 }, { model = "ct", psd = 2.0, turn_rate = 0 }]',
            Imm.of((ConstantVelocity(2, 1.0), CoordinatedTurn(2, 2.0, 0.0)), 9.0),
        ),
        (TURNS, Imm.of((ConstantVelocity(2, 0.5), CoordinatedTurn(2, 1.5, 0.1)), 25.0, 30.0)),
        (
            'model = "imm"\nsojourn = 9.0\nmodels = [{ model = "ca", psd = 0 }, { model = "ca", psd = 5.0 }]',
            Imm.of((ConstantAcceleration(2, 0.0), ConstantAcceleration(2, 5.0)), 9.0),
        ),
    ],
)
def test_a_model_is_built(tmp_path: Path, motion: str, expected: Motion) -> None:
    built = load_scenario(file(tmp_path, motion)).motion.build()
    assert built == expected
    assert type(built) is type(expected)


@pytest.mark.parametrize(
    ("motion", "expected"),
    [
        ('model = "ca"', ["motion.psd: is missing"]),
        ('model = "ca"\npsd = 1.0\nturn_rate = 0.1', ["motion.turn_rate: is of model = 'ct', not of 'ca'"]),
        ('model = "ct"', ["motion.psd: is missing", "motion.turn_rate: is missing"]),
        ('model = "ct"\npsd = 1.0\nturn_rate = inf', ["motion.turn_rate: inf is not finite"]),
        (
            'model = "ct"\npsd = 1.0\nturn_rate = 0.1\nsojourn = 3.0',
            ["motion.sojourn: is of model = 'imm', not of 'ct'"],
        ),
        ('model = "imm"', ["motion.models: is missing", "motion.sojourn: is missing"]),
        (TURNS.replace("25.0", "0.0"), ["motion.sojourn: 0 is not positive and finite"]),
        (
            TURNS.replace("psd = 30.0\n", ""),
            [
                "motion.psd: is missing; the models turn at different rates, and the single model that stands for all "
                "where only one can be had needs a psd that covers them"
            ],
        ),
        (f"turn_rate = 1.0{TURNS}", ["motion.turn_rate: with model = 'imm' every entry of motion.models has its own"]),
        (TURNS.replace("turn_rate = 0.1", ""), ["motion.models.1.turn_rate: is missing"]),
        (TURNS.replace("psd = 0.5", ""), ["motion.models.0.psd: is missing"]),
        (
            TURNS.replace("psd = 0.5", "psd = 0.5\nturn_rate = 1.0"),
            ["motion.models.0.turn_rate: is of model = 'ct', not of 'cv'"],
        ),
        (TURNS.replace('"ct"', '"imm"'), ["motion.models.1.model: 'imm' is not one of 'cv', 'ca' or 'ct'"]),
        (TURNS.replace("psd = 1.5", "psd = 1.5\nsojourn = 3.0"), ["motion.models.1.sojourn: is no known key"]),
        (
            'model = "imm"\nsojourn = 9.0\nmodels = [{ psd = 1.0 }]',
            ["motion.models: got [{'psd': 1.0}]: tuple should have at least 2 items after validation, not 1"],
        ),
        (
            'model = "imm"\nsojourn = 9.0\nmodels = [{ psd = 1.0 }, { model = "ca", psd = 1.0 }]',
            ["motion.models: the state of 'ca' has accelerations, that of 'cv' and 'ct' none; all must share one"],
        ),
    ],
)
def test_a_combination_that_says_nothing_is_named(tmp_path: Path, motion: str, expected: list[str]) -> None:
    assert sorted(faults(tmp_path, motion)) == expected


@pytest.mark.parametrize(
    ("motion", "count"),
    [
        ("psd = 1.0", 4),
        ("psd = 1.0\ndimensions = 2", 4),
        ('model = "ca"\npsd = 1.0', 6),
        ('model = "ct"\npsd = 1.0\nturn_rate = 0.1', 4),
        (TURNS, 4),
        ('model = "imm"\nsojourn = 9.0\nmodels = [{ model = "ca", psd = 0 }, { model = "ca", psd = 5.0 }]', 6),
    ],
)
def test_a_state_has_the_numbers_of_its_model(tmp_path: Path, motion: str, count: int) -> None:
    scenario = load_scenario(file(tmp_path, motion, target(count)))
    assert scenario.motion.build().n == count
    x = truth(scenario, 1).x
    assert x.shape == (1, 20, count)
    assert np.isfinite(x).all()
    for wrong in (count - 1, count + 2):
        assert faults(tmp_path, motion, target(wrong)) == [
            f"target.0.state: has {wrong} numbers, this scenario's dimensions and motion need {count}"
        ]


def test_the_motion_of_the_how_to_is_one(tmp_path: Path) -> None:
    text = (Path(__file__).parent.parent / "docs/how-to/first-network.md").read_text()
    table = next(block for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL) if "imm" in block)
    built = load_scenario(file(tmp_path, table.removeprefix("[motion]\n"))).motion.build()
    assert isinstance(built, Imm)
    assert [type(model) for model in built.models] == [ConstantVelocity, CoordinatedTurn, CoordinatedTurn]


def test_a_target_of_several_models_changes_between_them(tmp_path: Path) -> None:
    """Without noise it flies straight or turns by 0.1 rad/s, and in 200 s of 25 s each it does both."""
    motion = TURNS.replace("psd = 0.5", "psd = 0.0").replace("psd = 1.5", "psd = 0.0")
    rest = target(4).replace("20.0", "200.0").replace("[0.0, 0.0, 0.0, 0.0]", "[0.0, 0.0, 50.0, 0.0]")
    scenario = load_scenario(file(tmp_path, motion, rest))
    x = truth(scenario, 3).x[0]
    np.testing.assert_allclose(np.hypot(x[:, 2], x[:, 3]), 50.0, rtol=1e-12)
    turned = np.diff(np.unwrap(np.arctan2(x[:, 3], x[:, 2])))
    straight, turning = np.isclose(turned, 0.0), np.isclose(turned, 0.1)
    assert straight.sum() > 10
    assert turning.sum() > 10
    # All other seconds have a change within.
    assert 0 < (~straight & ~turning).sum() < 30
    np.testing.assert_array_equal(truth(scenario, 3).x[0], x)
