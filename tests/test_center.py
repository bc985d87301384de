from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pytest
from builders import Node, Stage, all_same, hypothesis_table, only, reports_of, same, scenario, sensor_table
from hypothesis import given, settings
from hypothesis import strategies as st

from waldnet.common.config import Scenario
from waldnet.common.messages import NEVER, Advice, Clock, Decision, Join, Report, Scan, Start, Stop, Tracks
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.state import Presence
from waldnet.offline.replay import Replay
from waldnet.scenarios.world import simulate, simulate_all

UNDECIDED = {"enabled": False}
#: Far enough over both thresholds to outweigh whatever the factors say.
MUCH = 100.0


def evidence(log_g: float, **changes: Any) -> dict[str, Any]:
    """Fields of a report with a cumulative log p_bar."""
    return {"log_g": np.array([log_g]), **changes}


def alone(**tables: Any) -> Stage:
    """A center with one sensor, a, that has joined; in lockstep."""
    stage = Stage(scenario(sensor_table("a"), **tables))
    stage.join("a", 2.0)
    return stage


def pair(speed: float = 1.0, **tables: Any) -> Stage:
    """A center with two sensors, a and b, that have joined; in real time."""
    stage = Stage(scenario(**tables), speed=speed)
    stage.join_all()
    return stage


def times_s(stage: Stage, messages: Iterable[Any]) -> list[float]:
    """Measurement times of the pictures among messages."""
    return [stage.scenario.to_seconds(tracks.time_ns) for tracks in only(Tracks, messages)]


# Beginning ------------------------------------------------------------------------------------------------------------


def test_a_sensor_that_joins_is_told_of_all_tracks() -> None:
    later = hypothesis_table(900.0, start=7.0, sigma=[50.0, 50.0, 5.0, 5.0])
    stage = Stage(scenario(hypothesis=[hypothesis_table(), later]))
    (start,) = stage.join("b", 2.0)
    assert isinstance(start, Start)
    assert start.sensor == "b"
    assert start.ids.tolist() == [0, 1]
    assert start.times_ns.tolist() == [stage.ns(0.0), stage.ns(7.0)]
    assert start.log_p_bar.tolist() == [0.0, 0.0]
    assert start.x.tolist() == start.x_a.tolist() == [[0.0, 0.0, 150.0, 0.0], [900.0, 0.0, 150.0, 0.0]]
    assert np.array_equal(start.P_a[1], np.diag([2500.0, 2500.0, 25.0, 25.0]))
    assert np.array_equal(start.P, 2.0 * start.P_a)


def test_without_hypotheses_there_is_nothing_to_tell() -> None:
    stage = Stage(scenario(sensor_table("a"), hypothesis=[], target=[]))
    start, _ = stage.join("a", 2.0)
    assert isinstance(start, Start)
    assert (start.ids.tolist(), start.x.shape, start.P.shape) == ([], (0, 4), (0, 4, 4))
    messages = stage.tell(
        stage.report("a", 2.0, ids=np.empty(0, np.int64), terms=np.empty(0, np.int64), **no_tracks(4))
    )
    assert times_s(stage, messages) == [2.0]


def no_tracks(n: int) -> dict[str, Any]:
    """Arrays of a report without tracks."""
    return {"log_g": np.empty(0), "x": np.empty((0, n)), "P": np.empty((0, n, n))}


@pytest.mark.parametrize("speed", [0.0, 5.0])
def test_the_clock_begins_when_all_sensors_are_there(speed: float) -> None:
    stage = Stage(scenario(), speed=speed)
    assert only(Clock, stage.join("a", 3.0)) == []
    (clock,) = only(Clock, stage.join("b", 2.0, at_s=1.0))
    # In lockstep the time is the newest that was worked in: none yet.
    time_ns = stage.ns(2.0) - (speed == 0.0)
    assert (clock.time_ns, clock.speed, clock.clear_ns) == (time_ns, speed, stage.ns(2.0))
    assert clock.wall_ns > 1.0 * NS_PER_S


def test_the_clock_begins_after_the_wait_with_those_who_joined() -> None:
    stage = Stage(scenario(), wait_s=10.0)
    stage.join("b", 2.0, at_s=3.0)
    assert stage.center.deadline_ns(stage.state) == 13 * NS_PER_S
    assert only(Clock, stage.tick(12.9)) == []
    assert len(only(Clock, stage.tick(13.0))) == 1
    assert times_s(stage, stage.tell(stage.report("b", 2.0), 13.1)) == [2.0]


def test_without_any_sensor_the_center_goes_on_waiting() -> None:
    stage = Stage(scenario(), wait_s=10.0)
    assert stage.tick(11.0) == []
    (start,) = stage.join("a", 2.0, at_s=12.0)
    assert isinstance(start, Start)
    assert len(only(Clock, stage.tick(22.0))) == 1


def test_a_wait_that_is_over_is_no_deadline() -> None:
    stage = Stage(scenario(), wait_s=10.0)
    stage.tick(11.0)
    deadline = stage.center.deadline_ns(stage.state)
    assert deadline is None or deadline > 11 * NS_PER_S


def test_reports_that_come_before_the_clock_wait_for_it() -> None:
    stage = Stage(scenario(), wait_s=10.0, speed=1.0)
    stage.join("a", 2.0)
    assert stage.tell(stage.report("a", 2.0)) == []
    assert times_s(stage, stage.tick(10.0)) == [2.0]


def test_who_joins_late_is_told_of_tracks_and_clock() -> None:
    stage = Stage(scenario(decision=UNDECIDED), wait_s=10.0)
    stage.join("a", 2.0)
    stage.tick(10.0)
    stage.tell(stage.report("a", 2.0), 10.0)
    start, clock = stage.join("b", 3.0, at_s=11.0)[:2]
    assert isinstance(start, Start)
    assert isinstance(clock, Clock)
    # b never reported: it begins with the prior at the start and works in what it has seen since.
    assert start.times_ns.tolist() == [stage.ns(0.0)]
    assert start.x.tolist() == [[0.0, 0.0, 150.0, 0.0]]


def test_who_joins_late_is_told_the_present() -> None:
    """So that a node whose clock is wrong sees all that is still to come."""
    stage = Stage(scenario(), wait_s=10.0, speed=2.0)
    stage.join("a", 2.0)
    (first,) = only(Clock, stage.tick(10.0))
    (late,) = only(Clock, stage.join("b", 9.0, at_s=14.05))
    assert late.wall_ns == round(14.05 * NS_PER_S)
    assert late.time_ns == stage.ns(10.0)
    assert late.due_ns(stage.ns(20.0)) == first.due_ns(stage.ns(20.0))
    assert stage.state.clock == first
    (again,) = only(Clock, stage.join("b", 9.0, at_s=10.0))
    assert again == first


def test_an_unknown_sensor_gets_no_answer() -> None:
    stage = Stage(scenario())
    assert stage.tell(Join("c", 1, stage.ns(2.0), stage.center.digest)) == []
    assert stage.tell(Presence("c", alive=True)) == []
    assert stage.state.refused == {("c", "unknown sensor"): 1}


def test_a_sensor_with_another_scenario_gets_no_answer() -> None:
    stage = Stage(scenario())
    assert stage.tell(Join("a", 1, stage.ns(2.0), "another")) == []
    assert stage.state.refused == {("a", "another scenario"): 1}


# Order ----------------------------------------------------------------------------------------------------------------

ORDERED = scenario(
    sensor_table("a", scan_interval=2.0),
    sensor_table("b", scan_interval=2.5, p_d=0.7),
    sensor_table("c", scan_interval=2.0, false_plots=6.0),
    hypothesis=[hypothesis_table(), hypothesis_table(4000.0), hypothesis_table(-3000.0, 2000.0, start=5.0)],
    simulation={"duration": 8.0},
    fusion={"window": 1000.0},
)


def ordered_stage(speed: float = 1.0) -> tuple[Stage, dict[str, Start]]:
    stage = Stage(ORDERED, speed=speed)
    return stage, stage.join_all(b=2.5)


ORDERED_REPORTS = reports_of(ORDERED, ordered_stage()[1], simulate_all(ORDERED, 3))


def play(reports: Sequence[Report], speed: float, pace_s: float) -> Stage:
    """A center that hears reports in the given order, one every ``pace_s`` of wall time, and then no more."""
    stage, _ = ordered_stage(speed)
    for number, report in enumerate(reports, start=1):
        stage.tell(report, number * pace_s)
        stage.tick((number + 0.9) * pace_s)
    stage.tick(1e6)
    return stage


def announced(stage: Stage) -> dict[tuple[int, int], str]:
    """The decisions that stand, as somebody knows them who heard all messages: by track and time."""
    standing: dict[tuple[int, int], str] = {}
    for decision in stage.decisions:
        place = decision.track, decision.time_ns
        if decision.kind == "withdrawn":
            del standing[place]
        else:
            assert place not in standing
            standing[place] = decision.kind
    return standing


def assert_same_picture(stage: Stage, expected: Stage) -> None:
    assert stage.state.waiting == expected.state.waiting == {}
    for one, other in zip(stage.tracks, expected.tracks, strict=True):
        if isinstance(one, np.ndarray):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
        else:
            assert one == other
    decided = [[d for checkpoint in it.state.history for d in checkpoint.decisions] for it in (stage, expected)]
    assert [decision[:3] for decision in decided[0]] == [decision[:3] for decision in decided[1]]
    np.testing.assert_allclose([d.log_lr for d in decided[0]], [d.log_lr for d in decided[1]], rtol=1e-9, atol=1e-9)
    assert announced(stage) == {(decision.track, decision.time_ns): decision.kind for decision in decided[0]}


IN_ORDER = play(ORDERED_REPORTS, 0.0, 0.01)


def test_in_order_the_center_is_the_replay() -> None:
    *_, last = only(Tracks, Replay(ORDERED, simulate_all(ORDERED, 3)).run())
    assert same(IN_ORDER.tracks, last)
    assert {decision.kind for decision in IN_ORDER.decisions} == {"confirmed", "deleted"}


@pytest.mark.parametrize("pace_s", [0.01, 1.0], ids=["within the hold-back", "beyond the hold-back"])
@pytest.mark.parametrize("speed", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(5))
def test_the_order_of_arrival_does_not_matter(seed: int, speed: float, pace_s: float) -> None:
    order = np.random.default_rng(seed).permutation(len(ORDERED_REPORTS))
    stage = play([ORDERED_REPORTS[number] for number in order], speed, pace_s)
    assert_same_picture(stage, IN_ORDER)
    assert stage.state.counts.late > 0
    assert stage.state.counts._replace(late=0) == IN_ORDER.state.counts


def test_the_worst_order_does_not_matter() -> None:
    stage = play(ORDERED_REPORTS[::-1], 1.0, 1.0)
    assert_same_picture(stage, IN_ORDER)
    assert "withdrawn" in {decision.kind for decision in stage.decisions}


@pytest.mark.parametrize("pace_s", [0.01, 1.0], ids=["within the hold-back", "beyond the hold-back"])
@pytest.mark.parametrize("seed", [None, 0, 1])
def test_work_done_ahead_changes_no_digit(seed: int | None, pace_s: float) -> None:
    count = len(ORDERED_REPORTS)
    order = range(count) if seed is None else np.random.default_rng(seed).permutation(count)
    (eager, _), (lazy, _) = ordered_stage(), ordered_stage()
    for at, number in enumerate(order, start=1):
        eager.state = eager.center.prepare(eager.state)
        for stage in (eager, lazy):
            stage.tell(ORDERED_REPORTS[number], at * pace_s)
    for stage in (eager, lazy):
        stage.tick(1e6)
    assert all_same(eager.said, lazy.said)
    assert eager.state.history[-1].picture.scans.tolist() == lazy.state.history[-1].picture.scans.tolist()


def test_what_is_prepared_is_not_done_again() -> None:
    stage = pair()
    stage.state = ahead = stage.center.prepare(stage.state)
    assert ahead.expected is not None
    assert ahead.expected.t_ns == stage.ns(2.0)
    assert stage.center.prepare(ahead).expected is ahead.expected
    # Were it computed anew, nobody would notice the spoilt constant.
    spoilt = ahead.expected.product._replace(log_c=ahead.expected.product.log_c - 1000.0)
    stage.state = ahead._replace(expected=ahead.expected._replace(product=spoilt))
    stage.tell(stage.report("a", 2.0))
    stage.tell(stage.report("b", 2.0))
    assert stage.tracks.log_lr_total[0] > 900.0


@pytest.mark.parametrize("next_s", [None, 1e9])
def test_nothing_is_prepared_while_nothing_is_due_soon(next_s: float | None) -> None:
    stage = Stage(scenario())
    assert stage.center.prepare(stage.state) is stage.state
    stage.join_all()
    for name in ("a", "b"):
        stage.tell(stage.report(name, 2.0)._replace(next_ns=stage.ns(next_s)))
    assert len(stage.state.history) == 1
    assert stage.center.prepare(stage.state) is stage.state


@settings(deadline=None, derandomize=True, database=None, max_examples=25)
@given(
    st.lists(st.integers(0, len(ORDERED_REPORTS) - 1), min_size=1, max_size=14),
    st.sampled_from([0.01, 0.3, 1.0]),
)
def test_with_reports_lost_and_repeated_the_order_does_not_matter(numbers: list[int], pace_s: float) -> None:
    stage = play([ORDERED_REPORTS[number] for number in numbers], 1.0, pace_s)
    expected = play([ORDERED_REPORTS[number] for number in sorted(set(numbers))], 1.0, 1.0)
    assert_same_picture(stage, expected)
    assert stage.state.counts.repeated == len(numbers) - len(set(numbers))


@pytest.mark.parametrize("pace_s", [0.0, 0.6])
def test_pictures_come_by_time_while_nothing_is_late(pace_s: float) -> None:
    stage = play(ORDERED_REPORTS, 1.0, pace_s)
    times = times_s(stage, stage.said)
    assert times == sorted(times)


# Waiting --------------------------------------------------------------------------------------------------------------


def test_a_report_waits_for_those_that_are_due() -> None:
    stage = pair()
    assert stage.tell(stage.report("a", 2.0), 5.0) == []
    assert stage.center.deadline_ns(stage.state) == round(5.5 * NS_PER_S)
    messages = stage.tell(stage.report("b", 2.0), 5.2)
    assert times_s(stage, messages) == [2.0]
    assert only(Tracks, messages)[0].contributing.tolist() == [[True, True]]
    assert stage.center.deadline_ns(stage.state) is None


def test_a_report_waits_for_earlier_ones() -> None:
    stage = pair()
    stage.join("b", 1.5, incarnation=2)
    stage.tell(stage.report("a", 2.0), 5.0)
    assert times_s(stage, stage.tell(stage.report("b", 1.5, 1.8), 5.1)) == [1.5]
    assert times_s(stage, stage.tell(stage.report("b", 1.8, 3.0), 5.2)) == [1.8, 2.0]


def test_the_hold_back_ends_the_wait() -> None:
    stage = pair(fusion={"hold_back": 0.25})
    stage.tell(stage.report("a", 2.0), 5.0)
    assert stage.tick(5.2) == []
    messages = stage.tick(5.25)
    assert only(Tracks, messages)[0].contributing.tolist() == [[True, False]]
    assert stage.tell(stage.report("b", 2.0), 5.3) != []
    assert stage.tracks.contributing.tolist() == [[True, True]]
    assert stage.state.counts.late == 1


def test_in_lockstep_the_center_waits_for_ever() -> None:
    stage = pair(speed=0.0)
    stage.tell(stage.report("a", 2.0), 5.0)
    assert stage.center.deadline_ns(stage.state) is None
    assert stage.tick(1e6) == []


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_a_dead_sensor_is_not_waited_for(speed: float) -> None:
    stage = pair(speed)
    stage.tell(stage.report("a", 2.0), 5.0)
    assert times_s(stage, stage.tell(Presence("b", alive=False), 5.1)) == [2.0]
    assert times_s(stage, stage.tell(stage.report("a", 4.0), 7.0)) == [4.0]


def test_a_sensor_that_comes_back_is_waited_for_again() -> None:
    stage = pair()
    stage.tell(Presence("b", alive=False))
    stage.tell(Presence("b", alive=True))
    assert stage.tell(stage.report("a", 2.0), 5.0) == []


def test_the_last_report_of_a_dead_sensor_does_not_raise_it() -> None:
    """The end of its token may overtake it."""
    stage = pair()
    stage.tell(Presence("b", alive=False))
    stage.tell(stage.report("b", 2.0), 5.0)
    stage.tell(stage.report("a", 2.0), 5.0)
    assert times_s(stage, stage.tell(stage.report("a", 4.0), 7.0)) == [4.0]


def test_a_sensor_that_has_nothing_due_is_not_waited_for() -> None:
    stage = Stage(scenario(), speed=1.0)
    stage.join_all(b=2.0)
    stage.tell(stage.report("b", 2.0, 8.0), 5.0)
    assert times_s(stage, stage.tell(stage.report("a", 2.0), 5.0)) == [2.0]
    assert times_s(stage, stage.tell(stage.report("a", 4.0), 7.0)) == [4.0]
    assert times_s(stage, stage.tell(stage.report("a", 6.0), 9.0)) == [6.0]
    assert times_s(stage, stage.tell(stage.report("a", 8.0), 11.0)) == []


def test_a_silent_sensors_factor_is_predicted() -> None:
    stage = pair(decision=UNDECIDED)
    motion = stage.scenario.motion.build()
    F, Q = motion.transition(np.array(2.0)), motion.noise(np.array(2.0))
    before = stage.state.picture
    stage.tell(stage.report("a", 2.0), 5.0)
    stage.tick(6.0)
    after = stage.state.picture
    np.testing.assert_allclose(after.x[0, 1, 0], F @ before.x[0, 1, 0])
    np.testing.assert_allclose(after.P[0, 1, 0], F @ before.P[0, 1, 0] @ F.T + 2.0 * Q)
    assert after.log_p_bar[0, 1] == 0.0
    information = np.linalg.inv(after.P[0, :, 0]).sum(axis=0)
    np.testing.assert_allclose(stage.tracks.P[0], np.linalg.inv(information), rtol=1e-9)


def test_a_scan_without_a_track_leaves_its_ratio_alone() -> None:
    stage = alone(hypothesis=[hypothesis_table(), hypothesis_table(5000.0, start=3.0)])
    stage.tell(stage.report("a", 2.0, **evidence(1.5)))
    assert stage.tracks.ids.tolist() == [0]
    stage.tell(stage.report("a", 4.0, **evidence(2.0)))
    assert stage.tracks.ids.tolist() == [0, 1]
    assert stage.tracks.scans.tolist() == [2, 0]
    assert stage.tracks.contributing.tolist() == [[True], [False]]
    np.testing.assert_allclose(stage.tracks.log_lr, [2.0, 0.0], atol=1e-9)


def test_a_report_of_the_time_a_track_starts_is_too_early_for_it() -> None:
    stage = alone(hypothesis=[hypothesis_table(start=2.0)], decision=UNDECIDED)
    stage.tell(stage.report("a", 2.0, **evidence(5.0)))
    assert stage.tracks.scans.tolist() == [0]
    assert stage.tracks.log_lr.tolist() == [0.0]


def test_only_sensors_that_reported_at_this_time_contribute() -> None:
    stage = pair(speed=0.0, decision=UNDECIDED)
    stage.tell(stage.report("a", 2.0))
    stage.tell(stage.report("b", 2.0, 6.0))
    stage.tell(stage.report("a", 4.0))
    assert [tracks.contributing.tolist() for tracks in only(Tracks, stage.said)] == [[[True, True]], [[True, False]]]


# Loss, repetition, refusal --------------------------------------------------------------------------------------------


def test_after_a_lost_report_the_next_one_restores_the_evidence() -> None:
    plot = scenario(sensor_table("a"), decision=UNDECIDED)
    whole, lossy = Stage(plot), Stage(plot)
    starts = whole.join_all()
    lossy.join_all()
    for number, report in enumerate(reports_of(plot, starts, simulate_all(plot, 3))):
        whole.tell(report)
        if number not in (1, 4, 5):
            lossy.tell(report)
            np.testing.assert_allclose(lossy.tracks.log_lr, whole.tracks.log_lr, rtol=1e-9)
            np.testing.assert_allclose(lossy.tracks.x, whole.tracks.x, rtol=1e-9)
    assert (whole.tracks.scans.tolist(), lossy.tracks.scans.tolist()) == ([10], [7])


def test_a_loss_in_a_network_restores_every_sum() -> None:
    plot = scenario(decision=UNDECIDED)
    whole, lossy = Stage(plot, speed=1.0), Stage(plot, speed=1.0)
    starts = whole.join_all()
    lossy.join_all()
    for number, report in enumerate(reports_of(plot, starts, simulate_all(plot, 3))):
        whole.tell(report, number)
        if number != 5:
            lossy.tell(report, number)
    lossy.tick(100.0)
    np.testing.assert_allclose(lossy.state.picture.log_p_bar, whole.state.picture.log_p_bar)
    np.testing.assert_allclose(lossy.tracks.x, whole.tracks.x, rtol=1e-9)
    # The constant of the product was taken at other factors in between: a little is lost for good.
    np.testing.assert_allclose(lossy.tracks.log_lr, whole.tracks.log_lr, atol=1.0)


@pytest.mark.parametrize("worked_in", [False, True])
def test_a_repeated_report_is_counted_and_changes_nothing(worked_in: bool) -> None:
    stage = pair()
    report = stage.report("a", 2.0, **evidence(1.0))
    stage.tell(report)
    if worked_in:
        stage.tell(stage.report("b", 2.0))
    before = stage.state
    assert stage.tell(report) == []
    assert stage.state.counts == before.counts._replace(repeated=1)
    assert same(stage.tracks, stage.center.tracks(before))
    assert stage.state._replace(counts=before.counts, members=before.members) == before


def test_a_report_older_than_the_window_is_counted_and_dropped() -> None:
    stage = pair(fusion={"window": 4.0}, decision=UNDECIDED)
    stage.tell(Presence("b", alive=False))
    for time_s in (2.0, 4.0, 6.0, 8.0):
        stage.tell(stage.report("a", time_s), time_s)
    before = stage.tracks
    assert stage.tell(stage.report("b", 2.0, **evidence(50.0)), 100.0) == []
    assert stage.state.counts.too_late == 1
    assert same(stage.tracks, before)
    assert only(Tracks, stage.tell(stage.report("b", 4.0, **evidence(50.0)), 100.0))
    assert stage.state.counts.late == 1


def test_a_wrong_clock_makes_nobody_else_late() -> None:
    stage = pair(fusion={"window": 4.0}, decision=UNDECIDED)
    assert stage.tell(stage.report("a", 86_400.0), 0.1) == []
    assert stage.state.refused == {("a", "time too far ahead"): 1}
    stage.tell(stage.report("b", 2.0), 0.2)
    assert stage.tell(stage.report("a", 2.0), 0.3)
    assert stage.state.counts.late == 0


def test_a_late_report_may_have_a_time_of_its_own() -> None:
    stage = pair(decision=UNDECIDED)
    stage.tell(Presence("b", alive=False))
    stage.tell(stage.report("a", 2.0))
    stage.tell(stage.report("a", 4.0))
    stage.tell(stage.report("b", 3.0, 5.0))
    assert [stage.scenario.to_seconds(checkpoint.time_ns) for checkpoint in stage.state.history] == [2.0, 3.0, 4.0]
    assert stage.tracks.scans.tolist() == [3]


#: Reports that are not the next one of their sensor.
MISPLACED: dict[str, tuple[str, dict[str, Any]]] = {
    "unknown sensor": ("unknown sensor", {"sensor": "z"}),
    "older epoch": ("older epoch", {"epoch": 1}),
    "newer epoch": ("epoch not in force", {"epoch": 99}),
    "next scan now": ("next scan not after this one", {"next_ns": scenario().to_ns(2.0)}),
    "next scan before": ("next scan not after this one", {"next_ns": scenario().to_ns(1.0)}),
}

#: Reports that are the next one of their sensor, and cannot be computed with.
UNFIT: dict[str, tuple[str, dict[str, Any]]] = {
    "wrong state": ("wrong dimensions", {"x": np.zeros((1, 6)), "P": np.eye(6)[None]}),
    "wrong state, no tracks": (
        "wrong dimensions",
        {"ids": np.empty(0, np.int64), "terms": np.empty(0, np.int64), **no_tracks(6)},
    ),
    "two terms": (
        "too many terms",
        {"terms": np.array([2]), "log_g": np.zeros(2), "x": np.zeros((2, 4)), "P": np.tile(np.eye(4), (2, 1, 1))},
    ),
}


@pytest.mark.parametrize(("why", "changes"), MISPLACED.values(), ids=MISPLACED.keys())
@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_a_report_that_is_not_the_next_of_its_sensor_changes_nothing_but_the_counts(
    why: str, changes: dict[str, Any], speed: float
) -> None:
    stage = pair(speed)
    before = stage.state
    report = stage.report("a", 2.0, **changes)
    assert stage.tell(report) == []
    assert stage.state.counts.refused == 1
    assert stage.state.refused == {(report.sensor, why): 1}
    assert stage.state._replace(counts=before.counts, refused=before.refused) == before
    assert stage.tick(100.0) == []
    # The network goes on.
    stage.tell(stage.report("a", 2.0), 200.0)
    assert times_s(stage, stage.tell(stage.report("b", 2.0), 200.0)) == [2.0]


@pytest.mark.parametrize(("why", "changes"), UNFIT.values(), ids=UNFIT.keys())
@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_a_scan_whose_report_cannot_be_computed_with_is_a_silent_one(
    why: str, changes: dict[str, Any], speed: float
) -> None:
    silent, stage = pair(speed), pair(speed)
    silent.tell(silent.report("a", 2.0))
    stage.tell(stage.report("a", 2.0))
    # What is left of b's report is when the next one is due: as if b had looked away at 2 s.
    silent.tell(Presence("b", alive=False))
    silent.tell(Presence("b", alive=True))
    pictures = stage.tell(stage.report("b", 2.0, **changes))
    assert stage.state.refused == {("b", why): 1}
    assert times_s(stage, pictures) == [2.0]
    assert same(stage.tracks, silent.tracks)
    stage.tell(stage.report("b", 4.0))
    assert times_s(stage, stage.tell(stage.report("a", 4.0))) == [4.0]


def test_in_lockstep_the_nodes_may_go_on_after_a_report_that_cannot_be_computed_with() -> None:
    stage = pair(speed=0.0)
    stage.tell(stage.report("a", 2.0, next_s=3.0, P=np.zeros((1, 4, 4))))
    stage.tell(stage.report("b", 2.0, next_s=5.0, P=np.zeros((1, 4, 4))))
    assert stage.clear_s[-1] == 3.0
    stage.tell(stage.report("a", 3.0, next_ns=NEVER, P=np.zeros((1, 4, 4))))
    stage.tell(stage.report("b", 5.0, next_ns=NEVER, P=np.zeros((1, 4, 4))))
    assert stage.state.finished


def test_names_that_somebody_invents_do_not_fill_the_counts() -> None:
    stage = pair()
    for number in range(2000):
        stage.tell(stage.report("a", 2.0, sensor=f"ghost-{number}"))
    assert stage.state.counts.refused == sum(stage.state.refused.values()) == 2000
    assert len(stage.state.refused) < 1000


@pytest.mark.parametrize(
    "changes",
    [{"P": 1e-300 * np.eye(4)[None]}, {"P": 1e300 * np.eye(4)[None]}, {"x": np.full((1, 4), 1e200)}],
    ids=["P tiny", "P huge", "x huge"],
)
def test_no_report_makes_a_ratio_that_is_no_number(changes: dict[str, Any]) -> None:
    stage = pair(speed=0.0, decision=UNDECIDED)
    stage.tell(stage.report("a", 2.0, **changes))
    stage.tell(stage.report("b", 2.0))
    assert not np.isnan(stage.tracks.log_lr).any()
    assert np.isfinite(stage.tracks.x).all()


def test_a_report_of_a_sensor_that_has_not_joined_is_refused() -> None:
    stage = Stage(scenario())
    stage.join("a", 2.0)
    assert stage.tell(stage.report("b", 2.0)) == []
    assert stage.state.refused == {("b", "not joined"): 1}


def test_a_report_on_tracks_that_are_not_known_is_worked_in_without_them() -> None:
    stage = alone(decision=UNDECIDED)
    report = stage.report("a", 2.0)
    more = report._replace(
        ids=np.array([0, 7]),
        terms=np.array([1, 1]),
        log_g=np.array([1.5, 9.0]),
        x=np.zeros((2, 4)),
        P=np.tile(1e4 * np.eye(4), (2, 1, 1)),
    )
    stage.tell(more)
    assert stage.tracks.ids.tolist() == [0]
    np.testing.assert_allclose(stage.tracks.log_lr, [1.5], atol=1e-9)


# Coming back ----------------------------------------------------------------------------------------------------------


def test_every_sensor_has_an_epoch_of_its_own_above_the_first() -> None:
    stage = Stage(scenario(), first_epoch=41)
    starts = stage.join_all()
    assert all(start.epoch > 41 for start in starts.values())
    assert starts["a"].epoch != starts["b"].epoch


def test_a_sensor_that_reconnects_keeps_its_epoch() -> None:
    stage = Stage(scenario())
    epoch = stage.join_all()["a"].epoch
    (again,) = only(Start, stage.join("a", 4.0, incarnation=1))
    assert again.epoch == epoch
    stage.tell(stage.report("a", 4.0, epoch=epoch))
    assert stage.state.counts.refused == 0


def test_a_sensor_that_starts_anew_gets_a_higher_epoch() -> None:
    stage = Stage(scenario())
    starts = stage.join_all()
    (again,) = only(Start, stage.join("a", 4.0, incarnation=2))
    assert again.epoch > max(start.epoch for start in starts.values())
    assert stage.tell(stage.report("a", 4.0, epoch=starts["a"].epoch)) == []
    assert stage.state.counts.refused == 1


def test_a_sensor_that_starts_anew_gets_its_last_factors_back() -> None:
    plot = scenario(decision=UNDECIDED)
    stage = Stage(plot)
    starts = stage.join_all()
    reports = reports_of(plot, starts, simulate_all(plot, 3))[:8]
    for report in reports:
        stage.tell(report)
    (back,) = only(Start, stage.join("b", 10.0, incarnation=2))
    last = reports[-1]
    assert last.sensor == "b"
    assert back.times_ns.tolist() == [last.time_ns]
    assert np.array_equal(back.log_p_bar, last.log_g)
    assert np.array_equal(back.x, last.x)
    assert np.array_equal(back.P, last.P)
    assert np.array_equal(back.x_a, stage.tracks.x)
    assert np.array_equal(back.P_a, stage.tracks.P)


class Network:
    """Center and nodes in lockstep; a node may die and come back as a new process."""

    def __init__(self, plot: Scenario, seed: int = 3) -> None:
        self.plot = plot
        self.stage = Stage(plot)
        self.scans = simulate_all(plot, seed)
        first = {name: simulate(plot, name, seed)[0].time_ns for name in plot.sensor_names}
        self.nodes = {
            name: Node(plot, name, start)
            for name, time_ns in first.items()
            for start in only(Start, self.stage.tell(Join(name, 1, time_ns, self.stage.center.digest)))
        }

    def scan(self, scan: Scan) -> None:
        later = [other.time_ns for other in self.scans if other.sensor == scan.sensor and other.time_ns > scan.time_ns]
        self.stage.tell(self.nodes[scan.sensor].scan(scan, min(later, default=NEVER)))

    def start_anew(self, name: str, next_ns: int) -> None:
        (back,) = only(Start, self.stage.tell(Join(name, 2, next_ns, self.stage.center.digest)))
        self.nodes[name] = Node(self.plot, name, back)


@pytest.mark.parametrize(("association", "atol"), [("factor", 1e-9), ("tight", 0.2)])
def test_when_a_sensor_starts_anew_the_ratio_goes_on(association: str, atol: float) -> None:
    plot = scenario(
        sensor_table("a"), sensor_table("b", scan_interval=3.0), decision=UNDECIDED, fusion={"association": association}
    )
    steady, broken = Network(plot), Network(plot)
    for scan in steady.scans:
        if scan.time_ns == plot.to_ns(9.0):
            broken.start_anew("b", scan.time_ns)
        steady.scan(scan)
        broken.scan(scan)
        assert_ratios_close(broken, steady, atol)
    assert broken.stage.tracks.scans.tolist() == steady.stage.tracks.scans.tolist()


def assert_ratios_close(first: Network, second: Network, atol: float) -> None:
    np.testing.assert_allclose(first.stage.tracks.log_lr, second.stage.tracks.log_lr, rtol=1e-9, atol=atol)


def test_who_starts_anew_after_a_pause_was_only_silent() -> None:
    plot = scenario(decision=UNDECIDED, fusion={"association": "factor"})
    silent, broken = Network(plot), Network(plot)
    for scan in silent.scans:
        time_s = plot.to_seconds(scan.time_ns)
        if scan.sensor == "a" and time_s == 12.0:
            broken.start_anew("b", scan.time_ns)
            silent.stage.tell(Presence("b", alive=True))
        for network in (silent, broken):
            if scan.sensor == "b" and 6.0 <= time_s <= 10.0:
                network.stage.tell(Presence("b", alive=False))
            else:
                network.scan(scan)
        if scan.sensor == "b":
            assert_ratios_close(broken, silent, 1e-9)
    assert silent.stage.tracks.contributing.tolist() == [[True, True]]
    assert silent.stage.state.counts.late == 0


def test_who_starts_anew_is_told_of_live_tracks_only() -> None:
    stage = alone(hypothesis=[hypothesis_table(), hypothesis_table(5000.0)])
    stage.tell(stage.report("a", 2.0, **evidence(-MUCH)))
    (back,) = only(Start, stage.join("a", 4.0, incarnation=2))
    assert back.ids.tolist() == [1]


# Decisions ------------------------------------------------------------------------------------------------------------


def test_a_track_is_confirmed_monitored_and_deleted() -> None:
    stage = alone()
    log_b = np.log(0.95 / 1e-4)
    sums = [log_b - 0.1, log_b + 0.1, log_b + 1.0, 2.0 * log_b + 0.2, 2.0 * log_b - 4.0]
    for time_s, total in zip((2.0, 4.0, 6.0, 8.0, 10.0), sums, strict=True):
        stage.tell(stage.report("a", time_s, **evidence(total)))
    # Confirmed anew at 8 s, the track only has its ratio reset.
    confirmed, deleted = stage.decisions
    assert [decision.kind for decision in stage.decisions] == ["confirmed", "deleted"]
    assert [decision.scans for decision in stage.decisions] == [2, 5]
    assert [decision.time_ns for decision in stage.decisions] == [stage.ns(time_s) for time_s in (4.0, 10.0)]
    np.testing.assert_allclose([confirmed.log_lr, confirmed.log_lr_total], log_b + 0.1, atol=1e-9)
    np.testing.assert_allclose([deleted.log_lr, deleted.log_lr_total], [-4.2, 2.0 * log_b - 4.0], atol=1e-9)
    assert [tracks.status.tolist() for tracks in only(Tracks, stage.said)] == [[0], [1], [1], [1], [2]]
    np.testing.assert_allclose(
        [tracks.log_lr[0] for tracks in only(Tracks, stage.said)], [log_b - 0.1, 0.0, 0.9, 0.0, -4.2], atol=1e-9
    )
    stage.tell(stage.report("a", 12.0, **evidence(MUCH)))
    assert stage.tracks.ids.tolist() == []


def test_a_decision_comes_before_its_picture() -> None:
    stage = alone()
    messages = stage.tell(stage.report("a", 2.0, **evidence(-MUCH)))
    assert [type(message) for message in messages] == [Decision, Tracks, Clock]


def test_an_impossible_scan_deletes() -> None:
    stage = alone()
    stage.tell(stage.report("a", 2.0, **evidence(-np.inf)))
    (decision,) = stage.decisions
    assert (decision.kind, decision.log_lr) == ("deleted", -np.inf)


def test_what_is_impossible_stays_so_where_nothing_is_decided() -> None:
    stage = pair(decision=UNDECIDED, speed=0.0)
    for time_s in (2.0, 4.0, 6.0):
        stage.tell(stage.report("a", time_s, **evidence(-np.inf)))
        stage.tell(stage.report("b", time_s, **evidence(-np.inf if time_s > 3.0 else 1.0)))
        assert stage.tracks.log_lr.tolist() == [-np.inf]
    assert stage.decisions == []
    assert stage.tracks.status.tolist() == [0]


def test_a_late_report_withdraws_what_it_undoes() -> None:
    stage = pair()
    stage.tell(stage.report("a", 2.0, **evidence(-MUCH)), 5.0)
    (deleted,) = only(Decision, stage.tick(6.0))
    assert (deleted.kind, deleted.track) == ("deleted", 0)
    messages = stage.tell(stage.report("b", 2.0, **evidence(3.0 * MUCH)), 7.0)
    withdrawn, confirmed = only(Decision, messages)
    assert withdrawn == deleted._replace(kind="withdrawn")
    assert (confirmed.kind, confirmed.time_ns) == ("confirmed", stage.ns(2.0))
    assert stage.tracks.status.tolist() == [1]


def test_a_late_report_repeats_no_decision_that_stands() -> None:
    stage = pair(hypothesis=[hypothesis_table(), hypothesis_table(5000.0)])
    stage.tell(Presence("b", alive=False))
    stage.tell(stage.report("a", 2.0, **evidence(5.0)))
    stage.tell(stage.report("a", 4.0, **evidence(-MUCH)))
    messages = stage.tell(stage.report("b", 2.0, ids=np.array([1]), **evidence(-1.0)))
    assert [decision.track for decision in only(Decision, messages)] == [1]


def test_a_late_report_may_decide_earlier() -> None:
    stage = pair()
    stage.tell(Presence("b", alive=False))
    stage.tell(stage.report("a", 2.0, **evidence(5.0)))
    stage.tell(stage.report("a", 4.0, **evidence(-MUCH)))
    withdrawn, deleted = only(Decision, stage.tell(stage.report("b", 2.0, **evidence(-3.0 * MUCH))))
    assert (withdrawn.kind, withdrawn.time_ns) == ("withdrawn", stage.ns(4.0))
    assert (deleted.kind, deleted.time_ns) == ("deleted", stage.ns(2.0))
    assert stage.tracks.ids.tolist() == []


def test_nodes_are_told_to_stop_only_when_no_late_report_can_undo_it() -> None:
    stage = pair(speed=0.0, fusion={"window": 4.0}, hypothesis=[hypothesis_table(), hypothesis_table(5000.0)])
    stopped = {}
    for time_s in (2.0, 4.0, 6.0, 8.0, 10.0, 12.0):
        log_g = -MUCH if time_s > 3.0 else 0.0
        stage.tell(stage.report("a", time_s, **evidence(log_g)))
        stopped[time_s] = only(Stop, stage.tell(stage.report("b", time_s, **evidence(0.0))))
    assert [decision.time_ns for decision in stage.decisions] == [stage.ns(4.0)]
    stops = stopped.pop(10.0)
    assert [(stop.sensor, stop.ids.tolist()) for stop in stops] == [("a", [0]), ("b", [0])]
    assert not any(stopped.values())


@pytest.mark.parametrize("feedback", ["none", "advice"])
def test_advice_is_the_picture_of_live_tracks(feedback: str) -> None:
    stage = alone(fusion={"feedback": feedback}, hypothesis=[hypothesis_table(), hypothesis_table(5000.0)])
    messages = stage.tell(stage.report("a", 2.0, **evidence(-MUCH)))
    (tracks,) = only(Tracks, messages)
    assert tracks.status.tolist() == [2, 0]
    given = only(Advice, messages)
    if feedback == "none":
        assert given == []
    else:
        assert all_same(given, [Advice(tracks.time_ns, tracks.time_ns, tracks.ids[1:], tracks.x[1:], tracks.P[1:])])


# Lockstep and end -----------------------------------------------------------------------------------------------------


def test_in_lockstep_the_clock_follows_the_slowest_sensor() -> None:
    stage = Stage(scenario())
    stage.join_all(a=2.0, b=3.0)
    assert stage.clear_s == [2.0]
    stage.tell(stage.report("a", 2.0, 4.0))
    stage.tell(stage.report("b", 3.0, 6.0))
    stage.tell(stage.report("a", 4.0, 6.0))
    assert stage.clear_s == [2.0, 3.0, 4.0, 6.0]
    assert only(Clock, stage.tell(stage.report("a", 6.0, 8.0))) == []
    assert not stage.state.finished
    stage.tell(stage.report("b", 6.0, next_ns=NEVER))
    stage.tell(stage.report("a", 8.0, next_ns=NEVER))
    assert stage.clear_s == [2.0, 3.0, 4.0, 6.0, 8.0, None]
    assert stage.state.finished


def test_in_lockstep_the_clock_goes_on_without_the_dead() -> None:
    stage = Stage(scenario())
    stage.join_all(a=2.0, b=2.0)
    stage.tell(stage.report("a", 2.0))
    stage.tell(Presence("b", alive=False))
    assert stage.clear_s == [2.0, 4.0]


def test_in_real_time_the_clock_is_set_once_and_then_stopped() -> None:
    stage = pair()
    for time_s in (2.0, 4.0, 6.0):
        for name in "ab":
            stage.tell(stage.report(name, time_s, **({"next_ns": NEVER} if time_s == 6.0 else {})))
    assert stage.clear_s == [2.0, None]
    assert stage.state.finished


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_the_end_does_not_wait_for_the_dead(speed: float) -> None:
    stage = pair(speed)
    stage.tell(stage.report("a", 2.0, next_ns=NEVER))
    assert not stage.state.finished
    stage.tell(Presence("b", alive=False))
    assert stage.state.finished


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_all_dead_is_no_end(speed: float) -> None:
    stage = pair(speed)
    for name in "ab":
        stage.tell(Presence(name, alive=False))
    assert not stage.state.finished


def test_a_network_with_nothing_to_see_ends_at_once() -> None:
    stage = Stage(scenario())
    stage.join("a", None)
    assert not stage.state.finished
    stage.join("b", None)
    assert stage.state.finished


# The whole against the textbook ---------------------------------------------------------------------------------------


def central_log_lr(plot: Scenario, scans: Sequence[Scan]) -> float:
    """Log LR of a central Kalman filter without misses and false plots."""
    motion = plot.motion.build()
    (x, P), now_ns, log_lr = plot.hypotheses[0].density, plot.epoch_ns, 0.0
    for scan in scans:
        dt = np.array((scan.time_ns - now_ns) / NS_PER_S)
        F = motion.transition(dt)
        x, P, now_ns = F @ x, F @ P @ F.T + motion.noise(dt), scan.time_ns
        sensor = plot.sensor(scan.sensor)
        S = P[:2, :2] + np.diag(np.square(sensor.sigma))
        (z,) = scan.z
        nu = z - x[:2]
        log_rho_f = sensor.build(motion).log_rho_f
        log_lr += -0.5 * nu @ np.linalg.solve(S, nu) - 0.5 * np.linalg.slogdet(2.0 * np.pi * S)[1] - log_rho_f
        K = P[:, :2] @ np.linalg.inv(S)
        x, P = x + K @ nu, P - K @ S @ K.T
    return float(log_lr)


@pytest.mark.parametrize("mode", ["dkf", "federated"])
def test_without_clutter_the_network_is_the_central_kalman_filter(mode: str) -> None:
    certain = {"p_d": 1.0, "false_plots": 1e-9}
    sensors = [sensor_table(name, **certain) for name in "abc"]
    if mode == "dkf":
        sensors[1].update(sigma=[20.0, 90.0], scan_interval=3.0)
        sensors[2].update(sigma=[70.0, 30.0], first_scan=0.5)
    plot = scenario(
        *sensors,
        decision=UNDECIDED,
        fusion={"mode": mode, "association": "factor", "gate_probability": 1.0},
    )
    scans = simulate_all(plot, 3)
    *_, last = only(Tracks, Replay(plot, scans).run())
    np.testing.assert_allclose(last.log_lr, central_log_lr(plot, scans), rtol=1e-9)
