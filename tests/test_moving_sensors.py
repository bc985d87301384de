"""Sensors that move and turn, from the recording to the decision.

A network does not care where north is, nor how fast it moves through the world as a whole: turned, and carried along
with a velocity, the same plots must give the same evidence, to rounding. Sigma points lie along the axes, so that where
the network is turned, all sensors take the EKF.
"""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import all_same, live_as_replayed, same, scenario, sensor_table

from waldnet.common.config import Scenario
from waldnet.common.errors import PlotsError, PlotsWarning
from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import NEVER, Decision, Scan, Start, Tracks
from waldnet.offline.centralised import Centralised
from waldnet.offline.replay import Replay
from waldnet.scenarios.plots import read_plots, write_plots
from waldnet.scenarios.world import simulate_all
from waldnet.sensor_node.tracker import LocalTracker
from waldnet.studies import baselines
from waldnet.studies.worlds import draw

#: Carried along with [m/s], turned by [rad].
VELOCITY, HEADING = np.array([9.0, -22.0]), 2.0
AT_REST = np.zeros(2)

SENSORS: tuple[dict[str, Any], ...] = (
    {
        "kind": "polar-doppler",
        "sigma": [15.0, 0.01, 1.0],
        "field_of_view": {"shape": "sector", "radius": 4000.0, "direction": 0.9, "width": 2.6},
    },
    {
        "kind": "polar-doppler",
        "sigma": [15.0, 0.01, 1.0],
        "position": [1000.0, -500.0],
        "update": "sigma-point",
        "field_of_view": {"shape": "box", "size": [5000.0, 4000.0]},
    },
    {
        "kind": "bearing",
        "sigma": [0.01],
        "field_of_view": {"shape": "sector", "radius": 5e3, "direction": 0, "width": 3},
    },
    {
        "kind": "polar",
        "sigma": [15.0, 0.01],
        "field_of_view": {"shape": "disc", "radius": 5000.0},
        "scan_interval": 3.0,
    },
)


def network(*, ekf: bool = False, **tables: Any) -> Scenario:
    """Four kinds of sensors, a target, and a hypothesis without one; all of the EKF, or with sigma points too."""
    common = {"position": [0.0, -1000.0], "p_d": 0.8, "false_plots": 3.0}
    update = {"update": "ekf"} if ekf else {}
    sensors = [sensor_table(f"s{i}", **common | changes | update) for i, changes in enumerate(SENSORS)]
    hypotheses = [
        {"state": [800.0, 400.0, 12.0, 5.0], "sigma": [60.0, 60.0, 8.0, 8.0]},
        {"state": [300.0, 1500.0, 0.0, 0.0], "sigma": [60.0, 60.0, 8.0, 8.0]},
    ]
    fixed = {"motion": {"psd": 0.5}, "decision": {"enabled": False}, "hypothesis": hypotheses}
    return scenario(*sensors, **fixed | tables)


def turn(heading: float) -> Array:
    """Rotation of (east, north) clockwise."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, s], [-s, c]])


def carried(plot: Scenario, scans: list[Scan], velocity: Array, heading: float) -> tuple[Scenario, list[Scan]]:
    """The same network and plots, on a platform that moves and is turned."""
    rotation = turn(heading)
    hypotheses = []
    for hypothesis in plot.hypotheses:
        x = np.array(hypothesis.state)
        state = (*(rotation @ x[:2]), *(rotation @ x[2:] + velocity))
        hypotheses.append(hypothesis.model_copy(update={"state": state}))
    moved = []
    for scan in scans:
        z = scan.z.copy()
        azimuth = plot.sensor(scan.sensor).numbers.index("azimuth")
        z[:, azimuth] = np.remainder(z[:, azimuth] + heading, 2.0 * np.pi)
        position = rotation @ scan.position + velocity * plot.to_seconds(scan.time_ns)
        moved.append(scan._replace(position=position, z=z, velocity=velocity, heading=heading))
    return plot.model_copy(update={"hypotheses": tuple(hypotheses)}), moved


def evidence(messages: Any) -> Array:
    """Log LR in total of all tracks over time; tracks that begin are NaN before."""
    pictures = [message for message in messages if isinstance(message, Tracks)]
    totals = np.full((len(pictures), max(int(picture.ids.max(initial=0)) for picture in pictures) + 1), np.nan)
    for row, picture in zip(totals, pictures, strict=True):
        row[picture.ids] = picture.log_lr_total
    return totals


MODES: dict[str, dict[str, Any]] = {
    "federated": {},
    "factor": {"association": "factor"},
    "advice": {"feedback": "advice"},
    "reset": {"feedback": "reset"},
    "reset late": {"feedback": "reset", "feedback_delay": 3.0},
    "mirrored": {"association": "mirrored", "filter": "mht"},
    "selected": {"mode": "selected"},
    "naive": {"mode": "naive"},
}
CARRIED = pytest.mark.parametrize(
    ("velocity", "heading"),
    [(VELOCITY, 0.0), (AT_REST, HEADING), (VELOCITY, HEADING)],
    ids=["moving", "turned", "both"],
)


@CARRIED
@pytest.mark.parametrize("fusion", MODES.values(), ids=MODES.keys())
def test_evidence_does_not_depend_on_how_the_network_moves_and_is_turned(
    fusion: dict[str, Any], velocity: Array, heading: float
) -> None:
    plot = network(fusion=fusion, ekf=bool(heading))
    scans = simulate_all(plot, 3)
    before = evidence(Replay(plot, scans).run())
    after = evidence(Replay(*carried(plot, scans, velocity, heading)).run())
    assert before[-1, 0] > 10.0 > 0.0 > before[-1, 1]
    np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-6)


@CARRIED
def test_nor_does_that_of_one_tracker_for_all_plots(velocity: Array, heading: float) -> None:
    plot = network(ekf=bool(heading))
    scans = simulate_all(plot, 3)
    before = evidence(Centralised.of(plot).run(scans))
    moved, there = carried(plot, scans, velocity, heading)
    np.testing.assert_allclose(evidence(Centralised.of(moved).run(there)), before, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("fusion", [{}, {"mode": "selected"}, {"feedback": "advice"}], ids=str)
def test_neither_does_what_starts_from_plots(fusion: dict[str, Any]) -> None:
    """Turned only: what a target's velocity may be is known around 0, over ground."""
    starts = {"initiation": {"speed": 15.0}, "hypothesis": [], "target": [{"state": [800.0, 400.0, 12.0, 5.0]}]}
    plot = network(fusion=fusion, decision={"p1": 0.9999}, ekf=True, **starts)
    scans = simulate_all(plot, 3)
    before = evidence(Replay(plot, scans).run())
    after = evidence(Replay(*carried(plot, scans, AT_REST, HEADING)).run())
    assert before.shape[1] > 3
    assert np.nanmax(before[-1]) > 10.0
    np.testing.assert_allclose(after, before, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("fusion", [{}, {"mode": "selected"}, {"feedback": "reset"}], ids=str)
def test_live_is_as_replayed(fusion: dict[str, Any], precision: str) -> None:
    """Poses cross the bus: in mode selected for the tracks, with [initiation] for those that start."""
    plot = network(fusion=fusion | {"precision": precision}, decision={"p1": 0.9999}, initiation={"speed": 30.0})
    moved, scans = carried(plot, simulate_all(plot, 3), VELOCITY, HEADING)
    live = live_as_replayed(moved, [scan for scan in scans if plot.to_seconds(scan.time_ns) <= 8.0])
    assert {tuple(scan.velocity) for scan in live.scans} == {tuple(VELOCITY)}


def test_modes_agree_for_moving_sensors_as_they_do_for_one_that_stands() -> None:
    """One Doppler sensor: a network is one tracker, whatever it sends."""
    common = {"position": [0.0, -1000.0], "p_d": 0.8, "false_plots": 3.0}
    sensors = [sensor_table("s0", **common | SENSORS[0])]
    for fusion in ({}, {"mode": "selected"}):
        plot = network(sensor=sensors, fusion=fusion)
        moved, scans = carried(plot, simulate_all(plot, 3), VELOCITY, HEADING)
        alone = evidence(Centralised.of(moved).run(scans))
        np.testing.assert_allclose(evidence(Replay(moved, scans).run()), alone, rtol=1e-6, atol=1e-6)


def test_what_a_scenario_says_of_all_scans_is_for_studies_too() -> None:
    """The baseline of studies beside the tracker for all plots, a simulated sensor with a velocity and a heading."""
    changes = SENSORS[0] | {"velocity": VELOCITY.tolist(), "heading": HEADING, "p_d": 0.8, "false_plots": 3.0}
    view = {"shape": "sector", "radius": 4000.0, "direction": 0.9 - HEADING, "width": 2.6}
    changes |= {"field_of_view": view, "position": [0.0, -1000.0]}
    plot = network(sensor=[sensor_table("s0", **changes)])
    plot = plot.model_copy(update={"hypotheses": plot.hypotheses[:1]})
    scans = simulate_all(plot, 2)
    assert {tuple(scan.velocity) for scan in scans} == {tuple(VELOCITY)}
    assert {scan.heading for scan in scans} == {HEADING}
    course = baselines.centralised(plot, draw(plot, [2]))
    np.testing.assert_allclose(course.log_lr[0], evidence(Centralised.of(plot).run(scans))[:, 0], rtol=1e-9)
    assert course.log_lr[0, -1] > 10.0


# A car passes a parked lorry ------------------------------------------------------------------------------------------

BUMPER = sensor_table(
    "bumper",
    kind="polar-doppler",
    sigma=[0.3, 0.01, 0.1],
    max_speed=60.0,
    position=None,
    field_of_view={"shape": "disc", "radius": 250.0},
)
LORRY = {"state": [6.0, 199.0, 0.0, 0.0], "sigma": [3.0, 3.0, 3.0, 3.0]}


def passing(**tables: Any) -> Scenario:
    fixed = {"motion": {"psd": 0.5}, "decision": {"p1": 0.9999}, "hypothesis": [LORRY], "target": []}
    return scenario(BUMPER, **{"simulation": None} | fixed | tables)


def lines(relative: bool, velocity: bool) -> str:
    """A car drives north with 20 m/s, the lorry is parked at (5, 200)."""
    rng = np.random.default_rng(16)
    rows = []
    for k in range(1, 41):
        own = np.array([0.0, 2.0 * k])
        offset = np.array([5.0, 200.0]) - own
        r, noise = np.hypot(*offset), rng.normal(size=3) * BUMPER["sigma"]
        rate = -20.0 * offset[1] / r if relative else 0.0
        z = np.array([r, np.arctan2(*offset), rate]) + noise
        row = {"sensor": "bumper", "time": 0.1 * k, "position": own.tolist(), "plots": [z.tolist()]}
        if rng.random() > 0.9:
            row["plots"] = []
        rows.append(json.dumps(row | {"velocity": [0.0, 20.0]} if velocity else row) + "\n")
    return "".join(rows)


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "plots.jsonl"
    path.write_text(text)
    return path


@pytest.mark.parametrize("fusion", [{}, {"mode": "selected"}, {"feedback": "reset"}], ids=str)
@pytest.mark.parametrize("update", ["ekf", "sigma-point"])
def test_a_parked_lorry_is_as_sure_as_with_range_rates_over_ground(
    tmp_path: Path, fusion: dict[str, Any], update: str
) -> None:
    """A relative range rate tells a little of the azimuth too, by -0.00016 here and there: 20 m/s and 0.01 rad."""
    plot = passing(fusion=fusion, sensor=[BUMPER | {"update": update}])
    over_ground = passing(fusion=fusion, sensor=[BUMPER | {"update": update, "velocity": [0.0, 0.0]}])
    told = read_plots(written(tmp_path, lines(relative=True, velocity=True)), plot)
    compensated = read_plots(written(tmp_path, lines(relative=False, velocity=False)), over_ground)
    moving, standing = (evidence(Replay(plot, scans).run())[-1, 0] for scans in (told, compensated))
    assert standing > 300.0
    assert moving == pytest.approx(standing, abs=0.1)


@pytest.mark.parametrize("fusion", [{}, {"mode": "selected"}], ids=str)
def test_it_starts_a_track_that_stands_still(tmp_path: Path, fusion: dict[str, Any]) -> None:
    plot = passing(fusion=fusion, hypothesis=[], initiation={"speed": 10.0})
    scans = read_plots(written(tmp_path, lines(relative=True, velocity=True)), plot)
    messages = list(Replay(plot, scans).run())
    (confirmed,) = [message for message in messages if isinstance(message, Decision) and message.kind == "confirmed"]
    assert confirmed.time_ns <= plot.to_ns(1.0)
    last = [message for message in messages if isinstance(message, Tracks)][-1]
    x = last.x[last.ids == confirmed.track][0]
    assert x[:2] == pytest.approx([5.0, 200.0], abs=2.0)
    assert np.linalg.norm(x[2:]) < 1.5


# Recordings -----------------------------------------------------------------------------------------------------------

LINE = {"sensor": "bumper", "time": 1.0, "position": [0.0, 0.0], "plots": [[100.0, 0.5, -3.0]]}
LATER = {**LINE, "time": 2.0, "position": [3.0, 4.0]}
UNTOLD = (
    ":2: bumper measures range rates and moves (median speed 5 m/s), but no velocity is told: its range rates are "
    "taken as over ground. If they are relative to the sensor, each line needs its velocity; else velocity = [0, 0] in "
    "[[sensor]] says so"
)
UNLIKE = "velocity is missing: bumper measures range rates, and"


def read(tmp_path: Path, *rows: dict[str, Any], **changes: Any) -> list[Scan]:
    text = "".join(json.dumps(row) + "\n" for row in rows)
    return read_plots(written(tmp_path, text), passing(sensor=[BUMPER | changes]))


def test_a_moving_doppler_sensor_without_a_velocity_is_warned_of(tmp_path: Path) -> None:
    with pytest.warns(PlotsWarning) as caught:
        read(tmp_path, LINE, LATER)
    assert [str(warning.message) for warning in caught] == [f"{tmp_path / 'plots.jsonl'}{UNTOLD}"]


@pytest.mark.parametrize(
    ("later", "changes"),
    [
        ({**LATER, "position": [0.0, 0.0]}, {}),
        (LATER, {"velocity": [0.0, 0.0]}),
        (LATER, {"kind": "polar", "sigma": [0.3, 0.01], "max_speed": None}),
    ],
    ids=["at rest", "over ground", "no range rates"],
)
def test_others_are_not(tmp_path: Path, later: dict[str, Any], changes: dict[str, Any]) -> None:
    plots = [plot[: 2 if "kind" in changes else 3] for plot in LINE["plots"]]  # type: ignore[attr-defined]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        table = {key: value for key, value in (BUMPER | changes).items() if value is not None}
        text = "".join(json.dumps({**row, "plots": plots}) + "\n" for row in (LINE, later))
        assert len(read_plots(written(tmp_path, text), passing(sensor=[table]))) == 2


def test_the_command_line_says_it_once_and_goes_on(tmp_path: Path) -> None:
    rows = "".join(json.dumps(row) + "\n" for row in (LINE, LATER))
    table = tmp_path / "bumper.toml"
    table.write_text(
        """
        name = "bumper"
        motion = { psd = 0.5 }
        [[sensor]]
        name = "bumper"
        kind = "polar-doppler"
        sigma = [0.3, 0.01, 0.1]
        p_d = 0.9
        false_plots = 2.0
        field_of_view = { shape = "disc", radius = 250.0 }
        [initiation]
        speed = 10.0
        """
    )
    plots, start = written(tmp_path, rows), [sys.executable, "-c", "from waldnet.launch.cli import main; main()"]
    done = subprocess.run([*start, "replay", table, plots], capture_output=True, text=True, check=True)
    assert done.stderr == f"warning: {plots}{UNTOLD}\n"
    for strict, code in (([], 0), (["--strict"], 1)):
        done = subprocess.run([*start, "check", table, plots, *strict], capture_output=True, text=True, check=False)
        assert done.returncode == code
        assert f"warning: {plots}{UNTOLD}" in done.stdout.replace("\n  ", " ")
        assert not done.stderr


def test_a_process_of_a_network_says_warnings_in_its_log() -> None:
    script = "from common.logs import configure; configure('json'); import warnings; warnings.warn('that')"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert json.loads(done.stderr) | {"timestamp": ""} == {
        "kind": "UserWarning",
        "event": "that",
        "level": "warning",
        "timestamp": "",
    }


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        (
            [{**LINE, "velocity": [0.0, 1.0]}, LATER],
            f"2: {UNLIKE} line 1 has one",
        ),
        (
            [LINE, {**LATER, "velocity": [0.0, 1.0]}],
            f"1: {UNLIKE} line 2 has one",
        ),
        ([{**LINE, "velocity": [0.0]}], "1: velocity: [0.0] is not a list of 2 finite numbers"),
        ([{**LINE, "velocity": 3.0}], "1: velocity: 3.0 is not a list of 2 finite numbers"),
        ([{**LINE, "heading": 90}], "1: heading: 90 is no angle in radians (-2 pi to 2 pi)"),
        ([{**LINE, "heading": "north"}], "1: heading: 'north' is no angle in radians (-2 pi to 2 pi)"),
        ([{**LINE, "heading": [0.0]}], "1: heading: [0.0] is no angle in radians (-2 pi to 2 pi)"),
        ([{**LINE, "heading": True}], "1: heading: True is no angle in radians (-2 pi to 2 pi)"),
        ([{**LINE, "heading": float("nan")}], "1: heading: nan is no angle in radians (-2 pi to 2 pi)"),
    ],
)
def test_poses_that_cannot_be_are_refused(tmp_path: Path, rows: list[dict[str, Any]], fault: str) -> None:
    with pytest.raises(PlotsError) as caught:
        read(tmp_path, *rows)
    assert str(caught.value) == f"{tmp_path / 'plots.jsonl'}:{fault}"


def test_azimuths_may_count_from_the_heading(tmp_path: Path) -> None:
    (scan,) = read(tmp_path, {**LINE, "heading": 6.0, "velocity": [0.0, 1.0]}, azimuth="heading")
    assert scan.z[0] == pytest.approx([100.0, 6.5 - 2.0 * np.pi, -3.0])
    (scan,) = read(tmp_path, {**LINE, "velocity": [0.0, 1.0]}, azimuth="heading", heading=-1.0)
    assert scan.z[0, 1] == pytest.approx(2.0 * np.pi - 0.5)
    assert scan.heading == -1.0
    with pytest.raises(PlotsError, match=r"plots\.jsonl:1: heading is missing: azimuths of bumper count from it"):
        read(tmp_path, LINE, azimuth="heading")


@pytest.mark.parametrize(
    "changes",
    [{}, {"heading": 0.5}, {"azimuth": "heading"}, {"velocity": [1.0, 2.0], "heading": 0.25, "azimuth": "heading"}],
    ids=str,
)
def test_scans_come_back_from_their_lines(tmp_path: Path, changes: dict[str, Any]) -> None:
    plot = passing(sensor=[BUMPER | changes])
    z = np.array([[100.0, 0.5, -3.0], [20.0, 6.0, 1.0]])
    own = plot.sensors[0].pose(2)
    scans = [
        Scan("bumper", plot.to_ns(1.0), np.zeros(2), z, np.array([3.0, 4.0]), heading=0.0),
        Scan("bumper", plot.to_ns(2.0), np.array([3.0, 4.0]), z, np.array([3.0, 4.0]), heading=-0.75),
        Scan("bumper", plot.to_ns(3.0), np.array([6.0, 8.0]), z[:0], np.zeros(2), heading=own.heading),
    ]
    path = tmp_path / "again.jsonl"
    with path.open("w") as file:
        write_plots(file, scans, plot)
    back = read_plots(path, plot)
    for one, other in zip(back, scans, strict=True):
        np.testing.assert_allclose(one.z, other.z, atol=1e-14)
        assert all_same([one._replace(z=other.z)], [other])


@pytest.mark.parametrize("mode", ["federated", "selected"])
def test_the_center_is_told_how_a_sensor_moves_where_it_needs_it(mode: str) -> None:
    """Given tracks are reported as densities: there the pose says nothing, and the bytes are as before."""
    for tables, told in (({}, mode == "selected"), ({"initiation": {"speed": 30.0}}, True)):
        moved, (scan, *_) = carried(*_simulated(network(fusion={"mode": mode}, **tables)), VELOCITY, HEADING)
        tracker = LocalTracker.of(moved, scan.sensor)
        _, report = tracker.scan(tracker.initial(), scan, NEVER)
        assert report.velocity.tolist() == (VELOCITY.tolist() if told else [])
        assert report.heading == (HEADING if told else 0.0)


def _simulated(plot: Scenario) -> tuple[Scenario, list[Scan]]:
    return plot, [scan for scan in simulate_all(plot, 3) if scan.sensor == "s0"]


@pytest.mark.parametrize("wrong", ["position", "velocity", "heading"])
def test_what_was_prepared_for_another_pose_is_not_used(wrong: str) -> None:
    plot = network()
    moved, (scan, *_) = carried(*_simulated(plot), VELOCITY, HEADING)
    tracker, scan = LocalTracker.of(moved, scan.sensor), scan._replace(time_ns=plot.to_ns(1.0))
    x, P = (np.stack(parts) for parts in zip(*(each.density for each in moved.hypotheses), strict=True))
    ids, zero = np.arange(2), np.zeros(2)
    start = Start("s0", 1, ids, np.full(2, plot.to_ns(0.0)), zero, x, P, x, P)
    state = tracker.start(tracker.initial(), start)
    pose = scan.pose._replace(**{wrong: 1.5 * getattr(scan.pose, wrong)})
    _, report = tracker.scan(tracker.prepare(state, scan.time_ns, pose), scan, NEVER)
    assert same(report, tracker.scan(state, scan, NEVER)[1])
    assert not same(report, tracker.scan(state, scan._replace(**{wrong: getattr(pose, wrong)}), NEVER)[1])
