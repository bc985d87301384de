"""Recordings and scenarios that are allowed and wrong: each kind of mistake is found, nothing right is blamed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import hypothesis_table, scenario, sensor_table

from waldnet.common.config import Scenario, load_scenario
from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import Scan
from waldnet.launch.checks import describe, recording_table, warn
from waldnet.scenarios.catalogue import find, names
from waldnet.scenarios.plots import read_plots
from waldnet.scenarios.recording_check import recording_findings, summarise
from waldnet.scenarios.scenario_check import Finding, scenario_findings
from waldnet.scenarios.world import simulate_all
from waldnet.sensor_node.sources import spaced

RECORDED = sorted(name for name in names() if load_scenario(find(name)).recording)
SIMULATED = ["crossing", "four-radars", "heavy-clutter", "mixed-sensors", "no-target", "parallel", "rarely-seen"]


def loaded(name: str) -> tuple[Scenario, list[Scan]]:
    plot = load_scenario(find(name))
    return plot, read_plots(plot.recording.plots, plot) if plot.recording else simulate_all(plot, 1)


def texts(plot: Scenario, scans: Sequence[Scan], *, spoiling: bool = True) -> list[str]:
    found = recording_findings(plot, spaced(scans, plot))
    return [str(finding) for finding in found if finding.spoils or not spoiling]


def test_what_is_wrong_with_a_recording_that_comes_along() -> None:
    """The ship's radar turned 255 times, and 238 scans are in its file; none is empty (its README)."""
    (text,) = texts(*loaded("joyride"))
    assert "about 17 scans of 2.5 s are missing" in text


@pytest.mark.parametrize("name", [*(name for name in RECORDED if name != "joyride"), *SIMULATED])
def test_nothing_spoils_the_recordings_that_come_along(name: str) -> None:
    plot, scans = loaded(name)
    assert texts(plot, scans) == []
    assert scenario_findings(plot, scans if plot.recording else ()) == []


KINDS = {
    "position": {},
    "polar": {"kind": "polar", "sigma": [20.0, 0.01]},
    "polar-doppler": {"kind": "polar-doppler", "sigma": [20.0, 0.01, 2.0]},
    "bearing": {"kind": "bearing", "sigma": [0.01]},
}


def world(kind: str, **changes: Any) -> Scenario:
    """Two sensors at some distance, which see a sector each."""
    view = {"shape": "sector", "radius": 9000.0, "inner": 200.0, "direction": 0.3, "width": 1.2}
    table = {**KINDS[kind], "field_of_view": view, **changes}
    places = [-6000.0, -2500.0], [-6500.0, -2000.0]
    sensors = [sensor_table(name, position=at, **table) for name, at in zip("ab", places, strict=True)]
    return scenario(
        *sensors,
        simulation={"duration": 60.0},
        hypothesis=[hypothesis_table(-4000.0, 0.0, state=[-4000.0, 0.0, 10.0, -5.0], sigma=[80.0, 80.0, 5.0, 5.0])],
    )


@pytest.mark.parametrize("kind", KINDS)
def test_right_worlds_give_nothing(kind: str) -> None:
    """Over many worlds: dense and thin false plots, rare and sure detections, with and without a target."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        changes = {"p_d": float(rng.uniform(0.3, 1.0)), "false_plots": float(10.0 ** rng.uniform(-2.0, 1.3))}
        plot = world(kind, **changes)
        if seed % 2:
            plot = plot.model_copy(update={"targets": ()})
        assert texts(plot, simulate_all(plot, seed), spoiling=False) == [], changes
        assert scenario_findings(plot) == []


@pytest.mark.parametrize("model", [{"psd": 1.0}, {"model": "ca", "psd": 0.1}], ids=["cv", "ca"])
@pytest.mark.parametrize("kind", KINDS)
def test_right_worlds_in_three_dimensions(kind: str, model: dict[str, Any]) -> None:
    sigma = {"position": [20.0] * 3, "bearing": [0.01] * 2}.get(kind, [20.0, 0.01, 0.01, 2.0][: 3 + kind.count("-")])
    view = {"shape": "sector", "radius": 9000.0, "direction": 0.5, "width": 2.0, "elevation": [0.0, 1.0]}
    rest = 3 * ("model" in model)
    plot = scenario(
        *[
            sensor_table(name, kind=kind, position=[at, -1000.0, 0.0], sigma=sigma, field_of_view=view)
            for name, at in (("a", -4000.0), ("b", -3500.0))
        ],
        motion={"dimensions": 3, **model},
        hypothesis=[
            {
                "state": [-2000.0, 2500.0, 1500.0, 10.0, 5.0, 0.0] + [0.0] * rest,
                "sigma": [80.0] * 3 + [5.0] * 3 + [0.1] * rest,
            }
        ],
        simulation={"duration": 60.0},
    )
    assert texts(plot, simulate_all(plot, 1), spoiling=False) == []
    assert scenario_findings(plot) == []


def with_plots(change: Callable[[Array], Array], *sensors: str) -> Callable[[Scenario, list[Scan]], list[Scan]]:
    def made(_: Scenario, scans: list[Scan]) -> list[Scan]:
        own = set(sensors) or {scan.sensor for scan in scans}
        return [scan._replace(z=change(scan.z)) if scan.sensor in own else scan for scan in scans]

    return made


def with_times(change: Callable[[float], float]) -> Callable[[Scenario, list[Scan]], list[Scan]]:
    return lambda plot, scans: [
        scan._replace(time_ns=plot.to_ns(change(plot.to_seconds(scan.time_ns)))) for scan in scans
    ]


def repeated(_: Scenario, scans: list[Scan]) -> list[Scan]:
    again = [scan._replace(time_ns=scan.time_ns + k * 100_000_000) for scan in scans for k in range(4)]
    return sorted(again, key=lambda scan: scan.time_ns)


def without_empty(_: Scenario, scans: list[Scan]) -> list[Scan]:
    return [scan for scan in scans if len(scan.z)]


SWAPPED = with_plots(lambda z: z[:, ::-1].copy())
CLOCKWISE = with_plots(lambda z: np.column_stack([z[:, :-1], 0.5 * np.pi - z[:, -1]]))
MISTAKES: list[tuple[str, Any, str]] = [
    ("autoferry-5", with_times(lambda t: t + 1.6e9), "If these are Unix times, write epoch = 1970-01-01T00:00:00Z"),
    ("autoferry-5-all", with_times(lambda t: t + 1.6e9), "If these are Unix times"),
    ("autoferry-5", with_times(lambda t: 1e3 * t), "Are these milliseconds? Times are in seconds."),
    ("solent-short", with_times(lambda t: 1e3 * t), "Are these milliseconds?"),
    ("four-radars", with_plots(lambda z: 1e-3 * z), "Are these kilometres? Lengths are in metres."),
    ("autoferry-5", with_plots(lambda z: 1e-3 * z), "Read as kilometres"),
    ("polar", with_plots(lambda z: z * [1e-3, 1.0]), "kilometres"),
    ("autoferry-5", SWAPPED, "Read as north before east they would lie inside."),
    ("four-radars", SWAPPED, "if its plots are read as north before east"),
    ("autoferry-5-all", with_plots(lambda z: z[:, ::-1].copy(), "radar"), "plots lie near plots of other sensors, but"),
    ("polar", CLOCKWISE, "Read as azimuths counted counterclockwise from east they would lie inside."),
    ("bearing", CLOCKWISE, "Read as azimuths counted counterclockwise from east"),
    ("position", with_plots(lambda z: z + np.array([6000.0, 2500.0])), "% of the plots lie outside the field of view"),
    ("autoferry-5", without_empty, 'write these scans with "plots": []'),
    ("thin", without_empty, 'write these scans with "plots": []'),
    ("thinner", without_empty, 'write these scans with "plots": []'),
    ("autoferry-5", repeated, "repeat the plots of the scan before to the last digit, under a new time"),
    ("thin", repeated, "repeat the plots of the scan before to the last digit, under a new time"),
    ("position", lambda _, scans: [scan for scan in scans if scan.sensor != "a"], "has no scan in the recording"),
    ("position", with_times(lambda t: t - 100.0), "is never tested"),
    ("position", with_times(lambda t: t + 600.0), "starts 602 s before the first scan"),
    (
        "position",
        lambda _, scans: [scan._replace(time_ns=scan.time_ns + (scan.sensor == "b") * 10**12) for scan in scans],
        "have no time in common with those of any other sensor",
    ),
    (
        "position",
        lambda _, scans: [scans[k - k % 2]._replace(sensor=scan.sensor) for k, scan in enumerate(scans)],
        "are those of a to the last digit",
    ),
    (
        "position",
        with_plots(lambda z: np.repeat(z, 9, axis=0) + 1e-3 * np.arange(9 * len(z))[:, None]),
        "false_plots too",
    ),
]


def of_mistake(name: str) -> tuple[Scenario, list[Scan]]:
    if name == "solent-short":
        plot = load_scenario(find("solent"))
        assert plot.simulation is not None
        short = plot.simulation.model_copy(update={"duration": 60.0})
        return plot, simulate_all(plot.model_copy(update={"simulation": short}), 1)
    if name.startswith("thin"):
        plot = world("position", p_d=0.4, false_plots=0.3 if name == "thin" else 0.02)
        return plot, simulate_all(plot, 1)
    if name in KINDS:
        plot = world(name)
        return plot, simulate_all(plot, 1)
    return loaded(name)


@pytest.mark.parametrize(("name", "spoil", "said"), MISTAKES, ids=[f"{n}: {said[:40]}" for n, _, said in MISTAKES])
def test_a_mistake_is_found(name: str, spoil: Any, said: str) -> None:
    plot, scans = of_mistake(name)
    assert not any(said in text for text in texts(plot, scans))
    found = texts(plot, spoil(plot, scans))
    assert any(said in text for text in found), found


@pytest.mark.parametrize("kind", ["polar", "bearing", "position"])
def test_a_field_of_view_that_turns_with_its_platform(kind: str) -> None:
    """A vessel that turns around: plots in its view are right; azimuths from its bow, read as from north, are found."""
    plot = world(kind)
    config, motion = plot.sensor("a"), plot.motion.build()
    rng, scans = np.random.default_rng(5), []
    for k in range(60):
        pose = config.pose(2, heading=0.1 * k)
        sensor = config.build(motion).at(pose)
        places = sensor.field_of_view.draw(rng, 3, pose.position)
        z = sensor.measurement.draw_false(rng, places, pose.position)
        scans.append(Scan("a", plot.to_ns(2.0 * k + 2.0), pose.position, z, pose.velocity, pose.heading))
    outside = "of the plots lie outside the field of view"
    assert not any(outside in text for text in texts(plot, scans, spoiling=False))
    assert any(outside in text for text in texts(plot, [scan._replace(heading=0.0) for scan in scans]))
    if kind != "position":
        back = np.array([0.0, 1.0] if kind == "polar" else [1.0])
        found = texts(plot, [scan._replace(z=scan.z - scan.heading * back) for scan in scans])
        assert any("Read as azimuths counted from the heading of the platform" in text for text in found), found


def test_the_spacing_that_is_advised_ends_the_warning() -> None:
    plot, scans = of_mistake("position")
    again = repeated(plot, scans)
    (text,) = {text.split(". Leave")[1] for text in texts(plot, again)}
    spacing = float(text.split("set spacing = ")[1].rstrip("."))
    assert spacing <= 2.0
    sensors = tuple(sensor.model_copy(update={"spacing": spacing}) for sensor in plot.sensors)
    mended = plot.model_copy(update={"sensors": sensors})
    assert texts(mended, again) == []
    assert len(spaced(again, mended)) == len(scans)


def test_an_interval_unlike_the_scenario_s_is_a_note_only_if_the_file_says_one() -> None:
    plot, scans = of_mistake("position")
    longer = with_times(lambda t: 2.0 * t)(plot, scans)
    assert "median time between scans is 4 s, but scan_interval = 2" in texts(plot, longer, spoiling=False)[0]
    tables = [{k: v for k, v in sensor_table(n).items() if k != "scan_interval"} for n in "ab"]
    unsaid = scenario(*tables)
    assert texts(unsaid, longer, spoiling=False) == []


def test_a_summary_counts() -> None:
    plot = scenario(sensor_table("a"), sensor_table("b"))
    z = np.array([[0.0, 0.0], [3e4, 0.0]])
    scans = [
        Scan("a", plot.to_ns(t), np.zeros(2), plots)
        for t, plots in ((1.0, z), (2.0, z), (4.0, z[:0]), (5.0, z[:1]), (6.0, z[:1]))
    ]
    a, b = summarise(plot, scans)
    assert a == ("a", 5, 6, 1.0, 6.0, 1.0, 1.2, 0.2, pytest.approx(1 / 3), 0.5)
    assert b[:3] == ("b", 0, 0)
    lines = list(recording_table(plot, scans))
    assert [" ".join(line.split()) for line in lines] == [
        "sensor scans from s to s interval s plots/scan empty outside view repeated",
        "a 5 1 6 1 (2) 1.2 (2 + 0.9 per target) 20.0% 33.3% 50.0%",
        "b 0 - - - - - - -",
    ]


def test_a_scan_or_two_are_no_recording_to_judge() -> None:
    plot, scans = of_mistake("position")
    assert texts(plot, scans[:2], spoiling=False) == []
    assert texts(plot, [scan._replace(z=scan.z[:0]) for scan in scans[:2]], spoiling=False) == []


# Scenario files -------------------------------------------------------------------------------------------------------

VIEW = {"shape": "disc", "radius": 5000.0}
DUBIOUS: list[tuple[dict[str, Any], str]] = [
    (
        {"sensor": [sensor_table(kind="polar", sigma=[20.0, 2.0])]},
        "sensor a: sigma.1: an azimuth known to 2 rad (115 degrees) says next to nothing. Angles are in radians; if "
        "degrees were meant, write 0.03491.",
    ),
    ({"sensor": [sensor_table(kind="bearing", sigma=[1.0], field_of_view=VIEW)]}, "known to 1 rad"),
    ({"sensor": [sensor_table(false_plots=5e4)]}, "no test can decide"),
    ({"sensor": [sensor_table(sigma=[9000.0, 9000.0])]}, "no test can decide"),
    ({"sensor": [sensor_table(kind="polar", sigma=[3000.0, 0.4], false_plots=20.0)]}, "no test can decide"),
    (
        {"sensor": [sensor_table(kind="bearing", sigma=[0.01], field_of_view=VIEW, false_plots=500.0)]},
        "no test can decide",
    ),
    ({"sensor": [sensor_table(p_d=0.0)]}, "never detects anything"),
    ({"hypothesis": [hypothesis_table(), hypothesis_table()]}, "hypothesis.1: is nearly the same as hypothesis.0"),
    ({"hypothesis": [hypothesis_table(), hypothesis_table(300.0, start=2.0)]}, "hypothesis.1: is nearly the same"),
    ({"hypothesis": [hypothesis_table(), hypothesis_table(1e6)]}, "hypothesis.1: lies outside all fields of view"),
    (
        {"sensor": [sensor_table(field_of_view=VIEW), sensor_table("b", position=[0.0, 9e4], field_of_view=VIEW)]},
        "sensor b: field_of_view: contains none of the hypotheses at any time",
    ),
]


@pytest.mark.parametrize(("tables", "said"), DUBIOUS, ids=[said[:50] for _, said in DUBIOUS])
def test_a_dubious_scenario_is_warned_of(tables: dict[str, Any], said: str) -> None:
    sensors = tables.get("sensor", [])
    plot = scenario(*sensors, **{key: table for key, table in tables.items() if key != "sensor"})
    assert any(said in str(finding) for finding in scenario_findings(plot)), scenario_findings(plot)


def test_hypotheses_that_will_pass_a_field_of_view_are_not_warned_of() -> None:
    """150 m/s for 20 s: 3000 m."""
    view = {"shape": "disc", "radius": 1000.0}
    plot = scenario(sensor_table(position=[3000.0, 0.0], field_of_view=view))
    assert scenario_findings(plot) == []


# What is said ---------------------------------------------------------------------------------------------------------


def test_the_worst_is_said_in_a_few_lines(capsys: pytest.CaptureFixture[str]) -> None:
    plot, scans = loaded("autoferry-5")
    warn(plot, scans, Path("plots.jsonl"))
    assert capsys.readouterr().err == ""
    warn(plot, SWAPPED(plot, with_times(lambda t: t + 1.6e9)(plot, scans)), Path("plots.jsonl"))
    said = capsys.readouterr().err
    assert said.count("warning: ") == 3
    assert said.endswith("more: see waldnet check\n")
    assert max(map(len, said.splitlines())) <= 120


def test_the_scans_of_a_simulated_world_are_not_checked(capsys: pytest.CaptureFixture[str]) -> None:
    plot, scans = loaded("four-radars")
    warn(plot, SWAPPED(plot, scans), None)
    assert capsys.readouterr().err == ""


def test_a_note_is_no_warning() -> None:
    found = [Finding("sensor a", "is late."), Finding("sensor b", "is early.", spoils=False)]
    assert list(describe(found)) == ["warning: sensor a: is late.", "note: sensor b: is early."]
