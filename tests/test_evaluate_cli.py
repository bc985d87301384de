"""``waldnet evaluate`` from files to files, and what it says of wrong ones; ``waldnet simulate --truth``."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import only, scenario, write_report

from waldnet.common.config import load_scenario
from waldnet.common.errors import EvaluationError, TruthError
from waldnet.common.messages import Tracks
from waldnet.common.process import main
from waldnet.evaluation.runs import names, read_run
from waldnet.evaluation.yardstick import centralised
from waldnet.launch.cli import app
from waldnet.offline.replay import Replay
from waldnet.recording.inputs import Source, kept
from waldnet.recording.record import Record
from waldnet.recording.run_folder import RunFolder
from waldnet.scenarios.catalogue import find
from waldnet.scenarios.truth import read_truth, write_truth
from waldnet.scenarios.world import simulate_all, truth

LINE: dict[str, Any] = {"time": 2.0, "track": 5, "status": "confirmed", "x": [1.0, 2.0, 3.0, 4.0], "P": []}
POINT: dict[str, Any] = {"target": 1, "time": 2.0, "position": [1.0, 2.0]}


def write(path: Path, *lines: Any) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text("".join((line if isinstance(line, str) else json.dumps(line)) + "\n" for line in lines))
    return path


def straight(count: int = 5, **changes: Any) -> list[dict[str, Any]]:
    """Lines of a track that goes north, one metre a second."""
    return [{**LINE, "time": float(k), "x": [0.0, float(k), 0.0, 1.0], **changes} for k in range(count)]


def points(count: int = 5, **changes: Any) -> list[dict[str, Any]]:
    """The truth of it."""
    return [{**POINT, "time": float(k), "position": [0.0, float(k)], **changes} for k in range(count)]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("{", "is no JSON: Expecting property name enclosed in double quotes at column 2"),
        ("[]", "is a JSON list, expected an object with target, time and position"),
        ({"target": 1, "time": 2.0}, "position is missing"),
        ({**POINT, "speed": 3}, "'speed' is no known key; expected position, target, time"),
        ({**POINT, "target": "a"}, "target: 'a' is not a whole number between -1e+15 and 1e+15"),
        ({**POINT, "target": True}, "target: True is not a whole number between -1e+15 and 1e+15"),
        ({**POINT, "target": 10**20}, f"target: {10**20} is not a whole number between -1e+15 and 1e+15"),
        ({**POINT, "time": None}, "time: None is not a number of seconds between -4e+09 and 4e+09"),
        ({**POINT, "position": [1.0, None]}, "position: [1.0, None] is not a list of 2 finite numbers"),
        ({**POINT, "position": [1, 2, 3]}, "position: [1, 2, 3] is not a list of 2 finite numbers"),
        ({**POINT, "time": 1.0}, "target 1 has a position at 1.0 s already, line 1"),
        ({**POINT, "time": 1.0 + 1e-10}, "target 1 has a position at 1.0000000001 s already, line 1"),
    ],
)
def test_a_line_that_is_no_truth_is_named(tmp_path: Path, line: Any, reason: str) -> None:
    path = write(tmp_path / "truth.jsonl", {**POINT, "time": 1.0}, "", line)
    with pytest.raises(TruthError) as caught:
        read_truth(path)
    assert str(caught.value) == f"{path}:3: {reason}"


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ({"time": 2.0, "track": 5, "kind": "confirmed"}, "status is missing"),
        ({**LINE, "status": "lost"}, "status: 'lost' is not one of tentative, confirmed, deleted, coasting"),
        ({**LINE, "track": 1.5}, "track: 1.5 is not a whole number between -1e+15 and 1e+15"),
        (
            {**LINE, "x": [1.0, 2.0]},
            "x, where the truth has 2 coordinates: [1.0, 2.0] is not a list of 4 or 6 finite numbers",
        ),
        ({**LINE, "time": 1.0}, "track 5 is there at 1.0 s already, line 1"),
    ],
)
def test_a_line_that_is_no_track_is_named(tmp_path: Path, line: Any, reason: str) -> None:
    path = write(tmp_path / "tracks.jsonl", {**LINE, "time": 1.0}, line)
    for given in (path, tmp_path):
        with pytest.raises(EvaluationError) as caught:
            read_run(given, 2)
        assert str(caught.value) == f"{path}:2: {reason}"


def test_a_folder_that_is_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match=r"tracks.jsonl: cannot be read: No such file or directory"):
        read_run(tmp_path, 2)


def test_only_confirmed_tracks_count(tmp_path: Path) -> None:
    lines = [{**LINE, "time": 1.0, "status": "tentative"}, {**LINE, "track": 6, "status": "deleted"}, LINE]
    run = read_run(write(tmp_path / "tracks.jsonl", *reversed(lines)), 2)
    assert run.times_s.tolist() == [1.0, 2.0]
    assert run.ids.tolist() == [5]
    np.testing.assert_array_equal(run.positions, [[[np.nan, np.nan], [1.0, 2.0]]])
    assert run.span_s == (1.0, 2.0)


def test_a_folder_tells_when_it_was_measured(tmp_path: Path) -> None:
    """A run had nothing to report at first, or ever."""
    record = Record(scenario())
    none = Tracks(0, ("a",), *(np.empty(0, np.int64) for _ in range(9)))  # type: ignore[arg-type]
    for second in (1, 2, 3):
        record.note(
            none._replace(x=np.empty((0, 4)), P=np.empty((0, 4, 4)), time_ns=record.scenario.to_ns(float(second)))
        )
    write_report(record, tmp_path, {})
    assert (tmp_path / "tracks.jsonl").read_text() == ""
    assert read_run(tmp_path, 2).span_s == (1.0, 3.0)
    (tmp_path / "nothing").mkdir()
    write_report(Record(scenario()), tmp_path / "nothing", {})
    assert read_run(tmp_path / "nothing", 2).span_s is None
    (tmp_path / "decisions.json").unlink()
    assert read_run(tmp_path, 2).span_s is None


def test_truth_in_three_dimensions(tmp_path: Path) -> None:
    path = write(tmp_path / "truth.jsonl", *points(position=[1.0, 2.0, 3.0]))
    assert read_truth(path)[1].positions.shape == (5, 3)
    run = read_run(write(tmp_path / "tracks.jsonl", *straight(x=[1.0, 2.0, 3.0, 0.0, 0.0, 0.0])), 3)
    np.testing.assert_array_equal(run.positions, np.full((1, 5, 3), [1.0, 2.0, 3.0]))


def test_runs_are_named_by_what_tells_them_apart(tmp_path: Path) -> None:
    for name in ("a/run", "b/run", "c"):
        (tmp_path / name).mkdir(parents=True)
    assert names([tmp_path / "a/run", tmp_path / "c"]) == ["run", "c"]
    assert names([tmp_path / "a/run", tmp_path / "b/run"]) == ["a/run", "b/run"]
    assert names([write(tmp_path / "x/lines.jsonl")]) == ["lines"]
    with pytest.raises(EvaluationError, match="a run is given twice: "):
        names([tmp_path / "c", tmp_path / "c"])


def command(*words: object) -> None:
    """A command line that goes well."""
    with pytest.raises(SystemExit) as caught:
        main(app, [*map(str, words)])
    assert caught.value.code == 0


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, with one space between words."""
    return " ".join(capsys.readouterr().out.split())


def test_a_run_gets_a_table_a_figure_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write(tmp_path / "run" / "tracks.jsonl", *straight(), *straight(track=6, x=[300.0, 0.0, 0.0, 0.0])).parent
    known = write(tmp_path / "truth.jsonl", *points())
    command("evaluate", run, "--truth", known)
    text = said(capsys)
    assert "targets confirmed 1 of 1 after [s], mean 0.00 held share 100.0%" in text
    assert "confirmed tracks 2 duplicates 0 false 1 false per minute 15.00" in text
    assert f"{run}/evaluation.png, {run}/evaluation.json" in text
    assert (run / "evaluation.png").read_bytes().startswith(b"\x89PNG")
    rules = ("--cutoff", 400, "--order", 1, "--window", 2, "--gap", 3)
    command("evaluate", run, "--truth", known, "--json", *rules)
    printed = capsys.readouterr().out
    told = json.loads(printed)
    assert told == json.loads((run / "evaluation.json").read_text())
    names_of_rules = ("cutoff_m", "order", "window_s", "gap_s", "first_time", "last_time")
    assert [told[name] for name in names_of_rules] == [400.0, 1.0, 2.0, 3.0, 0.0, 4.0]
    (entry,) = told["runs"]
    assert (entry["run"], entry["duplicate_ids"], entry["false_ids"]) == ("run", [6], [])
    assert entry["gospa_m"] == {"total": 200.0, "localisation": 0.0, "missed": 0.0, "false": 200.0}
    assert entry["over_time"]["ospa2_m"]["cardinality"] == [200.0] * 5


def test_several_runs_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = write(tmp_path / "first" / "tracks.jsonl", *straight()).parent
    second = write(tmp_path / "second.jsonl", *straight(3), *straight(status="tentative")[3:])
    known = write(tmp_path / "truth.jsonl", *points(), *points(target=2, position=[9e8, 0.0]))
    command("evaluate", first, second, "--truth", known, "--json")
    told = json.loads(capsys.readouterr().out)
    assert [entry["run"] for entry in told["runs"]] == ["first", "second"]
    assert [entry["held_share"] for entry in told["runs"]] == [0.5, 0.3]
    assert json.loads((first / "comparison.json").read_text()) == told
    command("evaluate", first, second, "--truth", known, "--figure", tmp_path / "both.png")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines if "held share" in line] == [["held", "share", "50.0%", "30.0%"]]
    assert (tmp_path / "both.png").stat().st_size > 0
    assert (tmp_path / "both.json").stat().st_size > 0


def test_a_run_without_a_track_and_a_world_without_a_target(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nothing, lines = write(tmp_path / "nothing.jsonl"), write(tmp_path / "lines.jsonl", *straight())
    known = write(tmp_path / "truth.jsonl", *points())
    command("evaluate", nothing, "--truth", known)
    assert "targets confirmed 0 of 1 after [s], mean - held share 0.0%" in said(capsys)
    command("evaluate", lines, "--truth", nothing)
    assert "targets confirmed 0 of 0 after [s], mean - held share -" in said(capsys)


def recorded(folder: Path, plot: str, seed: int = 1) -> Path:
    """A run folder as ``waldnet run`` writes it, and the truth in it."""
    loaded = load_scenario(find(plot))
    scans, record = simulate_all(loaded, seed), Record(loaded)
    folder.mkdir()
    for message in Replay(loaded, scans).run():
        record.note(message)
    write_report(record, folder, {"seed": seed}, Source(find(plot).read_bytes(), scans))
    with (folder / "truth.jsonl").open("w") as file:
        write_truth(file, *truth(loaded, seed), loaded)
    return folder


def test_a_run_stands_beside_the_centralised_run_of_its_plots(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = recorded(tmp_path / "run", "mixed-sensors", seed=7)
    words = ("evaluate", run, "--truth", run / "truth.jsonl")
    command(*words)
    shown = capsys.readouterr().out
    assert shown.splitlines()[1].split() == ["run", "run", "(centralised)"]
    assert "targets of run (centralised)" in shown
    command(*words, "--json")
    told = json.loads(capsys.readouterr().out)
    assert told == json.loads((run / "evaluation.json").read_text())
    network, one = told["runs"]
    assert [(each["run"], each["centralised_of"]) for each in (network, one)] == [
        ("run", []),
        ("run (centralised)", ["run"]),
    ]
    assert told["without_centralised"] == []
    assert 0.0 < one["rmse_m"] < network["rmse_m"]
    # The same as of the lines that a centralised replay prints.
    command("replay", run / "input/scenario.toml", run / "input/plots.jsonl", "--centralised", "--json")
    lines = write(tmp_path / "lines.jsonl", capsys.readouterr().out)
    command("evaluate", run, lines, "--truth", run / "truth.jsonl", "--json", "--no-centralised")
    again = json.loads(capsys.readouterr().out)["runs"]
    assert [each["run"] for each in again] == ["run", "lines"]
    assert again[0] == network
    assert again[1] == {**one, "run": "lines", "centralised_of": []}


def test_lines_stand_beside_the_centralised_run_of_a_scenario(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = recorded(tmp_path / "run", "four-radars", seed=5)
    for name in ("one", "two"):
        write(tmp_path / f"{name}.jsonl", (run / "tracks.jsonl").read_text())
    words = ["evaluate", tmp_path / "one.jsonl", run, tmp_path / "two.jsonl", "--truth", run / "truth.jsonl"]
    command(*words)
    said = " ".join(capsys.readouterr().out.split())
    assert "two: no centralised run beside it, for it keeps no plots; --scenario says where they come from" in said
    command(*words, "--json")
    told = json.loads(capsys.readouterr().out)
    assert told["without_centralised"] == ["one", "two"]
    assert [each["run"] for each in told["runs"]] == ["one", "run", "run (centralised)", "two"]
    command(*words, "--json", "--scenario", "four-radars", "--plots", run / "input/plots.jsonl")
    told = json.loads(capsys.readouterr().out)
    assert told["without_centralised"] == []
    *_, own, two, common = told["runs"]
    assert (two["run"], common["run"]) == ("two", "one, two (centralised)")
    assert common == {**own, "run": "one, two (centralised)", "centralised_of": ["one", "two"]}
    # Without plots, as in replay: the scenario's own, here another world.
    command(*words[:2], *words[4:], "--json", "--scenario", "four-radars")
    *_, other = json.loads(capsys.readouterr().out)["runs"]
    assert other["run"] == "one (centralised)"
    assert other["rmse_m"] != own["rmse_m"]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--scenario", "nowhere"), "nowhere: no such file, and none of the scenarios that come along: "),
        (("--plots", "p.jsonl"), "--plots: says nothing without the scenario they are of: give --scenario too\n"),
        (
            ("--scenario", "four-radars", "--plots", "none.jsonl"),
            "none.jsonl: cannot be read: No such file or directory",
        ),
        (
            ("--scenario", "four-radars", "--no-centralised"),
            "--scenario: only the centralised run needs it, which --no-centralised leaves out\n",
        ),
        (("--scenario", "PLANE"), "scenario plane: has 2 dimensions, the truth has 3\n"),
    ],
)
def test_what_is_wrong_with_the_plots_of_lines_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], reason: str
) -> None:
    high = {"position": [0.0, 0.0, 0.0]} if "PLANE" in options else {}
    text = find("four-radars").read_text().replace('name = "four-radars"', 'name = "plane"')
    plane = write(tmp_path / "plane.toml", text)
    run = write(tmp_path / "lines.jsonl", *straight(**({"x": [0.0] * 6} if high else {})))
    known = write(tmp_path / "truth.jsonl", *points(**high))
    words = [str(plane) if option == "PLANE" else option for option in options]
    with pytest.raises(SystemExit) as caught:
        main(app, ["evaluate", str(run), "--truth", str(known), *words])
    assert caught.value.code == 1
    assert capsys.readouterr().err.startswith(reason)


def test_a_scenario_for_runs_that_keep_theirs_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = recorded(tmp_path / "run", "four-radars")
    words = ("evaluate", run, "--truth", run / "truth.jsonl", "--scenario", "four-radars")
    with pytest.raises(SystemExit):
        main(app, [*map(str, words)])
    assert capsys.readouterr().err == "--scenario: every run here keeps its own scenario and plots; leave it out\n"


def test_plots_that_nobody_worked_in_are_not_kept(tmp_path: Path) -> None:
    """A run that was stopped, and of which a sensor had died before."""
    loaded = load_scenario(find("four-radars"))
    scans = simulate_all(loaded, 1)
    first, *_, last = loaded.sensor_names
    stop_ns = scans[-1].time_ns // 2 + scans[0].time_ns // 2
    source = Source(find("four-radars").read_bytes(), scans)
    run, nothing = tmp_path / "run", tmp_path / "nothing"
    for folder in (run, nothing):
        folder.mkdir()
    written = RunFolder(run, loaded, source)
    for scan in scans[1:]:  # the first one was shed by a link
        if scan.time_ns <= stop_ns - (10**10 if scan.sensor == last else 0):
            written.note(scan)
    written.lost[last] = "killed"
    pictures = only(Tracks, Replay(loaded, [scan for scan in scans if scan.time_ns <= stop_ns]).run())
    for picture in pictures:
        written.note(picture)
    assert not written.finish({}).failures
    found = kept(run)
    assert found is not None
    shown = {name: [scan.time_ns for scan in found.scans if scan.sensor == name] for name in (first, last)}
    assert max(shown[first]) == pictures[-1].time_ns <= stop_ns
    assert stop_ns - 12 * 10**9 < max(shown[last]) <= stop_ns - 10**10
    assert len(shown[first]) == len([scan for scan in scans if scan.sensor == first and scan.time_ns <= stop_ns])
    # Of a run in which nothing was worked in nothing is kept; and it can be judged.
    RunFolder(nothing, loaded, source).finish({})
    none = kept(nothing)
    assert none is not None
    assert none.scans == []
    assert centralised(none, ("none",), 2).span_s is None


@pytest.mark.parametrize(
    ("lines", "known", "reason"),
    [
        (straight(), points(time=99.0)[:1], "the truth tells of 99 s to 99 s, the runs of 0 s to 4 s"),
        ([], [], "the truth tells of no time at all, the runs of no time at all"),
    ],
)
def test_nothing_in_common_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], lines: list[Any], known: list[Any], reason: str
) -> None:
    run, told = write(tmp_path / "lines.jsonl", *lines), write(tmp_path / "truth.jsonl", *known)
    with pytest.raises(SystemExit) as caught:
        main(app, ["evaluate", str(run), "--truth", str(told)])
    assert caught.value.code == 1
    wanted = f"nothing to judge: {reason}; both must be in seconds since the same epoch\n"
    assert capsys.readouterr().err == wanted


def test_the_truth_of_a_simulated_world(tmp_path: Path) -> None:
    command("simulate", "four-radars", "--seed", 3, "--out", tmp_path / "p", "--truth", tmp_path / "t")

    loaded = load_scenario(find("four-radars"))
    world = truth(loaded, 3)
    (found,) = read_truth(tmp_path / "t").values()
    assert found.times_s.tolist() == [loaded.to_seconds(int(time_ns)) for time_ns in world.times_ns]
    np.testing.assert_array_equal(found.positions, world.x[0, :, :2])
    assert len((tmp_path / "p").read_text().splitlines()) == 4 * len(found.times_s)


def test_a_target_is_not_in_the_truth_before_it_starts(tmp_path: Path) -> None:
    late = scenario(target=[{"hypothesis": 0, "start": 7.0}, {"hypothesis": 0}])
    file = io.StringIO()
    write_truth(file, *truth(late, 1), late)
    known = read_truth(write(tmp_path / "truth.jsonl", file.getvalue()))
    assert (known[0].times_s[0], known[1].times_s[0]) == (8.0, 2.0)
