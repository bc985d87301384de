"""Sensors of all kinds in the simulated world, in recordings, in figures, and in a network that decides."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import all_same, scenario, sensor_table, write_report
from scipy import stats

from waldnet.common.config import Scenario, load_scenario
from waldnet.common.errors import PlotsError
from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import Decision, Scan, Tracks
from waldnet.offline.network import run_in_memory
from waldnet.offline.replay import Replay
from waldnet.recording.record import Record
from waldnet.scenarios import catalogue
from waldnet.scenarios.plots import read_plots, write_plots
from waldnet.scenarios.world import simulate, simulate_all, truth

#: Probability that a statistical test fails though the code is right; seeds are fixed, so it fails always or never.
ALPHA = 1e-3
RIGHT = 0.5 * np.pi
MIXED = load_scenario(catalogue.find("mixed-sensors"))
STAND = [700.0, -800.0]
SECTOR = {"shape": "sector", "radius": 300.0, "inner": 50.0, "direction": 0.5, "width": 1.2}


def seeing(kind: str, sigma: list[float], dimensions: int = 2, **changes: Any) -> Scenario:
    """A network of one sensor and 3 targets at rest."""
    stand = [*STAND, 30.0][:dimensions]
    entry = sensor_table("a", kind=kind, sigma=sigma, position=stand, **changes)
    places = np.array(stand) + np.array([[0.0, 200.0, 20.0], [-150.0, 1.0, 0.0], [90.0, -90.0, -50.0]])[:, :dimensions]
    targets = [{"state": [*place, *[3.0, -4.0, 1.0][:dimensions]]} for place in places]
    motion = {"psd": 0.0, "dimensions": dimensions}
    return scenario(entry, motion=motion, hypothesis=[], target=targets, simulation={"duration": 1000.0})


def expected_counts(plot: Scenario, edges: list[Array]) -> Array:
    """False plots per scan and cell that the sensor model claims: its density by 8 Gauss nodes a cell and number."""
    sensor = plot.sensors[0].build(plot.motion.build())
    node, weight = np.polynomial.legendre.leggauss(8)
    axes, weights = [], []
    for edge in edges:
        half = 0.5 * np.diff(edge)[:, None]
        axes.append((edge[:-1, None] + half * (1.0 + node)).ravel())
        weights.append((half * weight).ravel())
    z = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    log_relative = sensor.log_relative(z, plot.sensors[0].stand(plot.motion.dimensions))
    density = np.exp(sensor.log_rho_f + (0.0 if log_relative is None else log_relative)) * np.ones(z.shape[:-1])
    for axis, each in enumerate(weights):
        density = density * each.reshape([-1 if i == axis else 1 for i in range(len(weights))])
    cells = [length for edge in edges for length in (len(edge) - 1, 8)]
    return np.asarray(density.reshape(cells).sum(axis=tuple(range(1, 2 * len(edges), 2))))


TURN = np.linspace(0.0, 2.0 * np.pi, 7)
RANGES, SPEEDS = np.linspace(0.0, 300.0, 8), np.linspace(-80.0, 80.0, 5)
HEIGHTS = np.linspace(-RIGHT, RIGHT, 6)
SECTOR_TURN, SECTOR_RANGES = np.linspace(0.5 - 0.6, 0.5 + 0.6, 6), np.linspace(50.0, 300.0, 6)
DISC = {"shape": "disc", "radius": 300.0}


@pytest.mark.parametrize(
    ("kind", "dimensions", "sigma", "view", "edges"),
    [
        ("polar", 2, [0.01, 1e-3], DISC, [RANGES, TURN]),
        ("polar", 2, [0.01, 1e-3], SECTOR, [SECTOR_RANGES, SECTOR_TURN]),
        ("polar", 3, [0.01, 1e-3, 1e-3], DISC, [RANGES, TURN, HEIGHTS]),
        ("polar-doppler", 2, [0.01, 1e-3, 1.0], DISC, [RANGES, TURN, SPEEDS]),
        ("bearing", 2, [1e-3], DISC, [TURN]),
        ("bearing", 2, [1e-3], SECTOR, [SECTOR_TURN]),
        ("bearing", 2, [1e-3], {"shape": "everywhere"}, [TURN]),
        ("bearing", 3, [1e-3, 1e-3], {"shape": "everywhere"}, [TURN, HEIGHTS]),
        (
            "bearing",
            3,
            [1e-3, 1e-3],
            {**SECTOR, "elevation": [-0.2, 1.1]},
            [SECTOR_TURN, np.linspace(-0.2, 1.1, 6)],
        ),
    ],
)
def test_false_plots_have_the_density_that_the_model_says(
    kind: str, dimensions: int, sigma: list[float], view: dict[str, Any], edges: list[Array]
) -> None:
    """Chi-square test of a histogram in plot space, 20,000 false plots."""
    speed = {"max_speed": 80.0} if kind == "polar-doppler" else {}
    plot = seeing(kind, sigma, dimensions, false_plots=40.0, field_of_view=view, **speed)
    plot = plot.model_copy(update={"targets": ()})
    scans = simulate(plot, "a", 5)
    z = np.concatenate([scan.z for scan in scans])
    turn = kind.startswith("polar")
    z[:, int(turn)] = np.where(z[:, int(turn)] > edges[int(turn)][-1], z[:, int(turn)] - 2.0 * np.pi, z[:, int(turn)])
    counts, _ = np.histogramdd(z, edges)
    expected = len(scans) * expected_counts(plot, edges)
    assert counts.sum() == len(z)
    assert expected.sum() == pytest.approx(40.0 * len(scans), rel=1e-3)
    likely = expected > 5.0
    assert likely.sum() > 0.7 * likely.size
    distance = ((counts - expected)[likely] ** 2 / expected[likely]).sum()
    assert ALPHA / 2 < stats.chi2(likely.sum()).cdf(distance) < 1.0 - ALPHA / 2


@pytest.mark.parametrize(
    ("kind", "dimensions", "sigma"),
    [
        ("polar", 2, [1.0, 0.01]),
        ("polar", 3, [1.0, 0.01, 0.02]),
        ("polar-doppler", 2, [1.0, 0.01, 0.5]),
        ("polar-doppler", 3, [1.0, 0.01, 0.02, 0.5]),
        ("bearing", 2, [0.01]),
        ("bearing", 3, [0.01, 0.02]),
    ],
)
def test_plots_of_targets_have_the_noise_of_the_sensor(kind: str, dimensions: int, sigma: list[float]) -> None:
    """Mean and variance of every number, one target due north, where azimuth jumps."""
    view = {"shape": "disc", "radius": 1e6}
    plot = seeing(kind, sigma, dimensions, p_d=1.0, false_plots=1e-9, field_of_view=view)
    state = [*np.array([*STAND, 30.0][:dimensions]) + [0.0, 200.0, 20.0][:dimensions], *[0.0] * dimensions]
    plot = plot.model_copy(update={"targets": (plot.targets[0].model_copy(update={"state": tuple(state)}),)})
    measurement = plot.sensors[0].build(plot.motion.build()).measurement
    z = np.concatenate([scan.z for scan in simulate(plot, "a", 5)])
    error = z - measurement.observe(np.array(state), np.array([*STAND, 30.0][:dimensions]))
    for i in measurement.angular:
        assert ((z[:, i] >= 0.0) & (z[:, i] < 2.0 * np.pi)).all()
        error[:, i] = (error[:, i] + np.pi) % (2.0 * np.pi) - np.pi
    for number, spread in zip(error.T, sigma, strict=True):
        assert stats.kstest(number / spread, "norm").pvalue > ALPHA


def test_a_swerling_radar_sees_less_far_away() -> None:
    """Two targets at rest, 1 and 3 km away: detected as often as their ranges say."""
    model = {"model": "swerling", "p_fa": 1e-4, "snr_db": 13.0, "at_range": 2000.0}
    view = {"shape": "disc", "radius": 1e6}
    entry = sensor_table("a", kind="polar", sigma=[1.0, 1e-4], false_plots=1e-9, detection=model, field_of_view=view)
    del entry["p_d"]
    targets = [{"state": [3000.0, y, 0.0, 0.0]} for y in (1000.0, 3000.0)]
    plot = scenario(entry, motion={"psd": 0.0}, target=targets, simulation={"duration": 2000.0})
    ranges = np.concatenate([scan.z[:, 0] for scan in simulate(plot, "a", 3)])
    for r in (1000.0, 3000.0):
        snr = 10.0**1.3 * (2000.0 / r) ** 4
        assert stats.binomtest(int((abs(ranges - r) < 50.0).sum()), 1000, 1e-4 ** (1.0 / (1.0 + snr))).pvalue > ALPHA


def test_a_notch_hides_who_crosses() -> None:
    view = {"shape": "disc", "radius": 1e9}
    entry = sensor_table(
        "a", kind="polar", sigma=[1.0, 1e-4], p_d=1.0, false_plots=1e-9, field_of_view=view, position=[0.0, -1e7]
    )
    entry["detection"] = {"model": "notch", "mdv": 3.0}
    targets = [{"state": [0.0, 0.0, 20.0, speed]} for speed in (0.0, 3.0, 30.0)]
    plot = scenario(entry, motion={"psd": 0.0}, target=targets, simulation={"duration": 600.0})
    world, scans = truth(plot, 3), simulate(plot, "a", 3)
    for target, p in zip(world.x, (0.0, 0.5, 1.0), strict=True):
        r = np.hypot(target[:, 0], target[:, 1] + 1e7)
        seen = sum(bool((abs(scan.z[:, 0] - distance) < 5.0).any()) for scan, distance in zip(scans, r, strict=True))
        # The first scans, in which the three are near each other, may mistake one for another.
        assert abs(seen - 300 * p) < 5.0 * np.sqrt(300 * 0.25) if p == 0.5 else abs(seen - 300 * p) < 4


# Recordings -----------------------------------------------------------------------------------------------------------


def test_a_simulated_world_comes_back_from_its_file(tmp_path: Path) -> None:
    scans, file = simulate_all(MIXED, 3), io.StringIO()
    write_plots(file, scans, MIXED)
    path = tmp_path / "plots.jsonl"
    path.write_text(file.getvalue())
    assert all_same(read_plots(path, MIXED), scans)


@pytest.mark.parametrize(
    ("sensor", "plot", "fault"),
    [
        ("radar", [1000.0], "plots.0: [1000.0] is not a list of 2 finite numbers"),
        ("radar", [-1.0, 0.0], "plots.0: range -1 is no distance in metres (0 to 1e+09)"),
        ("radar", [1000.0, 135.0], "plots.0: azimuth 135 is no angle in radians (-2 pi to 2 pi)"),
        ("doppler", [1000.0, 1.0], "plots.0: [1000.0, 1.0] is not a list of 3 finite numbers"),
        ("camera", [90.0], "plots.0: azimuth 90 is no angle in radians (-2 pi to 2 pi)"),
    ],
)
def test_plots_that_cannot_be_are_refused(tmp_path: Path, sensor: str, plot: list[float], fault: str) -> None:
    path = tmp_path / "plots.jsonl"
    path.write_text(json.dumps({"sensor": sensor, "time": 2.0, "plots": [plot]}))
    with pytest.raises(PlotsError) as caught:
        read_plots(path, MIXED)
    assert str(caught.value) == f"{path}:1: {fault}"


# A network ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_mixed_sensors_confirm_the_target_and_delete_the_decoy(seed: int) -> None:
    """And the track is consistent: the mean of its NEES, 4 if right, where 1.5 to 10 would be no wonder."""
    messages = list(Replay(MIXED, simulate_all(MIXED, seed)).run())
    decisions = [(m.track, m.kind) for m in messages if isinstance(m, Decision)]
    assert set(decisions) == {(0, "confirmed"), (1, "deleted")}
    world = truth(MIXED, seed)
    nees = []
    for picture in messages:
        if isinstance(picture, Tracks):
            error = picture.x[0] - world.x[0, np.searchsorted(world.times_ns, picture.time_ns)]
            nees.append(error @ np.linalg.solve(picture.P[0], error))
    assert 1.5 < np.mean(nees) < 10.0


def test_nodes_and_center_on_a_bus_decide_as_the_replay_does() -> None:
    """Scans of one, two and three numbers a plot cross the codec."""
    scans = [scan for scan in simulate_all(MIXED, 1) if MIXED.to_seconds(scan.time_ns) <= 8.0]
    heard = run_in_memory(MIXED, scans)
    replayed = [message for message in Replay(MIXED, scans).run() if isinstance(message, Decision)]
    assert [(d.track, d.kind, d.time_ns) for d in heard.standing()] == [(d.track, d.kind, d.time_ns) for d in replayed]
    assert {scan.z.shape[1] for scan in heard.scans} == {1, 2, 3}


@pytest.mark.parametrize("without", MIXED.sensor_names)
def test_every_sensor_helps(without: str) -> None:
    """Mean log LR after 10 s over 6 worlds, with and without one of the sensors."""
    fewer = MIXED.model_copy(update={"sensors": tuple(s for s in MIXED.sensors if s.name != without)})
    assert gain(MIXED) > gain(fewer) + 1.0


def gain(plot: Scenario) -> float:
    """Mean log LR in total of track 0 after 10 s."""
    total = []
    for seed in range(6):
        scans = [scan for scan in simulate_all(plot, seed) if plot.to_seconds(scan.time_ns) <= 10.0]
        last = [m for m in Replay(plot, scans).run() if isinstance(m, Tracks)][-1]
        total.append(last.log_lr_total[0])
    return float(np.mean(total))


def test_the_report_shows_plots_where_they_lie(tmp_path: Path) -> None:
    """Of all kinds; the figure itself is for people to look at, here only that it comes."""
    record = Record(MIXED)
    scans = simulate_all(MIXED, 1)[:30]
    for message in [*scans, *Replay(MIXED, scans).run()]:
        record.note(message)
    files = write_report(record, tmp_path, {})
    assert all(file.stat().st_size > 0 for file in files)


def test_a_node_weights_plots_with_the_density_of_false_ones_at_their_range() -> None:
    """Eq. (6) of one polar plot, 2500 m away, at a density of false plots of rho_f times its range."""
    view = {"shape": "disc", "radius": 10_000.0}
    plot = scenario(
        sensor_table("a", kind="polar", sigma=[20.0, 0.01], position=[0.0, 0.0], field_of_view=view),
        motion={"psd": 0.0},
        fusion={"association": "factor", "gate_probability": 1.0},
        hypothesis=[{"state": [1500.0, 2000.0, 0.0, 0.0], "sigma": [50.0, 50.0, 1e-6, 1e-6]}],
    )
    z = np.array([2510.0, np.arctan2(1500.0, 2000.0) + 0.02])
    scan = Scan("a", plot.to_ns(2.0), np.zeros(2), z[None])
    (picture,) = [message for message in Replay(plot, [scan]).run() if isinstance(message, Tracks)]
    H = np.array([[0.6, 0.8], [0.8 / 2500.0, -0.6 / 2500.0]])
    S = 2500.0 * H @ H.T + np.diag([400.0, 1e-4])
    rho_f = 2.0 / (np.pi * 10_000.0**2) * 2510.0
    p_bar = 0.1 + 0.9 / rho_f * stats.multivariate_normal([2500.0, z[1] - 0.02], S).pdf(z)
    assert picture.log_lr_total[0] == pytest.approx(np.log(p_bar), rel=1e-9)
