"""One bound for files, nodes and center: what lies beyond it is refused or left out alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import Node, Stage, all_same, same, scenario, sensor_table
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from waldnet.common.config import load_scenario
from waldnet.common.errors import PlotsError
from waldnet.common.limits import MAX_ESTIMATE, MAX_VALUE
from waldnet.common.messages import Begin, Picked, Report, Scan
from waldnet.fusion_center.initiation import Initiation
from waldnet.launch.cli import app
from waldnet.launch.left_out import left_out
from waldnet.offline.replay import Replay
from waldnet.scenarios.plots import read_plots
from waldnet.scenarios.world import simulate_all

Array = NDArray[np.float64]
DISC = {"shape": "disc", "radius": 1000.0}
KINDS = {
    "position": sensor_table("position"),
    "polar": sensor_table("polar", kind="polar", sigma=[10.0, 0.01]),
    "polar-doppler": sensor_table("polar-doppler", kind="polar-doppler", sigma=[10.0, 0.01, 1.0], field_of_view=DISC),
}
STARTING = {"initiation": {"speed": 100.0}, "hypothesis": [], "target": []}
ALL_KINDS = scenario(*KINDS.values(), **STARTING)
#: Of every order, around the bounds, and what stands for "not available".
NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([0.0, -1.0, 1.5, 3.1, 6.28, 7.0, 91.0, 181.0, -9999.0, 2147483647.0, 3.4e38, 1e300]),
    st.sampled_from([sign * MAX_VALUE * (1.0 + more) for sign in (-1.0, 1.0) for more in (-1e-9, 0.0, 1e-9)]),
)


@settings(deadline=None, derandomize=True, database=None, max_examples=200)
@given(st.sampled_from(sorted(KINDS)), st.lists(NUMBERS, min_size=3, max_size=3))
def test_reader_node_and_center_take_the_same_plots(
    tmp_path_factory: pytest.TempPathFactory, kind: str, numbers: list[float]
) -> None:
    plot = np.array([numbers[: len(KINDS[kind]["sigma"])]])
    path = tmp_path_factory.mktemp("plots") / "plots.jsonl"
    path.write_text(json.dumps({"sensor": kind, "time": 2.0, "plots": plot.tolist()}))
    try:
        read_plots(path, ALL_KINDS)
        read = True
    except PlotsError as error:
        assert f"{path}:1: plots.0" in str(error)
        read = False
    node = Node(ALL_KINDS, kind)
    assert len(node.scan(Scan(kind, ALL_KINDS.to_ns(2.0), np.zeros(2), plot)).unclaimed) == read
    assert node.state.unusable == (not read)
    starts = Initiation.of(ALL_KINDS)
    assert starts is not None
    report = Stage(ALL_KINDS).report(kind, 2.0, position=np.zeros(2), unclaimed=plot)
    assert len(starts.usable(report, ALL_KINDS.sensor_names.index(kind)).unclaimed) == read


def bad_plots() -> list[list[float]]:
    return [[2147483647.0, 2147483647.0], [np.inf, 0.0], [np.nan, np.nan], [0.0, -3.4e38]]


@pytest.mark.parametrize("bad", bad_plots(), ids=str)
@pytest.mark.parametrize("mode", ["federated", "naive", "selected"])
def test_a_node_is_as_if_a_bad_plot_of_its_source_were_not_there(mode: str, bad: list[float]) -> None:
    plot = scenario(sensor_table("a"), fusion={"mode": mode})
    scans = simulate_all(plot, 1)
    with_bad = [scan._replace(z=np.insert(scan.z, 0, bad, axis=0)) for scan in scans]
    replay, spoiled = Replay(plot, scans), Replay(plot, with_bad)
    assert all_same(list(spoiled.run()), list(replay.run()))
    assert not replay.left_out
    assert list(spoiled.left_out.values()) == [len(scans)]


def starting_stage(**fusion: Any) -> Stage:
    stage = Stage(scenario(sensor_table("a"), fusion=fusion, **STARTING))
    stage.join("a", 2.0)
    return stage


NO_IDS = np.empty(0, np.int64)


def picked(stage: Stage, time_s: float, z: Array, **changes: Any) -> Picked:
    """A report of plots that all matter to track 0, if there is one."""
    report = stage.report("a", time_s)
    plots = np.array([len(z)] if len(z) else [], np.int64)
    ids, which = np.arange(len(plots)), np.arange(len(z))
    return Picked(*report[:5], np.array([3000.0, 0.0]), ids, plots, which, z, np.empty((0, 2)))._replace(**changes)


@pytest.mark.parametrize("mode", ["federated", "selected"])
def test_the_center_starts_tracks_from_the_other_unclaimed_plots(mode: str) -> None:
    stage = starting_stage(mode=mode)
    z = np.array([[2147483647.0, 1.0], [100.0, 200.0], [1.0, -3.4e38], [-4000.0, 50.0]])
    none = {"position": np.array([3000.0, 0.0]), "unclaimed": z}
    tracks = {"ids": NO_IDS, "terms": NO_IDS, "log_g": np.empty(0), "x": np.empty((0, 4)), "P": np.empty((0, 4, 4))}
    report: Report | Picked = (
        stage.report("a", 2.0, **tracks, **none)
        if mode == "federated"
        else picked(stage, 2.0, np.empty((0, 2)), **none)
    )
    (begin,) = (message for message in stage.tell(report) if isinstance(message, Begin))
    assert begin.x[:, :2].tolist() == [[100.0, 200.0], [-4000.0, 50.0]]
    assert stage.state.counts._replace(unusable_plots=0) == type(stage.state.counts)()
    assert stage.state.counts.unusable_plots == 2


def three_tracks(count: int = 3) -> Stage:
    stage = Stage(scenario(sensor_table("a"), hypothesis=[hypothesis_at(1000.0 * i) for i in range(count)]))
    stage.join("a", 2.0)
    return stage


def hypothesis_at(east: float) -> dict[str, Any]:
    return {"state": [east, 0.0, 0.0, 0.0], "sigma": [100.0, 100.0, 20.0, 20.0]}


BAD_FACTORS = {
    "indefinite": {"P": np.diag([1.0, 1.0, 1.0, -1.0])},
    "singular": {"P": np.ones((4, 4))},
    "correlation too large": {"P": np.eye(4) + 2.0 * np.eye(4)[::-1]},
    "zero": {"P": np.zeros((4, 4))},
    "tiny": {"P": 1e-300 * np.eye(4)},
    "huge": {"P": 1e300 * np.eye(4)},
    "far": {"x": np.full(4, 10.0 * MAX_ESTIMATE)},
}


@pytest.mark.parametrize("bad", BAD_FACTORS.values(), ids=BAD_FACTORS.keys())
@pytest.mark.parametrize("count", [3, 12])  # few and many covariances are taken apart in different ways
def test_a_track_that_cannot_be_computed_with_is_left_out_alone(bad: dict[str, Array], count: int) -> None:
    stage, without = three_tracks(count), three_tracks(count)
    x = np.array([[1000.0 * i, 0.0, 0.0, 0.0] for i in range(count)])
    fields = {
        "terms": np.ones(count, np.int64),
        "log_g": np.full(count, 2.0),
        "P": np.tile(1e3 * np.eye(4), (count, 1, 1)),
    }
    report = stage.report("a", 2.0, ids=np.arange(count), x=x, **fields)
    good = np.arange(count) != 1
    rest = report._replace(**{name: getattr(report, name)[good] for name in ("ids", "x", *fields)})
    for name, value in bad.items():
        getattr(report, name)[1] = value
    assert stage.tell(report)
    without.tell(rest)
    assert same(stage.tracks, without.tracks)
    assert stage.state.counts == without.state.counts._replace(unusable_tracks=1)
    assert stage.tracks.scans.tolist() == [int(one) for one in good]


def test_of_a_track_with_several_terms_one_bad_term_is_enough() -> None:
    stage = Stage(
        scenario(
            sensor_table("a"),
            fusion={"association": "mirrored", "terms": 2},
            hypothesis=[hypothesis_at(0.0), hypothesis_at(1000.0)],
        )
    )
    stage.join("a", 2.0)
    fields = {"ids": np.array([0, 1]), "terms": np.array([2, 1]), "log_g": np.full(3, 2.0), "x": np.zeros((3, 4))}
    P = np.tile(1e3 * np.eye(4), (3, 1, 1))
    P[1, 0, 0] = -1.0
    stage.tell(stage.report("a", 2.0, P=P, **fields))
    assert stage.state.counts.unusable_tracks == 1
    assert stage.tracks.scans.tolist() == [0, 1]


def test_a_bad_plot_among_those_that_matter_is_left_out_alone() -> None:
    plot = scenario(sensor_table("a"), fusion={"mode": "selected"})
    stage, without = Stage(plot), Stage(plot)
    for one in (stage, without):
        one.join("a", 2.0)
    stage.tell(picked(stage, 2.0, np.array([[10.0, 5.0], [2147483647.0, 0.0], [-30.0, 20.0]])))
    without.tell(picked(without, 2.0, np.array([[10.0, 5.0], [-30.0, 20.0]])))
    assert same(stage.tracks, without.tracks)
    assert stage.state.counts == without.state.counts._replace(unusable_plots=1)


def test_a_run_says_what_its_logs_say_was_left_out(tmp_path: Path) -> None:
    center = {
        "event": "ended",
        "refused": {"b": {"wrong dimensions": 3, "older epoch": 1}, "a": {"not joined": 2}},
        "dropped": {"unusable tracks": 4, "late report": 5},
    }
    (tmp_path / "center.log").write_text('{"event": "waiting"}\n' + json.dumps(center) + "\nnot JSON\n")
    (tmp_path / "a.log").write_text(json.dumps({"event": "ended", "dropped": {"unusable plots": 12}}) + "\n")
    (tmp_path / "b.log").write_text('{"event": "tracks started"}\n[]\n"ended"\n{"event": "end')
    assert list(left_out(tmp_path)) == [
        "a: left out 12 unusable plots",
        "center: refused 2 of a: not joined",
        "center: refused 1 of b: older epoch",
        "center: refused 3 of b: wrong dimensions",
        "center: left out 4 unusable tracks",
    ]
    assert list(left_out(tmp_path / "none")) == []


def test_replay_says_what_was_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "edge.toml"
    # Of a target at the edge of all bounds, noise takes some plots beyond them.
    path.write_text(
        """
        name = "edge"
        motion = { psd = 0.0 }
        simulation = { duration = 20.0 }
        target = [{ state = [1e9, 0.0, 0.0, 0.0] }]
        hypothesis = [{ state = [1e9, 0.0, 0.0, 0.0], sigma = [10.0, 10.0, 1.0, 1.0] }]
        [[sensor]]
        name = "a"
        sigma = [10.0, 10.0]
        p_d = 1.0
        false_plots = 1e-6
        field_of_view = { shape = "box", size = [1000.0, 1000.0], center = [1e9, 0.0] }
        """
    )
    scans = simulate_all(load_scenario(path), 1)
    beyond = sum(int((scan.z > MAX_VALUE).any(axis=-1).sum()) for scan in scans)
    assert 0 < beyond < 20
    with pytest.raises(SystemExit) as ended:
        app(["replay", str(path)])
    said = capsys.readouterr()
    assert ended.value.code in (None, 0)
    assert "track 0" in said.out
    assert said.err == f"edge: {beyond} plots left out: numbers that no sensor can mean\n"
