"""What people are told: decisions that matter, complaints that do not flood, a table that fits."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import structlog
from builders import scenario, sensor_table
from rich.console import Console
from structlog.testing import capture_logs

from waldnet.common import logs
from waldnet.common.decision_filter import DecisionFilter
from waldnet.common.estimation.sprt import Status
from waldnet.common.logs import Complaints
from waldnet.common.messages import Decision, DecisionKind, Tracks
from waldnet.common.quantities import NS_PER_S
from waldnet.launch.status import LiveStatus
from waldnet.launch.watch import clock_text
from waldnet.offline.network import run_in_memory
from waldnet.scenarios.world import simulate_all

STARTING: dict[str, Any] = {"hypothesis": [], "initiation": {"speed": 100.0}}


def decision(kind: DecisionKind, track: int, time_s: float = 0.0) -> Decision:
    return Decision(kind, track, round(time_s * NS_PER_S), log_lr=1.0, log_lr_total=1.0, scans=1)


def picture(time_s: float, tracks: dict[int, Status], log_lr: float = 0.0) -> Tracks:
    count, plot = len(tracks), scenario()
    return Tracks(
        time_ns=plot.to_ns(time_s),
        sensors=plot.sensor_names,
        ids=np.array(list(tracks), np.int64),
        status=np.array(list(tracks.values()), np.uint8),
        scans=np.ones(count, np.int64),
        contributing=np.ones((count, 2), np.bool_),
        log_lr=np.full(count, log_lr),
        log_lr_total=np.full(count, log_lr),
        x=np.zeros((count, 4)),
        P=np.tile(np.eye(4), (count, 1, 1)),
        supported_ns=np.zeros(count, np.int64),
    )


def test_decisions_on_tracks_that_never_were_confirmed_do_not_pass() -> None:
    told = DecisionFilter(scenario(**STARTING))
    assert not told.passes(decision("deleted", 1))
    assert not told.passes(decision("merged", 2))
    assert not told.passes(decision("withdrawn", 1))
    assert told.passes(decision("confirmed", 3))
    assert told.passes(decision("confirmed", 3))
    assert told.passes(decision("deleted", 3, 5.0))
    assert told.passes(decision("withdrawn", 3, 6.0))
    assert told.passes(decision("deleted", 3, 7.0))


def test_given_hypotheses_and_verbose_always_pass() -> None:
    assert DecisionFilter(scenario()).passes(decision("deleted", 0))
    assert not DecisionFilter(scenario()).passes(decision("deleted", 1))
    assert DecisionFilter(scenario(), verbose=True).passes(decision("deleted", 1))


def test_whoever_comes_late_learns_from_a_picture_who_is_confirmed() -> None:
    told = DecisionFilter(scenario(**STARTING))
    told.learn(picture(0.0, dict(enumerate(Status))))
    passed = {status for track, status in enumerate(Status) if told.passes(decision("deleted", track))}
    assert passed == set(Status) - {Status.TENTATIVE, Status.DELETED}


@pytest.mark.parametrize("verbose", [False, True])
def test_the_center_logs_a_line_for_every_decision_on_a_confirmed_track_and_no_other(
    monkeypatch: pytest.MonkeyPatch, *, verbose: bool
) -> None:
    boats = [{"state": [-1000.0, 0.0, 60.0, 0.0]}, {"state": [2000.0, 3000.0, 0.0, -80.0]}]
    sensors = [sensor_table("a", false_plots=5.0), sensor_table("b", first_scan=1.0, false_plots=5.0)]
    plot = scenario(*sensors, target=boats, decision={"p1": 0.9999}, **STARTING)
    if verbose:
        monkeypatch.setattr(DecisionFilter, "passes", lambda *_: True)
    with capture_logs() as entries:
        record = run_in_memory(plot, simulate_all(plot, 1))
    said = {(entry["event"], entry["track"]) for entry in entries if "track" in entry}
    confirmed = {one.track for one in record.decisions if one.kind == "confirmed"}
    of_all = {(one.kind, one.track) for one in record.decisions}
    assert 0 < len(confirmed) < len({track for _, track in of_all})
    assert said == (of_all if verbose else {(kind, track) for kind, track in of_all if track in confirmed})
    # Beside decisions a few lines at the beginning and the end: none for a scan.
    assert len([entry for entry in entries if "track" not in entry]) <= 6 + 3 * len(plot.sensors)


class Watchless:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s


def test_a_complaint_that_goes_on_is_logged_ever_more_seldom_and_counted_always(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Watchless()
    monkeypatch.setattr(logs, "time", clock)
    with capture_logs() as entries:
        complaints = Complaints(structlog.get_logger())
        for _ in range(24 * 3600):
            complaints.add("late report", "it is", sensor="a")
            clock.now_s += 1.0
        assert complaints.counts["late report"] == 24 * 3600
        assert entries[0]["count"] == 1
        assert 24 * 60 <= len(entries) <= 24 * 60 + 10
        # Another sensor is heard of at once, and the same one when it begins anew.
        complaints.add("late report", "it is", sensor="b")
        clock.now_s += 3600.0
        complaints.add("late report", "it is", sensor="a")
        assert [entry["sensor"] for entry in entries[-2:]] == ["b", "a"]
        clock.now_s += 1.0
        assert complaints.add("late report", "it is", sensor="a")
        assert not complaints.add("late report", "it is", sensor="a")


def shown(status: LiveStatus, width: int = 80, height: int = 24) -> list[str]:
    screen = io.StringIO()
    Console(file=screen, width=width, height=height).print(status.render())
    return screen.getvalue().rstrip("\n").split("\n")


def status_of(number: int, *, width: int = 80, height: int = 24, **changes: Any) -> LiveStatus:
    """A status of so many sensors on a terminal of a size."""
    plot = scenario(*(sensor_table(f"a-sensor-{k}") for k in range(number)), **changes)
    console = Console(file=io.StringIO(), force_terminal=True, width=width, height=height)
    return LiveStatus(plot, plot.to_ns(36_000.0), console)


@pytest.mark.parametrize("first", [0, 4_000_000_000 - 60])
@pytest.mark.parametrize("log_lr", [-1.797e308, -12.3, 4.5, 1e7])
@pytest.mark.parametrize(("width", "height"), [(80, 24), (60, 10), (200, 100)])
def test_the_table_fits_into_the_terminal_with_many_tracks_and_sensors(
    width: int, height: int, log_lr: float, first: int
) -> None:
    status = status_of(100, width=width, height=height)
    for k in range(100):
        status.present(f"a-sensor-{k}", alive=k != 50)
    status.lose("a-sensor-50")
    few = list(Status)
    status.picture(picture(35_000.0, {first + k: few[k % len(few)] for k in range(59)}, log_lr))
    lines = shown(status, width, height)
    assert max(map(len, lines)) <= width
    assert len(lines) <= height
    if width >= 80:
        assert any("confirmed" in line for line in lines)
        assert not any("…" in line for line in lines if "sensor" not in line)
    # What matters is there: sensors that are lost, how far it has come.
    assert any("a-sensor-50 lost" in line for line in lines)
    assert any("99 of 100" in line for line in lines)
    assert "35000.0 of 36000.0 s" in lines[-1]


def test_confirmed_tracks_come_first_and_the_newest_of_them() -> None:
    status = status_of(2)
    tracks = {
        1: Status.CONFIRMED,
        2: Status.TENTATIVE,
        3: Status.DELETED,
        4: Status.CONFIRMED,
        5: Status.TENTATIVE,
    }
    status.picture(picture(2.0, tracks))
    rows = [line.split()[:2] for line in shown(status) if line.split()[:1] and line.split()[0].isdigit()]
    assert rows == [["4", "confirmed"], ["1", "confirmed"], ["5", "tentative"], ["2", "tentative"], ["3", "deleted"]]
    assert any(line.startswith("tracks  2 tentative, 2 confirmed, 1 deleted") for line in shown(status))


def test_tracks_that_have_ended_leave_after_a_while() -> None:
    status = status_of(2)
    most = 0
    for k in range(500):
        status.picture(picture(float(k), {k: Status.TENTATIVE, **({k - 1: Status.DELETED} if k else {})}))
        most = max(most, len(status))
    assert most == 32
    assert any(line.split()[:2] == ["498", "deleted"] for line in shown(status, height=100))


def test_a_run_says_what_was_decided_on_tracks_that_matter() -> None:
    said = io.StringIO()
    status = LiveStatus(scenario(**STARTING), 0, Console(file=said, width=80))
    for one in (decision("deleted", 1), decision("confirmed", 2), decision("deleted", 2), decision("deleted", 3)):
        status.decided(one)
    assert [line.split()[3:5] for line in said.getvalue().splitlines()] == [["2", "confirmed"], ["2", "deleted"]]


def test_a_watcher_says_times_as_a_clock_in_utc_does() -> None:
    assert clock_text(0) == "1970-01-01 00:00:00.00Z"
    assert clock_text(scenario().to_ns(3661.239)) == "2026-01-01 01:01:01.23Z"
    assert clock_text(-1) == "1969-12-31 23:59:59.99Z"
