"""The one driver of the pure steps: what it hands to whom, and what a tap hears of it."""

from __future__ import annotations

import numpy as np
import pytest
from builders import all_same, only, reports_of, same, scenario, sensor_table

from waldnet.common.messages import Begin, Clock, Decision, Join, Message, Picked, Report, Scan, Start, Tracks
from waldnet.fusion_center.state import Presence
from waldnet.offline.loopback import ALL, CENTER, NODES, Loopback, Sent
from waldnet.offline.replay import Replay
from waldnet.scenarios.world import simulate_all

NETWORK = scenario(sensor_table("a", false_plots=0.1), sensor_table("b", false_plots=0.1))


def played() -> tuple[Loopback, list[Sent], list[Message]]:
    """Two sensors join, and each scans once."""
    sent: list[Sent] = []
    network = Loopback.of(NETWORK, tap=sent.append)
    scans = simulate_all(NETWORK, 1)[:2]
    answers = [answer for scan in scans for answer in network.join(scan.sensor, scan.time_ns)]
    for scan in scans:
        answers += network.scan(scan)
    return network, sent, answers


def test_a_tap_hears_every_message_in_its_order_and_who_gets_it() -> None:
    _, sent, answers = played()
    first = [(one.sender, one.receiver, type(one.message)) for one in sent[:5]]
    assert first == [
        ("a", CENTER, Join),
        (CENTER, "a", Start),
        ("b", CENTER, Join),
        (CENTER, "b", Start),
        (CENTER, ALL, Clock),
    ]
    assert [type(one.message) for one in sent if one.sender == "b"] == [Join, Scan, Report]
    assert all_same([one.message for one in sent if one.sender == CENTER], answers)


def test_its_nodes_report_what_nodes_alone_report() -> None:
    network, sent, answers = played()
    starts = {start.sensor: start for start in only(Start, answers)}
    alone = reports_of(NETWORK, starts, simulate_all(NETWORK, 1)[:2])
    assert all_same([one.message for one in sent if isinstance(one.message, Report)], alone)
    assert same(network.center.tracks(network.state), only(Tracks, answers)[-1])


def test_a_report_held_back_is_late_and_ends_in_the_same_picture() -> None:
    """The parts of an exchange let a message wait; the center, told that the sensor is away, goes on without it."""
    punctual, _, _ = played()
    network = Loopback.of(NETWORK)
    first, second = simulate_all(NETWORK, 1)[:2]
    for scan in (first, second):
        network.join(scan.sensor, scan.time_ns)
    held = network.report(first)
    network.deliver(Presence(first.sensor, alive=False))
    network.scan(second)
    network.deliver(held)
    assert network.state.counts.late == 1
    assert same(network.center.tracks(network.state), punctual.center.tracks(punctual.state))


@pytest.mark.parametrize("name", ["a", "b"])
def test_what_begins_reaches_every_node(name: str) -> None:
    plot = scenario(hypothesis=[], target=[{"state": [0.0, 0.0, 60.0, 0.0]}], initiation={"speed": 100.0})
    sent: list[Sent] = []
    scans = simulate_all(plot, 1)
    network = Loopback.of(plot, tap=sent.append)
    for sensor in plot.sensor_names:
        network.join(sensor, scans[0].time_ns)
    for at, scan in enumerate(scans[:6]):
        network.scan(scan, next(other.time_ns for other in scans[at + 1 :] if other.sensor == scan.sensor))
    begun = np.concatenate([one.message.ids for one in sent if isinstance(one.message, Begin)])
    assert {one.receiver for one in sent if isinstance(one.message, Begin)} == {NODES}
    assert len(begun) and set(begun) <= set(network.nodes[name].tracks.ids)


@pytest.mark.parametrize("fusion", [{}, {"mode": "selected"}, {"feedback": "advice"}, {"precision": "float32"}])
def test_a_replay_is_its_scans_one_after_the_other(fusion: dict[str, str]) -> None:
    plot = scenario(fusion=fusion)
    scans, sent = simulate_all(plot, 2), list[Sent]()
    shown = list(Replay(plot, scans, sent.append).run())
    assert all_same([one.message for one in sent if isinstance(one.message, Tracks | Decision)], shown)
    kind = Picked if fusion.get("mode") == "selected" else Report
    reports = [one.message for one in sent if isinstance(one.message, kind)]
    assert len(reports) == len(scans)
    # Of later scans the replay knows nothing.
    assert all(report.next_ns == report.time_ns + 1 for report in reports)


def test_the_schedule_is_asked_for_where_the_mode_needs_it() -> None:
    with pytest.raises(ValueError, match="scan times of all sensors"):
        Loopback.of(scenario(fusion={"mode": "dkf", "association": "factor"}))


def test_reports_are_rounded_as_on_the_wire() -> None:
    """A covariance in single precision is one, and not that which the node keeps."""
    plot = scenario(fusion={"precision": "float32"})
    network, scan = Loopback.of(plot), simulate_all(plot, 1)[0]
    network.join(scan.sensor, scan.time_ns)
    report = network.report(scan)
    assert isinstance(report, Report)
    np.testing.assert_array_equal(report.P, report.P.astype(np.float32))
    assert (network.nodes[scan.sensor].tracks.P[:, 0] != report.P).any()
