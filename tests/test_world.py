from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builders import all_same, hypothesis_table, scenario, sensor_table
from scipy import stats

from waldnet.common.config import Scenario
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.gaussian import draw_noise
from waldnet.scenarios.world import scan_times_ns, simulate, simulate_all, truth

#: Probability that a statistical test fails though the code is right; seeds are fixed, so it fails always or never.
ALPHA = 1e-3
FAR = {"shape": "box", "center": [0.0, 0.0], "size": [1e9, 1e9]}
THREE = scenario(sensor_table("a"), sensor_table("b", scan_interval=3.0, p_d=0.4), sensor_table("c", first_scan=0.5))


def seconds(plot: Scenario, times_ns: Any) -> list[float]:
    return [plot.to_seconds(int(time_ns)) for time_ns in times_ns]


def test_scan_times() -> None:
    plot = scenario(
        sensor_table("a", scan_interval=2.5),
        sensor_table("b", scan_interval=2.5, first_scan=0.0),
        sensor_table("c", scan_interval=0.1),
        sensor_table("d", scan_interval=60.0),
        simulation={"duration": 10.0},
    )
    a, b, c, d = (scan_times_ns(plot, sensor) for sensor in plot.sensors)
    assert seconds(plot, a) == [2.5, 5.0, 7.5, 10.0]
    assert seconds(plot, b) == [0.0, 2.5, 5.0, 7.5, 10.0]
    assert seconds(plot, c) == pytest.approx(np.arange(1, 101) / 10)
    assert (c - plot.epoch_ns).tolist() == [k * 100_000_000 for k in range(1, 101)]
    assert d.tolist() == []


def test_a_scenario_without_simulation_has_no_world() -> None:
    plot = scenario(simulation=None)
    with pytest.raises(ConfigError) as caught:
        simulate_all(plot, 1)
    assert str(caught.value) == "test: has no [simulation]; give recorded plots, or a duration to simulate"


def test_the_same_seed_gives_the_same_world() -> None:
    assert all_same(simulate_all(THREE, 5), simulate_all(THREE, 5))


def test_another_seed_gives_another_world() -> None:
    one, other = simulate_all(THREE, 5), simulate_all(THREE, 6)
    assert not np.array_equal(truth(THREE, 5).x, truth(THREE, 6).x)
    assert all(not np.array_equal(a.z, b.z) for a, b in zip(one, other, strict=True) if len(a.z))


def test_every_process_sees_its_part_of_the_same_world() -> None:
    whole = simulate_all(THREE, 5)
    for name in reversed(THREE.sensor_names):
        assert all_same(simulate(THREE, name, 5), [scan for scan in whole if scan.sensor == name])


def test_all_scans_come_by_time_and_then_by_sensor() -> None:
    order = [(scan.time_ns, THREE.sensor_names.index(scan.sensor)) for scan in simulate_all(THREE, 5)]
    assert order == sorted(order)
    assert len(set(order)) == len(order)


def test_sensors_do_not_see_the_same_noise() -> None:
    plot = scenario(sensor_table("a", p_d=1.0), sensor_table("b", p_d=1.0))
    scans = simulate_all(plot, 1)
    assert not {tuple(z) for z in simulate(plot, "a", 1)[0].z} & {tuple(z) for z in simulate(plot, "b", 1)[0].z}
    assert {scan.sensor for scan in scans} == {"a", "b"}


def test_what_one_sensor_sees_depends_on_no_other_sensor() -> None:
    alone = scenario(sensor_table("a"), simulation={"duration": 20.0})
    pair = scenario(sensor_table("b", p_d=0.1, false_plots=9.0), sensor_table("a"), simulation={"duration": 20.0})
    assert all_same(simulate(alone, "a", 5), simulate(pair, "a", 5))


def test_the_truth_is_at_all_scan_times_of_the_network() -> None:
    world = truth(THREE, 5)
    times = {scan.time_ns for scan in simulate_all(THREE, 5)}
    assert world.times_ns.tolist() == sorted(times)
    assert world.x.shape == (1, len(times), 4)
    assert np.isfinite(world.x).all()


def test_without_noise_targets_go_straight() -> None:
    plot = scenario(motion={"psd": 0.0}, target=[{"start": -1.0, "state": [1.0, 2.0, 30.0, -4.0]}])
    world = truth(plot, 5)
    t = (world.times_ns - plot.epoch_ns) / 1e9
    expected = np.stack([1.0 + 30.0 * (t + 1.0), 2.0 - 4.0 * (t + 1.0), np.full_like(t, 30.0), np.full_like(t, -4.0)])
    np.testing.assert_allclose(world.x[0], expected.T, atol=1e-9)


def test_a_target_that_starts_later_is_not_there_before() -> None:
    plot = scenario(
        sensor_table(p_d=1.0, false_plots=1e-9),
        motion={"psd": 0.0},
        target=[{"start": 7.0, "state": [0.0, 0.0, 10.0, 0.0]}, {"start": 8.0, "state": [500.0, 0.0, 10.0, 0.0]}],
    )
    world = truth(plot, 5)
    there = ~np.isnan(world.x).any(axis=-1)
    times = (world.times_ns - plot.epoch_ns) / 1e9
    assert np.array_equal(there, np.array([times >= 7.0, times >= 8.0]))
    assert world.x[0, times == 8.0].tolist() == [[10.0, 0.0, 10.0, 0.0]]
    assert world.x[1, times == 8.0].tolist() == [[500.0, 0.0, 10.0, 0.0]]
    assert [len(scan.z) for scan in simulate(plot, "a", 5)] == [0, 0, 0, *[2] * 7]


def test_the_process_noise_has_its_covariance() -> None:
    plot = scenario(motion={"psd": 4.0}, target=[{"state": [0.0, 0.0, 0.0, 0.0]}] * 400, simulation={"duration": 2.0})
    x = truth(plot, 5).x[:, -1]
    q, dt = 4.0, 2.0
    Q = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    for axis in (0, 1):
        whitened = np.linalg.solve(np.linalg.cholesky(Q), x[:, [axis, axis + 2]].T)
        assert covariance_fits(whitened.T, np.eye(2))


def covariance_fits(samples: Any, P: Any) -> bool:
    """Chi-square test of zero mean and of the covariance of Gaussian samples, at the level ALPHA each."""
    d = samples.shape[-1]
    distances = np.vecdot(samples, np.linalg.solve(P, samples.T).T)
    spread = stats.chi2(len(samples) * d)
    center = samples.mean(axis=0)
    mean_distance = len(samples) * center @ np.linalg.solve(P, center)
    inside = spread.ppf(ALPHA / 2) < distances.sum() < spread.ppf(1 - ALPHA / 2)
    return bool(inside and mean_distance < stats.chi2(d).ppf(1 - ALPHA))


def test_a_target_is_drawn_from_its_hypothesis() -> None:
    hypotheses = [hypothesis_table(-9000.0), hypothesis_table(1000.0, sigma=[100.0, 50.0, 20.0, 10.0])]
    plot = scenario(
        sensor_table(first_scan=0.0),
        hypothesis=hypotheses,
        target=[{"hypothesis": 1}],
        simulation={"duration": 0.0001},
    )
    first = np.array([truth(plot, seed).x[0, 0] for seed in range(400)])
    assert covariance_fits(first - np.array([1000.0, 0.0, 150.0, 0.0]), np.diag([1e4, 2500.0, 400.0, 100.0]))


@pytest.mark.parametrize("count", [0, 1, 2, 7])
@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_noise_is_digit_by_digit_that_of_numpy(n: int, count: int) -> None:
    """Recorded results depend on it; a diagonal matrix, and one with correlations."""
    A = np.random.default_rng(1).normal(size=(n, n))
    for P in (np.diag(np.arange(1.0, n + 1.0)), A @ A.T):
        expected = np.random.default_rng(2).multivariate_normal(np.zeros(n), P, size=count)
        assert np.array_equal(draw_noise(np.random.default_rng(2), P, count), expected)


def test_two_targets_of_one_hypothesis_are_drawn_apart() -> None:
    x = truth(scenario(target=[{"hypothesis": 0}, {"hypothesis": 0}]), 5).x
    assert not np.allclose(x[0], x[1])


def test_a_target_is_detected_with_p_d() -> None:
    targets = [{"state": [0.0, 0.0, 0.0, 0.0]}] * 20
    plot = scenario(
        sensor_table(p_d=0.5, false_plots=1e-9, field_of_view=FAR), target=targets, simulation={"duration": 400.0}
    )
    plots = sum(len(scan.z) for scan in simulate(plot, "a", 5))
    assert stats.binomtest(plots, 20 * 200, 0.5).pvalue > ALPHA


def test_false_plots_are_poisson() -> None:
    plot = scenario(sensor_table(false_plots=3.0), target=[], simulation={"duration": 2000.0})
    counts = np.array([len(scan.z) for scan in simulate(plot, "a", 5)])
    spread = stats.poisson(3.0 * len(counts))
    assert spread.ppf(ALPHA / 2) < counts.sum() < spread.ppf(1 - ALPHA / 2)
    dispersion = ((counts - counts.mean()) ** 2).sum() / counts.mean()
    assert ALPHA / 2 < stats.chi2(len(counts) - 1).cdf(dispersion) < 1 - ALPHA / 2


@pytest.mark.parametrize(
    "fov",
    [
        {"shape": "box", "center": [1000.0, -500.0], "size": [400.0, 200.0]},
        {"shape": "box", "size": [400.0, 200.0]},
        {"shape": "disc", "center": [1000.0, -500.0], "radius": 300.0},
        {"shape": "disc", "radius": 300.0},
        {"shape": "everywhere", "area": 160_000.0},
    ],
)
def test_false_plots_are_uniform_in_the_field_of_view(fov: dict[str, Any]) -> None:
    plot = scenario(
        sensor_table(false_plots=20.0, field_of_view=fov, position=[7000.0, 8000.0]),
        target=[],
        simulation={"duration": 200.0},
    )
    center = [0.0, 0.0] if fov["shape"] == "everywhere" else fov.get("center", [7000.0, 8000.0])
    z = np.concatenate([scan.z for scan in simulate(plot, "a", 5)]) - center
    if fov["shape"] == "disc":
        radius = np.linalg.norm(z, axis=-1)
        assert stats.kstest(radius**2 / 300.0**2, "uniform").pvalue > ALPHA
        assert stats.kstest(np.arctan2(z[:, 1], z[:, 0]) / (2 * np.pi) + 0.5, "uniform").pvalue > ALPHA
    else:
        u = z / fov.get("size", [400.0, 400.0]) + 0.5
        assert all(stats.kstest(u[:, axis], "uniform").pvalue > ALPHA for axis in (0, 1))


def test_plots_have_the_noise_of_the_sensor() -> None:
    plot = scenario(
        sensor_table(p_d=1.0, false_plots=1e-9, sigma=[50.0, 20.0], field_of_view=FAR),
        motion={"psd": 0.0},
        target=[{"state": [100.0, 200.0, 30.0, -4.0]}],
        simulation={"duration": 1000.0},
    )
    errors = np.concatenate([scan.z for scan in simulate(plot, "a", 5)]) - truth(plot, 5).x[0, :, :2]
    assert covariance_fits(errors, np.diag([2500.0, 400.0]))


@pytest.mark.parametrize(
    "fov",
    [
        {"shape": "box", "center": [0.0, 0.0], "size": [2000.0, 2000.0]},
        {"shape": "disc", "center": [0.0, 0.0], "radius": 1000.0},
    ],
)
def test_a_sensor_sees_no_target_outside_its_field_of_view(fov: dict[str, Any]) -> None:
    plot = scenario(
        sensor_table(p_d=1.0, false_plots=1e-9, sigma=[0.1, 0.1], field_of_view=fov, scan_interval=1.0),
        motion={"psd": 0.0},
        target=[{"state": [-1505.0, 0.0, 100.0, 0.0]}],
        simulation={"duration": 30.0},
    )
    seen = [len(scan.z) for scan in simulate(plot, "a", 5)]
    assert seen == [int(abs(100.0 * t - 1505.0) <= 1000.0) for t in range(1, 31)]


def test_a_blind_sensor_sees_only_false_plots() -> None:
    plot = scenario(sensor_table(p_d=0.0, false_plots=1e-9))
    assert [len(scan.z) for scan in simulate(plot, "a", 5)] == [0] * 10


def test_plots_come_in_random_order() -> None:
    plot = scenario(
        sensor_table(p_d=1.0, false_plots=5.0, sigma=[0.1, 0.1]),
        motion={"psd": 0.0},
        target=[{"state": [0.0, 0.0, 0.0, 0.0]}],
        simulation={"duration": 200.0},
    )
    places = {int(np.argmin(np.linalg.norm(scan.z, axis=-1))) for scan in simulate(plot, "a", 5)}
    assert len(places) > 4


def test_three_dimensions() -> None:
    plot = scenario(
        sensor_table(
            position=[0.0, 0.0, 10.0],
            sigma=[5.0, 6.0, 7.0],
            p_d=1.0,
            false_plots=1.0,
            field_of_view={"shape": "disc", "radius": 1e5},
        ),
        motion={"psd": 0.0, "dimensions": 3},
        hypothesis=[],
        target=[{"state": [1.0, 2.0, 3.0, 10.0, 20.0, 30.0]}],
        simulation={"duration": 400.0},
    )
    world = truth(plot, 5)
    assert world.x[0, 0].tolist() == [21.0, 42.0, 63.0, 10.0, 20.0, 30.0]
    scans = simulate(plot, "a", 5)
    assert all(scan.position.tolist() == [0.0, 0.0, 10.0] for scan in scans)
    nearest = [
        scan.z[np.argmin(np.linalg.norm(scan.z - x, axis=-1))] - x
        for scan, x in zip(scans, world.x[0, :, :3], strict=True)
    ]
    assert covariance_fits(np.array(nearest), np.diag([25.0, 36.0, 49.0]))
