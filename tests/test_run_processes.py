"""``waldnet run`` as a process that is stopped at any moment, whose folder is taken, whose disk is full."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from process_helpers import ANY_PORT, PATIENCE_S, Processes

from waldnet.common.config import load_scenario
from waldnet.scenarios.plots import read_plots

pytestmark = pytest.mark.processes

REPORT = {"decisions.json", "tracks.jsonl", "log_lr.png", "plan.png", "input", "logs", "network.toml"}


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    with Processes(tmp_path) as started:
        yield started


def await_file(path: Path) -> None:
    until = time.monotonic() + PATIENCE_S
    while not path.exists():
        assert time.monotonic() < until, f"{path} never came"


def assert_whole(folder: Path) -> None:
    """All files are there, whole, and no other ones."""
    assert {path.name for path in folder.iterdir()} <= REPORT
    assert {path.name for path in folder.iterdir()} >= REPORT - {"network.toml"}
    for name in ("log_lr.png", "plan.png"):
        assert (folder / name).read_bytes().endswith(b"IEND\xaeB`\x82")
    told = [json.loads(line) for line in (folder / "tracks.jsonl").read_text().splitlines()]
    summary = json.loads((folder / "decisions.json").read_text())
    assert summary["last_time"] == max((entry["time"] for entry in told), default=summary["last_time"])
    scenario = folder / "input" / "scenario.toml"
    if summary["last_time"] is not None:
        scans = read_plots(folder / "input" / "plots.jsonl", load_scenario(scenario))
        assert load_scenario(scenario).to_seconds(scans[-1].time_ns) == summary["last_time"]


@pytest.mark.parametrize(
    ("moment", "number"),
    [
        ("input", signal.SIGTERM),
        ("logs/center.log", signal.SIGINT),
        ("logs/radar-4.log", signal.SIGHUP),
        ("decisions.json", signal.SIGTERM),
        ("decisions.json", signal.SIGINT),
    ],
)
def test_a_run_that_is_stopped_at_any_moment_leaves_a_whole_report(
    processes: Processes, tmp_path: Path, moment: str, number: signal.Signals
) -> None:
    """At its beginning, and while the report is being written."""
    run = processes.waldnet("run", "four-radars-0.2", "--speed", "max", "--out", "out")
    await_file(tmp_path / "out" / moment)
    for _ in range(3):
        run.signal(number)
    assert run.wait() == 0, run.err
    assert run.err == []
    assert processes.alive() == {}
    assert_whole(tmp_path / "out")


def test_what_is_left_of_a_stopped_run_can_be_evaluated_and_replayed(processes: Processes, tmp_path: Path) -> None:
    processes.output("simulate", "four-radars-0.2", "--out", "plots.jsonl", "--truth", "truth.jsonl")
    run = processes.waldnet("run", "four-radars-0.2", "--speed", "8", "--out", "out")
    run.await_line("track 4 deleted")
    run.signal(signal.SIGTERM)
    assert run.wait() == 0, run.err
    assert_whole(tmp_path / "out")
    (told,) = processes.output("evaluate", "out", "--truth", "truth.jsonl", "--json")
    assert [one["confirmed_targets"] for one in json.loads(told)["runs"]] == [1, 1]
    inside = [str(Path("out", "input", name)) for name in ("scenario.toml", "plots.jsonl")]
    assert any(line.startswith("track 0: confirmed") for line in processes.output("replay", *inside))


def test_a_folder_that_holds_a_run_is_refused_and_stays_as_it_is(processes: Processes, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "tracks.jsonl").write_text("mine\n")
    run = processes.waldnet("run", "four-radars", "--speed", "max", "--out", "out")
    assert run.wait() == 1
    assert run.err == [
        "out: holds a run already (tracks.jsonl), which is not overwritten: give another --out, or remove the folder"
    ]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["tracks.jsonl"]
    assert (tmp_path / "out" / "tracks.jsonl").read_text() == "mine\n"


def test_a_full_disk_ends_a_run_with_one_error_and_what_was_written_can_be_read(
    processes: Processes, tmp_path: Path
) -> None:
    """Here no file may be longer than 16 KiB."""
    command = f"ulimit -f 32; exec {processes.command('run', 'four-radars', '--speed', 'max', '--out', 'out')}"
    run = processes.start("sh", "-c", command)
    assert run.wait() == 1
    assert len(run.err) == 1
    assert run.err[0].startswith("out/tracks.jsonl: File too large; ")
    assert processes.alive() == {}
    folder = tmp_path / "out"
    told = [json.loads(line) for line in (folder / "tracks.jsonl").read_text().splitlines()]
    summary = json.loads((folder / "decisions.json").read_text())
    assert 0 < summary["last_time"] == told[-1]["time"]
    assert not list(folder.glob("*.tmp"))
    processes.output("simulate", "four-radars", "--out", "plots.jsonl", "--truth", "truth.jsonl")
    (evaluated,) = processes.output("evaluate", "out", "--truth", "truth.jsonl", "--json")
    assert [one["confirmed_targets"] for one in json.loads(evaluated)["runs"]] == [1, 1]


def test_a_run_whose_output_nobody_reads_any_more_leaves_a_whole_report(processes: Processes, tmp_path: Path) -> None:
    command = processes.command("run", "four-radars-0.2", "--speed", "max", "--out", "out")
    run = processes.start("sh", "-c", f"{command} | true")
    assert run.wait() == 0
    assert run.err == []
    assert processes.alive() == {}
    assert_whole(tmp_path / "out")


def test_a_process_whose_log_cannot_be_written_goes_on(processes: Processes) -> None:
    command = processes.command("center", "four-radars", "--listen", ANY_PORT)
    center = processes.start("sh", "-c", f"exec {command} 2> /dev/full")
    center.await_line("listening")
    center.signal(signal.SIGTERM)
    assert center.wait() == 0
