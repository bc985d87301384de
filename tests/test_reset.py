"""Feedback that resets the factors: what the center promises when reports are late, lost, or of another epoch."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, permutations
from typing import Any

import numpy as np
import pytest
from builders import Node, Stage, all_same, hypothesis_table, only, same, scenario, sensor_table
from process_helpers import assert_agree, points_of
from reference import Density, folded

from waldnet.common.codec import encode
from waldnet.common.config import Scenario
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.memory import MemoryNetwork
from waldnet.common.messages import NEVER, Advice, Clock, Join, Keys, Message, Rebase, Report, Scan, Start, Stop, Tracks
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.state import Presence
from waldnet.offline.network import run_in_memory
from waldnet.offline.replay import Replay
from waldnet.recording.record import Record
from waldnet.scenarios.world import simulate_all
from waldnet.sensor_node.shell import NodeShell
from waldnet.sensor_node.state import State
from waldnet.sensor_node.tracker import LocalTracker

UNDECIDED = {"enabled": False}
CERTAIN = {"p_d": 1.0, "false_plots": 1e-6}
MUCH = 100.0


def resetting(*sensors: dict[str, Any], fusion: dict[str, Any] | None = None, **tables: Any) -> Scenario:
    return scenario(*sensors, fusion={"feedback": "reset"} | (fusion or {}), **{"decision": UNDECIDED} | tables)


class Network:
    """Center and nodes. Reports may be kept back, a node may be deaf or hear of rebases later, and nodes begin anew."""

    def __init__(self, plot: Scenario, seed: int = 3, speed: float = 0.0, members: str | None = None) -> None:
        self.plot, self.stage = plot, Stage(plot, speed=speed)
        self.scans = simulate_all(plot, seed)
        self.nodes: dict[str, Node] = {}
        self.deaf: set[str] = set()
        self.latency_s: dict[str, float] = {}
        self.under_way: list[tuple[str, Rebase]] = []
        for name in members or plot.sensor_names:
            self.join(name, 1, 0)

    def later(self, name: str, after_ns: int) -> int:
        return next((s.time_ns for s in self.scans if s.sensor == name and s.time_ns > after_ns), NEVER)

    def join(self, name: str, incarnation: int, after_ns: int) -> list[Message]:
        """A new process, which sees what comes after a time."""
        answers = self.stage.tell(Join(name, incarnation, self.later(name, after_ns), self.stage.center.digest))
        self.nodes[name] = Node(self.plot, name, *only(Start, answers))
        self.under_way = [(other, rebase) for other, rebase in self.under_way if other != name]
        self.hear(answers)
        return answers

    def report(self, scan: Scan) -> Report:
        node, latency_ns = self.nodes[scan.sensor], round(self.latency_s.get(scan.sensor, 0.0) * NS_PER_S)
        for name, rebase in list(self.under_way):
            if name == scan.sensor and rebase.time_ns + latency_ns <= scan.time_ns:
                self.under_way.remove((name, rebase))
                node.state = node.tracker.rebase(node.state, rebase)
        return self.nodes[scan.sensor].scan(scan, self.later(scan.sensor, scan.time_ns))

    def tell(self, report: Report, at_s: float = 0.0) -> list[Message]:
        """The center hears a report, and all nodes but the deaf ones will hear its answer before they scan."""
        answers = self.stage.tell(report, at_s)
        self.hear(answers)
        return answers

    def hear(self, answers: Sequence[Message]) -> None:
        listening = [name for name in self.nodes if name not in self.deaf]
        self.under_way += [(name, rebase) for rebase in only(Rebase, answers) for name in listening]

    def scan(self, scan: Scan) -> list[Message]:
        return self.tell(self.report(scan))

    @property
    def rebases(self) -> list[Rebase]:
        return only(Rebase, self.stage.said)

    @property
    def log_lr(self) -> float:
        return float(self.stage.tracks.log_lr_total[0])

    @property
    def contributing(self) -> list[list[bool]]:
        """Who did, of the first track, at every time that is remembered."""
        return [past.picture.contributing[0].tolist() for past in self.stage.state.history]


def followed(node: Node, *rebases: Rebase) -> State:
    """The state of a node that has heard of rebases, before a scan for which all of them hold."""
    state = node.state
    for rebase in rebases:
        state = node.tracker.rebase(state, rebase)
    return node.tracker.prepare(state, max(rebase.after_ns for rebase in rebases) + 1, SensorPose(np.zeros(2)))


def seconds(network: Network, scan: Scan) -> float:
    return network.plot.to_seconds(scan.time_ns)


# The rebase -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("association", ["tight", "mirrored"])
def test_a_rebase_leaves_density_and_ratio_as_they_are(association: str) -> None:
    terms = 3 if association == "mirrored" else 1
    plot = resetting(
        sensor_table("a"), sensor_table("b", sigma=[20.0, 90.0]), fusion={"association": association, "terms": terms}
    )
    network = Network(plot)
    for scan in network.scans[:4]:
        network.scan(scan)
    state, fuser = network.stage.state, network.stage.center.fuser
    told = network.rebases[-1]
    assert (told.time_ns, told.after_ns) == (state.time_ns, state.time_ns)
    assert np.array_equal(told.x, state.picture.fused_x)
    assert np.array_equal(told.P, state.picture.fused_P)
    after = fuser.rebased(state.picture, state.picture, told)
    assert after.log_lr_total.tolist() == state.picture.log_lr_total.tolist()
    assert after.log_lr.tolist() == state.picture.log_lr.tolist()
    log_a = after.log_a[0]
    assert log_a.tolist() == 2 * [[0.0, *[-np.inf] * (terms - 1)]]
    _, fused = folded([Density(after.x[0, s, 0], after.P[0, s, 0]) for s in range(2)])
    np.testing.assert_allclose(fused.x, told.x[0], rtol=1e-12)
    np.testing.assert_allclose(fused.P, told.P[0], rtol=1e-9)
    # The factors of center and node are the same.
    for number, name in enumerate("ab"):
        tracks = followed(network.nodes[name], told).tracks
        np.testing.assert_array_equal(tracks.x[0, 0], after.x[0, number, 0])
        np.testing.assert_array_equal(tracks.P[0, 0], after.P[0, number, 0])
        assert np.exp(tracks.log_w).sum() == np.exp(tracks.log_w[0, 0]) == 1.0
        assert tracks.log_g[0, 0] == 0.0


def test_a_rebase_keeps_what_a_confirmation_took() -> None:
    network = Network(resetting(sensor_table("a"), fusion={"feedback_delay": 2.0}, decision={}))
    course = [only(Tracks, network.scan(scan))[0] for scan in network.scans[:6]]
    confirmed = next(k for k, tracks in enumerate(course) if tracks.status[0] == 1)
    taken = course[confirmed].log_lr_total[0]
    assert course[confirmed].log_lr[0] == 0.0
    for tracks in course[confirmed + 1 :]:
        if tracks.log_lr[0] != 0.0:
            np.testing.assert_allclose(tracks.log_lr_total[0] - tracks.log_lr[0], taken)
        taken = tracks.log_lr_total[0] - tracks.log_lr[0]


def test_deleted_tracks_are_not_rebased() -> None:
    stage = Stage(resetting(sensor_table("a"), hypothesis=[hypothesis_table(), hypothesis_table(5000.0)], decision={}))
    stage.join("a", 2.0)
    (rebase,) = only(Rebase, stage.tell(stage.report("a", 2.0)._replace(log_g=np.array([-MUCH]))))
    assert rebase.ids.tolist() == [1]


@pytest.mark.parametrize("delay", [0.0, 3.0])
def test_a_track_that_begins_later_is_not_rebased_before(delay: float) -> None:
    fusion = {"feedback_delay": delay, "joint": False}
    plot = resetting(hypothesis=[hypothesis_table(), hypothesis_table(500.0, start=5.0)], fusion=fusion)
    network = Network(plot)
    for scan in network.scans:
        for rebase in only(Rebase, network.scan(scan)):
            assert rebase.ids.tolist() == ([0] if seconds(network, scan) < 5.0 else [0, 1])
    assert network.stage.tracks.scans.tolist() == [10, 8]
    alone = Network(resetting(hypothesis=[hypothesis_table(500.0, start=5.0)], fusion=fusion))
    for scan in network.scans:
        alone.scan(scan)
    np.testing.assert_allclose(network.stage.tracks.log_lr_total[1], alone.stage.tracks.log_lr_total[0], rtol=1e-9)


def test_while_nothing_is_old_enough_nothing_begins_anew() -> None:
    network = Network(resetting(fusion={"feedback_delay": 4.0}))
    plain = Network(scenario(decision=UNDECIDED))
    for scan in network.scans[:8]:
        network.scan(scan)
        plain.scan(scan)
        not_yet = seconds(network, scan) < 8.0 or scan.sensor == "a"
        assert same(network.stage.tracks, plain.stage.tracks) == not_yet
    # The center tells it at once. In lockstep nodes wait for what it tells at every time.
    assert [network.plot.to_seconds(rebase.time_ns) for rebase in network.rebases] == [2.0, 4.0, 6.0, 8.0]
    assert [network.plot.to_seconds(rebase.after_ns) for rebase in network.rebases] == [6.0, 8.0, 10.0, 12.0]


@pytest.mark.parametrize("delay", [0.0, 2.0, 2.5, 4.0, 5.0])
def test_every_scan_descends_from_the_newest_rebase_that_holds_for_it(delay: float) -> None:
    """Several are told and not followed yet; the sensors do not scan together."""
    sensors = sensor_table("a"), sensor_table("b", scan_interval=3.0)
    network = Network(resetting(*sensors, fusion={"feedback_delay": delay, "window": 1000.0}))
    for scan in network.scans:
        network.scan(scan)
    told = {rebase.epoch: network.plot.to_seconds(rebase.time_ns) for rebase in network.rebases}
    for past in network.stage.state.history:
        time_s = network.plot.to_seconds(past.time_ns)
        assert told.get(past.lineage) == max((then for then in told.values() if then + delay < time_s), default=None)
    assert network.contributing == [[time_s % 2 == 0, time_s % 3 == 0] for time_s in told.values()]


def test_a_track_that_is_deleted_before_a_rebase_holds_stays_so() -> None:
    sensors = sensor_table("a", p_d=0.5), sensor_table("b", p_d=0.5)
    both = [hypothesis_table(), hypothesis_table(8000.0)]
    network = Network(resetting(*sensors, hypothesis=both, fusion={"feedback_delay": 6.0}, decision={}))
    for scan in network.scans:
        network.scan(scan)
    (deleted,) = [decision for decision in network.stage.decisions if decision.kind == "deleted"]
    assert deleted.track == 1
    assert [rebase.ids.tolist() for rebase in network.rebases] == 2 * [[0, 1]] + 8 * [[0]]
    assert network.stage.tracks.ids.tolist() == [0]
    assert all(tracks.contributing.all() for tracks in only(Tracks, network.stage.said))


def test_nobody_follows_a_rebase_before_it_holds() -> None:
    stage = Stage(resetting(sensor_table("a"), fusion={"feedback_delay": 4.0}))
    stage.join("a", 2.0)
    (rebase,) = only(Rebase, stage.tell(stage.report("a", 2.0)))
    for time_s in (4.0, 6.0):
        assert stage.tell(stage.report("a", time_s, epoch=rebase.epoch)) == []
        stage.tell(stage.report("a", time_s))
    assert stage.state.counts.refused == 2
    assert stage.tell(stage.report("a", 8.0, epoch=rebase.epoch)) != []
    assert stage.state.lineage == rebase.epoch


@pytest.mark.parametrize("delay", [0.0, 3.0, 4.0])
def test_a_delay_as_long_as_the_window_shuts_nobody_out(delay: float) -> None:
    """The fused track of then leaves the window while the reports that descend from it come."""
    network = Network(resetting(fusion={"feedback_delay": delay, "window": 4.0}))
    for scan in network.scans:
        network.scan(scan)
    assert network.stage.tracks.scans.tolist() == [10]
    assert network.stage.state.counts == Stage(network.plot).state.counts
    assert all(tracks.contributing.all() for tracks in only(Tracks, network.stage.said))


@pytest.mark.parametrize("feedback_delay", [0.0, 2.0])
def test_what_is_impossible_stays_so(feedback_delay: float) -> None:
    plot = resetting(
        sensor_table("a", p_d=1.0),
        sensor_table("b"),
        fusion={"gate_probability": 1.0, "feedback_delay": feedback_delay},
    )
    network = Network(plot)
    for scan in network.scans[:12]:
        blind = scan.sensor == "a" and seconds(network, scan) == 6.0
        network.scan(scan._replace(z=scan.z[:0]) if blind else scan)
    ratios = [float(tracks.log_lr_total[0]) for tracks in only(Tracks, network.stage.said)]
    assert np.isfinite(ratios[:2]).all()
    assert ratios[2:] == 4 * [-np.inf]


# Late, lost, and from before ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("delay", "counted_in"), [(0.0, False), (1.0, False), (3.0, True), (5.0, True)])
def test_a_delay_as_long_as_the_latency_counts_in_who_hears_late(delay: float, counted_in: bool) -> None:
    """Node b hears of every rebase only after its next scan; without the delay it is left out always."""
    plot = resetting(fusion={"feedback_delay": delay, "window": 1000.0})
    slow, quick = Network(plot, speed=1.0), Network(plot, speed=1.0)
    slow.latency_s = {"b": 3.0}
    for scan in slow.scans:
        for network in (slow, quick):
            network.tell(network.report(scan), seconds(network, scan))
    assert slow.stage.state.counts.refused == 0
    assert same(slow.stage.tracks, quick.stage.tracks) == counted_in
    assert slow.contributing == [[True, True], *(9 * [[True, counted_in]])]


def with_late_reports(order: Sequence[int], delay: float) -> Network:
    """Reports of a come at once, those of b and c, who hear everything, after the last one of a, in some order."""
    fusion = {"feedback_delay": delay, "window": 1000.0, "hold_back": 0.0}
    network, late = Network(resetting(*(sensor_table(name) for name in "abc"), fusion=fusion), speed=1.0), []
    for at in range(0, 9, 3):
        prompt, *others = [network.report(scan) for scan in network.scans[at : at + 3]]
        # At once, but after its scan: the hold-back does not begin before that.
        network.tell(prompt, 1.0 + seconds(network, network.scans[at]))
        late += others
    for number in order:
        network.tell(late[number], 100.0)
    return network


@pytest.mark.parametrize("delay", [0.0, 2.0])
def test_given_what_the_nodes_were_told_the_order_of_late_reports_does_not_matter(delay: float) -> None:
    expected = with_late_reports(range(6), delay)
    assert expected.stage.state.counts.late == 6
    assert len(expected.rebases) == 3
    assert expected.contributing == 3 * [[True, True, True]]
    for order in list(permutations(range(6)))[::37]:
        network = with_late_reports(order, delay)
        assert all_same(network.rebases, expected.rebases)
        for one, other in zip(network.stage.tracks, expected.stage.tracks, strict=True):
            if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
                np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
        assert network.contributing == expected.contributing
    assert abs(expected.log_lr - with_late_reports((), delay).log_lr) > 1.0


@pytest.mark.parametrize("delay", [0.0, 3.0, 8.0])
@pytest.mark.parametrize("seconds_late", [2.0, 4.0, 8.0])
def test_a_late_report_costs_nobody_else_a_report(seconds_late: float, delay: float) -> None:
    """What came before the window began has been forgotten, but not what the reports in it descend from."""
    network, kept = Network(resetting(fusion={"feedback_delay": delay, "window": 8.0}), speed=1.0), None
    for scan in network.scans:
        time_s, report = seconds(network, scan), network.report(scan)
        if scan.sensor == "b" and time_s == 20.0 - seconds_late:
            kept = report
        else:
            network.tell(report, time_s)
        if scan.sensor == "b":
            network.hear(network.stage.tick(time_s + 1.0))
    assert kept is not None
    before = network.contributing
    network.tell(kept, 21.0)
    assert network.stage.state.counts.late == 1
    assert network.stage.state.counts._replace(late=0) == Stage(network.plot).state.counts
    after = network.contributing
    assert len(before) == len(after)
    # One more has contributed, and nobody less.
    assert sum(map(sum, after)) == sum(map(sum, before)) + 1


def test_a_node_that_missed_a_rebase_is_silent_until_it_follows_the_next() -> None:
    deaf, silent = Network(resetting()), Network(resetting())
    for scan in deaf.scans[:8]:
        time_s = seconds(deaf, scan)
        deaf.deaf = {"b"} if time_s == 4.0 else set()
        deaf.scan(scan)
        if scan.sensor == "b" and time_s == 6.0:
            silent.report(scan)
            silent.hear(silent.stage.tell(Presence("b", alive=False)))
            silent.stage.tell(Presence("b", alive=True))
        else:
            silent.scan(scan)
        if scan.sensor == "b":
            assert same(deaf.stage.tracks, silent.stage.tracks)
    assert deaf.contributing == [[True, True], [True, True], [True, False], [True, True]]
    assert deaf.stage.state.counts.refused == 0


def test_a_network_that_hears_no_rebase_goes_on_as_without() -> None:
    """Far longer than the window."""
    deaf, plain = Network(resetting(fusion={"window": 2.0})), Network(scenario(decision=UNDECIDED))
    deaf.deaf = {"a", "b"}
    for scan in deaf.scans:
        deaf.scan(scan)
        plain.scan(scan)
    assert same(deaf.stage.tracks, plain.stage.tracks)
    assert deaf.stage.state.counts.refused == 0
    # What nobody can follow any more is forgotten.
    assert len(deaf.stage.state.told) < len(deaf.rebases)


def test_a_network_that_hears_no_more_rebases_goes_on_from_the_last() -> None:
    """Far longer than the window and what is remembered beyond it."""
    network = Network(resetting(fusion={"window": 2.0}))
    for scan in network.scans:
        network.deaf = {"a", "b"} if seconds(network, scan) > 6.0 else set()
        network.scan(scan)
    assert network.stage.state.counts.refused == 0
    assert all(tracks.contributing.all() for tracks in only(Tracks, network.stage.said))


def test_an_old_rebase_is_no_way_back() -> None:
    network = Network(resetting())
    for scan in network.scans[:6]:
        network.scan(scan)
    node = network.nodes["a"]
    *past, newest = network.rebases
    for rebase in past:
        assert node.tracker.rebase(node.state, rebase) is node.state
    other = Node(network.plot, "a", only(Start, network.stage.said)[0])
    state = followed(other, newest, *past)
    assert (state.lineage, state.rebases) == (newest.epoch, ())


def test_a_new_center_ends_what_the_one_before_has_told() -> None:
    network = Network(resetting())
    for scan in network.scans[:6]:
        network.scan(scan)
    node, newest = network.nodes["a"], network.rebases[-1]
    node.state = node.tracker.rebase(node.state, newest)
    (start,) = only(Start, Stage(network.plot, first_epoch=99).join("a", 8.0))
    node.start(start)
    assert node.scan(network.scans[6]).epoch == start.epoch


def test_a_rebase_raises_no_track_that_the_node_does_not_keep() -> None:
    """A rebase of a while ago may tell of tracks that were stopped since."""
    network = Network(resetting(hypothesis=[hypothesis_table(), hypothesis_table(500.0)]))
    for scan in network.scans[:2]:
        network.scan(scan)
    node, told = network.nodes["a"], network.rebases[-1]
    stopped = node.tracker.stop(node.state, Stop("a", np.array([1])))
    node.state = stopped
    again = followed(node, told)
    assert again.tracks.ids.tolist() == [0]
    assert again.lineage == told.epoch


def test_a_track_that_a_rebase_does_not_name_keeps_its_factor() -> None:
    network = Network(resetting(hypothesis=[hypothesis_table(), hypothesis_table(500.0)]))
    for scan in network.scans[:3]:
        network.scan(scan)
    node, told = network.nodes["a"], network.rebases[-1]
    one = told._replace(epoch=told.epoch + 1, ids=told.ids[:1], x=told.x[:1] + 1.0, P=told.P[:1])
    tracks = followed(node, one).tracks
    assert not np.array_equal(tracks.x[0], node.state.tracks.x[0])
    for field in ("times_ns", "log_g", "x", "P", "x_a", "P_a"):
        assert np.array_equal(getattr(tracks, field)[1], getattr(node.state.tracks, field)[1])


def test_a_late_rebase_is_as_good_as_one_in_time() -> None:
    """The node works its own scans since in again."""
    plot = resetting()
    in_time, late = Network(plot), Network(plot)
    for scan in in_time.scans[:4]:
        in_time.scan(scan)
    told = in_time.rebases[0]
    prompt, slow = late.nodes["a"], Node(plot, "a", *only(Start, late.stage.said)[:1])
    for number, scan in enumerate(scan for scan in in_time.scans if scan.sensor == "a"):
        if number == 1:
            prompt.state = prompt.tracker.rebase(prompt.state, told)
        if number == 4:
            slow.state = slow.tracker.rebase(slow.state, told)
        reports = prompt.scan(scan), slow.scan(scan)
        assert same(*reports) == (number in (0, *range(4, 10)))


@pytest.mark.parametrize("delay", [0.0, 3.0])
def test_a_rebase_from_ahead_of_a_slow_node_waits(delay: float) -> None:
    network = Network(resetting(fusion={"feedback_delay": delay}))
    for scan in network.scans[:8]:
        network.scan(scan)
    start = only(Start, network.stage.said)[0]
    ahead, unaware = Node(network.plot, "a", start), Node(network.plot, "a", start)
    told = network.rebases[-1]
    ahead.state = ahead.tracker.rebase(ahead.state, told)
    for scan in (scan for scan in network.scans if scan.sensor == "a"):
        assert same(ahead.scan(scan), unaware.scan(scan)) == (scan.time_ns <= told.after_ns)


# Coming and going -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("association", ["factor", "tight"])
@pytest.mark.parametrize("reset_at", [5.0, 6.0])
def test_who_begins_anew_goes_on_from_the_newest_rebase(association: str, reset_at: float) -> None:
    plot = resetting(sensor_table("a"), sensor_table("b", scan_interval=3.0), fusion={"association": association})
    steady, broken = Network(plot), Network(plot)
    for scan in steady.scans:
        if scan.sensor == "b" and seconds(steady, scan) == 6.0:
            broken.join("b", 2, scan.time_ns - 1)
        steady.scan(scan)
        broken.scan(scan)
        np.testing.assert_allclose(broken.log_lr, steady.log_lr, rtol=1e-12)
    assert broken.stage.state.counts.refused == 0


@pytest.mark.parametrize(("delay", "to_come"), [(0.0, [10.0]), (3.0, [8.0, 9.0, 10.0]), (5.0, [6.0, 8.0, 9.0, 10.0])])
@pytest.mark.parametrize("association", ["factor", "tight", "mirrored"])
def test_who_joins_while_rebases_are_to_come_follows_them_like_all(
    association: str, delay: float, to_come: list[float]
) -> None:
    """It reports, to the last digit, what a node does that was there all the time and scans as late."""
    sensors = sensor_table("a"), sensor_table("b", scan_interval=3.0), sensor_table("c")
    plot = resetting(*sensors, fusion={"feedback_delay": delay, "association": association})
    joining, there = Network(plot, members="ab"), Network(plot, members="ab")
    there.join("c", 1, plot.to_ns(11.0))
    joining.hear(joining.stage.tick(0.0))
    joining.hear(joining.stage.tick(11.0))
    for scan in joining.scans:
        if scan.sensor == "a" and seconds(joining, scan) == 12.0:
            again = only(Rebase, joining.join("c", 1, scan.time_ns - 1))
            assert [plot.to_seconds(rebase.time_ns) for rebase in again] == to_come
        if scan.sensor != "c" or seconds(joining, scan) >= 12.0:
            said = only(Tracks, joining.scan(scan)), only(Tracks, there.scan(scan))
            assert all_same(*said)
    assert joining.contributing[-1] == [True, False, True]
    assert joining.stage.state.counts.refused == 0


@pytest.mark.parametrize("delay", [3.0, 5.0])
def test_who_is_restarted_while_rebases_are_to_come_is_left_out_of_nothing(delay: float) -> None:
    network = Network(resetting(fusion={"feedback_delay": delay, "window": 1000.0}))
    for scan in network.scans:
        if scan.sensor == "a" and seconds(network, scan) in {6.0, 12.0}:
            network.join("b", round(seconds(network, scan)), scan.time_ns - 1)
        network.scan(scan)
    assert network.contributing == 10 * [[True, True]]
    assert network.stage.state.counts.refused == 0


def test_who_is_restarted_and_hears_of_no_rebase_goes_on_with_its_own_factors() -> None:
    plot = resetting(fusion={"association": "factor"})
    steady, broken = Network(plot), Network(plot)
    for scan in steady.scans:
        steady.deaf = broken.deaf = {"a", "b"} if seconds(steady, scan) >= 6.0 else set()
        if scan.sensor == "a" and seconds(steady, scan) == 10.0:
            broken.join("b", 2, scan.time_ns - 1)
        for network in (steady, broken):
            network.scan(scan)
        assert same(broken.stage.tracks, steady.stage.tracks)
    assert all(tracks.contributing.all() for tracks in only(Tracks, broken.stage.said))


def test_what_a_process_reports_that_has_been_restarted_since_is_refused() -> None:
    stage = Stage(resetting(sensor_table("a")))
    stage.join("a", 2.0)
    (first,) = only(Rebase, stage.tell(stage.report("a", 2.0)))
    stage.tell(stage.report("a", 4.0, epoch=first.epoch))
    (start,) = only(Start, stage.join("a", 6.0, incarnation=2))
    assert stage.tell(stage.report("a", 6.0, epoch=first.epoch)) == []
    assert stage.state.counts.refused == 1
    assert stage.tell(stage.report("a", 6.0, epoch=start.epoch)) != []


def kalman_network() -> Scenario:
    sensors = [sensor_table(name, sigma=sigma, **CERTAIN) for name, sigma in zip("abc", SIGMAS, strict=True)]
    return resetting(*sensors, fusion={"gate_probability": 1.0})


SIGMAS = ([50.0, 50.0], [10.0, 80.0], [200.0, 20.0])


def test_who_joins_in_the_middle_adds_its_plots_and_nothing_else() -> None:
    """Without doubt: c's first scans are missing, else log LR is that of a center that has all plots."""
    network = Network(kalman_network(), members="ab")
    network.hear(network.stage.tick(0.0))
    network.hear(network.stage.tick(11.0))
    density, now, log_lr = network.plot.hypotheses[0].density, 0.0, 0.0
    x, P = density
    motion = network.plot.motion.build()
    log_rho_f = network.plot.sensors[0].build(motion).log_rho_f
    for scan in network.scans:
        time_s = seconds(network, scan)
        if scan.sensor == "c" and time_s < 8.0:
            continue
        if scan.sensor == "a" and time_s == 8.0:
            network.join("c", 1, scan.time_ns - 1)
        network.scan(scan)
        F, Q = motion.transition(np.array(time_s - now)), motion.noise(np.array(time_s - now))
        x, P, now = F @ x, F @ P @ F.T + Q, time_s
        S = P[:2, :2] + np.diag(np.square(SIGMAS["abc".index(scan.sensor)]))
        nu, K = scan.z[0] - x[:2], P[:, :2] @ np.linalg.inv(S)
        log_lr += -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1]) - log_rho_f
        x, P = x + K @ nu, P - K @ S @ K.T
        if scan.sensor == "c" or (time_s < 8.0 and scan.sensor == "b"):
            np.testing.assert_allclose(network.log_lr, log_lr, rtol=1e-9)
            np.testing.assert_allclose(network.stage.tracks.x[0], x, rtol=1e-9)
            np.testing.assert_allclose(network.stage.tracks.P[0], P, rtol=1e-6)


# The same in threads --------------------------------------------------------------------------------------------------

ELABORATE = {
    "reset": {"feedback": "reset"},
    "reset, late": {"feedback": "reset", "feedback_delay": 4.0},
    "reset, mirrored": {"feedback": "reset", "association": "mirrored", "terms": 3},
    "advice": {"feedback": "advice"},
    "advice, late": {"feedback": "advice", "feedback_delay": 4.0},
}


@pytest.mark.parametrize("fusion", ELABORATE.values(), ids=ELABORATE.keys())
def test_in_lockstep_a_network_with_feedback_is_its_replay(fusion: dict[str, Any]) -> None:
    sensors = [sensor_table("a"), sensor_table("b", scan_interval=3.0), sensor_table("c", p_d=0.6, false_plots=500.0)]
    late = hypothesis_table(3000.0, start=5.0)
    plot = scenario(*sensors, fusion=fusion, hypothesis=[hypothesis_table(), hypothesis_table(6000.0), late])
    scans = simulate_all(plot, 3)
    replayed = Record(plot)
    for message in Replay(plot, scans).run():
        replayed.note(message)
    assert len(replayed.decisions) >= 2
    for _ in range(3):
        assert_agree(points_of(run_in_memory(plot, scans)), points_of(replayed))


@pytest.mark.parametrize("delay", [0.0, 4.0])
@pytest.mark.parametrize("feedback", ["reset", "advice"])
def test_in_lockstep_a_node_waits_for_what_the_center_gives(feedback: str, delay: float) -> None:
    """The clock comes on another key, and may overtake it; from the first measurement time on."""
    fusion = {"feedback": feedback, "feedback_delay": delay}
    plot = scenario(sensor_table("a"), fusion=fusion, decision=UNDECIDED)
    stage, keys, scans = Stage(plot), Keys("test"), simulate_all(plot, 3)
    with MemoryNetwork().bus() as bus:
        shell = NodeShell(bus, plot.network, LocalTracker.of(plot, "a"), scans)
        shell._open()
        shell._center_changed(alive=True)

        def hear(messages: Sequence[Message]) -> None:
            for message in messages:
                shell._hear(keys.of(message), encode(message))

        node = Node(plot, "a")
        hear(answers := stage.join("a", 2.0))
        node.start(*only(Start, answers))
        for scan, later in pairwise(scans[:4]):
            assert shell._due_ns() == 0
            report = node.scan(scan, later.time_ns)
            shell._process(scan)
            answers = stage.tell(report)
            given = [*only(Rebase, answers), *only(Advice, answers)]
            assert len(given) == 1
            hear(only(Clock, answers))
            assert shell._due_ns() is None
            hear(given)
            node.state = shell._state


def test_advice_may_be_given_later() -> None:
    stage = Stage(scenario(sensor_table("a"), fusion={"feedback": "advice", "feedback_delay": 3.0}, decision=UNDECIDED))
    stage.join("a", 2.0)
    pictures = {}
    for time_s in (2.0, 4.0, 6.0, 8.0):
        messages = stage.tell(stage.report("a", time_s)._replace(x=np.full((1, 4), time_s)))
        (advice,), (tracks,) = only(Advice, messages), only(Tracks, messages)
        pictures[tracks.time_ns] = tracks
        assert advice.given_ns == stage.ns(time_s)
        if time_s < 5.0:
            assert advice.ids.tolist() == []
        else:
            assert advice.time_ns == stage.ns(time_s - 4.0)
            assert np.array_equal(advice.x, pictures[advice.time_ns].x)
            assert np.array_equal(advice.P, pictures[advice.time_ns].P)


# The first message on a key may be lost without a trace ---------------------------------------------------------------


@pytest.mark.parametrize("lost", ["advice", "clock", "command"])
@pytest.mark.parametrize(
    "tables",
    [
        {"fusion": {"feedback": "advice"}},
        {"fusion": {"feedback": "reset"}},
        {"fusion": {"feedback": "none"}, "initiation": {"speed": 100.0}},
    ],
    ids=["advice", "reset", "begin"],
)
def test_a_node_that_missed_the_first_word_of_the_center_asks_again(
    monkeypatch: pytest.MonkeyPatch, tables: dict[str, Any], lost: str
) -> None:
    plot = scenario(**tables)
    scans, keys = simulate_all(plot, 3), Keys(plot.network.name)
    key = {"advice": keys.advice(), "clock": keys.clock(), "command": keys.command("b")}[lost]
    dropped: list[bytes] = []

    class Lossy(MemoryNetwork):
        """Loses the first message on a key for the node that subscribes last."""

        def matching(self, kind: str, key_expr: str) -> list[Any]:
            found = super().matching(kind, key_expr)
            if kind != "subscriber" or key_expr != key or not found or dropped:
                return found
            dropped.append(b"")
            return found[:-1]

    monkeypatch.setattr("waldnet.offline.network.MemoryNetwork", Lossy)
    live = run_in_memory(plot, scans)
    assert dropped
    assert [*live.pictures] == sorted({scan.time_ns for scan in scans})
