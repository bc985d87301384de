"""Tracks that start from plots no track claims, and tracks that turn out to be one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builders import Node, Stage, live_as_replayed, only, scenario, sensor_table

from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.messages import NEVER, Begin, Decision, Join, Message, Report, Scan, Start, Stop, Tracks
from waldnet.fusion_center.initiation import Initiation, Unclaimed
from waldnet.fusion_center.picture import Picture
from waldnet.offline.replay import Replay
from waldnet.scenarios.world import simulate_all

NONE = np.empty(0, np.int64)


def starting(*sensors: dict[str, Any], initiation: dict[str, Any] | None = None, **tables: Any) -> Scenario:
    content = {"initiation": {"speed": 100.0} | (initiation or {}), "hypothesis": [], "target": []}
    return scenario(*sensors, **content | tables)


def initiation_of(plot: Scenario) -> Initiation:
    found = Initiation.of(plot)
    assert found is not None
    return found


def seen(z: list[list[float]], number: int = 0, time_s: float = 2.0, ids: list[int] | None = None) -> Unclaimed:
    known = np.array(ids or [], np.int64)
    return Unclaimed(
        round(time_s * 1e9), number, SensorPose(np.array([3000.0, 0.0])), known, np.array(z).reshape(-1, 2)
    )


def picture(plot: Scenario, places: list[list[float]], sigma: float = 20.0, **fields: Any) -> Picture:
    """Tracks at places, all alike but for what is given."""
    stage, count = Stage(plot), len(places)
    states = np.hstack([np.array(places).reshape(-1, 2), np.zeros((count, 2))])
    P = np.repeat(np.diag([sigma**2, sigma**2, 25.0, 25.0])[None], count, axis=0)
    fuser = stage.center.fuser
    whole = fuser.begin(fuser.empty(), np.arange(count), np.zeros(count, np.int64), Gaussian(states, P))
    return whole._replace(scans=np.full(count, 5), **fields)


def test_a_plot_that_no_track_claims_starts_a_track() -> None:
    starts = initiation_of(starting())
    seeds = starts.seeds(picture(starting(), []), [seen([[100.0, 200.0], [-4000.0, 50.0]])], [])
    np.testing.assert_allclose(seeds.x, [[100.0, 200.0, 0.0, 0.0], [-4000.0, 50.0, 0.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(seeds.P[1], np.diag([2500.0, 2500.0, 1e4, 1e4]), rtol=1e-9)


def test_of_plots_that_are_near_each_other_the_first_starts_a_track() -> None:
    starts = initiation_of(starting())
    now = [seen([[0.0, 0.0], [100.0, 0.0], [5000.0, 0.0]]), seen([[5050.0, 0.0], [0.0, 900.0]], number=1)]
    seeds = starts.seeds(picture(starting(), []), now, [])
    np.testing.assert_allclose(seeds.x[:, :2], [[0.0, 0.0], [5000.0, 0.0], [0.0, 900.0]], atol=1e-9)


def test_a_track_that_the_node_did_not_know_of_takes_the_plots_near_it() -> None:
    plot = starting()
    there = picture(plot, [[0.0, 0.0]])
    starts = initiation_of(plot)
    assert not len(starts.seeds(there, [seen([[60.0, 0.0]])], []).x)
    assert len(starts.seeds(there, [seen([[60.0, 0.0]], ids=[0])], []).x) == 1
    gone = there._replace(status=np.array([2], np.uint8))
    assert len(starts.seeds(gone, [seen([[60.0, 0.0]])], []).x) == 1


def test_two_plots_start_a_track_only_if_a_target_can_be_so_fast() -> None:
    plot = starting(initiation={"plots": 2, "speed": 100.0, "max_speed": 150.0, "within": 4.0})
    starts, nothing = initiation_of(plot), picture(plot, [])
    before = [seen([[0.0, 0.0], [4000.0, 0.0]], number=1)]
    now = [seen([[200.0, 0.0], [4000.0, 2000.0], [-9000.0, 0.0]], time_s=4.0)]
    seeds = starts.seeds(nothing, now, before)
    assert len(seeds.x) == 1
    assert 150.0 < seeds.x[0, 0] < 200.0
    assert 40.0 < seeds.x[0, 2] < 100.0
    assert not len(starts.seeds(nothing, [now[0]._replace(time_ns=7_000_000_000)], before).x)
    assert not len(starts.seeds(nothing, [now[0]._replace(time_ns=2_000_000_000)], before).x)


def test_there_are_not_more_tentative_tracks_than_allowed() -> None:
    plot = starting(initiation={"tentative": 3})
    places = [[2000.0 * i, 0.0] for i in range(-4, 4)]
    starts = initiation_of(plot)
    assert len(starts.seeds(picture(plot, []), [seen(places)], []).x) == 3
    assert len(starts.seeds(picture(plot, [[0.0, 9000.0]] * 2), [seen(places)], []).x) == 1
    confirmed = picture(plot, [[0.0, 9000.0]] * 2, status=np.array([1, 1], np.uint8))
    assert len(starts.seeds(confirmed, [seen(places)], []).x) == 3


def test_of_tracks_that_are_one_the_stronger_stays() -> None:
    plot = starting()
    there = picture(
        plot,
        [[0.0, 0.0], [5.0, 0.0], [3.0, 3.0], [3000.0, 0.0], [3001.0, 0.0]],
        status=np.array([0, 1, 0, 0, 0], np.uint8),
        log_lr_total=np.array([30.0, 10.0, 5.0, 1.0, 1.0]),
    )
    merged, pairs, decisions = initiation_of(plot).merged(there, there, {})
    assert not pairs
    assert [(decision.track, decision.into) for decision in decisions] == [(0, 1), (2, 1), (4, 3)]
    assert merged.status.tolist() == [2, 1, 2, 0, 2]
    assert {decision.kind for decision in decisions} == {"merged"}


@pytest.mark.parametrize("change", [{"apart": 80.0}, {"speed": 20.0}])
def test_targets_side_by_side_or_crossing_are_two(change: dict[str, float]) -> None:
    plot = starting()
    there = picture(plot, [[0.0, 0.0], [change.get("apart", 0.0), 0.0]])
    there.fused_x[1, 2] = change.get("speed", 0.0)
    assert initiation_of(plot).duplicates(there, there, {}) == ([], {})


def test_plots_that_are_no_place_start_nothing() -> None:
    plot = starting(
        sensor_table("a", kind="polar", sigma=[50.0, 0.01]), sensor_table("b", kind="bearing", sigma=[0.01])
    )
    starts = initiation_of(plot)
    assert len(starts.seeds(picture(plot, []), [seen([[0.0, 1.0], [900.0, 1.0]])], []).x) == 1
    report = Stage(plot).report("a", 2.0, position=np.zeros(2), unclaimed=np.array([[900.0, 1.0]]))
    assert starts.fault(report, 0) is None
    assert starts.fault(report._replace(position=np.zeros(3)), 0) == "unclaimed plots of another sensor"
    assert starts.fault(report._replace(unclaimed=np.array([[1.0]])), 0) == "unclaimed plots of another sensor"
    assert starts.fault(report._replace(unclaimed=np.array([[1.0]])), 1) == "unclaimed plots of another sensor"


def two_boats(**tables: Any) -> Scenario:
    boats = [{"state": [-1000.0, 0.0, 60.0, 0.0]}, {"state": [2000.0, 3000.0, 0.0, -80.0]}]
    quiet = {"false_plots": 0.5, "sigma": [30.0, 30.0]}
    sensors = [sensor_table("a", **quiet), sensor_table("b", first_scan=1.0, **quiet)]
    fixed = {"motion": {"psd": 1e-6}, "decision": {"p1": 0.9999}, "target": boats, "simulation": {"duration": 40.0}}
    return starting(*sensors, **fixed | tables)


def final(messages: list[Tracks | Decision]) -> Tracks:
    return [message for message in messages if isinstance(message, Tracks)][-1]


@pytest.mark.parametrize(
    "tables",
    [
        {},
        {"initiation": {"plots": 2}},
        {"fusion": {"feedback": "advice"}},
        {"fusion": {"feedback": "reset"}},
        {"fusion": {"association": "mirrored", "terms": 3}},
        {"fusion": {"mode": "selected"}},
        {"fusion": {"joint": False}},
        {"fusion": {"mode": "naive", "association": "factor"}},
    ],
)
def test_a_network_finds_its_targets_itself(tables: dict[str, Any]) -> None:
    plot = two_boats(**tables)
    messages = list(Replay(plot, simulate_all(plot, 5)).run())
    last = final(messages)
    held = last.x[last.status == 1, :2]
    truth = np.array([[-1000.0 + 60.0 * 40.0, 0.0], [2000.0, 3000.0 - 80.0 * 40.0]])
    assert len(held) == 2
    assert np.linalg.norm(held[:, None] - truth, axis=-1).min(axis=0).max() < 150.0
    confirmed = [message for message in messages if isinstance(message, Decision) and message.kind == "confirmed"]
    assert len(confirmed) == 2


def test_a_network_with_a_bearing_sensor_finds_its_targets_from_two_plots() -> None:
    plot = two_boats(initiation={"speed": 100.0, "plots": 2})
    disc = {"shape": "disc", "radius": 20_000.0}
    bearing = sensor_table("c", kind="bearing", sigma=[0.01], field_of_view=disc, false_plots=0.5)
    plot = plot.model_copy(update={"sensors": (*plot.sensors, scenario(bearing).sensors[0])})
    last = final(list(Replay(plot, simulate_all(plot, 5)).run()))
    assert (last.status == 1).sum() == 2


def test_live_and_replayed_networks_say_the_same_in_lockstep() -> None:
    plot = two_boats()
    scans = simulate_all(plot, 5)
    live_as_replayed(plot, scans)


class Network:
    """Center and nodes at a real-time speed, who hear each other at once; scans and reports may be kept back."""

    def __init__(self, plot: Scenario, seed: int = 5) -> None:
        self.plot, self.stage, self.nodes = plot, Stage(plot, speed=1.0), {}
        self.now_s = 0.0
        self.scans = simulate_all(plot, seed)
        for name in plot.sensor_names:
            self.join(name, 1, 0)

    def later(self, name: str, after_ns: int) -> int:
        return next((s.time_ns for s in self.scans if s.sensor == name and s.time_ns > after_ns), NEVER)

    def join(self, name: str, incarnation: int, after_ns: int) -> None:
        self.nodes[name] = Node(self.plot, name)
        self.hear(self.stage.tell(Join(name, incarnation, self.later(name, after_ns), self.stage.center.digest)))

    def scan(self, scan: Scan) -> Report:
        return self.nodes[scan.sensor].scan(scan, self.later(scan.sensor, scan.time_ns))

    def tell(self, report: Report) -> None:
        """At the wall time of the newest scan: reports may come after it, never before."""
        self.now_s = max(self.now_s, self.plot.to_seconds(report.time_ns))
        self.hear(self.stage.tell(report, self.now_s))

    def hear(self, answers: list[Message]) -> None:
        for answer in answers:
            match answer:
                case Start(sensor=name) | Stop(sensor=name):
                    self.nodes[name].told(answer)
                case Begin():
                    for node in self.nodes.values():
                        node.told(answer)
                case _:
                    pass

    @property
    def confirmed(self) -> np.ndarray:
        tracks = self.stage.tracks
        return tracks.x[tracks.status == 1]


def test_a_report_that_comes_late_starts_no_track_and_undoes_none() -> None:
    plot = two_boats(fusion={"hold_back": 0.0})
    prompt, late = Network(plot), Network(plot)
    for scan in prompt.scans:
        prompt.tell(prompt.scan(scan))
    # The first report of b, from which both boats' tracks start on time, comes after the next two.
    kept: list[Report] = []
    for number, scan in enumerate(late.scans):
        report = late.scan(scan)
        if number == 0:
            kept.append(report)
            continue
        late.tell(report)
        if number == 2:
            late.tell(kept.pop())
    assert late.stage.state.counts.late == 1
    began = [begun for message in only(Begin, late.stage.said) for begun in message.ids.tolist()]
    assert len(began) == len(set(began))
    np.testing.assert_allclose(np.sort(late.confirmed[:, 0]), np.sort(prompt.confirmed[:, 0]), atol=30.0)


def test_a_node_that_is_restarted_is_told_of_the_tracks_that_began() -> None:
    network = Network(two_boats())
    for scan in network.scans[:20]:
        network.tell(network.scan(scan))
    ids = network.nodes["a"].state.tracks.ids
    network.join("b", 2, network.scans[19].time_ns)
    live = network.stage.tracks.ids[network.stage.tracks.status < 2]
    assert network.nodes["b"].state.tracks.ids.tolist() == live.tolist()
    for scan in network.scans[20:]:
        network.tell(network.scan(scan))
    assert len(ids) >= 2
    assert len(network.confirmed) == 2


@pytest.mark.parametrize("first_epoch", [10**9, 0], ids=["later", "clock set back"])
@pytest.mark.parametrize("restarted", [(), ("a",)], ids=["all nodes live on", "one node restarted too"])
def test_a_new_center_gives_no_id_of_the_old_one_again(first_epoch: int, restarted: tuple[str, ...]) -> None:
    network = Network(two_boats())
    half = len(network.scans) // 2
    for scan in network.scans[:half]:
        network.tell(network.scan(scan))
    old = [track for begin in only(Begin, network.stage.said) for track in begin.ids.tolist()]
    assert len(old) > 2
    network.stage, last_ns = Stage(network.plot, speed=1.0, first_epoch=first_epoch), network.scans[half - 1].time_ns
    for name in restarted:
        network.nodes[name] = Node(network.plot, name)
    # The clock begins with the last one that joins: here one that knows of the old center.
    for name, node in network.nodes.items():
        network.hear(network.stage.tell(node.tracker.join(node.state, 1, network.later(name, last_ns))))
    for node in network.nodes.values():
        assert len(node.state.tracks.ids) == 0
    for scan in network.scans[half:]:
        network.tell(network.scan(scan))
    new = [track for begin in only(Begin, network.stage.said) for track in begin.ids.tolist()]
    assert min(new) > max(old)
    assert len(network.confirmed) == 2
    assert network.stage.state.counts.refused == 0


def test_who_asks_again_changes_no_ids_and_no_epoch() -> None:
    network = Network(two_boats())
    for scan in network.scans[:20]:
        network.tell(network.scan(scan))
    before, node = network.stage.state, network.nodes["a"]
    network.hear(network.stage.tell(node.tracker.join(node.state, 1, before.members[0].next_ns)))
    assert network.stage.state.next_id == before.next_id
    assert network.stage.state.members[0] == before.members[0]


def test_what_begins_before_a_node_has_its_start_message_waits_for_it() -> None:
    network = Network(two_boats())
    for scan in network.scans[:4]:
        network.tell(network.scan(scan))
    begin = next(message for message in only(Begin, network.stage.said) if len(message.ids))
    node = Node(network.plot, "a")
    node.told(begin)
    assert not len(node.state.tracks.ids)
    start = next(message for message in only(Start, network.stage.said) if message.sensor == "a")
    node.start(start)
    assert node.state.tracks.ids.tolist() == begin.ids.tolist()
    # A start message that came later has told of them, or they are no more.
    other = Node(network.plot, "a", start._replace(next_id=int(begin.ids.max()) + 1))
    other.told(begin)
    assert not len(other.state.tracks.ids)


def test_a_deleted_track_claims_no_plots() -> None:
    network = Network(two_boats())
    for scan in network.scans[:10]:
        network.tell(network.scan(scan))
    boat = int(network.stage.tracks.ids[network.stage.tracks.status == 1][0])
    node = network.nodes["a"]
    before = node.scan(network.scans[11])
    ended = Begin(1, 0, NONE, NONE, np.empty((0, 4)), np.empty((0, 4, 4)), np.array([boat]))
    node = Node(network.plot, "a")
    node.state = node.tracker.begin(network.nodes["a"].state, ended)
    after = node.scan(network.scans[13])
    assert len(after.unclaimed) >= len(before.unclaimed)
    assert boat in after.ids
    x = network.stage.tracks.x[network.stage.tracks.ids == boat, :2]
    assert (np.linalg.norm(after.unclaimed - x, axis=-1) < 500.0).any()
