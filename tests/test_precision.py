"""Reports in single precision lose nothing that matters, wherever the network lies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builders import live_as_replayed, only, scenario, sensor_table
from numpy.typing import NDArray

from waldnet.common.config import Scenario
from waldnet.common.messages import Scan, Tracks
from waldnet.offline.replay import Replay
from waldnet.scenarios.precision_check import precision_faults
from waldnet.scenarios.scenario_check import scenario_findings
from waldnet.scenarios.world import simulate_all

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


def spread_out(extent: float, precision: str = "float32", mode: str = "federated") -> Scenario:
    """Two targets at the ends of a network, whose sensors measure to a metre."""
    view = {"shape": "box", "size": [extent, 0.5 * extent], "center": [0.0, 0.0]}
    sensors = [
        sensor_table(
            name, position=[0.0, 0.0], sigma=[1.0, 1.0], false_plots=1.0, scan_interval=0.1, field_of_view=view
        )
        for name in "ab"
    ]
    ends = [[sign * (0.5 * extent - 100.0), 0.0, 0.0, 0.5] for sign in (-1.0, 1.0)]
    return scenario(
        *sensors,
        motion={"psd": 0.05},
        simulation={"duration": 10.0},
        decision={"enabled": False},
        hypothesis=[{"state": end, "sigma": [3.0, 3.0, 1.0, 1.0]} for end in ends],
        target=[{"hypothesis": 0}, {"hypothesis": 1}],
        fusion={"precision": precision, "mode": mode},
    )


#: The largest network across which steps are 1/32 m.
HELD = np.nextafter(np.float32(2.0**19), np.float32(0.0)).item()


@pytest.mark.parametrize("mode", ["federated", "selected"])
def test_what_is_not_warned_of_loses_nothing(mode: str) -> None:
    plot = spread_out(HELD, mode=mode)
    assert list(precision_faults(plot)) == []
    scans = simulate_all(plot, 2)
    single, double = last(plot, scans), last(spread_out(HELD, "float64", mode), scans)
    assert np.abs(single.log_lr_total - double.log_lr_total).max() < 0.1


def test_a_network_too_large_for_single_precision_is_warned_of() -> None:
    (first, _) = found = scenario_findings(spread_out(1.01 * HELD))
    assert str(first) == (
        "fusion.precision: single precision keeps positions of this network, which is 5.3e+05 m across, to 0.062 m, "
        'and sensor a measures them to 1 m: evidence is lost with every scan. Set precision = "float64".'
    )
    assert all(finding.spoils for finding in found)
    assert scenario_findings(spread_out(1.01 * HELD, "float64")) == []


def test_where_recorded_sensors_stood_counts() -> None:
    table = sensor_table("a", field_of_view={"shape": "disc", "radius": 80.0}, sigma=[0.05, 0.05], position=[0.0, 0.0])
    plot = scenario(table, fusion={"precision": "float32"}, hypothesis=[])
    scans = [Scan("a", plot.to_ns(1.0 + i), np.array([east, 0.0]), np.empty((0, 2))) for i, east in enumerate((0, 1e5))]
    assert not list(precision_faults(plot, scans[:1]))
    assert len(list(precision_faults(plot, scans))) == 1


@pytest.mark.parametrize(
    ("changes", "tables", "name"),
    [
        ({"sigma": [0.05, 1e-5]}, {"fusion": {"precision": "float32", "mode": "selected"}}, "azimuth"),
        ({"sigma": [0.05, 1e-5]}, {"initiation": {"speed": 1.0}}, "azimuth"),
        ({"sigma": [0.05, 1e-5]}, {}, None),
        ({"sigma": [0.0005, 1e-4]}, {"initiation": {"speed": 1.0}}, "range"),
        ({"sigma": [0.05, 1e-4]}, {"initiation": {"speed": 1.0}}, None),
    ],
)
def test_plots_that_are_sent_as_they_are_are_looked_at(
    changes: dict[str, Any], tables: dict[str, Any], name: str | None
) -> None:
    disc = {"shape": "disc", "radius": 300.0}
    table = sensor_table("a", kind="polar", field_of_view=disc, **changes)
    plot = scenario(table, **{"fusion": {"precision": "float32"}, "hypothesis": []} | tables)
    faults = [fault for fault in precision_faults(plot) if "of a plot" in fault]
    assert [f"the {name} of a plot" in fault for fault in faults] == ([True] if name else [])
