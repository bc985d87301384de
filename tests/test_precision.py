"""Reports in single precision lose nothing that matters, wherever the network lies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builders import live_as_replayed, only, scenario, sensor_table
from numpy.typing import NDArray

from common.config import Scenario
from common.messages import Scan, Tracks
from scenarios.world import simulate_all
from studies.replay import Replay

Array = NDArray[np.float64]
UTM = np.array([388_100.2, 3_949_000.1])
KINDS: dict[str, dict[str, Any]] = {
    "position": {"sigma": [0.05, 0.05]},
    "polar": {"kind": "polar", "sigma": [0.05, 0.001]},
}
SPREAD = 20.0


def network(kind: str, at: Array, **tables: Any) -> Scenario:
    """Two sensors that know a target within centimetres, somewhere."""
    sensors = [
        sensor_table(
            name,
            position=(at + offset).tolist(),
            p_d=0.9,
            false_plots=1.0,
            scan_interval=0.1,
            field_of_view={"shape": "disc", "radius": 80.0},
            **KINDS[kind],
        )
        for name, offset in (("a", np.array([-SPREAD, 0.0])), ("b", np.array([0.0, SPREAD])))
    ]
    target = {"state": [*at.tolist(), 1.0, 0.5], "sigma": [1.0, 1.0, 1.0, 1.0]}
    plain = {"motion": {"psd": 0.05}, "simulation": {"duration": 6.0}, "decision": {"enabled": False}}
    hypotheses = {"hypothesis": [target], "target": [{"hypothesis": 0}]}
    return scenario(*sensors, **plain | hypotheses | tables)


def last(plot: Scenario, scans: list[Scan]) -> Tracks:
    return only(Tracks, Replay(plot, scans).run())[-1]


FUSIONS = [
    {"mode": "federated"},
    {"mode": "federated", "feedback": "reset"},
    {"association": "mirrored", "terms": 3},
    {"mode": "selected"},
    {"mode": "naive"},
]


@pytest.mark.parametrize("fusion", FUSIONS, ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_log_lr_of_single_precision_is_that_of_double_wherever_the_network_lies(
    kind: str, fusion: dict[str, Any]
) -> None:
    scans = simulate_all(network(kind, UTM), 1)
    double, single = (
        last(network(kind, UTM, fusion=fusion | {"precision": precision}), scans)
        for precision in ("float64", "float32")
    )
    assert double.log_lr_total[0] > 100.0
    assert 0.0 < abs(single.log_lr_total[0] - double.log_lr_total[0]) < 0.1
    assert np.abs(single.x - double.x).max() < 1e-3


@pytest.mark.parametrize("mode", ["federated", "selected"])
@pytest.mark.parametrize("kind", KINDS)
def test_tracks_start_where_they_start_in_double_precision(kind: str, mode: str) -> None:
    tables = {"initiation": {"speed": 2.0}, "hypothesis": [], "target": [{"state": [*UTM.tolist(), 1.0, 0.5]}]}
    scans = simulate_all(network(kind, UTM, **tables), 2)
    double, single = (
        last(network(kind, UTM, fusion={"mode": mode, "precision": precision}, **tables), scans)
        for precision in ("float64", "float32")
    )
    assert single.ids.tolist() == double.ids.tolist()
    best = double.log_lr_total.argmax()
    assert double.log_lr_total[best] > 50.0
    assert abs(single.log_lr_total[best] - double.log_lr_total[best]) < 0.1


@pytest.mark.parametrize("mode", ["federated", "selected"])
@pytest.mark.parametrize("kind", KINDS)
def test_live_is_replay_to_the_bit_in_single_precision(kind: str, mode: str) -> None:
    plot = network(kind, UTM, fusion={"mode": mode, "precision": "float32"}, initiation={"speed": 2.0})
    live_as_replayed(plot, simulate_all(plot, 3))
