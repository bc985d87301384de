from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builders import Node, same, scenario, sensor_table
from scipy import stats

from waldnet.common.config import Scenario
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.estimation.motion import ConstantVelocity
from waldnet.common.estimation.representation import Share
from waldnet.common.messages import NEVER, Advice, Scan, Start, Stop
from waldnet.scenarios.world import simulate, simulate_all
from waldnet.sensor_node.sources import schedule_of
from waldnet.sensor_node.state import Tracks
from waldnet.sensor_node.tracker import LocalTracker

CONFIGURATIONS = [
    ("federated", "tight"),
    ("federated", "factor"),
    ("federated", "mirrored"),
    ("naive", "tight"),
    ("naive", "mirrored"),
    ("dkf", "factor"),
]
PRIOR_P = np.diag([1e4, 1e4, 400.0, 400.0])
#: Positions of hypotheses: where the target is, near it, and where nothing is.
PLACES = np.array([[0.0, 0.0, 150.0, 0.0], [200.0, -100.0, 140.0, 10.0], [5000.0, 5000.0, -50.0, 0.0]])

each_configuration = pytest.mark.parametrize(("mode", "association"), CONFIGURATIONS)


def world(mode: str = "federated", association: str = "tight", **tables: Any) -> Scenario:
    fusion = {"mode": mode, "association": association, **tables.pop("fusion", {})}
    return scenario(sensor_table("a"), sensor_table("b", first_scan=1.0), fusion=fusion, **tables)


def node(plot: Scenario, *starts: Start) -> Node:
    fresh = Node(plot, "a", schedule=schedule_of(simulate_all(plot, 1), plot))
    for start in starts:
        fresh.start(start)
    return fresh


def start(plot: Scenario, *times_s: float, ids: list[int] | None = None, epoch: int = 1, x: Any = PLACES) -> Start:
    """Tracks 0, 1, ... that start at the given times, at ``x``."""
    count = len(times_s)
    honest = Gaussian(x[:count], np.tile(PRIOR_P, (count, 1, 1)))
    factor = plot.share.start(honest)
    return Start(
        sensor="a",
        epoch=epoch,
        ids=np.arange(count) if ids is None else np.array(ids),
        times_ns=np.array([plot.to_ns(time_s) for time_s in times_s], np.int64),
        log_p_bar=np.zeros(count),
        x=factor.x,
        P=factor.P,
        x_a=honest.x,
        P_a=honest.P,
    )


def rows(message: Start, *numbers: int) -> Start:
    """Some tracks of a start."""
    fields = message._asdict().items()
    return message._replace(**{name: value[list(numbers)] for name, value in fields if isinstance(value, np.ndarray)})


def close(first: Tracks, second: Tracks) -> bool:
    """Whether two nodes keep the same tracks, to rounding; where there is no component any density does."""

    def kept(tracks: Tracks) -> list[Any]:
        there = tracks.log_w > -np.inf
        mixtures = ("log_w", "log_g", "x", "P", "x_a", "P_a")
        arrays = [array[there] if name in mixtures else array for name, array in tracks._asdict().items()]
        return [there.sum(axis=-1), *arrays]

    return all(
        one.shape == other.shape
        and (np.array_equal(one, other) if one.dtype == np.int64 else np.allclose(one, other, rtol=1e-9, atol=1e-9))
        for one, other in zip(kept(first), kept(second), strict=True)
    )


def scan_at(plot: Scenario, time_s: float, *plots: tuple[float, float], position: Any = (3000.0, 0.0)) -> Scan:
    return Scan("a", plot.to_ns(time_s), np.array(position), np.array(plots, np.float64).reshape(-1, 2))


@each_configuration
def test_a_batch_of_tracks_equals_one_by_one(mode: str, association: str) -> None:
    plot = world(mode, association, fusion={"joint": False})
    tracks = start(plot, 0.0, 3.0, 4.0)
    together, alone = node(plot, tracks), [node(plot, rows(tracks, number)) for number in range(3)]
    for scan in simulate(plot, "a", 1):
        report = together.scan(scan)
        singles = [single.scan(scan) for single in alone]
        assert report.ids.tolist() == [int(track) for single in singles for track in single.ids]
        for field in ("log_g", "x", "P"):
            expected = np.concatenate([getattr(single, field) for single in singles])
            np.testing.assert_allclose(getattr(report, field), expected, rtol=1e-9, atol=1e-9)


@each_configuration
def test_tracks_that_start_late_catch_up(mode: str, association: str) -> None:
    plot = world(mode, association)
    tracks = start(plot, 0.0, 4.0, 5.0)
    scans = simulate(plot, "a", 1)
    in_time, late = node(plot, tracks), node(plot)
    for number, scan in enumerate(scans):
        in_time.scan(scan)
        late.scan(scan)
        if number == 3:
            late.start(tracks)
            assert close(late.state.tracks, in_time.state.tracks)
    assert close(late.state.tracks, in_time.state.tracks)


def test_a_start_that_comes_in_parts_in_any_order_is_one_start() -> None:
    plot = world()
    tracks = start(plot, 0.0, 1.0, 2.0)
    whole, parts = node(plot, tracks), node(plot, rows(tracks, 2), rows(tracks, 0), rows(tracks, 1))
    assert parts.state.tracks.ids.tolist() == [0, 1, 2]
    for scan in simulate(plot, "a", 1):
        assert same(whole.scan(scan), parts.scan(scan))


def test_the_buffer_ends_with_the_window() -> None:
    plot = world(fusion={"window": 4.0})
    scans = simulate(plot, "a", 1)
    late = node(plot)
    for scan in scans[:5]:
        late.scan(scan)
    assert [scan.time_ns for scan in late.state.recent] == [plot.to_ns(time_s) for time_s in (6.0, 8.0, 10.0)]
    late.start(start(plot, 0.0))
    expected = node(plot, start(plot, 0.0))
    for scan in scans[2:5]:
        expected.scan(scan)
    assert close(late.state.tracks, expected.state.tracks)


def test_only_scans_after_its_start_move_a_track() -> None:
    plot = world()
    keeper = node(plot, start(plot, 4.0, 5.0))
    before = keeper.state.tracks
    for time_s in (2.0, 4.0):
        report = keeper.scan(scan_at(plot, time_s, (0.0, 0.0)))
        assert report.ids.tolist() == []
        assert (report.log_g.shape, report.x.shape, report.P.shape) == ((0,), (0, 4), (0, 4, 4))
    assert close(keeper.state.tracks, before)
    assert keeper.scan(scan_at(plot, 4.5)).ids.tolist() == [0]
    assert keeper.scan(scan_at(plot, 5.5)).ids.tolist() == [0, 1]
    late = node(plot)
    late.scan(scan_at(plot, 4.0, (0.0, 0.0)))
    late.start(start(plot, 4.0))
    assert close(late.state.tracks, node(plot, start(plot, 4.0)).state.tracks)


def test_a_report_says_what_the_center_needs() -> None:
    plot = world()
    keeper = node(plot, start(plot, 0.0, 0.0, ids=[3, 8], epoch=5))
    first = keeper.scan(scan_at(plot, 2.0), plot.to_ns(4.0))
    second = keeper.scan(scan_at(plot, 4.0), NEVER)
    assert (first.sensor, first.sequence, first.time_ns, first.next_ns, first.epoch) == (
        "a",
        0,
        plot.to_ns(2.0),
        plot.to_ns(4.0),
        5,
    )
    assert (second.sequence, second.time_ns, second.next_ns) == (1, plot.to_ns(4.0), NEVER)
    assert first.ids.tolist() == [3, 8]
    assert first.terms.tolist() == [1, 1]


def test_a_node_without_tracks_reports_too() -> None:
    report = node(world()).scan(scan_at(world(), 2.0, (0.0, 0.0)))
    assert (report.ids.tolist(), report.x.shape, report.P.shape) == ([], (0, 4), (0, 4, 4))


def test_a_step_leaves_the_state_before_as_it_was() -> None:
    plot = world()
    keeper = node(plot, start(plot, 0.0, 3.0))
    for scan in simulate(plot, "a", 1)[:3]:
        keeper.scan(scan)
    advice = Advice(plot.to_ns(4.0), plot.to_ns(4.0), np.array([0, 1]), PLACES[:2], np.tile(PRIOR_P, (2, 1, 1)))
    state, tracker, scan = keeper.state, keeper.tracker, simulate(plot, "a", 1)[3]
    copy = [array.copy() for array in state.tracks]
    first = tracker.scan(state, scan, NEVER)
    tracker.advise(state, advice)
    tracker.start(state, start(plot, 1.0, epoch=9))
    tracker.stop(state, Stop("a", np.array([0])))
    assert all(np.array_equal(before, now) for before, now in zip(copy, state.tracks, strict=True))
    assert same(tracker.scan(state, scan, NEVER)[1], first[1])


# Work done ahead ------------------------------------------------------------------------------------------------------


def prepared(keeper: Node, scan: Scan) -> Any:
    """What a node has ready for a scan."""
    keeper.state = keeper.tracker.prepare(keeper.state, scan.time_ns, scan.pose)
    return keeper.state.ready


@each_configuration
def test_work_done_ahead_changes_no_digit(mode: str, association: str) -> None:
    plot = world(mode, association, fusion={"joint": False})
    tracks = start(plot, 0.0, 3.0, 4.0)
    eager, lazy = node(plot, tracks), node(plot, tracks)
    for scan in simulate(plot, "a", 1):
        prepared(eager, scan)
        assert same(eager.scan(scan), lazy.scan(scan))
        assert same(eager.state.tracks, lazy.state.tracks)


def test_what_is_prepared_is_not_done_again() -> None:
    plot = world()
    keeper, scan = node(plot, start(plot, 0.0)), scan_at(plot, 2.0, (300.0, 0.0))
    ready = prepared(keeper, scan)
    assert prepared(keeper, scan) is ready
    # Were it computed anew, nobody would notice the spoilt prediction.
    spoilt = ready._replace(expected=ready.expected._replace(z=ready.expected.z + 1000.0))
    keeper.state = keeper.state._replace(ready=spoilt)
    assert keeper.scan(scan).log_g[0] < node(plot, start(plot, 0.0)).scan(scan).log_g[0] - 1.0


@pytest.mark.parametrize(("time_s", "position"), [(2.5, (3000.0, 0.0)), (2.0, (3000.0, 1.0))])
def test_what_was_prepared_for_another_scan_is_not_used(time_s: float, position: tuple[float, float]) -> None:
    plot = world()
    tracks, scan = start(plot, 0.0, 0.0), scan_at(plot, 2.0, (300.0, 0.0))
    keeper = node(plot, tracks)
    prepared(keeper, scan_at(plot, time_s, position=position))
    assert same(keeper.scan(scan), node(plot, tracks).scan(scan))


@pytest.mark.parametrize("again", [False, True])
def test_what_comes_in_between_is_not_missed(again: bool) -> None:
    """Start, stop and advice, also from ahead, out of order and repeated, between the preparation and the scan."""
    plot = world(fusion={"feedback": "advice"})
    tracks = start(plot, 0.0, 0.0, 0.0)
    eager, lazy = node(plot, rows(tracks, 0, 1)), node(plot, rows(tracks, 0, 1))
    commands = {
        2: [("start", rows(tracks, 2))],
        3: [("advise", advice_at(plot, 6.0, 0, 1, 2))],
        4: [("advise", advice_at(plot, 8.0, 2)), ("advise", advice_at(plot, 7.0, 0, 1))],
        5: [("advise", advice_at(plot, 99.0, 0))],
        6: [("stop", Stop("a", np.array([1]))), ("advise", advice_at(plot, 11.0, 0, 1))],
        7: [("start", start(plot, 3.0, 4.0, epoch=9))],
        8: [("stop", Stop("a", np.array([77]))), ("start", start(plot, 3.0, 4.0, epoch=9))],
    }
    for number, scan in enumerate(simulate(plot, "a", 1)):
        prepared(eager, scan)
        for name, message in commands.get(number, []):
            for keeper in (eager, lazy):
                keeper.state = getattr(keeper.tracker, name)(keeper.state, message)
            if again:
                prepared(eager, scan)
        assert same(eager.scan(scan), lazy.scan(scan))
        assert same(eager.state.tracks, lazy.state.tracks)
        assert len(eager.state.advice) == len(lazy.state.advice)


# Start and stop -------------------------------------------------------------------------------------------------------


def test_stopped_tracks_are_forgotten_and_the_others_go_on() -> None:
    plot = world(fusion={"joint": False})
    tracks = start(plot, 0.0, 0.0, 0.0)
    keeper, other = node(plot, tracks), node(plot, rows(tracks, 1))
    for number, scan in enumerate(simulate(plot, "a", 1)):
        if number == 3:
            keeper.state = keeper.tracker.stop(keeper.state, Stop("a", np.array([0, 2, 77])))
        report, expected = keeper.scan(scan), other.scan(scan)
    assert report.ids.tolist() == [1]
    np.testing.assert_allclose(report.log_g, expected.log_g, rtol=1e-9)


@pytest.mark.parametrize("epoch", [5, 4])
def test_a_known_track_stays_unless_the_epoch_is_higher(epoch: int) -> None:
    plot = world()
    keeper = node(plot, start(plot, 0.0, 0.0, epoch=5))
    keeper.scan(scan_at(plot, 2.0, (300.0, 0.0)))
    before = keeper.state
    keeper.start(start(plot, 1.0, 1.0, epoch=epoch, x=PLACES[::-1]))
    assert keeper.state.epoch == 5
    assert close(keeper.state.tracks, before.tracks)


def test_a_higher_epoch_replaces_tracks() -> None:
    plot = world()
    again = start(plot, 1.0, ids=[1], epoch=6, x=PLACES[::-1])._replace(log_p_bar=np.array([2.5]))
    keeper = node(plot, start(plot, 0.0, 0.0, epoch=5))
    keeper.scan(scan_at(plot, 2.0, (300.0, 0.0)))
    keeper.start(again)
    fresh = node(plot)
    fresh.scan(scan_at(plot, 2.0, (300.0, 0.0)))
    fresh.start(again)
    assert keeper.state.epoch == 6
    assert keeper.state.tracks.ids.tolist() == [1]
    assert close(keeper.state.tracks, fresh.state.tracks)


def test_a_new_track_of_the_same_epoch_joins_the_others() -> None:
    plot = world()
    keeper = node(plot, start(plot, 0.0, ids=[4], epoch=5), start(plot, 0.0, 0.0, ids=[2, 4], epoch=5))
    assert keeper.state.tracks.ids.tolist() == [2, 4]


def test_a_start_goes_on_from_the_evidence_it_carries() -> None:
    plot = world()
    scans = simulate(plot, "a", 1)
    keeper = node(plot, start(plot, 0.0))
    for scan in scans[:5]:
        report = keeper.scan(scan)
    kept = keeper.state.tracks
    back = Start("a", 2, kept.ids, kept.times_ns, report.log_g, report.x, report.P, kept.x_a[:, 0], kept.P_a[:, 0])
    again = node(plot, back)
    for scan in scans[5:]:
        expected, report = keeper.scan(scan), again.scan(scan)
    np.testing.assert_allclose(report.log_g, expected.log_g, rtol=1e-12)
    np.testing.assert_allclose(report.x, expected.x, rtol=1e-12)


# What is computed -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("association", ["tight", "factor"])
def test_an_empty_scan_is_evidence(association: str) -> None:
    plot = world(association=association)
    keeper = node(plot, start(plot, 0.0))
    p_0 = 1.0 - 0.9 * plot.fusion.gate_probability
    for count, time_s in enumerate((2.0, 4.0, 6.0), start=1):
        report = keeper.scan(scan_at(plot, time_s))
        np.testing.assert_allclose(report.log_g, count * np.log(p_0), rtol=1e-12)


@pytest.mark.parametrize(("mode", "share"), [("federated", 2.0), ("naive", 1.0)])
def test_an_empty_scan_predicts_with_the_sensors_share_of_the_noise(mode: str, share: float) -> None:
    plot = world(mode)
    tracks = start(plot, 0.0)
    keeper = node(plot, tracks)
    report = keeper.scan(scan_at(plot, 2.0))
    motion, dt = ConstantVelocity(2, 10.0), np.array(2.0)
    F, Q = motion.transition(dt), motion.noise(dt)
    np.testing.assert_allclose(report.P[0], F @ (share * PRIOR_P) @ F.T + share * Q)
    np.testing.assert_allclose(report.x[0], F @ PLACES[0])
    np.testing.assert_allclose(keeper.state.tracks.P_a[0, 0], F @ PRIOR_P @ F.T + Q)


def predicted(plot: Scenario, share: Share, dt: float) -> tuple[Any, Any]:
    """Prior of track 0, predicted by the textbook."""
    motion = plot.motion.build()
    F = motion.transition(np.array(dt))
    P = share.multiplicity * (F @ PRIOR_P @ F.T + motion.noise(np.array(dt)))
    return F @ PLACES[0], P


def weights(x: Any, P: Any, plots: Any, gate: Any = None) -> tuple[Any, Any]:
    """Unnormalised weights p* of Eq. (6) by loops, and which plots lie inside the gate."""
    S = P[:2, :2] + 2500.0 * np.eye(2)
    rho_f = 2.0 / 20_000.0**2
    limit = stats.chi2(2).ppf(0.9997)
    inside = [(z - x[:2]) @ np.linalg.inv(S) @ (z - x[:2]) <= limit for z in plots] if gate is None else gate
    hits = [
        0.9 / rho_f * stats.multivariate_normal(x[:2], S).pdf(z) if near else 0.0
        for z, near in zip(plots, inside, strict=True)
    ]
    return np.array([1.0 - 0.9 * 0.9997, *hits]), inside


PLOTS = np.array([[310.0, 20.0], [260.0, -80.0], [9000.0, 0.0]])


def test_association_by_the_factor_is_the_textbooks() -> None:
    plot = world(association="factor")
    report = node(plot, start(plot, 0.0)).scan(scan_at(plot, 2.0, *PLOTS))
    x, P = predicted(plot, Share(2.0), 2.0)
    p, _ = weights(x, P, PLOTS)
    assert p[3] == 0.0
    np.testing.assert_allclose(report.log_g[0], np.log(p.sum()), rtol=1e-9)
    K = P[:, :2] @ np.linalg.inv(P[:2, :2] + 2500.0 * np.eye(2))
    nu = sum(p[j + 1] / p.sum() * (z - x[:2]) for j, z in enumerate(PLOTS))
    np.testing.assert_allclose(report.x[0], x + K @ nu, rtol=1e-9)


def test_tight_association_is_equations_12_and_13() -> None:
    plot = world()
    report = node(plot, start(plot, 0.0)).scan(scan_at(plot, 2.0, *PLOTS))
    q, inside = weights(*predicted(plot, Share(1.0), 2.0), PLOTS)
    q = q / q.sum()
    x, P = predicted(plot, Share(2.0), 2.0)
    p, _ = weights(x, P, PLOTS, inside)
    possible = q > 0.0
    log_p_bar = (q[possible] * np.log(p[possible] / q[possible])).sum()
    np.testing.assert_allclose(report.log_g[0], log_p_bar, rtol=1e-9)
    K = P[:, :2] @ np.linalg.inv(P[:2, :2] + 2500.0 * np.eye(2))
    nu = sum(q[j + 1] * (z - x[:2]) for j, z in enumerate(PLOTS))
    np.testing.assert_allclose(report.x[0], x + K @ nu, rtol=1e-9)


@pytest.mark.parametrize("association", ["tight", "factor"])
def test_a_track_that_the_sensor_cannot_see_is_left_alone(association: str) -> None:
    plot = world(association=association)
    far = np.array([[90_000.0, 0.0, 0.0, 0.0]])
    keeper = node(plot, start(plot, 0.0, x=far))
    for time_s in (2.0, 4.0):
        report = keeper.scan(scan_at(plot, time_s, (90_000.0, 0.0)))
        np.testing.assert_allclose(report.log_g, 0.0, atol=1e-12)
        np.testing.assert_allclose(report.x, far)


@pytest.mark.parametrize(("association", "share"), [("tight", 1.0), ("factor", 2.0)])
def test_at_the_edge_the_filter_that_associates_says_how_much_is_seen(association: str, share: float) -> None:
    plot = world(association=association)
    inside = 50.0
    keeper = node(plot, start(plot, 0.0, x=np.array([[10_000.0 - inside, 0.0, 0.0, 0.0]])))
    report = keeper.scan(scan_at(plot, 2.0))
    sigma = np.sqrt(share * (1e4 + 400.0 * 2.0**2 + 10.0 * 2.0**3 / 3.0))
    p_d = 0.9 * stats.norm.cdf(inside / sigma)
    np.testing.assert_allclose(report.log_g, np.log(1.0 - p_d * plot.fusion.gate_probability), rtol=1e-9)


def test_the_field_of_view_moves_with_the_sensor() -> None:
    sensors = [sensor_table("a", field_of_view={"shape": "disc", "radius": 2000.0}), sensor_table("b")]
    plot = scenario(*sensors)
    keeper = node(plot, start(plot, 0.0))
    near = keeper.scan(scan_at(plot, 2.0, position=(0.0, 0.0)))
    far = keeper.scan(scan_at(plot, 4.0, position=(50_000.0, 0.0)))
    assert near.log_g[0] < -1.0
    np.testing.assert_allclose(far.log_g, near.log_g, atol=1e-12)


def test_a_scan_that_cannot_be_is_minus_infinity_and_stays_so() -> None:
    plot = scenario(sensor_table("a", p_d=1.0), fusion={"gate_probability": 1.0})
    keeper = node(plot, start(plot, 0.0))
    assert keeper.scan(scan_at(plot, 2.0)).log_g[0] == -np.inf
    report = keeper.scan(scan_at(plot, 4.0, (600.0, 0.0)))
    assert report.log_g[0] == -np.inf
    assert np.isfinite(report.x).all()


def test_dkf_needs_the_scan_times_of_the_network() -> None:
    with pytest.raises(ValueError, match="scan times of all sensors"):
        LocalTracker.of(world("dkf", "factor"), "a")


def test_a_sensor_that_is_not_there() -> None:
    with pytest.raises(ConfigError, match="no sensor 'c'; there are a, b"):
        LocalTracker.of(world(), "c")


# Advice ---------------------------------------------------------------------------------------------------------------


def advice_at(plot: Scenario, time_s: float, *ids: int) -> Advice:
    count = len(ids)
    x = np.tile([150.0 * time_s, 30.0, 150.0, 0.0], (count, 1))
    return Advice(
        plot.to_ns(time_s), plot.to_ns(time_s), np.array(ids, np.int64), x, np.tile(0.3 * PRIOR_P, (count, 1, 1))
    )


@pytest.mark.parametrize("late", [1, 2, 4])
def test_late_advice_is_as_good_as_advice_in_time(late: int) -> None:
    # Jointly, existence counts too, which goes by the evidence of the factors, and they saw worse advice.
    plot = world(fusion={"feedback": "advice", "joint": False})
    tracks = start(plot, 0.0, 0.0)
    advice = advice_at(plot, 4.0, 0, 1)
    in_time, delayed = node(plot, tracks), node(plot, tracks)
    for number, scan in enumerate(simulate(plot, "a", 1)):
        if number == 2:
            in_time.state = in_time.tracker.advise(in_time.state, advice)
        if number == 2 + late:
            delayed.state = delayed.tracker.advise(delayed.state, advice)
        in_time.scan(scan)
        delayed.scan(scan)
        if number >= 2 + late:
            for field in ("x_a", "P_a", "times_a_ns"):
                one, other = getattr(in_time.state.tracks, field), getattr(delayed.state.tracks, field)
                np.testing.assert_allclose(one, other, rtol=1e-12)
    assert not np.allclose(in_time.state.tracks.log_g, delayed.state.tracks.log_g, rtol=1e-12)


def test_advice_never_touches_the_factors() -> None:
    plot = world(fusion={"feedback": "advice"})
    keeper = node(plot, start(plot, 0.0, 0.0))
    *scans, last = simulate(plot, "a", 1)[:4]
    for scan in scans:
        keeper.scan(scan)
    nothing = last._replace(z=last.z[:0])
    unadvised = keeper.tracker.scan(keeper.state, nothing, NEVER)[0]
    advised = keeper.tracker.advise(keeper.state, advice_at(plot, 4.0, 1))
    before, after = unadvised.tracks, keeper.tracker.scan(advised, nothing, NEVER)[0].tracks
    for field in ("ids", "times_ns", "log_w", "log_g", "x", "P"):
        assert np.array_equal(getattr(before, field), getattr(after, field))
    assert np.array_equal(before.x_a[0], after.x_a[0])
    assert not np.array_equal(before.x_a[1], after.x_a[1])


def test_advice_on_unknown_tracks_is_nothing() -> None:
    plot = world(fusion={"feedback": "advice"})
    keeper = node(plot, start(plot, 0.0))
    keeper.scan(scan_at(plot, 2.0))
    unadvised = keeper.tracker.scan(keeper.state, scan_at(plot, 4.0), NEVER)[0]
    for advice in (advice_at(plot, 2.0, 5, 9), advice_at(plot, 2.0)):
        advised = keeper.tracker.advise(keeper.state, advice)
        assert close(keeper.tracker.scan(advised, scan_at(plot, 4.0), NEVER)[0].tracks, unadvised.tracks)


def test_advice_from_ahead_of_the_sensor_is_no_way_back_in_time() -> None:
    plot = world(fusion={"feedback": "advice"}, motion={"psd": 1000.0})
    keeper = node(plot, start(plot, 0.0))
    keeper.scan(scan_at(plot, 2.0, (300.0, 0.0)))
    sharp = advice_at(plot, 5.0, 0)._replace(P=np.diag([100.0, 100.0, 25.0, 25.0])[None])
    keeper.state = keeper.tracker.advise(keeper.state, sharp)
    report = keeper.scan(scan_at(plot, 4.0, (600.0, 0.0)))
    assert np.isfinite(report.log_g).all()
    assert (np.linalg.eigvalsh(keeper.state.tracks.P_a) > 0.0).all()
