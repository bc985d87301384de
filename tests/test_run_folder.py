"""The folder of a run: written as it is heard, with bounded memory, whole at any moment."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import Stage, hypothesis_table, only, reports_of, scenario, sensor_table, write_report

from waldnet.common.config import Scenario
from waldnet.common.decision_filter import DecisionFilter
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.sprt import Status
from waldnet.common.messages import Decision, Message, Scan, Tracks
from waldnet.offline.replay import Replay
from waldnet.recording import sketch
from waldnet.recording.inputs import Source
from waldnet.recording.lines import TrackLines, decision_entry
from waldnet.recording.record import Record
from waldnet.recording.run_folder import RunFolder, refuse_used
from waldnet.recording.sketch import ThinnedRows
from waldnet.scenarios.world import simulate_all

STARTING = {"hypothesis": [], "initiation": {"speed": 100.0}}


def written(folder: Path, plot: Scenario, messages: Iterable[Message], **extra: Any) -> dict[str, Any]:
    """The summary of a run in which these messages were heard."""
    run = RunFolder(folder, plot)
    for message in messages:
        assert run.note(message) is None
    assert run.finish(extra).failures == []
    summary: dict[str, Any] = json.loads((folder / "decisions.json").read_text())
    return summary


def tracks_of(record: Record) -> list[dict[str, Any]]:
    """The tracks of a summary, worked out with everything in memory."""
    last: dict[int, tuple[int, Tracks]] = {}
    for time_ns in sorted(record.pictures):
        tracks = record.pictures[time_ns]
        last.update({track: (row, tracks) for row, track in enumerate(tracks.ids.tolist())})
    return [
        {
            "track": track,
            "status": Status(int(tracks.status[row])).name.lower(),
            "log_lr": tracks.log_lr[row],
            "log_lr_total": tracks.log_lr_total[row],
            "last_time": record.scenario.to_seconds(tracks.time_ns),
            "x": tracks.x[row].tolist(),
            "supported": record.scenario.to_seconds(int(tracks.supported_ns[row])),
            "decisions": [decision_entry(d, record.scenario) for d in record.standing() if d.track == track],
        }
        for track, (row, tracks) in sorted(last.items())
    ]


def late_reports() -> tuple[Scenario, list[Message]]:
    """What a center says of real and false hypotheses when the reports of a sensor come late."""
    sensors = [sensor_table("a", p_d=0.6), sensor_table("b", p_d=0.6)]
    hypotheses = [hypothesis_table(offset) for offset in (0.0, 300.0, 600.0, 3000.0, -3000.0)]
    fusion = {"window": 6.0, "hold_back": 0.1}
    stage = Stage(scenario(*sensors, hypothesis=hypotheses, fusion=fusion), speed=1.0)
    starts = stage.join_all()
    reports = reports_of(stage.scenario, starts, simulate_all(stage.scenario, 3))
    rng = np.random.default_rng(1)
    delays_s = np.where([report.sensor == "b" for report in reports], rng.uniform(0.0, 5.0, len(reports)), 0.0)
    times_s = [stage.scenario.to_seconds(report.time_ns) for report in reports] + delays_s
    for k in np.argsort(times_s, kind="stable"):
        stage.tell(reports[k], times_s[k])
        stage.tick(times_s[k] + 0.11)
    return stage.scenario, stage.said


def test_a_folder_written_as_it_comes_holds_what_all_messages_together_say(tmp_path: Path) -> None:
    """Late reports replace pictures and withdraw decisions; the files know only what came of it."""
    plot, messages = late_reports()
    record = Record(plot)
    for message in messages:
        record.note(message)
    heard = only(Tracks, messages)
    assert len(record.pictures) < len(heard), "no picture was replaced"
    summary = written(tmp_path, plot, messages, seed=2)
    lines = TrackLines(plot)
    expected = [line for time_ns in sorted(record.pictures) for line in lines.of(record.pictures[time_ns])]
    assert (tmp_path / "tracks.jsonl").read_text().splitlines() == expected
    assert summary["tracks"] == tracks_of(record)
    withdrawn = [decision_entry(d, plot) for d in record.decisions if d.kind == "withdrawn"]
    assert summary["withdrawn"] == withdrawn
    assert len(withdrawn) > 0
    assert [entry for entry in summary["tracks"] if entry["decisions"]]
    assert (summary["scenario"], summary["seed"], summary["messages_refused"]) == (plot.name, 2, {})
    assert summary["first_time"] == plot.to_seconds(min(record.pictures))
    assert summary["last_time"] == plot.to_seconds(max(record.pictures))
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "decisions.json",
        "log_lr.png",
        "plan.png",
        "tracks.jsonl",
    ]


def test_what_is_final_is_in_the_files_at_once(tmp_path: Path) -> None:
    """Whatever ends the process, that much is left."""
    plot = scenario(fusion={"window": 4.0})
    scans = simulate_all(plot, 1)
    run, lines, expected = RunFolder(tmp_path, plot, Source(b"", scans)), TrackLines(plot), list[str]()
    for scan in scans:
        run.note(scan)
    said = list(Replay(plot, scans).run())
    pictures = only(Tracks, said)
    decided = 0
    for message in said:
        run.note(message)
        decided += isinstance(message, Decision)
        assert len((tmp_path / "decisions.jsonl").read_text().splitlines()) == decided
        if isinstance(message, Tracks):
            final = [one for one in pictures if one.time_ns < message.time_ns - 4 * 10**9]
            expected = [line for one in final for line in TrackLines(plot).of(one)]
            assert (tmp_path / "tracks.jsonl").read_text().splitlines() == expected
            seen = [json.loads(line)["time"] for line in (tmp_path / "input" / "plots.jsonl").read_text().splitlines()]
            assert seen == [plot.to_seconds(s.time_ns) for s in scans if final and s.time_ns <= final[-1].time_ns]
    assert decided >= 1
    assert len(expected) > 0
    run.finish({})
    assert len((tmp_path / "input" / "plots.jsonl").read_text().splitlines()) == len(scans)
    assert (tmp_path / "tracks.jsonl").read_text().splitlines() == [line for one in pictures for line in lines.of(one)]


def crowd(plot: Scenario, number: int) -> Iterable[Message]:
    """A long run: at every second a track starts and lives 20 s, every fifth is confirmed."""
    for k in range(number):
        ids = np.arange(max(0, k - 19), k + 1)
        status = np.where(ids % 5 == 0, Status.CONFIRMED, Status.TENTATIVE).astype(np.uint8)
        status[ids == k - 19] = Status.DELETED
        count = len(ids)
        time_ns = plot.to_ns(float(k))
        if k % 5 == 0:
            yield Decision("confirmed", k, time_ns, 5.0, 5.0, 1)
        if k >= 19:
            yield Decision("deleted", k - 19, time_ns, -5.0, 1.0, 20)
        yield Tracks(
            time_ns=time_ns,
            sensors=plot.sensor_names,
            ids=ids,
            status=status,
            scans=np.ones(count, np.int64),
            contributing=np.ones((count, len(plot.sensor_names)), np.bool_),
            log_lr=np.full(count, 0.1),
            log_lr_total=np.full(count, 0.1 * k),
            x=np.ones((count, 4)),
            P=np.tile(np.eye(4), (count, 1, 1)),
            supported_ns=np.zeros(count, np.int64),
        )
        for name in plot.sensor_names:
            yield Scan(name, time_ns, np.zeros(2), np.ones((3, 2)))


def test_what_is_kept_in_memory_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sketch, "MOST_TRACKS", 30)
    monkeypatch.setattr(sketch, "_MOST_TIMES", 8)
    monkeypatch.setattr(sketch, "_MOST_PLOTS", 100)
    plot = scenario(**STARTING)
    run, told = RunFolder(tmp_path, plot), DecisionFilter(plot)
    pictures, courses, confirmed = [], [], []
    for message in crowd(plot, 1000):
        run.note(message)
        if isinstance(message, Decision):
            told.passes(message)
        pictures.append(run.pending)
        courses.append(len(run.sketch))
        confirmed.append(len(told))
    assert max(pictures) == plot.fusion.window + 1
    assert max(courses) <= 30 + 20 + 1
    # Four confirmed tracks are alive; those that ended within the window are remembered.
    assert max(confirmed) <= 4 + 1 + plot.fusion.window / 5 + 1
    assert len(run._live) <= 20
    plots, count = run.sketch.plots(rays=False)
    assert count == 1000 * 3 * len(plot.sensor_names)
    assert len(plots) <= 100 + len(plot.sensor_names)
    assert run.finish({}).failures == []
    drawn = run.sketch.histories()
    assert set(drawn) == {track for track in range(0, 1000, 5) if track >= 980 - 30 * 5}
    assert max(len(history.times_s) for history in drawn.values()) <= 9
    assert run.sketch.outcome.total() == 1000
    # What was let go of is in the files, all of it.
    summary = json.loads((tmp_path / "decisions.json").read_text())
    assert [entry["track"] for entry in summary["tracks"]] == list(range(1000))
    for entry in summary["tracks"][:981]:
        kinds = ["confirmed", "deleted"] if entry["track"] % 5 == 0 else ["deleted"]
        assert [decision["kind"] for decision in entry["decisions"]] == kinds
        assert (entry["status"], entry["last_time"]) == ("deleted", entry["track"] + 19.0)


@pytest.mark.parametrize("number", [0, 1, 7, 8, 9, 1000])
def test_thinned_rows_are_even_and_have_the_last(number: int) -> None:
    rows = ThinnedRows(1, 8)
    for k in range(number):
        rows.add((float(k),))
    kept = rows.rows()[:, 0]
    assert rows.count == number
    assert len(kept) == number if number <= 8 else 4 < len(kept) <= 9
    if number:
        assert (kept[0], kept[-1]) == (0.0, number - 1)
        assert len(set(np.diff(kept[:-1]))) <= 1


def strange(plot: Scenario) -> dict[str, Message]:
    """Messages that are whole and cannot belong to the run."""
    one = next(iter(crowd(plot, 2)))
    picture = only(Tracks, crowd(plot, 2))[-1]
    assert isinstance(one, Decision)
    return {
        "a picture with states of 6 numbers, the scenario's have 4": picture._replace(
            x=np.ones((2, 6)), P=np.tile(np.eye(6), (2, 1, 1))
        ),
        "a Tracks later than the last scan of all sources": picture._replace(time_ns=2**62),
        "a Scan later than the last scan of all sources": Scan("a", 2**62, np.zeros(2), np.ones((1, 2))),
        "plots of 'nobody', a sensor that the scenario does not have": Scan("nobody", 0, np.zeros(2), np.ones((1, 2))),
        "plots of a of 3 numbers, seen from 2 coordinates": Scan("a", 0, np.zeros(2), np.ones((1, 3))),
        "plots of a of 2 numbers, seen from 3 coordinates": Scan("a", 0, np.zeros(3), np.ones((1, 2))),
        "a picture older than fusion.window": picture._replace(time_ns=plot.to_ns(2.0)),
    }


def test_strange_messages_are_counted_with_their_reasons_and_cost_nothing(tmp_path: Path) -> None:
    plot = scenario()
    scans = simulate_all(plot, 1)
    said = list(Replay(plot, scans).run())
    clean, disturbed = tmp_path / "clean", tmp_path / "disturbed"
    for folder in (clean, disturbed):
        folder.mkdir()
        run = RunFolder(folder, plot, Source(b"", scans))
        for k, message in enumerate(said):
            assert run.note(message) is None
            if folder == disturbed and k == len(said) - 2:
                for reason, other in strange(plot).items():
                    assert run.note(other) == reason
        assert run.finish({}).failures == []
    one, two = (json.loads((folder / "decisions.json").read_text()) for folder in (clean, disturbed))
    assert two.pop("messages_refused") == dict.fromkeys(strange(plot), 1)
    assert one.pop("messages_refused") == {}
    assert one == two
    for name in ("tracks.jsonl", "log_lr.png", "plan.png", "input/plots.jsonl"):
        assert (clean / name).read_bytes() == (disturbed / name).read_bytes()


def test_a_folder_with_a_run_is_not_written_to(tmp_path: Path) -> None:
    refuse_used(tmp_path / "nowhere")
    (tmp_path / "notes.txt").write_text("mine")
    refuse_used(tmp_path)
    write_report(Record(scenario()), tmp_path, {})
    with pytest.raises(ConfigError, match=r"holds a run already \(decisions.json, tracks.jsonl, .*another --out"):
        refuse_used(tmp_path)


def test_a_full_disk_costs_what_does_not_fit_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file of tracks does not take any more; the summary tells of what is in it."""
    plot = scenario(fusion={"window": 4.0})
    scans = simulate_all(plot, 1)
    run = RunFolder(tmp_path, plot, Source(b"", scans))
    failed = 0
    for k, message in enumerate(Replay(plot, scans).run()):
        if k == 8:
            monkeypatch.setattr(run._tracks, "_file", FullDisk(run._tracks._file))
        try:
            run.note(message)
        except OSError:
            failed += 1
    report = run.finish({})
    assert failed > 0
    assert report.failures == [f"{tmp_path / 'tracks.jsonl'}: No space left on device"]
    told = [json.loads(line) for line in (tmp_path / "tracks.jsonl").read_text().splitlines()]
    summary = json.loads((tmp_path / "decisions.json").read_text())
    assert 0 < summary["last_time"] == max(entry["time"] for entry in told) < 20.0
    assert [file.name for file in report.files] == [
        "decisions.json",
        "tracks.jsonl",
        "log_lr.png",
        "plan.png",
        "input",
    ]


class FullDisk:
    """A raw file on a disk that is full."""

    def __init__(self, file: Any) -> None:
        self._file = file

    def write(self, _: memoryview) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
