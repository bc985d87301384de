"""What the center tells of sensors that do not fit, are silent or have a wrong clock, and what becomes of them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest
from builders import scenario, sensor_table
from process_helpers import ANY_PORT, PATIENCE_S, Processes, free_endpoint, log_entries, start_center, variant
from rich.console import Console
from structlog.testing import capture_logs

from waldnet.common import clock, health, notice
from waldnet.common.clock import now_ns
from waldnet.common.codec import decode, encode
from waldnet.common.config import Network, Scenario, load_scenario
from waldnet.common.errors import ConfigError
from waldnet.common.health import Health
from waldnet.common.inbox import Heard, Inbox
from waldnet.common.memory import MemoryNetwork
from waldnet.common.messages import NEVER, Clock, Join, Keys, Report, Scan, Start
from waldnet.common.notice import Notice
from waldnet.common.quantities import NS_PER_S
from waldnet.common.transport import Bus, open_zenoh
from waldnet.fusion_center.center import Center
from waldnet.fusion_center.shell import CenterShell
from waldnet.launch.run import Order, Run
from waldnet.recording.run_folder import RunFolder
from waldnet.scenarios.catalogue import find
from waldnet.sensor_node.shell import NodeShell
from waldnet.sensor_node.tracker import LocalTracker


class Sensor:
    """Something that joins as a sensor, and then says what it is told to."""

    def __init__(self, bus: Bus, plot: Scenario, name: str, next_ns: int) -> None:
        self._bus, self._plot, self._name, keys = bus, plot, name, Keys(plot.network.name)
        self.started: SimpleQueue[Start] = SimpleQueue()
        self.clock: SimpleQueue[Clock] = SimpleQueue()
        self.notices: SimpleQueue[Notice] = SimpleQueue()
        there: SimpleQueue[bool] = SimpleQueue()
        bus.subscribe(keys.command(name), lambda key, payload: self.started.put(decode(key, payload)))
        bus.subscribe(keys.clock(), lambda key, payload: self.clock.put(decode(key, payload)))
        bus.subscribe(keys.notice(), lambda key, payload: self.notices.put(notice.decode(key, payload)))
        self._reports = bus.publisher(keys.report(name))
        join = bus.publisher(keys.join(name))
        bus.announce(keys.sensor_alive(name))
        bus.watch(keys.center_alive(), lambda _, alive: there.put(alive))
        assert there.get(timeout=PATIENCE_S)
        join.put(encode(Join(name, 1, next_ns, plot.digest)))
        self.start = self.started.get(timeout=PATIENCE_S)

    def report(self, time_ns: int, next_ns: int, **changes: Any) -> None:
        """A report without tracks."""
        ids, x, P = np.empty(0, np.int64), np.empty((0, 4)), np.empty((0, 4, 4))
        report = Report(self._name, 0, time_ns, next_ns, self.start.epoch, ids, ids, np.empty(0), x, P)
        self._reports.put(encode(report._replace(**changes)))

    def await_notice(self, about: str) -> Notice:
        """The next notice of a kind."""
        while (told := self.notices.get(timeout=PATIENCE_S)).kind != about:
            pass
        return told


#: Of another dimension than the network's, so that the center can compute nothing with it.
UNFIT = {"x": np.empty((0, 6)), "P": np.empty((0, 6, 6))}


class Live:
    """A center in this process, and what is needed to ask it how it is."""

    def __init__(self, plot: Scenario, inbox: Inbox, memory: MemoryNetwork) -> None:
        self.plot, self._inbox, self.memory = plot, inbox, memory

    def sensor(self, name: str, next_s: float) -> Sensor:
        return Sensor(self.memory.bus(), self.plot, name, self.plot.to_ns(next_s))

    def health(self) -> Health:
        """How the center is, once all that was said before is worked in."""
        answers: SimpleQueue[Health] = SimpleQueue()
        self._inbox.asked(answers.put)
        return answers.get(timeout=PATIENCE_S)


@contextmanager
def running(plot: Scenario, **options: Any) -> Iterator[Live]:
    inbox, memory = Inbox(), MemoryNetwork()
    with memory.bus() as bus, ThreadPoolExecutor(1) as pool:
        shell = CenterShell(bus, plot.network, plot, Center.of(plot, **options), inbox=inbox)
        ended = pool.submit(shell.run)
        try:
            yield Live(plot, inbox, memory)
        finally:
            inbox.stop()
            ended.result(PATIENCE_S)


def test_health_tells_when_a_report_was_accepted_not_when_one_came() -> None:
    plot = scenario(hypothesis=[], target=[])
    with running(plot) as network:
        a, b = (network.sensor(name, 2.0) for name in "ab")
        a.report(plot.to_ns(2.0), plot.to_ns(4.0), **UNFIT)
        a.report(plot.to_ns(4.0), plot.to_ns(6.0), epoch=0)
        found = network.health()
        assert found["last_report_s"] is None
        assert found["last_report_s_of"] == {"a": None, "b": None}
        assert found["last_picture_s"] is None
        assert found["refused"] == {"a": {"older epoch": 1, "wrong dimensions": 1}}
        assert health.fault(found, 1000.0) == "no report for 1000 s"
        b.report(plot.to_ns(2.0), plot.to_ns(4.0))
        found = network.health()
        assert found["last_report_s"] == found["last_report_s_of"]["b"] >= 0.0
        assert found["last_report_s_of"]["a"] is None
        assert found["last_picture_s"] >= 0.0
        # What is dropped is not accepted either.
        b.report(plot.to_ns(2.0), plot.to_ns(4.0))
        assert network.health()["last_report_s"] >= found["last_report_s"]
        assert health.fault(found, 1000.0) is None


def test_a_refusal_is_told_once_and_summed_up_in_the_end() -> None:
    plot = scenario(hypothesis=[], target=[])
    with running(plot) as network:
        a, b = (network.sensor(name, 2.0) for name in "ab")
        for time_s in (2.0, 4.0):
            a.report(plot.to_ns(time_s), plot.to_ns(time_s + 2.0), **UNFIT)
        a.report(plot.to_ns(6.0), NEVER, **UNFIT)
        b.report(plot.to_ns(2.0), NEVER)
        said = [a.await_notice("refused") for _ in range(2)]
    assert {told.sensor for told in said} == {"a"}
    assert [told.text for told in said] == [
        "a: a report was refused: wrong dimensions",
        "a: 3 reports in all were refused: wrong dimensions",
    ]


def test_those_without_whom_the_clock_starts_are_named() -> None:
    with running(scenario(), wait_s=0.0) as network:
        told = network.sensor("a", 2.0).await_notice("silent")
    assert told.text == "b has not joined: the clock starts without it"


@pytest.mark.parametrize("offset_s", [3.0, -3.0])
def test_the_sensor_whose_clock_is_wrong_is_told_of(offset_s: float) -> None:
    plot = scenario(hypothesis=[], target=[], fusion={"hold_back": 0.5, "window": 1000.0})
    with running(plot, speed=1.0) as network:
        a, b = (network.sensor(name, 2.0) for name in "ab")
        runs = b.clock.get(timeout=PATIENCE_S)
        for number in range(20):
            for sensor, by_s in ((b, 0.0), (a, offset_s)):
                time_ns = runs.present_ns(now_ns()) + round(by_s * NS_PER_S) + number
                sensor.report(time_ns, time_ns + 1)
        told = a.await_notice("clock")
        found = network.health()["clock_offset_s_of"]
    assert told.sensor == "a"
    assert ("ahead of" if offset_s > 0.0 else "behind") in told.text
    assert found["a"] == pytest.approx(offset_s, abs=0.5)
    assert found["b"] == pytest.approx(0.0, abs=0.5)


def set_clock(monkeypatch: pytest.MonkeyPatch, by_s: float) -> None:
    """Set the wall clock of all that runs here."""
    real = clock.time.time_ns
    monkeypatch.setattr(clock.time, "time_ns", lambda: real() + round(by_s * NS_PER_S))


def test_the_clock_is_told_as_wall_time_of_the_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    set_clock(monkeypatch, -3600.0)
    with running(scenario(), speed=1.0) as network:
        a, _ = (network.sensor(name, 2.0) for name in "ab")
        told = a.clock.get(timeout=PATIENCE_S)
    assert (now_ns() - told.wall_ns) / NS_PER_S == pytest.approx(3600.0, abs=PATIENCE_S)


@pytest.mark.parametrize("set_by_s", [0.0, -3600.0])
@pytest.mark.parametrize("offset_s", [60.0, -60.0, 0.0])
def test_a_node_notices_that_its_clock_is_not_the_centers_and_skips_nothing(
    monkeypatch: pytest.MonkeyPatch, offset_s: float, set_by_s: float
) -> None:
    set_clock(monkeypatch, set_by_s)
    plot, memory, inbox = scenario(hypothesis=[], target=[]), MemoryNetwork(), Inbox()
    keys, joined, answers = Keys(plot.network.name), SimpleQueue[bytes](), SimpleQueue[Health]()
    scans = [Scan("a", plot.to_ns(time_s), np.zeros(2), np.empty((0, 2))) for time_s in (2.0, 1000.0)]
    with memory.bus() as center, memory.bus() as bus, ThreadPoolExecutor(1) as pool, capture_logs() as logs:
        reports: SimpleQueue[Any] = SimpleQueue()
        center.subscribe(keys.join("a"), lambda _, payload: joined.put(payload))
        center.subscribe(keys.report("a"), lambda key, payload: reports.put(decode(key, payload)))
        command, clocks = center.publisher(keys.command("a")), center.publisher(keys.clock())
        center.announce(keys.center_alive())
        shell = NodeShell(bus, plot.network, LocalTracker.of(plot, "a"), scans, inbox=inbox, patience_s=PATIENCE_S)
        ended = pool.submit(shell.run)
        joined.get(timeout=PATIENCE_S)
        ids, x, P = np.empty(0, np.int64), np.empty((0, 4)), np.empty((0, 4, 4))
        command.put(encode(Start("a", 1, ids, ids, np.empty(0), x, P, x, P)))
        wall_ns = clock.time.time_ns() - round(offset_s * NS_PER_S)
        clocks.put(encode(Clock(plot.to_ns(2.0), wall_ns, 1.0, plot.to_ns(2.0))))
        inbox.asked(answers.put)
        found = answers.get(timeout=PATIENCE_S)
        if offset_s >= 0.0:
            assert reports.get(timeout=PATIENCE_S).time_ns == plot.to_ns(2.0)
        inbox.stop()
        ended.result(PATIENCE_S)
    assert found["clock_offset_s"] == pytest.approx(offset_s, abs=1.0)
    named = [entry["why"].split(",")[0] for entry in logs if entry["event"] == "clock"]
    side = {60.0: ["ahead of"], -60.0: ["behind"], 0.0: []}[offset_s]
    assert [re.sub(r"\d+\.\d", "#", why) for why in named] == [
        f"the clock of this host is # s {which} the center's" for which in side
    ]


def test_a_node_with_another_scenario_is_told_in_what_it_differs() -> None:
    plot, other = scenario(), scenario(sensor_table("a", p_d=0.7), sensor_table("b"), motion={"psd": 1.0})
    with running(plot) as network, network.memory.bus() as bus:
        node = NodeShell(bus, plot.network, LocalTracker.of(other, "a"), [], patience_s=PATIENCE_S)
        with pytest.raises(ConfigError, match=r"differs from the center's, 'test' \(motion, sensors differ\)"):
            node.run()
        assert network.health()["refused"] == {"a": {"another scenario": 1}}


def test_a_node_the_center_knows_nothing_of_is_told_so_too() -> None:
    plot, other = scenario(), scenario(sensor_table("c"))
    with running(plot) as network, network.memory.bus() as bus:
        node = NodeShell(bus, plot.network, LocalTracker.of(other, "c"), [], patience_s=PATIENCE_S)
        with pytest.raises(ConfigError, match=r"c cannot join: .* \(sensors differs\)"):
            node.run()


def test_a_namesake_with_another_scenario_ends_no_node() -> None:
    plot, other = scenario(hypothesis=[], target=[]), scenario(sensor_table("a", p_d=0.7))
    with running(plot) as network, network.memory.bus() as bus, ThreadPoolExecutor(1) as pool:
        shell = NodeShell(bus, plot.network, LocalTracker.of(plot, "a"), [], patience_s=PATIENCE_S)
        right = pool.submit(shell.run)
        network.sensor("b", 2.0).clock.get(timeout=PATIENCE_S)
        with network.memory.bus() as wrong, pytest.raises(ConfigError):
            NodeShell(wrong, plot.network, LocalTracker.of(other, "a"), [], patience_s=PATIENCE_S).run()
        shell.stop()
        right.result(PATIENCE_S)


def test_a_run_shows_what_the_center_tells(tmp_path: Path) -> None:
    plot, console = scenario(), Console(record=True, width=200)
    order = Order(plot, tmp_path / "test.toml", None, 1, 0.0, tmp_path, [])
    folder = RunFolder(tmp_path, plot)
    run = Run(order, folder, console, Inbox())
    told = notice.encode(Notice("silent", "a", "a is there, but silent"))
    run._work_off(Heard(Keys(plot.network.name).notice(), told))
    folder.finish({})
    assert "a is there, but silent" in console.export_text()


# Processes ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    with Processes(tmp_path) as started:
        yield started


@pytest.mark.processes
def test_a_silent_sensor_is_named_in_lockstep_and_nobody_goes_on_without_it(
    processes: Processes, tmp_path: Path
) -> None:
    path = variant(tmp_path, "short", ("duration = 60.0", "duration = 8.0"))
    plot, socket = load_scenario(path), tmp_path / "health"
    center = start_center(processes, path, "--speed", "max", "--wait", PATIENCE_S, "--health", socket)
    with open_zenoh(Network(connect=center.at)) as bus:
        Sensor(bus, plot, "radar-4", plot.to_ns(2.0))
        nodes = {
            name: processes.waldnet("node", path, name, "--connect", *center.at)
            for name in ("radar-1", "radar-2", "radar-3")
        }
        line = json.loads(center.process.await_log("is there, but its report of 2.0 s has been missing"))
        assert (line["event"], line["sensor"]) == ("silent", "radar-4")
        assert "everybody waits for it" in line["why"]
        found = health.ask(str(socket))
        assert list(found["waiting_s_for"]) == ["radar-4"]
        assert found["waiting_s_for"]["radar-4"] >= 5.0
        assert found["last_picture_s"] is None
    # Its token is gone with it.
    assert [process.wait() for process in (center.process, *nodes.values())] == 4 * [0]


@pytest.mark.processes
def test_a_node_with_another_scenario_ends_at_once(processes: Processes, tmp_path: Path) -> None:
    path = variant(tmp_path, "four-radars", ("psd = 10.0", "psd = 9.0"))
    center = start_center(processes, find("four-radars"), "--wait", PATIENCE_S)
    node = processes.waldnet("node", path, "radar-1", "--connect", *center.at, "--patience", PATIENCE_S)
    assert node.wait() == 1
    assert node.err[-1] == (
        "radar-1 cannot join: its scenario differs from the center's, 'four-radars' (motion differs); "
        "all processes of a network need the same scenario file"
    )
    (refused, *_) = [entry for entry in log_entries(center.process.err) if entry["event"] == "refused message"]
    assert refused["sensor"] == "radar-1"
    assert refused["why"].startswith("another scenario: ")


@pytest.mark.processes
def test_peers_of_a_router_are_told_to_be_clients(processes: Processes) -> None:
    router = processes.waldnet("router", "--listen", ANY_PORT)
    at = json.loads(router.await_line("listening"))["listening"]
    center = start_center(processes, find("four-radars"), "--connect", *at)
    node = processes.waldnet("node", "four-radars", "radar-1", "--connect", *at, "--patience", "3")
    assert node.wait() == 1
    assert node.err[-1].endswith("start everybody with --mode client")
    assert "--mode client" in center.process.await_log("no sensor reaches the center")


def test_a_peer_without_a_router_is_no_peer_of_one() -> None:
    endpoint = free_endpoint()
    with open_zenoh(Network(listen=(endpoint,))) as one, open_zenoh(Network(connect=(endpoint,))) as other:
        there: SimpleQueue[bool] = SimpleQueue()
        one.announce("there")
        other.watch("there", lambda _, alive: there.put(alive))
        assert there.get(timeout=PATIENCE_S)
        assert not one.peer_of_router
        assert not other.peer_of_router
