"""Whose clock is wrong, and who is silent: from when reports come, and from nothing else."""

from __future__ import annotations

import re
import threading

import numpy as np
import pytest
from builders import Stage, hypothesis_table, only, scenario, sensor_table

from waldnet.common import clock, notice
from waldnet.common.clock import now_ns
from waldnet.common.errors import DecodeError
from waldnet.common.memory import MemoryNetwork
from waldnet.common.messages import Keys, Tracks
from waldnet.common.notice import Notice
from waldnet.fusion_center.punctuality import CENTER, Punctuality
from waldnet.fusion_center.silence import PATIENCE_NS, Silence
from waldnet.offline.network import run_in_memory
from waldnet.offline.replay import Replay
from waldnet.recording.record import Record
from waldnet.scenarios.world import simulate_all

NAMES = ("a", "b", "c", "d")


def heard(lags_s: dict[str, list[float]], tolerance_s: float = 0.5) -> list[tuple[str, str]]:
    """All that is said when reports come so long after their scans, the sensors taking turns."""
    punctuality, said = Punctuality(tolerance_s), []
    for lags in zip(*lags_s.values(), strict=True):
        for name, lag_s in zip(lags_s, lags, strict=True):
            said += punctuality.note(name, lag_s)
    return said


@pytest.mark.parametrize(("lag_s", "what"), [(-3.1, "ahead of"), (3.1, "behind")])
@pytest.mark.parametrize("honest", ["", "b", "bc", "bcd"])
def test_the_sensor_whose_clock_is_wrong_is_named_once_and_no_other(lag_s: float, what: str, honest: str) -> None:
    rng = np.random.default_rng(1)
    lags = {name: (rng.uniform(0.0, 0.1, 20) + (lag_s if name == "a" else 0.0)).tolist() for name in "a" + honest}
    ((name, text),) = heard(lags)
    assert name == "a"
    assert re.match(rf"the clock of a is 3\.\d s {what} the center's", text)


def test_clocks_that_agree_are_worth_no_word() -> None:
    rng = np.random.default_rng(2)
    assert heard({name: rng.uniform(0.0, 0.4, 50).tolist() for name in NAMES}) == []


@pytest.mark.parametrize(("lag_s", "what"), [(-7.0, "behind those"), (7.0, "ahead of those")])
def test_what_most_sensors_show_is_the_centers_fault(lag_s: float, what: str) -> None:
    lags = {name: 20 * [lag_s] for name in NAMES}
    ((name, text),) = heard(lags)
    assert name == CENTER
    assert f"the center's clock is 7.0 s {what}" in text
    # With one whose clock is the center's, that one is odd among them.
    assert {name for name, _ in heard({**lags, "e": 20 * [0.0]})} == {CENTER, "e"}


def test_reports_that_were_kept_back_and_come_all_at_once_tell_nothing() -> None:
    assert heard({"a": [30.0, 28.0, 26.0, 24.0, 22.0, 20.0, 18.0, 16.0]}) == []


def test_a_clock_that_is_set_right_is_said_to_be() -> None:
    said = heard({"a": 10 * [-3.0] + 10 * [0.01]})
    assert [text.split(" ")[-2:] for _, text in said] == [["the", "center's"], ["agree", "again"]]


def test_offsets_are_told_as_they_are() -> None:
    punctuality = Punctuality(0.5)
    for _ in range(5):
        assert punctuality.offsets_s == {}
        punctuality.note("a", -2.0)
    assert punctuality.offsets_s == {"a": -2.0}


def test_a_silent_sensor_is_named_again_whenever_it_has_been_twice_as_long() -> None:
    silence, second = Silence(), 10**9
    named = [now for now in range(100) if silence.look({"a": 0, "b": now * second}, now * second)[0]]
    assert named == [5, 10, 20, 40, 80]
    assert silence.look({}, 100 * second) == ({}, ["a"])
    assert silence.look({}, 101 * second) == ({}, [])
    assert silence.look({"a": 0}, PATIENCE_NS) == ({"a": PATIENCE_NS / 1e9}, [])


# The center -----------------------------------------------------------------------------------------------------------


def test_a_sensor_whose_clock_is_ahead_makes_no_other_late() -> None:
    stage = Stage(scenario(fusion={"hold_back": 0.5}), speed=1.0)
    stage.join_all()
    for time_s in (2.0, 4.0, 6.0):
        # The clock begins at 2 s. All of a comes 3 s early, all of b in time.
        stage.tell(stage.report("a", time_s), time_s - 5.0)
        stage.tick(time_s - 4.0)
        stage.tick(time_s - 2.0)
        assert len(only(Tracks, stage.tell(stage.report("b", time_s), time_s - 1.9))) == 1
    assert stage.state.counts.late == 0


def test_in_lockstep_those_are_awaited_without_whom_nobody_can_go_on() -> None:
    stage = Stage(scenario(sensor_table("a"), sensor_table("b"), sensor_table("c")))
    stage.join("a", 2.0)
    stage.join("b", 3.0)
    assert stage.center.awaited(stage.state) == {}
    stage.join("c", 2.0)
    assert stage.center.awaited(stage.state) == {"a": 0, "c": 0}
    stage.tell(stage.report("a", 2.0, 4.0))
    assert stage.center.awaited(stage.state) == {"c": 0}
    stage.tell(stage.report("c", 2.0, None, next_ns=stage.ns(None)))
    assert stage.center.awaited(stage.state) == {"b": 0}
    stage.tell(stage.report("b", 3.0, None, next_ns=stage.ns(None)))
    stage.tell(stage.report("a", 4.0, None, next_ns=stage.ns(None)))
    assert stage.center.awaited(stage.state) == {}


def test_at_a_speed_every_sensor_owes_its_next_report_when_it_is_due() -> None:
    stage = Stage(scenario(), speed=2.0)
    stage.join_all(b=5.0)
    start_ns = stage.state.clock.wall_ns if stage.state.clock is not None else 0
    assert stage.center.awaited(stage.state) == {"a": start_ns, "b": start_ns + 1_500_000_000}


# The clock ------------------------------------------------------------------------------------------------------------


def test_a_clock_that_is_set_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    before = now_ns()
    real = clock.time.time_ns
    monkeypatch.setattr(clock.time, "time_ns", lambda: real() - 3600 * 10**9)
    assert 0 <= now_ns() - before < 60 * 10**9
    assert abs(clock.set_by_ns() + 3600 * 10**9) < 10**9


@pytest.mark.parametrize("by_s", [-3600, 3600])
def test_a_network_goes_on_when_the_clock_is_set(monkeypatch: pytest.MonkeyPatch, by_s: int) -> None:
    plot = scenario(fusion={"hold_back": 1000.0}, hypothesis=[hypothesis_table(), hypothesis_table(4000.0)])
    scans, went_on, real = simulate_all(plot, 3), threading.Event(), clock.time.time_ns

    class Watched(MemoryNetwork):
        """Has the clock set when the first picture is there."""

        def __init__(self) -> None:
            super().__init__()
            self.bus().subscribe(Keys(plot.network.name).tracks(), lambda *_: went_on.set())

    monkeypatch.setattr("waldnet.offline.network.MemoryNetwork", Watched)
    monkeypatch.setattr(clock.time, "time_ns", lambda: real() + by_s * 10**9 * went_on.is_set())
    live = run_in_memory(plot, scans, speed=20.0)
    replayed = Record(plot)
    for message in Replay(plot, scans).run():
        replayed.note(message)
    assert list(live.pictures) == list(replayed.pictures)
    assert [decision[:3] for decision in live.decisions] == [decision[:3] for decision in replayed.decisions]


# Notices --------------------------------------------------------------------------------------------------------------


def test_a_notice_comes_back_as_it_was_sent() -> None:
    told = Notice("another scenario", "a", "größe", "0f", {"sensors": "1a"})
    assert notice.decode("key", notice.encode(told)) == told


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{}",
        b"[]",
        b"\xff",
        b"[" * 100_000,
        b'{"kind": "?", "sensor": "", "text": ""}',
        b'{"kind": [], "sensor": "", "text": ""}',
        b'{"kind": "clock", "sensor": 1, "text": ""}',
        b'{"kind": "clock", "sensor": "", "text": "", "digests": 1}',
        b'{"kind": "clock", "sensor": "", "text": "", "more": 1}',
    ],
)
def test_what_is_no_notice_is_an_error_of_the_wire(payload: bytes) -> None:
    with pytest.raises(DecodeError, match="no notice"):
        notice.decode("key", payload)
