"""Whole networks of real processes: what they decide, and what becomes of them when one of them fails."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from builders import Node, Stage, only
from process_helpers import (
    ANY_PORT,
    PATIENCE_S,
    Center,
    Observer,
    Point,
    Process,
    Processes,
    assert_agree,
    free_endpoint,
    log_entries,
    observe,
    peer_of,
    points,
    points_of,
    start_center,
    start_nodes,
    variant,
)

from waldnet.common.codec import VERSION, encode
from waldnet.common.config import Network, Scenario, load_scenario
from waldnet.common.estimation.sprt import Status
from waldnet.common.messages import Clock, Join, Keys, Report, Scan, Start, Tracks
from waldnet.common.quantities import NS_PER_S
from waldnet.common.transport import open_zenoh
from waldnet.fusion_center.state import Presence
from waldnet.offline.network import run_in_memory
from waldnet.offline.replay import Replay
from waldnet.recording.lines import TrackLines
from waldnet.recording.record import Record
from waldnet.scenarios.catalogue import find
from waldnet.scenarios.plots import read_plots
from waldnet.sensor_node.sources import all_scans

pytestmark = pytest.mark.processes

#: What is real among the hypotheses of a scenario; the others are decoys.
REAL = {
    "four-radars": {0},
    "four-radars-0.5": {0},
    "four-radars-0.2": {0},
    "autoferry-2": {0, 1},
    "autoferry-5": {0, 1},
}
#: A loaded machine must not bring the center to go on without a sensor that is still there.
PATIENT = ('association = "tight"', 'association = "tight"\nhold_back = 1000.0')
#: The target stays in sight for a long time.
STEADY = (("psd = 10.0", "psd = 0.1"), ("state = [0.0, 0.0, 150.0, 0.0]", "state = [0.0, 0.0, 0.0, 0.0]"))
LONG = (("duration = 60.0", "duration = 3000.0"), *STEADY)


class Ran(NamedTuple):
    """A run that has ended."""

    scenario: str
    code: int
    out: list[str]
    err: list[str]
    left: dict[int, list[str]]
    folder: Path
    replayed: list[str]

    @property
    def tracks(self) -> dict[tuple[float, int], Point]:
        return points((self.folder / "tracks.jsonl").read_text().splitlines())

    @property
    def decisions(self) -> dict[str, Any]:
        loaded: dict[str, Any] = json.loads((self.folder / "decisions.json").read_text())
        return loaded


@pytest.fixture(scope="module", params=REAL)
def lockstep(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ran]:
    """A run as fast as all go together, and the replay of the same plots."""
    name: str = request.param
    folder = tmp_path_factory.mktemp(name)
    with Processes(folder) as processes:
        run = processes.run(name, "--speed", "max", "--out", folder / "out")
        recording = load_scenario(find(name)).recording
        plots = folder / "plots.jsonl" if recording is None else recording.plots
        if recording is None:
            processes.output("simulate", name, "--out", plots)
        replayed = processes.output("replay", name, plots, "--json")
        code = run.wait()
        yield Ran(name, code, run.out, run.err, processes.alive(), folder / "out", replayed)


def test_a_lockstep_run_says_what_replay_says(lockstep: Ran) -> None:
    assert_agree(lockstep.tracks, points(lockstep.replayed))


def test_the_real_are_confirmed_and_stay_so_and_the_others_are_deleted(lockstep: Ran) -> None:
    report, real = lockstep.decisions, REAL[lockstep.scenario]
    expected = ["confirmed" if track in real else "deleted" for track in range(len(report["tracks"]))]
    assert [track["track"] for track in report["tracks"]] == list(range(len(expected)))
    assert [track["status"] for track in report["tracks"]] == expected
    assert [[decision["kind"] for decision in track["decisions"]] for track in report["tracks"]] == [
        [kind] for kind in expected
    ]
    if lockstep.scenario.startswith("four-radars"):
        assert report["tracks"][0]["decisions"][0]["scans"] <= 20


def test_a_run_ends_well_and_leaves_a_report_and_no_process(lockstep: Ran) -> None:
    assert lockstep.code == 0
    assert lockstep.err == []
    assert lockstep.left == {}
    assert lockstep.decisions["sensors_lost"] == {}
    assert lockstep.decisions["withdrawn"] == []
    names = ("decisions.json", "tracks.jsonl", "log_lr.png", "plan.png", "input")
    assert lockstep.out[-1] == "report: " + ", ".join(str(lockstep.folder / name) for name in names)
    for name in ("log_lr.png", "plan.png"):
        picture = (lockstep.folder / name).read_bytes()
        assert picture.startswith(b"\x89PNG")
        assert len(picture) > 20_000
    said = [line for line in lockstep.out if re.search(r"track \d+ (confirmed|deleted) after", line)]
    assert len(said) == len(lockstep.decisions["tracks"])
    sensors = load_scenario(find(lockstep.scenario)).sensor_names
    assert {log.stem for log in (lockstep.folder / "logs").iterdir()} == {"center", *sensors}


def test_a_network_in_memory_says_what_replay_says(lockstep: Ran) -> None:
    scenario = load_scenario(find(lockstep.scenario))
    record = run_in_memory(scenario, all_scans(scenario))
    assert_agree(points_of(record), points(lockstep.replayed))


def test_replay_prints_json_lines_of_all_tracks_in_the_order_of_the_hypotheses(lockstep: Ran) -> None:
    starts = [hypothesis.start for hypothesis in load_scenario(find(lockstep.scenario)).hypotheses]
    entries = [json.loads(line) for line in lockstep.replayed]
    times = sorted({entry["time"] for entry in entries})
    assert [(entry["time"], entry["track"]) for entry in entries] == [
        (time_s, track) for time_s in times for track, start_s in enumerate(starts) if start_s <= time_s
    ]
    for track in range(len(starts)):
        statuses = [entry["status"] for entry in entries if entry["track"] == track]
        ended = statuses.index("deleted") if "deleted" in statuses else len(statuses)
        assert "deleted" not in statuses[:ended]
        assert set(statuses[ended:]) <= {"deleted"}


#: What goes between nodes and center beside plain reports.
ELABORATE = {
    "reset": 'association = "tight"\nfeedback = "reset"',
    "mirrored": 'association = "mirrored"\nterms = 3',
    "mirrored, reset": 'association = "mirrored"\nterms = 3\nfeedback = "reset"',
    "advice, late": 'association = "tight"\nfeedback = "advice"\nfeedback_delay = 4.0',
}


@pytest.mark.parametrize("fusion", ELABORATE.values(), ids=ELABORATE.keys())
def test_a_lockstep_run_with_several_hypotheses_or_feedback_says_what_replay_says(
    processes: Processes, tmp_path: Path, fusion: str
) -> None:
    short = ("duration = 60.0", "duration = 16.0")
    undecided = ("p1 = 0.95", "p1 = 0.95\nenabled = false")
    path = variant(tmp_path, "elaborate", ('association = "tight"', fusion), short, undecided)
    run = processes.run(path.name, "--speed", "max", "--out", "out")
    assert run.wait() == 0, run.err
    assert processes.alive() == {}
    tracks = points((tmp_path / "out" / "tracks.jsonl").read_text().splitlines())
    assert_agree(tracks, points(processes.output("replay", path.name, "--json")))
    (reached, *_) = sorted((time_s for time_s, _ in tracks), reverse=True)
    assert reached == 16.0


def test_a_run_in_real_time_says_what_replay_says(processes: Processes, tmp_path: Path) -> None:
    path = variant(tmp_path, "my scenario", PATIENT, ('name = "four-radars"', 'name = "patient"'))
    run = processes.run(path.name, "--speed", "30", "--out", "a folder/of mine")
    assert run.wait() == 0, run.err
    assert processes.alive() == {}
    folder = Path("a folder/of mine")
    tracks = points((tmp_path / folder / "tracks.jsonl").read_text().splitlines())
    kept = [str(folder / "input" / name) for name in ("scenario.toml", "plots.jsonl")]
    for words in ([path.name], kept):
        assert_agree(tracks, points(processes.output("replay", *words, "--json")))


def test_a_sensor_that_dies_does_not_end_the_run(processes: Processes, tmp_path: Path) -> None:
    # Confirmed after three scans, so that all sensors have shown some; three sensors may miss a target at once.
    kept = ("p0 = 1e-4\np1 = 0.95", "p0 = 1e-30\np1 = 0.95\nkeep = 0.9999")
    path = variant(tmp_path, "patient", PATIENT, ("duration = 60.0", "duration = 160.0"), *STEADY, kept)
    run = processes.run(path, "--speed", "20", "--out", "out")
    run.await_line("track 0 confirmed")
    processes.kill("waldnet.sensor_node", "radar-2")
    run.await_line("sensor radar-2 died (killed by SIGKILL); the run goes on with the others")
    assert run.wait() == 0, run.err
    assert run.err == []
    report = json.loads((tmp_path / "out" / "decisions.json").read_text())
    assert report["sensors_lost"] == {"radar-2": "killed by SIGKILL"}
    assert report["tracks"][0]["status"] == "confirmed"
    assert report["tracks"][0]["last_time"] == 160.0
    lost = [entry for entry in log_of(tmp_path / "out", "center") if "sensor lost" in entry["event"]]
    assert [entry["sensor"] for entry in lost] == ["radar-2"]
    tracks = points((tmp_path / "out" / "tracks.jsonl").read_text().splitlines())
    assert_agree(tracks, replay_until_death(path, "radar-2", tracks))
    kept = read_plots(tmp_path / "out" / "input" / "plots.jsonl", load_scenario(path))
    lasts = {scan.sensor: scan.time_ns for scan in kept}
    assert lasts.pop("radar-2") < min(lasts.values())


def replay_until_death(path: Path, sensor: str, got: dict[tuple[float, int], Point]) -> dict[tuple[float, int], Point]:
    """The replay in which a sensor sees nothing any more from the time on at which the tracks went another way."""
    scenario = load_scenario(path)
    scans = all_scans(scenario)
    nobody_died = replay(scenario, scans)
    death_s = min(
        key[0] for key, point in nobody_died.items() if abs(got[key].log_lr_total - point.log_lr_total) > 1e-6
    )
    death_ns = scenario.to_ns(death_s)
    return replay(scenario, [scan for scan in scans if scan.sensor != sensor or scan.time_ns < death_ns])


def replay(scenario: Scenario, scans: Sequence[Scan]) -> dict[tuple[float, int], Point]:
    lines = TrackLines(scenario)
    pictures = [message for message in Replay(scenario, scans).run() if isinstance(message, Tracks)]
    return points([line for tracks in pictures for line in lines.of(tracks)])


def log_of(folder: Path, name: str) -> list[dict[str, Any]]:
    return list(log_entries((folder / "logs" / f"{name}.log").read_text().splitlines()))


def test_a_center_that_dies_ends_the_run(processes: Processes, tmp_path: Path) -> None:
    path = variant(tmp_path, "long", ("duration = 60.0", "duration = 600.0"), of="four-radars-0.2")
    run = processes.run(path, "--speed", "8", "--out", "out")
    run.await_line("track 4 deleted")  # a scan after the confirmation, so that has been heard of for certain
    processes.kill("waldnet.fusion_center")
    assert run.wait() == 1
    assert len(run.err) == 1
    assert run.err[0].startswith("the fusion center died (killed by SIGKILL)")
    assert processes.alive() == {}
    report = json.loads((tmp_path / "out" / "decisions.json").read_text())
    assert report["tracks"][0]["status"] == "confirmed"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_run_that_is_stopped_writes_its_report(processes: Processes, tmp_path: Path, number: signal.Signals) -> None:
    path = variant(tmp_path, "long", ("duration = 60.0", "duration = 600.0"), of="four-radars-0.2")
    run = processes.run(path, "--speed", "8", "--out", "out")
    run.await_line("track 4 deleted")  # a scan after the confirmation
    run.signal(number)
    assert run.wait() == 0, run.err
    assert run.err == []
    assert "stopped" in run.out
    assert processes.alive() == {}
    report = json.loads((tmp_path / "out" / "decisions.json").read_text())
    assert report["tracks"][0]["status"] == "confirmed"
    assert report["sensors_lost"] == {}
    assert (tmp_path / "out" / "plan.png").stat().st_size > 20_000


def test_processes_whose_launcher_is_killed_end_by_themselves(processes: Processes, tmp_path: Path) -> None:
    path = variant(tmp_path, "long", *LONG)
    run = processes.run(path, "--speed", "2", "--out", "out")
    run.await_line("track 0 confirmed")
    family = processes.alive()
    assert len(family) == 6
    run.signal(signal.SIGKILL)
    assert run.wait() == -signal.SIGKILL
    processes.await_end(family)
    assert processes.alive() == {}
    # What had come by then is there, in whole lines.
    decided = [json.loads(line) for line in (tmp_path / "out" / "decisions.jsonl").read_text().splitlines()]
    assert [(entry["track"], entry["kind"]) for entry in decided][:1] == [(0, "confirmed")]
    told = [json.loads(line) for line in (tmp_path / "out" / "tracks.jsonl").read_text().splitlines()]
    assert {entry["track"] for entry in told} <= set(range(5))


@pytest.mark.parametrize(
    "arguments", [("center", "four-radars", "--listen", ANY_PORT), ("router", "--listen", ANY_PORT)]
)
def test_whoever_listens_ends_well_on_sigterm(processes: Processes, arguments: tuple[str, ...]) -> None:
    process = processes.waldnet(*arguments)
    (endpoint,) = json.loads(process.await_line("listening"))["listening"]
    assert re.fullmatch(r"tcp/127\.0\.0\.1:[1-9]\d*", endpoint)
    process.signal(signal.SIGTERM)
    assert process.wait() == 0
    assert processes.alive() == {}


def test_a_node_that_waits_for_a_center_ends_well_on_sigterm(processes: Processes) -> None:
    with open_zenoh(Network(listen=(ANY_PORT,))) as bus:
        present = Arrival()
        bus.watch(Keys("four-radars").sensor_alive(), present)
        node = processes.waldnet("node", "four-radars", "radar-1", "--connect", *bus.endpoints())
        assert present.wait()
        node.signal(signal.SIGTERM)
        assert node.wait() == 0, node.err


class Arrival(threading.Event):
    """Set by whatever comes."""

    def __call__(self, _: str, alive: bool) -> None:
        if alive:
            self.set()

    def wait(self, timeout: float | None = PATIENCE_S) -> bool:
        return super().wait(timeout)


BAD_PLOTS = '{"sensor": "radar-1", "time": 2.0, "plots": []}\n{"sensor": "radar-9", "time": 2.0, "plots": []}\n'
NAMES = "autoferry-2, autoferry-5, four-radars, "


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "bad.toml"), r"bad\.toml: motion\.psd: -1 is not zero or positive and finite"),
        (("check", "bad.toml"), r"bad\.toml: motion\.psd: -1 is not zero or positive and finite"),
        (("center", "bad.toml"), r"bad\.toml: motion\.psd: -1 is not zero or positive and finite"),
        (
            ("run", "four-radars", "--plots", "bad.jsonl"),
            r".*/bad\.jsonl:2: sensor: 'radar-9' is not one of radar-1, .*",
        ),
        (("replay", "four-radars", "bad.jsonl"), r"bad\.jsonl:2: sensor: 'radar-9' is not one of radar-1, .*"),
        (("replay", "four-radars", "no.jsonl"), r"no\.jsonl: cannot be read: No such file or directory"),
        (("node", "four-radars", "radar-9"), r"four-radars: no sensor 'radar-9'; there are radar-1, .*"),
        (
            ("run", "five-radars"),
            r"five-radars: no such file, and none of the scenarios that come along: autoferry-13-all, .*",
        ),
        (("simulate", "four-radars", "--out", "no/folder.jsonl"), r"no/folder\.jsonl: .*No such file or directory"),
        (("run", "four-radars", "--speed", "max", "--out", "bad.toml"), r"bad\.toml: .*File exists"),
        (("replay", "four-radars", "late.jsonl"), r"late\.jsonl:1: time: .*"),
        (("replay", "four-radars", "empty.jsonl"), r"empty\.jsonl: has no scan.*"),
        (("run", "four-radars", "--plots", "empty.jsonl"), r".*/empty\.jsonl: has no scan.*"),
        (("replay", "ancient.toml"), r"ancient\.toml: epoch: .*"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else "",
)
def test_what_is_wrong_is_said_in_one_line(
    processes: Processes, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    variant(tmp_path, "bad", ("psd = 10.0", "psd = -1.0"))
    variant(tmp_path, "ancient", ("2026-01-01", "1026-01-01"))
    (tmp_path / "bad.jsonl").write_text(BAD_PLOTS)
    (tmp_path / "empty.jsonl").write_text("")
    (tmp_path / "late.jsonl").write_text('{"sensor": "radar-1", "time": 1e300, "plots": []}\n')
    process = processes.waldnet(*arguments)
    assert process.wait() == 1, process.err
    assert process.out == []
    assert len(process.err) == 1, process.err
    assert re.fullmatch(message, process.err[0]), process.err[0]


@pytest.mark.parametrize("option", [("--seed", "-1"), ("--speed", "0"), ("--speed", "nan"), ("--fast",)])
def test_wrong_options_are_refused(processes: Processes, option: tuple[str, ...]) -> None:
    process = processes.waldnet("run", "four-radars", *option)
    assert process.wait() == 2, process.err
    assert process.out == []
    assert option[0] in " ".join(process.err)
    assert len(process.err) < 6


def test_a_node_without_a_center_gives_up(processes: Processes) -> None:
    node = processes.waldnet("node", "four-radars", "radar-1", "--connect", free_endpoint(), "--patience", "1")
    assert node.wait() == 1
    assert node.out == []
    assert re.fullmatch(
        r"no center of network 'four-radars' answered 'radar-1' within \d+ s \(peer at tcp/127\.0\.0\.1:\d+\): .*",
        node.err[-1],
    )


@pytest.mark.parametrize("command", [("center", "four-radars"), ("router",)], ids=lambda command: command[0])
def test_an_endpoint_that_is_taken(processes: Processes, command: tuple[str, ...]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        process = processes.waldnet(*command, "--listen", endpoint)
        assert process.wait() == 1
    assert process.out == []
    assert process.err == [
        f"cannot listen on {endpoint}: address already in use; expected a free one "
        "(is another center or router running?)"
    ]


CLOCK = Clock(time_ns=0, wall_ns=0, speed=0.0, clear_ns=0)


def of_version_99(payload: bytes) -> bytes:
    """The same message of another wire version: the second byte is the version."""
    assert payload[:2] == bytes([0x95, VERSION])
    return b"\x95\x63" + payload[2:]


@pytest.mark.parametrize("key", [Keys("four-radars").clock(), Keys("four-radars").command("radar-1")])
def test_a_node_refuses_a_center_of_another_wire_version(processes: Processes, key: str) -> None:
    keys = Keys("four-radars")
    with open_zenoh(Network(listen=(ANY_PORT,))) as bus:
        present = Arrival()
        publisher = bus.publisher(key)
        bus.announce(keys.center_alive())
        bus.watch(keys.sensor_alive(), present)
        node = processes.waldnet("node", "four-radars", "radar-1", "--connect", *bus.endpoints())
        assert present.wait()
        publisher.put(of_version_99(encode(CLOCK)))
        assert node.wait() == 1
    assert node.out == []
    assert re.fullmatch(
        rf"the center of this network and this node do not fit together: {key}: \d+ bytes are no message: version 99, "
        rf"this program reads {VERSION}",
        node.err[-1],
    )


def stale_report(sensor: str) -> Report:
    """A report that fits but for its epoch."""
    return Report(sensor, 0, 10, 20, 0, np.array([0]), np.array([1]), np.zeros(1), np.zeros((1, 4)), np.eye(4)[None])


def test_bad_bytes_are_counted_and_change_nothing(processes: Processes) -> None:
    path, keys = find("four-radars"), Keys("four-radars")
    report, clock = encode(stale_report("radar-1")), encode(CLOCK)
    bad = [b"", b"\x00", b"\xff" * 200, b'{"sensor": "radar-1"}', report[:-3], of_version_99(report)]
    sent = {
        keys.report("radar-1"): [*bad, clock, report],
        keys.join("radar-9"): [*bad, clock, encode(Join("", 1, 2, "x"))],
    }
    center = start_center(processes, path, "--speed", "max", "--wait", PATIENCE_S)
    with peer_of(center.at) as bus:
        observer = observe(bus, path)
        publishers = {key: bus.publisher(key) for key in sent}

        def send_all() -> None:
            for key, payloads in sent.items():
                for payload in payloads:
                    publishers[key].put(payload)
            observer.fence()

        send_all()
        nodes = start_nodes(processes, path, "--connect", *center.at)
        observer.await_tracks(lambda _: True)
        send_all()
        record = observer.follow_to_the_end()
    assert [process.wait() for process in (center.process, *nodes.values())] == 5 * [0]
    assert_agree(points_of(record), points(processes.output("replay", path, "--json")))
    (ended,) = [entry for entry in log_entries(center.process.err) if entry["event"] == "ended"]
    joined = [entry["sensor"] for entry in log_entries(center.process.err) if entry["event"] == "sensor joined"]
    assert set(joined) == set(nodes)
    assert ended["dropped"] == {"bad bytes": 4 * len(bad), "unexpected": 4, "refused report": 2, "refused message": 2}


def test_two_networks_on_one_router_do_not_meet(processes: Processes) -> None:
    path = find("four-radars")
    router = processes.waldnet("router", "--listen", ANY_PORT)
    at = json.loads(router.await_line("listening"))["listening"]
    seeds = {"one": 1, "two": 2}
    client = ("--mode", "client", "--connect", *at)
    with ExitStack() as stack:
        centers: list[Center] = []
        nodes: list[Process] = []
        observers: dict[str, Observer] = {}
        for name in seeds:
            options = ("--network-name", name, *client, "--speed", "max", "--wait", PATIENCE_S)
            centers.append(start_center(processes, path, *options))
            bus = stack.enter_context(open_zenoh(Network(mode="client", connect=at)))
            observers[name] = observe(bus, path, name)
        for name, seed in seeds.items():
            options = ("--network-name", name, *client, "--seed", str(seed))
            nodes += start_nodes(processes, path, *options).values()
        records = {name: observer.follow_to_the_end() for name, observer in observers.items()}
    assert [process.wait() for process in (*(center.process for center in centers), *nodes)] == 10 * [0]
    router.signal(signal.SIGTERM)
    assert router.wait() == 0
    scenario = load_scenario(path)
    for name, seed in seeds.items():
        assert_agree(points_of(records[name]), replay(scenario, all_scans(scenario, seed=seed)))


def test_a_sensor_that_is_restarted_takes_part_again(processes: Processes, tmp_path: Path) -> None:
    path = variant(tmp_path, "long", PATIENT, *LONG)
    center = start_center(processes, path, "--speed", "2", "--wait", PATIENCE_S)
    names = load_scenario(path).sensor_names

    def reported(*missing: str) -> Callable[[Tracks], bool]:
        expected = [name not in missing for name in names]
        return lambda tracks: tracks.ids[0] == 0 and tracks.contributing[0].tolist() == expected

    with peer_of(center.at) as bus:
        observer = observe(bus, path)
        nodes = start_nodes(processes, path, "--connect", *center.at)
        for _ in range(3):
            observer.await_tracks(reported())
        nodes["radar-2"].signal(signal.SIGKILL)
        observer.await_tracks(reported("radar-2"))
        again = processes.waldnet("node", path, "radar-2", "--connect", *center.at)
        for _ in range(3):
            last = observer.await_tracks(reported())
        center.process.signal(signal.SIGTERM)
        record = observer.follow_to_the_end()
    assert center.process.wait() == 0
    for name, node in {**nodes, "radar-2": again}.items():
        node.signal(signal.SIGTERM)
        assert node.wait() == (-signal.SIGKILL if node is nodes["radar-2"] else 0), name
    assert last.status[0] == Status.CONFIRMED
    assert [decision.kind for decision in record.decisions if decision.track == 0] == ["confirmed"]
    got, expected = points_of(record), steps_with_a_restart(record, "radar-2")
    assert_agree(got, min(expected, key=lambda steps: misfit(got, steps)))
    # Only the new process's association filter is another one: as if the old one had looked away for a while.
    looked_away = replay(record.scenario, seen_in(record, "radar-2"))
    assert max(abs(point.log_lr_total - looked_away[key].log_lr_total) for key, point in got.items()) < 1.0


def misfit(got: dict[tuple[float, int], Point], expected: dict[tuple[float, int], Point]) -> float:
    return sum(abs(got[key].log_lr_total - point.log_lr_total) for key, point in expected.items())


def gap_of(record: Record, name: str) -> list[int]:
    """Times at which a sensor was missing."""
    number = record.scenario.sensor_names.index(name)
    return [time_ns for time_ns, tracks in sorted(record.pictures.items()) if not tracks.contributing[0, number]]


def seen_in(record: Record, name: str) -> list[Scan]:
    """The scans that went into a record in which one sensor was missing for a while."""
    gap, last_ns = gap_of(record, name), max(record.pictures)
    scans = all_scans(record.scenario)
    return [scan for scan in scans if scan.time_ns <= last_ns and not (scan.sensor == name and scan.time_ns in gap)]


def steps_with_a_restart(record: Record, name: str) -> Iterator[dict[tuple[float, int], Point]]:
    """What the pure steps make of the same scans, for every time at which the restart may have been."""
    plot, gap = record.scenario, gap_of(record, name)
    for restart_ns in gap:
        stage = Stage(plot)
        nodes = {sensor: Node(plot, sensor, start) for sensor, start in stage.join_all().items()}
        for scan in seen_in(record, name):
            if scan.time_ns == gap[0]:
                stage.tell(Presence(name, alive=False))
            stage.tell(nodes[scan.sensor].scan(scan, scan.time_ns + 2 * NS_PER_S))
            if scan.time_ns == restart_ns and scan.sensor == plot.sensor_names[-1]:
                (start,) = only(Start, stage.join(name, plot.to_seconds(gap[-1]) + 2.0, incarnation=2))
                nodes[name] = Node(plot, name, start)
        heard = Record(plot)
        for message in stage.said:
            heard.note(message)
        yield points_of(heard)


def test_a_test_that_is_not_enabled_decides_nothing(processes: Processes, tmp_path: Path) -> None:
    path = variant(tmp_path, "off", ("p1 = 0.95", "p1 = 0.95\nenabled = false"))
    found = points(processes.output("replay", path, "--json"))
    assert len(found) == 30 * 5
    assert {point.status for point in found.values()} == {"tentative"}
    assert all(point.log_lr == point.log_lr_total for point in found.values())
    last = [found[60.0, track].log_lr for track in range(5)]
    assert last[0] > 100.0
    assert max(last[1:]) < -100.0


def test_surroundings_do_not_matter(processes: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh logs to standard output if the environment wants it; modules may be called like some of the library's."""
    monkeypatch.setenv("RUST_LOG", "info")
    (tmp_path / "json.py").write_text("raise ImportError('not this one')")
    run = processes.run("four-radars", "--speed", "max", "--out", "out")
    assert run.wait() == 0, run.err
    assert run.err == []


def test_a_reader_who_has_seen_enough_may_leave() -> None:
    waldnet = Path(sys.executable).with_name("waldnet")
    ended = subprocess.run(
        ["bash", "-c", f"{waldnet} replay four-radars --json | head -n 1"],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert json.loads(ended.stdout)["track"] == 0
    assert ended.stderr == ""


def test_the_version_is_that_of_the_package(processes: Processes) -> None:
    assert processes.output("--version") == [version("waldnet")]


def test_a_terminal_that_knows_only_ascii(processes: Processes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    (processes.cwd / "größe.jsonl").write_text('{"sensor": "radar-1", "time": 2.0, "plots": []}\n')
    said = processes.output("check", "four-radars", "größe.jsonl")
    assert any(line.endswith("1 scans, 0 plots") for line in said)
