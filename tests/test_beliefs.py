"""What a node knows of tracks beside their densities, over rebases, advice, joins and restarts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builders import Node, Stage, hypothesis_table, only, scenario, sensor_table
from scipy.special import expit, logsumexp

from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.imm import Imm
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.local_filter import SUREST
from waldnet.common.messages import Advice, Begin, Message, Rebase, Report, Scan, Start, Tracks
from waldnet.offline.replay import Replay
from waldnet.scenarios.world import simulate_all

LOSES = {"visible_for": 40.0, "hidden_for": 20.0}
FAR = {"shape": "box", "center": [0.0, 0.0], "size": [1e6, 1e6]}
#: Known to a tenth of a millimetre: what is seen does not move it, so only hits and misses count.
STILL: dict[str, Any] = {
    "hypothesis": [hypothesis_table(state=[0.0] * 4, sigma=[1e-4] * 4)],
    "motion": {"psd": 1e-12},
    "decision": {"enabled": False},
}
#: Straight on, or a turn to the left.
TURNS: dict[str, Any] = {
    "motion": {
        "model": "imm",
        "sojourn": 20.0,
        "psd": 5.0,
        "models": [{"model": "cv", "psd": 1.0}, {"model": "ct", "psd": 1.0, "turn_rate": 0.2}],
    },
    "decision": {"enabled": False},
}
HERE = SensorPose(np.zeros(2))
X, P = np.zeros((1, 4)), 1e-8 * np.eye(4)[None]


def hidden(feedback: str, delay: float = 0.0, first_b: float = 2.0, p_d: float = 0.97) -> Scenario:
    """Two sensors that lose targets for a while."""
    a = sensor_table("a", p_d=p_d, visibility=LOSES, field_of_view=FAR)
    fusion = {"feedback": feedback, "feedback_delay": delay}
    return scenario(a, a | {"name": "b", "first_scan": first_b}, fusion=fusion, **STILL)


def scan_at(plot: Scenario, time_s: float, *plots: tuple[float, float], name: str = "a") -> Scan:
    return Scan(name, plot.to_ns(time_s), np.zeros(2), np.array(plots, float).reshape(-1, 2))


def steps(plot: Scenario, scans: list[Scan]) -> Array:
    """What log LR gains with every measurement time."""
    tracks = only(Tracks, Replay(plot, scans).run())
    return np.diff([0.0] + [float(picture.log_lr_total[0]) for picture in tracks])


def rebase_at(plot: Scenario, epoch: int, time_s: float, *, x: Array = X, P: Array = P, delay: float = 0.0) -> Rebase:
    time_ns = plot.to_ns(time_s)
    return Rebase(epoch, time_ns + plot.to_ns(delay) - plot.to_ns(0.0), time_ns, np.arange(len(x)), x, P)


def node(plot: Scenario, x: Array = X, P: Array = P) -> Node:
    count = len(x)
    factor = (x, len(plot.sensors) * P)
    times = np.full(count, plot.to_ns(0.0))
    return Node(plot, "a", Start("a", 1, np.arange(count), times, np.zeros(count), *factor, x, P))


# Visibility -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("feedback", "delay", "first_b"),
    [
        ("reset", 0.0, 2.0),
        ("reset", 0.0, 3.0),
        # Not in turns: between a rebase with a delay and its own report, what a sensor had seen since is missing.
        ("reset", 3.0, 2.0),
        ("advice", 0.0, 2.0),
        ("advice", 0.0, 3.0),
        ("advice", 3.0, 2.0),
        ("advice", 3.0, 3.0),
    ],
)
def test_misses_of_a_hidden_target_cost_with_feedback_what_they_cost_without(
    feedback: str, delay: float, first_b: float
) -> None:
    """Forgotten at a reset, v would begin at its stationary share, and every miss would cost -1.04."""
    scans = []
    for k in range(1, 13):
        there = [(3.0, -2.0)] if k < 5 or k > 9 else []
        scans += [scan_at(hidden("none"), 2.0 * k, *there)]
        scans += [scan_at(hidden("none"), 2.0 * k + first_b - 2.0, *there, name="b")]
    plain = steps(hidden("none", first_b=first_b), scans)
    assert plain[plain < 0.0].min() < -2.5 and plain[plain < 0.0].max() > -0.3
    np.testing.assert_allclose(steps(hidden(feedback, delay, first_b), scans), plain, atol=1e-3)


@pytest.mark.parametrize("told_s", [[0.5], [4.0], [5.0], [8.0], [9.0], [4.0, 4.5, 8.0], [4.0, 7.0]])
@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("kind", ["reset", "advice"])
def test_every_scan_tells_once_whether_the_target_is_visible(kind: str, late: bool, told_s: list[float]) -> None:
    """Told in time or after all scans, one after the other or all at once. No hit and no sure miss makes v forget."""
    plot = hidden(kind, p_d=0.3)
    ours, plain = node(plot), node(plot)
    messages: list[Any] = []
    for epoch, time_s in enumerate(told_s, start=2):
        if kind == "reset":
            messages.append(rebase_at(plot, epoch, time_s))
        else:
            messages.append(Advice(plot.to_ns(time_s), plot.to_ns(time_s), np.array([0]), X, P))
    for k, found in enumerate([True, False, False, False, False, False], start=1):
        scan = scan_at(plot, 2.0 * k, *[(10.0, 10.0)] * found)
        due = [message for message in messages if (k == 6 if late else message.time_ns < scan.time_ns)]
        for message in due:
            ours.told(message)
            messages.remove(message)
        for keeper in (ours, plain):
            keeper.scan(scan)
    assert not messages
    assert 0.1 < plain.state.tracks.visible[0, 0] < 0.65
    np.testing.assert_allclose(ours.state.tracks.visible, plain.state.tracks.visible, atol=1e-6)


def test_a_track_that_began_late_has_what_it_caught_up() -> None:
    """Its scans were worked in when it was told of, so what was known between them is known too."""
    plot = hidden("reset")
    ours, plain = node(plot), node(plot)
    first = Begin(0, plot.to_ns(1.0), np.array([1]), np.array([plot.to_ns(1.0)]), X, P, np.empty(0, np.int64))
    for keeper in (ours, plain):
        keeper.state = keeper.state._replace(next_id=1)
    plain.told(first)
    for k in range(1, 5):
        for keeper in (ours, plain):
            keeper.scan(scan_at(plot, 2.0 * k))
    ours.told(first)
    both = Rebase(2, plot.to_ns(5.0), plot.to_ns(5.0), np.arange(2), np.tile(X, (2, 1)), np.tile(P, (2, 1, 1)))
    ours.told(both)
    for keeper in (ours, plain):
        keeper.scan(scan_at(plot, 10.0))
    np.testing.assert_allclose(ours.state.tracks.visible, plain.state.tracks.visible, atol=1e-6)


# Existence ------------------------------------------------------------------------------------------------------------


def near(*, feedback: str = "reset") -> tuple[Scenario, Array, Array]:
    """Two tracks that share plots, associated jointly by how surely they exist."""
    fusion = {"feedback": feedback, "joint": True, "gate_probability": 0.99}
    x = np.array([[0.0, 0.0, 0.0, 0.0], [60.0, 0.0, 0.0, 0.0]])
    plot = scenario(sensor_table("a", p_d=0.6), sensor_table("b"), fusion=fusion, decision={"enabled": False})
    return plot, x, np.tile(np.diag([900.0, 900.0, 1.0, 1.0]), (2, 1, 1))


@pytest.mark.parametrize("told_after", [1, 2, 3])
def test_existence_goes_on_over_a_rebase_and_every_scan_counts_once(told_after: int) -> None:
    plot, x, P = near()
    keeper = node(plot, x, P)
    odds = [keeper.state.tracks.log_odds]
    for k in range(1, 4):
        keeper.scan(scan_at(plot, 2.0 * k, (10.0 * k, 20.0), (800.0, 0.0)))
        odds.append(keeper.state.tracks.log_odds)
    assert (np.abs(odds) < SUREST).all() and np.abs(odds[1:]).min() > 0.1
    keeper.told(rebase_at(plot, 2, 2.0 * told_after, x=x, P=P))
    state = keeper.tracker.prepare(keeper.state, plot.to_ns(8.0), HERE)
    gained = logsumexp(state.tracks.log_g, axis=-1)
    assert (gained != 0.0).all() == (told_after < 3)
    np.testing.assert_allclose(state.tracks.log_odds, odds[told_after] + gained, atol=1e-12)


def test_a_track_that_has_ended_claims_nothing_after_a_rebase_either() -> None:
    plot, x, P = near()
    keeper = node(plot, x, P)
    keeper.scan(scan_at(plot, 2.0, (0.0, 0.0)))
    nothing, none = np.empty((0, 4)), np.empty(0, np.int64)
    keeper.told(Begin(0, plot.to_ns(2.0), none, none, nothing, np.empty((0, 4, 4)), ended=np.array([1])))
    keeper.told(rebase_at(plot, 2, 2.0, x=x, P=P))
    state = keeper.tracker.prepare(keeper.state, plot.to_ns(4.0), HERE)
    assert state.lineage == 2
    assert state.tracks.log_odds[1] == -np.inf < state.tracks.log_odds[0]


# Several motion models ------------------------------------------------------------------------------------------------


def turning(time_s: float) -> tuple[float, float]:
    """Where a target is that turns to the left all the time."""
    angle = 0.2 * time_s
    return 150.0 / 0.2 * np.sin(angle), 150.0 / 0.2 * (1.0 - np.cos(angle))


def of_turns(feedback: str) -> Scenario:
    sure = {"p_d": 0.95, "false_plots": 1e-3, "sigma": [10.0, 10.0]}
    return scenario(
        sensor_table("a", **sure), sensor_table("b", first_scan=3.0, **sure), fusion={"feedback": feedback}, **TURNS
    )


def in_turns(plot: Scenario) -> list[Scan]:
    seen = [(2.0 * k + late, name) for k in range(1, 8) for name, late in (("a", 0.0), ("b", 1.0))]
    return [scan_at(plot, time_s, turning(time_s), name=name) for time_s, name in seen]


def test_the_models_probabilities_go_on_over_a_rebase() -> None:
    """Eq. (1a) over the time since the last scan, in the factor and in the filter that associates."""
    plot = of_turns("reset")
    keeper = node(plot, np.array([[0.0, 0.0, 150.0, 0.0]]), np.diag([400.0, 400.0, 100.0, 100.0])[None])
    for k in range(1, 4):
        keeper.scan(scan_at(plot, 2.0 * k, turning(2.0 * k)))
    tracks = keeper.state.tracks
    motion = plot.motion.build()
    assert isinstance(motion, Imm)
    to = motion.mode_transition(np.array(1.0))
    before = [np.exp(log_mu - logsumexp(log_mu)) @ to for log_mu in (tracks.log_w[0], tracks.log_g[0])]
    keeper.told(rebase_at(plot, 2, 7.0, x=tracks.x_a[:, 0], P=tracks.P_a[:, 0]))
    tracks = keeper.tracker.prepare(keeper.state, plot.to_ns(8.0), HERE).tracks
    assert before[0][1] > 0.8
    np.testing.assert_allclose(np.exp([tracks.log_w[0], tracks.log_g[0]]), before, rtol=1e-9)


def test_center_and_nodes_agree_on_the_models_after_a_reset() -> None:
    plot = of_turns("reset")
    stage, nodes = Stage(plot, speed=0.0), {}
    for name, start in stage.join_all(a=2.0, b=3.0).items():
        nodes[name] = Node(plot, name, start)
    for scan in in_turns(plot):
        report = nodes[scan.sensor].scan(scan, scan.time_ns + plot.to_ns(2.0) - plot.to_ns(0.0))
        told = only(Rebase, stage.tell(report))
        for rebase in told:
            for keeper in nodes.values():
                keeper.state = keeper.tracker.prepare(
                    keeper.tracker.rebase(keeper.state, rebase), rebase.time_ns + 1, HERE
                )
    last = stage.state.history[-1].picture
    (then,) = [told for told in stage.state.told if told.rebase.epoch == nodes["a"].state.lineage]
    assert then.rebase.time_ns == int(last.times_ns[0])
    theirs = stage.center.fuser.rebased(last, last, then.rebase).log_a[0]
    ours = np.stack([nodes[name].state.tracks.log_g[0] for name in "ab"])
    np.testing.assert_allclose(np.exp(ours), np.exp(theirs), rtol=1e-9)
    assert (np.exp(ours)[:, 1] > 0.7).all()


def test_late_advice_finds_the_models_as_they_were() -> None:
    """Else scans that are redone would tell of the models twice."""
    plot = of_turns("advice")
    x, P = np.array([[0.0, 0.0, 150.0, 0.0]]), np.diag([400.0, 400.0, 100.0, 100.0])[None]
    in_time, late = node(plot, x, P), node(plot, x, P)
    advice = Advice(plot.to_ns(3.0), plot.to_ns(3.0), np.array([0]), np.array([[*turning(3.0), 120.0, 80.0]]), P)
    for k in range(1, 6):
        if k == 2:
            in_time.told(advice)
        if k == 5:
            late.told(advice)
        for keeper in (in_time, late):
            keeper.scan(scan_at(plot, 2.0 * k, turning(2.0 * k)))
    for field in ("log_w", "x_a", "P_a", "visible"):
        np.testing.assert_allclose(
            getattr(late.state.tracks, field), getattr(in_time.state.tracks, field), rtol=1e-9, atol=1e-12
        )


# Joins and restarts ---------------------------------------------------------------------------------------------------


def joint_network() -> Scenario:
    sensors = [sensor_table(name, p_d=0.8, visibility=LOSES) for name in "ab"]
    return scenario(*sensors, fusion={"joint": True}, decision={"enabled": False})


def worked_in(plot: Scenario) -> tuple[Stage, dict[str, Node]]:
    stage = Stage(plot)
    nodes = {name: Node(plot, name, start) for name, start in stage.join_all(a=2.0, b=2.0).items()}
    for scan in simulate_all(plot, 2)[:6]:
        report: Report = nodes[scan.sensor].scan(scan, scan.time_ns + plot.to_ns(2.0) - plot.to_ns(0.0))
        stage.tell(report)
    return stage, nodes


def answered(messages: list[Message]) -> Start:
    (start,) = only(Start, messages)
    assert isinstance(start, Start)
    return start


def test_a_process_that_was_cut_off_goes_on_with_all_it_knew() -> None:
    stage, nodes = worked_in(joint_network())
    before = nodes["a"].state.tracks
    nodes["a"].told(answered(stage.join("a", 8.0, incarnation=1)))
    for field in ("log_odds", "visible", "log_w", "log_g"):
        np.testing.assert_array_equal(getattr(nodes["a"].state.tracks, field), getattr(before, field))


def test_a_process_that_was_restarted_has_existence_from_its_evidence() -> None:
    """Visibility begins anew: no message tells of it."""
    plot = joint_network()
    stage, nodes = worked_in(plot)
    before = nodes["a"].state.tracks
    again = Node(plot, "a", answered(stage.join("a", 8.0, incarnation=2)))
    assert abs(before.log_odds[0]) > 0.1
    np.testing.assert_allclose(expit(again.state.tracks.log_odds), expit(before.log_odds), atol=1e-6)
    np.testing.assert_allclose(again.state.tracks.visible, [[40.0 / 60.0, 40.0 / 60.0]])


def test_a_new_center_begins_everything_anew() -> None:
    """Its track 0 is not that of the center before, so what was known of that one says nothing."""
    plot = hidden("reset")
    keeper = node(plot)
    for k in range(1, 4):
        keeper.scan(scan_at(plot, 2.0 * k))
    lost = keeper.state.tracks.visible[0, 0]
    times, zero = np.array([plot.to_ns(6.0)]), np.zeros(1)
    keeper.told(Start("a", 5, np.array([0]), times, zero, X, 2.0 * P, X, P))
    keeper.told(rebase_at(plot, 6, 6.5))
    tracks = keeper.tracker.prepare(keeper.state, plot.to_ns(8.0), HERE).tracks
    assert lost < 0.2
    assert tracks.visible[0, 0] == pytest.approx(40.0 / 60.0)
