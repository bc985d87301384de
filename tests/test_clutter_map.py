"""Maps of false plots in a network: things that stand still, and what is not let start or confirm for them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import Node, Stage, live_as_replayed, scenario, sensor_table

from waldnet.common.config import Scenario, load_scenario
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.clutter_map import ClutterMap, log_relative
from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import Report, Scan, Tracks
from waldnet.offline.replay import Replay
from waldnet.scenarios.world import simulate, simulate_all
from waldnet.studies.plan import Order, check

MAP = {"cell": 100.0, "memory": 120.0, "shape": 3e-3, "start_below": 10.0}
OWN = {"false_plots": 60.0, "sigma": [50.0, 50.0]}
#: Two rows of buoys, and a boat that passes between them.
BUOYS = [{"position": [800.0 * k - 4000.0, north], "p_d": 0.6} for k in range(8) for north in (1500.0, -1500.0)]
T0_NS = scenario().epoch_ns
BOAT = {"state": [-3000.0, 0.0, 40.0, 0.0]}


def harbour(learned: dict[str, Any] | None = MAP, *more: dict[str, Any], **tables: Any) -> Scenario:
    own = {} if learned is None else {"clutter_map": learned}
    sensors = [sensor_table("a", **OWN, **own), sensor_table("b", first_scan=1.0, **OWN, **own)]
    content = {
        "motion": {"psd": 1e-3},
        "decision": {"p0": 1e-6, "p1": 0.9999},
        "initiation": {"speed": 30.0},
        "simulation": {"duration": 60.0},
        "hypothesis": [],
        "target": [BOAT],
        "clutter_source": BUOYS,
    }
    return scenario(*sensors, *more, **content | tables)


def confirmed(plot: Scenario, seed: int) -> dict[int, Array]:
    """Where confirmed tracks were, all their states."""
    paths: dict[int, list[Array]] = {}
    for message in Replay(plot, simulate_all(plot, seed)).run():
        if isinstance(message, Tracks):
            for row in np.nonzero(message.status == 1)[0]:
                paths.setdefault(int(message.ids[row]), []).append(message.x[row])
    return {track: np.array(path) for track, path in paths.items()}


def split(paths: dict[int, Array]) -> tuple[int, int]:
    """How many confirmed tracks there were of the boat, and of what is none."""
    of_the_boat = sum(bool((np.abs(path[:, 1]) < 300.0).mean() > 0.5) for path in paths.values())
    return of_the_boat, len(paths) - of_the_boat


def test_of_buoys_fewer_tracks_are_confirmed_and_the_boat_is_as_before() -> None:
    without, with_map = (np.array([split(confirmed(harbour(own), seed)) for seed in (1,)]) for own in (None, MAP))
    assert (without[:, 0] >= 1).all()
    assert (with_map[:, 0] >= 1).all()
    assert without[:, 1].sum() >= 12
    assert with_map[:, 1].sum() < without[:, 1].sum() / 3


def test_live_and_replayed_networks_with_maps_say_the_same_in_lockstep() -> None:
    camera = sensor_table(
        "c",
        kind="bearing",
        sigma=[0.02],
        p_d=0.7,
        false_plots=1.0,
        field_of_view={"shape": "everywhere"},
        clutter_map={"cell": 0.05, "memory": 10.0},
    )
    plot = harbour(MAP, camera, simulation={"duration": 20.0}, fusion={"feedback": "advice"})
    scans = simulate_all(plot, 5)
    live_as_replayed(plot, scans)


def given(**tables: Any) -> Scenario:
    """One sensor with a map, and one track, told of."""
    own = sensor_table("a", p_d=0.9, false_plots=1.0, sigma=[30.0, 30.0], clutter_map=MAP)
    return scenario(own, **{"motion": {"psd": 1e-3}} | tables)


def node_of(plot: Scenario) -> Node:
    return Node(plot, "a", Stage(plot).join_all()["a"])


def own_map(node: Node) -> ClutterMap:
    (seen,) = node.state.maps
    assert seen is not None
    return seen


def relative(node: Node, place: list[float]) -> float:
    (model,) = [node.tracker.sights[0].clutter]
    assert model is not None
    return float(np.exp(log_relative(own_map(node), model, np.array([place]), np.array([3000.0, 0.0])))[0])


def seen_at(node: Node, time_s: float, *plots: list[float]) -> Report:
    z = np.array(plots).reshape(-1, 2)
    return node.scan(Scan("a", T0_NS + round(time_s * 1e9), np.array([3000.0, 0.0]), z))


def test_a_target_that_is_tracked_hardly_counts_and_what_nobody_claims_does() -> None:
    plot = given()
    node = node_of(plot)
    for k in range(1, 16):
        seen_at(node, 2.0 * k, [300.0 * k, 0.0], [-2000.0, 3000.0])
    # Where it was tracked already; the buoy of as many plots in one place is far denser.
    assert max(relative(node, [300.0 * k, 0.0]) for k in range(8, 16)) < 3.0
    assert relative(node, [-2000.0, 3000.0]) > 100.0


def test_what_a_track_claims_that_stands_still_is_learned_where_targets_move() -> None:
    still = [{"state": [0.0, 0.0, 0.0, 0.0], "sigma": [100.0, 100.0, 20.0, 20.0]}]
    learned = []
    for min_speed in (0.0, 20.0):
        node = node_of(given(hypothesis=still, target=[], initiation={"speed": 30.0, "min_speed": min_speed}))
        for k in range(1, 16):
            seen_at(node, 2.0 * k, [0.0, 0.0])
        learned.append(relative(node, [0.0, 0.0]))
    assert learned[1] > 3.0 * learned[0]


def test_a_scan_is_judged_by_earlier_ones_and_keeps_its_judgement() -> None:
    plot = given()
    node = node_of(plot)
    for k in range(1, 4):
        before = relative(node, [-2000.0, 3000.0])
        seen_at(node, 2.0 * k, [-2000.0, 3000.0])
        kept = node.state.recent[-1].plots.log_relative
        assert kept is not None
        assert np.exp(kept) == pytest.approx([before])
    first = node.state.recent[0].plots.log_relative
    assert first is not None
    assert first.tolist() == [0.0]


def test_a_track_that_comes_late_is_told_what_it_would_have_been_in_time() -> None:
    plot = given(fusion={"joint": False})
    start = Stage(plot).join_all()["a"]
    prompt, late = Node(plot, "a", start), Node(plot, "a")
    reports = []
    for k in range(1, 5):
        for node in (prompt, late):
            if node is late and k == 4:
                late.start(start)
            # Of a target that passes a buoy: far enough that neither claims the other's plots.
            reports.append(seen_at(node, 2.0 * k, [300.0 * k, 0.0], [-2000.0, 3000.0]))
    # The late node's map took the target's plots for false ones, so only what lies elsewhere is the same.
    assert relative(prompt, [-2000.0, 3000.0]) == pytest.approx(relative(late, [-2000.0, 3000.0]))
    np.testing.assert_allclose(reports[-1].x, reports[-2].x, atol=30.0)
    assert reports[-1].log_g == pytest.approx(reports[-2].log_g, abs=4.0)


def test_a_node_that_begins_anew_has_learned_nothing() -> None:
    node = node_of(given())
    assert not len(own_map(node).cells)
    assert not len(own_map(node).scans)


def test_plots_of_cluttered_places_start_no_tracks() -> None:
    plot = harbour(target=[])
    node = Node(plot, "a")
    started = [len(seen_at(node, 2.0 * k, [500.0, 500.0]).unclaimed) for k in range(1, 6)]
    assert started[0] == 1
    assert started[-1] == 0


def test_without_a_map_nothing_is_kept_of_one() -> None:
    node = Node(harbour(None), "a")
    assert node.state.maps == (None, None)
    seen_at(node, 2.0, [500.0, 500.0])
    assert node.state.maps == (None, None)
    assert node.state.recent[-1].plots.log_relative is None


# Simulated


def test_clutter_sources_are_seen_as_often_as_they_say_by_whom_they_say() -> None:
    source = {"position": [1000.0, 1000.0], "p_d": 0.3, "sensors": ["a"]}
    plot = harbour(clutter_source=[source], target=[], simulation={"duration": 4000.0})
    near = {
        name: sum(
            (np.linalg.norm(scan.z - [1000.0, 1000.0], axis=-1) < 150.0).sum() for scan in simulate(plot, name, 3)
        )
        for name in ("a", "b")
    }
    # In 2000 scans; 21 of the uniform ones lie there too. Four standard deviations each.
    assert abs(near["a"] - 621) < 4.0 * np.sqrt(2000 * 0.3 * 0.7 + 21)
    assert near["b"] < 21 + 4.0 * np.sqrt(21)


def test_beyond_the_field_of_view_a_source_is_not_seen() -> None:
    source = {"position": [50_000.0, 0.0], "p_d": 1.0}
    without, with_source = (harbour(clutter_source=sources, target=[]) for sources in ([], [source]))
    far = [scan.z[:, 0].max(initial=0.0) for scan in simulate_all(with_source, 3)]
    assert max(far) < 20_000.0
    assert len(simulate_all(without, 3)) == len(far)


HEAD = """
name = "coast"
[motion]
psd = 1.0
[[sensor]]
name = "a"
sigma = [5.0, 5.0]
p_d = 0.9
false_plots = 1.0
field_of_view = { shape = "disc", radius = 1000.0 }
"""
CAMERA = """
[[sensor]]
name = "b"
kind = "bearing"
sigma = [0.02]
p_d = 0.9
false_plots = 1.0
field_of_view = { shape = "everywhere" }
"""


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (HEAD + "clutter_map = {}", "sensor.0.clutter_map.cell: is missing"),
        (HEAD + "clutter_map = { cell = 0.0 }", "sensor.0.clutter_map.cell: 0 is not positive and finite"),
        (
            HEAD + "clutter_map = { cell = 10.0, memory = -1 }",
            "sensor.0.clutter_map.memory: -1 is not positive and finite",
        ),
        (
            HEAD + "clutter_map = { cell = 10.0, shape = 0 }",
            "sensor.0.clutter_map.shape: 0 is not positive and finite",
        ),
        (HEAD + "clutter_map = { cell = 10.0, spread = 1.0 }", "sensor.0.clutter_map.spread: is no known key"),
        (
            HEAD + CAMERA + "clutter_map = { cell = 2.5 }",
            "sensor.1.clutter_map.cell: 2.5 is no side of a cell of directions in radians (up to pi/2)",
        ),
        (
            HEAD + 'clutter_map = { cell = 10.0 }\n[fusion]\nmode = "selected"',
            "fusion.mode: 'selected' associates at the center, which has no clutter_map; sensor.0 has one",
        ),
        (
            HEAD + "[[clutter_source]]\nposition = [1.0]\np_d = 0.5",
            "clutter_source.0.position: has 1 numbers, this scenario's dimensions need 2",
        ),
        (
            HEAD + "[[clutter_source]]\nposition = [1.0, 2.0]\np_d = 1.5",
            "clutter_source.0.p_d: 1.5 is not a probability (0 to 1)",
        ),
        (
            HEAD + '[[clutter_source]]\nposition = [1.0, 2.0]\np_d = 0.5\nsensors = ["a", "c"]',
            "clutter_source.0.sensors: 'c' is no sensor of this scenario",
        ),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, fault: str) -> None:
    path = tmp_path / "coast.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_scenario(path)
    assert str(caught.value) == f"{path}: {fault}"


@pytest.mark.parametrize("tables", [{"clutter_source": []}, {}])
def test_studies_refuse_what_they_do_not_draw(tables: dict[str, Any]) -> None:
    plot = harbour(MAP if tables else None, hypothesis=[{"state": [0.0] * 4, "sigma": [1.0] * 4}], **tables)
    with pytest.raises(ConfigError, match="the false plots of a study are uniform"):
        check(plot, Order(("tight",), 10, 1), ["tight"])
