"""``import waldnet``: the door for people with a notebook."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import hypothesis_table, scenario, sensor_table

import waldnet
from waldnet.common.config import Scenario
from waldnet.common.errors import ConfigError, EvaluationError, PlotsError, TruthError

ROOT = Path(__file__).parent.parent
NAMES = {
    "ConfigError",
    "Decision",
    "EvaluationError",
    "Picture",
    "PlotsError",
    "Scan",
    "Scenario",
    "Track",
    "TruthError",
    "WaldnetError",
    "columns",
    "estimation",
    "evaluate",
    "load_scenario",
    "read_plots",
    "replay",
    "scenario_names",
    "simulate",
    "simulate_truth",
}


def test_the_door_in_its_own_lines() -> None:
    scenario = waldnet.load_scenario("four-radars")
    scans = waldnet.simulate(scenario, seed=1)
    pictures = list(waldnet.replay(scenario, scans))
    for picture in pictures:
        for track in picture.tracks:
            assert track.id in range(5)
            assert track.status in ("confirmed", "deleted")
            assert (track.x.shape, track.P.shape) == ((4,), (4, 4))
    assert [decision.kind for decision in pictures[0].decisions] == ["confirmed", *4 * ["deleted"]]
    assert pictures[0].time == 2.0
    assert pictures[0].tracks[0].log_lr_total == pytest.approx(33.33, abs=0.01)
    table = waldnet.columns(pictures)
    assert len(table["time"]) == 30 * 5
    summary = waldnet.evaluate(pictures, waldnet.simulate_truth(scenario, seed=1))
    assert (summary["confirmed_targets"], summary["false_tracks"]) == (1, 0)
    centralised = list(waldnet.replay(scenario, scans, centralised=True))
    assert [picture.time for picture in centralised] == [picture.time for picture in pictures]


def test_the_python_of_the_readme(capsys: pytest.CaptureFixture[str]) -> None:
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    exec(block, {})
    *lines, summary = capsys.readouterr().out.splitlines()
    assert len(lines) == 30 * 5
    assert "'confirmed_targets': 1" in summary


def test_the_names_are_these() -> None:
    assert set(waldnet.__all__) == NAMES
    assert set(dir(waldnet)) >= NAMES
    for name in NAMES:
        assert getattr(waldnet, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        waldnet.nothing  # type: ignore[attr-defined]  # noqa: B018


def test_the_import_loads_nothing_heavy() -> None:
    """Nor does the use of what needs no figures, wires or command line."""
    heavy = "[m for m in ('cyclopts', 'matplotlib', 'rich', 'zenoh', 'numpy', 'scipy') if m in sys.modules]"
    use = "waldnet.load_scenario('four-radars'); waldnet.replay; waldnet.evaluate"
    code = f"import sys, waldnet; print({heavy}); {use}; print({heavy})"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.splitlines() == ["[]", "['numpy', 'scipy']"]


# ---- scenarios


def test_a_scenario_may_be_a_name_a_path_or_a_dict(tmp_path: Path) -> None:
    file = ROOT / "scenarios/four-radars.toml"
    by_name = waldnet.load_scenario("four-radars")
    assert waldnet.load_scenario(file) == waldnet.load_scenario(str(file)) == by_name
    tables = {
        "name": "own",
        "motion": {"psd": np.float64(10.0)},
        "sensor": (sensor_table("a", position=np.array([3000.0, 0.0])),),
        "simulation": {"duration": 20},
        "hypothesis": [hypothesis_table()],
        "recording": {"plots": "plots.jsonl"},
    }
    own = waldnet.load_scenario(tables)
    assert (own.network.name, own.sensor_names) == ("own", ("a",))
    assert own.recording is not None
    assert own.recording.plots == Path("plots.jsonl")
    assert "network" not in tables


def test_all_faults_of_a_dict_are_named() -> None:
    tables = {"name": "own", "motion": {"psd": -1.0}, "sensor": [sensor_table(sigma=[1.0])], "nonsense": 1}
    with pytest.raises(ConfigError) as raised:
        waldnet.load_scenario(tables)
    said = str(raised.value).splitlines()
    assert all(line.startswith("own: ") for line in said)
    assert {line.split(": ")[1] for line in said} == {"motion.psd", "sensor.0.sigma", "nonsense"}
    with pytest.raises(ConfigError, match="got int, expected a name, a path or a dict"):
        waldnet.load_scenario(3)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="nowhere: no such file"):
        waldnet.load_scenario("nowhere")


# ---- scans

PLOT = scenario(sensor_table("a"), sensor_table("b"))


def test_plots_of_a_scan_may_be_lists_or_arrays() -> None:
    for plots in ([[1, 2], [3, 4]], ((1.0, 2.0), (3.0, 4.0)), np.array([[1, 2], [3, 4]])):
        scan = waldnet.Scan("a", time=2, plots=plots, position=(1, 2))
        assert scan.plots.dtype == np.float64
        np.testing.assert_array_equal(scan.plots, [[1.0, 2.0], [3.0, 4.0]])
        assert (scan.time, scan.heading, scan.velocity) == (2.0, None, None)
    for none in ([], np.empty((0, 2))):
        (picture,) = waldnet.replay(PLOT, [waldnet.Scan("a", 2.0, none)])
        assert picture.tracks[0].sensors == ("a",)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"plots": [1.0, 2.0]}, r"scan of a at 2.0 s: plots: got shape \(2,\), expected \(M, m\)"),
        ({"plots": [[1.0, 2.0], [1.0]]}, r"plots: got \[\[1.0, 2.0\], \[1.0\]\], expected a list of plots"),
        ({"plots": [["x", 2.0]]}, "expected a list of plots"),
        ({"plots": [[1.0, 2.0, 3.0]]}, r"scan of a at 2.0 s: plots.0: \[1.0, 2.0, 3.0\] is not a list of 2 finite"),
        ({"plots": [[np.nan, 2.0]]}, "plots.0: .* is not a list of 2 finite numbers"),
        ({"plots": [[1e12, 2.0]]}, "plots.0: .*coordinate in metres"),
        ({"time": "noon"}, "time: got 'noon', expected a finite number"),
        ({"time": 1e18}, "are these milliseconds, or nanoseconds"),
        ({"position": [[1.0, 2.0]]}, r"position: got shape \(1, 2\), expected \(d,\)"),
        ({"position": [1.0]}, r"position: \[1.0\] is not a list of 2 finite numbers"),
        ({"heading": 90.0}, r"heading: 90.0 is no angle in radians"),
        ({"sensor": "c"}, "sensor: 'c' is not one of a, b"),
    ],
)
def test_what_is_wrong_with_a_scan_is_said(values: dict[str, Any], said: str) -> None:
    with pytest.raises(PlotsError, match=said):
        list(waldnet.replay(PLOT, [waldnet.Scan(**{"sensor": "a", "time": 2.0, "plots": [], **values})]))


def scans_at(*times: tuple[str, float]) -> list[waldnet.Scan]:
    return [waldnet.Scan(name, time, []) for name, time in times]


@pytest.mark.parametrize("centralised", [False, True])
@pytest.mark.parametrize(
    ("times", "pictures", "said"),
    [
        ([("a", 2.0), ("b", 1.0)], 1, r"scan of b at 1.0 s comes after one at 2.0 s, expected are scans by time"),
        ([("a", 2.0), ("a", 2.0)], 1, r"scan of a at 2.0 s is its second at that time"),
        ([("a", 2.0), ("b", 2.0), ("a", 2.0)], 1, r"scan of a at 2.0 s is its second at that time"),
        ([("a", 2.0), ("b", 3.0), ("a", 2.0)], 2, r"scan of a at 2.0 s comes after one at 3.0 s"),
    ],
)
def test_scans_out_of_order_are_refused_after_the_pictures_before(
    times: list[tuple[str, float]], pictures: int, said: str, *, centralised: bool
) -> None:
    seen = []
    with pytest.raises(PlotsError, match=said):
        seen.extend(waldnet.replay(PLOT, scans_at(*times), centralised=centralised))
    replay = waldnet.replay(PLOT, scans_at(*times), centralised=centralised)
    assert len(list(islice(replay, pictures))) == pictures
    with pytest.raises(PlotsError, match=r"got str, expected waldnet\.Scan"):
        list(waldnet.replay(PLOT, ["a"], centralised=centralised))  # type: ignore[list-item]


def test_scans_of_sensors_that_the_scenario_ignores_are_left_out() -> None:
    plot = waldnet.load_scenario(
        {
            "name": "own",
            "motion": {"psd": 1.0},
            "sensor": [sensor_table("a")],
            "recording": {"plots": "x", "ignore": ["b"]},
        }
    )
    pictures = list(waldnet.replay(plot, scans_at(("a", 1.0), ("b", 2.0), ("a", 3.0))))
    assert [picture.time for picture in pictures] == [1.0, 3.0]


def test_scans_that_come_too_soon_are_left_out_as_by_the_command() -> None:
    plot = scenario(sensor_table("a", spacing=1.5), sensor_table("b"))
    times = [("a", 1.0), ("b", 2.0), ("a", 2.4), ("a", 2.5), ("a", 3.9)]
    assert [picture.time for picture in waldnet.replay(plot, scans_at(*times))] == [1.0, 2.0, 2.5]
    with pytest.raises(PlotsError, match=r"scan of a at 2\.0 s comes after one at 3\.0 s"):
        list(waldnet.replay(plot, scans_at(("a", 3.0), ("a", 2.0))))


# ---- pictures


def line_of(picture: waldnet.Picture, track: waldnet.Track) -> dict[str, Any]:
    """What ``waldnet replay --json`` says of a track."""
    largest = np.finfo(np.float64).max
    return {
        "time": picture.time,
        "track": track.id,
        "status": track.status,
        "log_lr": float(np.clip(track.log_lr, -largest, largest)),
        "log_lr_total": float(np.clip(track.log_lr_total, -largest, largest)),
        "x": track.x.tolist(),
        "P": track.P.tolist(),
        "supported": track.supported,
    }


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    from waldnet.launch.cli import app

    app(words, result_action="return_value")
    return capsys.readouterr().out


@pytest.mark.parametrize("centralised", [False, True])
@pytest.mark.parametrize("name", ["four-radars", "crossing", "mixed-sensors", "autoferry-2"])
def test_pictures_are_those_of_the_command_line_for_line(
    name: str, capsys: pytest.CaptureFixture[str], *, centralised: bool
) -> None:
    plot = waldnet.load_scenario(name)
    scans = waldnet.simulate(plot) if plot.recording is None else waldnet.read_plots(plot.recording.plots, plot)
    pictures = waldnet.replay(plot, iter(scans), centralised=centralised)
    ours = [line_of(picture, track) for picture in pictures for track in picture.tracks]
    said = printed(capsys, "replay", name, "--json", *(["--centralised"] if centralised else []))
    theirs = [json.loads(line) for line in said.splitlines()]
    assert len(ours) == len(theirs) > 0
    assert ours == theirs


@pytest.mark.parametrize(
    ("mode", "feedback"),
    [
        ("federated", "none"),
        ("federated", "advice"),
        ("federated", "reset"),
        ("naive", "none"),
        ("dkf", "none"),
        ("selected", "none"),
    ],
)
def test_modes_need_to_know_nothing_of_later_scans(mode: str, feedback: str) -> None:
    """Pictures of the first scans are the same whatever comes later, in any mode, sensors in step or not."""
    plot = scenario(sensor_table("a"), sensor_table("b", first_scan=0.7), fusion={"mode": mode, "feedback": feedback})
    scans = waldnet.simulate(plot, seed=3)
    every = list(waldnet.replay(plot, scans))
    first = list(waldnet.replay(plot, scans[:7]))
    assert len(first) == 7
    for one, other in zip(first, every, strict=False):
        assert [line_of(one, track) for track in one.tracks] == [line_of(other, track) for track in other.tracks]
        assert one.decisions == other.decisions


def endless(plot: Scenario, taken: list[float]) -> Iterator[waldnet.Scan]:
    """The scans of a simulation again and again, without end; notes which were asked for."""
    scans, again = waldnet.simulate(plot), 0
    while True:
        for scan in scans:
            time = 20.0 * again + scan.time
            taken.append(time)
            yield waldnet.Scan(scan.sensor, time, scan.plots, scan.position)
        again += 1


@pytest.mark.parametrize("centralised", [False, True])
def test_scans_may_have_no_end(*, centralised: bool) -> None:
    """A picture is there as soon as all sensors have scanned, or with the first later scan."""
    for first, ahead in ((2.0, 0.0), (0.7, 1.0)):
        plot = scenario(sensor_table("a"), sensor_table("b", first_scan=first), decision={"enabled": False})
        taken: list[float] = []
        replay = waldnet.replay(plot, endless(plot, taken), centralised=centralised)
        for picture in islice(replay, 40):
            assert picture.time <= taken[-1] <= picture.time + 1.4 * ahead


def test_the_memory_of_an_endless_replay_is_bounded() -> None:
    """What the driver keeps of the past, in the mode that needs the scan times of all sensors."""
    from waldnet.offline import replay as driver

    plot = scenario(decision={"enabled": False}, fusion={"mode": "dkf"})
    network = driver.Replay(plot, (message for scan in endless(plot, []) if (message := scan._message(plot))))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "_SCHEDULED", 10)
        lengths = [len(network._times_ns) for _ in islice(network.run(), 60)]
    assert max(lengths[30:]) <= max(lengths[:30]) < 25


def test_what_is_decided_stands_in_the_picture_of_its_time() -> None:
    plot = waldnet.load_scenario("autoferry-2-all")
    assert plot.recording is not None
    pictures = list(waldnet.replay(plot, islice(waldnet.read_plots(plot.recording.plots, plot), 250)))
    decisions = [(picture.time, decision) for picture in pictures for decision in picture.decisions]
    assert {"confirmed", "deleted"} <= {decision.kind for _, decision in decisions}
    assert all(time == decision.time for time, decision in decisions)
    assert all(decision.into is None for _, decision in decisions if decision.kind != "merged")


def test_a_track_tells_when_a_plot_was_its_own() -> None:
    """Confirmed, and no plot any more from 10 s on: it coasts, and the last plot stays that of then."""
    plot = scenario(life={})
    scans = [
        waldnet.Scan(scan.sensor, scan.time, scan.plots if scan.time < 10.0 else []) for scan in waldnet.simulate(plot)
    ]
    *_, last = waldnet.replay(plot, scans)
    (track,) = last.tracks
    assert (track.status, track.supported, last.time) == ("coasting", 8.0, 20.0)


# ---- columns


def test_columns_have_a_row_for_every_track_at_every_time() -> None:
    plot = scenario()
    pictures = list(waldnet.replay(plot, waldnet.simulate(plot)))
    table = waldnet.columns(iter(pictures))
    assert {column.shape for column in table.values()} == {(sum(len(picture.tracks) for picture in pictures),)}
    state = ["east", "north", "v_east", "v_north"]
    base = ["time", "track", "status", "log_lr", "log_lr_total", "scans", "supported"]
    assert list(table) == [*base, *state, *(f"sd_{name}" for name in state)]
    last = pictures[-1].tracks[-1]
    assert [table[name][-1] for name in state] == last.x.tolist()
    np.testing.assert_array_equal([table[f"sd_{name}"][-1] for name in state], np.sqrt(last.P.diagonal()))
    assert (table["time"][-1], table["status"][-1]) == (pictures[-1].time, last.status)
    assert {len(column) for column in waldnet.columns([]).values()} == {0}


def test_columns_are_taken_by_pyarrow() -> None:
    pyarrow = pytest.importorskip("pyarrow")
    plot = scenario()
    table = pyarrow.table(waldnet.columns(waldnet.replay(plot, waldnet.simulate(plot))))
    assert table.column("status").to_pylist()[0] in ("tentative", "confirmed")


def test_the_numbers_of_a_state_have_names() -> None:
    plot = waldnet.load_scenario(
        {
            "name": "own",
            "motion": {"psd": 1.0, "model": "ca"},
            "sensor": [sensor_table("a")],
            "hypothesis": [{"state": 6 * [0.0], "sigma": 6 * [1.0]}],
        }
    )
    (picture,) = waldnet.replay(plot, scans_at(("a", 1.0)))
    assert picture.state == ("east", "north", "v_east", "v_north", "a_east", "a_north")


# ---- evaluation


def test_the_evaluation_is_that_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plot = waldnet.load_scenario("crossing")
    truth, lines = tmp_path / "truth.jsonl", tmp_path / "lines.jsonl"
    printed(capsys, "simulate", "crossing", "--out", str(tmp_path / "plots.jsonl"), "--truth", str(truth))
    lines.write_text(printed(capsys, "replay", "crossing", str(tmp_path / "plots.jsonl"), "--json"))
    options = ["--truth", str(truth), "--cutoff", "50", "--window", "5", "--no-centralised", "--json"]
    (run,) = json.loads(printed(capsys, "evaluate", str(lines), *options))["runs"]
    pictures = list(waldnet.replay(plot, waldnet.read_plots(tmp_path / "plots.jsonl", plot)))
    summary = waldnet.evaluate(pictures, truth, cutoff=50.0, window=5.0)
    assert summary == {key: run[key] for key in summary}
    columns = waldnet.simulate_truth(plot)
    mixed = np.random.default_rng(1).permutation(len(columns["time"]))
    shuffled = {name: column[mixed].tolist() for name, column in columns.items()}
    assert waldnet.evaluate(pictures, shuffled, cutoff=50.0, window=5.0) == summary


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"time": None}, "column 'time' is missing"),
        ({"time": [1.0]}, r"have shapes \(2,\), \(1,\) and \(2, 2\), expected"),
        ({"position": [[1.0], [2.0]]}, r"position: has shape \(2, 1\), expected \(K, 2\) or \(K, 3\)"),
        ({"position": [[1.0, np.nan], [2.0, 3.0]]}, "position: row 0 is not finite"),
        ({"position": "here"}, "position: is no array of numbers"),
        ({"time": [1.0, 1.0]}, "target 1 has two positions at 1.0 s"),
    ],
)
def test_what_is_wrong_with_the_truth_is_said(changes: dict[str, Any], said: str) -> None:
    truth = {"target": [1, 1], "time": [2.0, 1.0], "position": [[0.0, 0.0], [1.0, 1.0]], **changes}
    with pytest.raises(TruthError, match=said):
        waldnet.evaluate([], {name: column for name, column in truth.items() if column is not None})


def test_what_cannot_be_evaluated_is_said() -> None:
    plot = scenario()
    pictures = list(waldnet.replay(plot, waldnet.simulate(plot)))
    with pytest.raises(EvaluationError, match=r"cutoff: got -1\.0, expected a number above 0"):
        waldnet.evaluate(pictures, {}, cutoff=-1.0)
    truth = {"target": [1], "time": [2.0], "position": [[0.0, 0.0, 0.0]]}
    with pytest.raises(EvaluationError, match="truth: has 3 coordinates, the tracks have 2"):
        waldnet.evaluate(pictures, truth)
    with pytest.raises(EvaluationError, match="in seconds since the same epoch"):
        waldnet.evaluate(pictures, {"target": [1], "time": [1e6], "position": [[0.0, 0.0]]})
