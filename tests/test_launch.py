"""What a run shows and keeps, and what its shells make of partners that do not fit; without processes."""

from __future__ import annotations

import io
import json
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from builders import Stage, reports_of, scenario, write_report
from process_helpers import PATIENCE_S, variant
from rich.console import Console
from structlog.testing import capture_logs

from waldnet.common.codec import encode
from waldnet.common.config import load_scenario
from waldnet.common.errors import ConfigError, WaldnetError
from waldnet.common.estimation.sprt import Status
from waldnet.common.inbox import Inbox, Missed
from waldnet.common.memory import MemoryNetwork
from waldnet.common.messages import Decision, Keys, Scan, Start, Tracks
from waldnet.fusion_center.center import Center
from waldnet.fusion_center.shell import CenterShell
from waldnet.launch.run import Order, Run
from waldnet.launch.status import LiveStatus
from waldnet.recording.record import Record
from waldnet.recording.run_folder import RunFolder
from waldnet.sensor_node.shell import NodeShell
from waldnet.sensor_node.tracker import LocalTracker


def picture(time_s: float, tracks: dict[int, Status]) -> Tracks:
    count = len(tracks)
    return Tracks(
        time_ns=scenario().to_ns(time_s),
        sensors=("a", "b"),
        ids=np.array(list(tracks), np.int64),
        status=np.array(list(tracks.values()), np.uint8),
        scans=np.ones(count, np.int64),
        contributing=np.ones((count, 2), np.bool_),
        log_lr=np.zeros(count),
        log_lr_total=np.zeros(count),
        x=np.zeros((count, 4)),
        P=np.tile(np.eye(4), (count, 1, 1)),
        supported_ns=np.zeros(count, np.int64),
    )


def test_the_live_status_misses_nothing_between_two_refreshes() -> None:
    screen, plot = io.StringIO(), scenario()
    status = LiveStatus(plot, plot.to_ns(20.0), Console(file=screen, force_terminal=True, width=120))
    with status:
        status.picture(picture(2.0, {0: Status.CONFIRMED, 1: Status.DELETED}))
        status.picture(picture(4.0, {0: Status.CONFIRMED}))
    assert "deleted" in screen.getvalue()


def test_what_is_said_into_a_file_is_one_line() -> None:
    file, plot = io.StringIO(), scenario()
    LiveStatus(plot, plot.to_ns(20.0), Console(file=file, width=80)).say(30 * "a long story ")
    assert file.getvalue().count("\n") == 1


def test_a_deletion_that_a_late_report_brings_forward_is_kept(tmp_path: Path) -> None:
    """The picture of that time must be told anew, or the track would be tentative in the record for ever."""
    stage = Stage(scenario(), speed=1.0)
    starts = stage.join_all()
    scans = [
        Scan(name, stage.ns(time_s), np.zeros(2), np.empty((0, 2)))
        for time_s in (2.0, 4.0, 6.0)
        for name in stage.scenario.sensor_names
    ]
    first_a, first_b, second_a, second_b, *_ = reports_of(stage.scenario, starts, scans)
    stage.tell(first_a, 0.1)
    stage.tick(1.0)
    stage.tell(second_a, 2.1)
    stage.tell(second_b, 2.1)
    assert [(decision.kind, stage.scenario.to_seconds(decision.time_ns)) for decision in stage.decisions] == [
        ("deleted", 4.0)
    ]
    stage.tell(first_b, 2.2)
    record = Record(stage.scenario)
    for message in stage.said:
        record.note(message)
    assert [(decision.kind, stage.scenario.to_seconds(decision.time_ns)) for decision in record.standing()] == [
        ("deleted", 2.0)
    ]
    write_report(record, tmp_path, {})
    assert json.loads((tmp_path / "decisions.json").read_text())["tracks"][0]["status"] == "deleted"


def test_a_report_of_a_decision_whose_picture_was_never_heard(tmp_path: Path) -> None:
    """The center is killed right after it has decided."""
    record = Record(scenario())
    record.note(Decision("confirmed", 0, record.scenario.to_ns(2.0), log_lr=10.0, log_lr_total=10.0, scans=1))
    assert all(file.exists() for file in write_report(record, tmp_path, {}))


def test_plots_that_were_shed_are_told_once_and_counted(tmp_path: Path) -> None:
    plot, said = scenario(), io.StringIO()
    folder = RunFolder(tmp_path, plot)
    run = Run(Order(plot, tmp_path, None, 1, 0.0, tmp_path, ()), folder, Console(file=said, width=200), Inbox())
    for number in (2, 3):
        run._work_off(Missed(Keys(plot.network.name).plots("a"), number))
    folder.finish({})
    assert json.loads((tmp_path / "decisions.json").read_text())["plots_shed"] == {"a": 5}
    assert said.getvalue().splitlines() == ["a: not all plots are shown, its link is full: reports go first"]


def test_whoever_joins_a_lockstep_late_does_not_stop_it() -> None:
    stage = Stage(scenario(), wait_s=0.0)
    stage.join("a", 2.0)
    stage.tell(stage.report("a", 2.0))
    assert stage.clear_s == [2.0, 4.0]
    stage.join("b", 2.0)
    stage.tell(stage.report("a", 4.0))
    stage.join("b", 4.0)
    assert stage.clear_s[-1] == 4.0
    stage.tell(stage.report("b", 4.0))
    assert stage.clear_s[-1] == 6.0
    told = [time_s for time_s in stage.clear_s if time_s is not None]
    assert told == sorted(told)


def test_a_node_refuses_tracks_of_another_dimension() -> None:
    memory, plot = MemoryNetwork(), scenario()
    keys, here = Keys(plot.network.name), threading.Event()
    center = memory.bus()
    center.watch(keys.sensor_alive(), lambda *_: here.set())
    commands = center.publisher(keys.command("a"))
    shell = NodeShell(memory.bus(), plot.network, LocalTracker.of(plot, "a"), [], patience_s=PATIENCE_S)
    one, x, P = np.ones(1), np.zeros((1, 6)), np.eye(6)[None]
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(shell.run)
        assert here.wait(PATIENCE_S)
        commands.put(encode(Start("a", 1, np.array([0]), np.array([0]), one, x, P, x, P)))
        shell.stop()
        with pytest.raises(WaldnetError, match="same scenario"):
            running.result(PATIENCE_S)


def test_no_sensor_may_be_called_like_the_center(tmp_path: Path) -> None:
    """A run keeps its children and their logs by name."""
    with pytest.raises(ConfigError, match=r"sensor\.0\.name: 'center'"):
        load_scenario(variant(tmp_path, "taken", ('name = "radar-1"', 'name = "center"')))


def test_a_sensor_that_never_joined_is_not_lost() -> None:
    memory, plot = MemoryNetwork(), scenario()
    keys, here = Keys(plot.network.name), threading.Event()
    with capture_logs() as logs, ThreadPoolExecutor(1) as pool:
        shell = CenterShell(memory.bus(), plot.network, plot, Center.of(plot))
        running = pool.submit(shell.run)
        with memory.bus() as node:
            node.watch(keys.center_alive(), lambda *_: here.set())
            assert here.wait(PATIENCE_S)
            node.announce(keys.sensor_alive("a"))
        shell.stop()
        running.result(PATIENCE_S)
    assert not [entry for entry in logs if "sensor lost" in entry["event"]]
