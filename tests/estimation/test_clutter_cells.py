"""Maps of false plots: against a recursion by hand, and against what uniform and other false plots must give."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from waldnet.common.estimation import clutter_map
from waldnet.common.estimation.clutter_map import ClutterMap, ClutterModel, learn, log_relative
from waldnet.common.estimation.field_of_view import AllAround, Box, Disc, FieldOfView
from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.polar import Bearing, Polar
from waldnet.common.estimation.sector import Sector
from waldnet.common.estimation.sensing import Measurement, Position, Sensor

HERE = np.zeros(2)
#: Five false plots in 100 cells of 100 m.
FIELD = Sensor(Position((20.0, 20.0), 4), 0.9, 5.0, Box((1000.0, 1000.0)))
NEVER_FORGETS = 1e18


def model(
    sensor: Sensor = FIELD, cell: float = 100.0, memory_s: float = NEVER_FORGETS, shape: float = 0.1
) -> ClutterModel:
    return ClutterModel(sensor, cell, memory_s, shape)


def camera(dimensions: int = 2, false_plots: float = 2.0) -> Sensor:
    sigma, whole = (0.02,) * (dimensions - 1), (2.0 if dimensions == 2 else 4.0) * np.pi
    return Sensor(Bearing(sigma, 2 * dimensions, whole), 0.7, false_plots, AllAround(dimensions))


def told(
    of: ClutterModel,
    scans: Sequence[Array],
    interval_s: float = 1.0,
    stands: Sequence[Array] | None = None,
    false: float = 1.0,
) -> ClutterMap:
    """The map after scans."""
    seen = clutter_map.start(len(HERE) if stands is None else len(stands[0]))
    for k, z in enumerate(scans):
        stand = HERE if stands is None else stands[k]
        seen = learn(seen, of, z, np.full(len(z), false), round((k + 1) * interval_s * 1e9), stand, stand)
    return seen


def relative(seen: ClutterMap, of: ClutterModel, *z: Sequence[float], stand: Array = HERE) -> list[float]:
    return np.exp(log_relative(seen, of, np.array(z), stand)).tolist()


def test_before_anything_was_seen_false_plots_are_uniform() -> None:
    assert relative(clutter_map.start(2), model(), [3.0, 4.0], [400.0, 400.0]) == [1.0, 1.0]


def test_a_cell_is_a_gamma_poisson_recursion() -> None:
    """Plots in the middle of a cell, of which that cell gets all: shape and rate by hand, forgotten on the way."""
    of, rng = model(memory_s=7.0, shape=0.3), np.random.default_rng(1)
    prior_rate = 5.0 / 100.0
    shape, rate = 0.3, 0.3 / prior_rate
    seen, time_s = clutter_map.start(2), 0.0
    for _ in range(40):
        dt, count, weight = rng.uniform(0.5, 3.0), int(rng.integers(0, 3)), rng.uniform(0.0, 1.0)
        time_s += dt
        kept = np.exp(-dt / 7.0)
        shape = 0.3 + kept * (shape - 0.3) + weight * count
        rate = 0.3 / prior_rate + kept * (rate - 0.3 / prior_rate) + 1.0
        z = np.tile([50.0, -50.0], (count, 1))
        seen = learn(seen, of, z, np.full(count, weight), round(time_s * 1e9), HERE, HERE)
        # Up to what has faded so far that it was dropped.
        assert relative(seen, of, [50.0, -50.0])[0] == pytest.approx(shape / rate / prior_rate, rel=0.02)


def test_without_forgetting_the_recursion_is_exact() -> None:
    of = model()
    seen = told(of, [np.array([[50.0, 50.0]])] * 3 + [np.empty((0, 2))] * 2)
    assert relative(seen, of, [50.0, 50.0])[0] == pytest.approx((0.1 + 3.0) / (0.1 + 0.05 * 5.0), rel=1e-12)
    assert relative(seen, of, [350.0, 50.0])[0] == pytest.approx(0.1 / (0.1 + 0.05 * 5.0), rel=1e-3)


@pytest.mark.parametrize("z", [[0.0, 0.0], [50.0, 0.0], [13.0, -37.0], [-499.0, 499.0]])
def test_a_plot_counts_once_wherever_it_lies(z: list[float]) -> None:
    seen = told(model(), [np.array([z])], false=0.7)
    assert seen.counts.sum() == pytest.approx(0.7, rel=1e-12)


def test_what_is_told_is_continuous_over_the_edges_of_cells() -> None:
    seen = told(model(), [np.array([[1.0, 2.0], [160.0, 20.0]])])
    line = np.column_stack([np.linspace(-300.0, 300.0, 6001), np.full(6001, 7.0)])
    values = log_relative(seen, model(), line, HERE)
    assert np.abs(np.diff(values)).max() < 0.02
    # An object on the edge of cells is told of as one in the middle of a cell, but for a factor of four.
    on, amid = told(model(), [np.array([[0.0, 0.0]])]), told(model(), [np.array([[50.0, 50.0]])])
    assert relative(on, model(), [0.0, 0.0])[0] > 0.25 * relative(amid, model(), [50.0, 50.0])[0] > 1.0


DISC = Disc(600.0, 2)
POLAR = Sensor(Polar((20.0, 0.02), 4), 0.9, 5.0, DISC)


@pytest.mark.parametrize(
    ("sensor", "cell", "d"),
    [
        (FIELD, 100.0, 2),
        (POLAR, 100.0, 2),
        (camera(), 0.3, 2),
        (Sensor(Position((20.0, 20.0, 20.0), 6), 0.9, 20.0, Box((1000.0,) * 3)), 200.0, 3),
        (camera(3, 6.0), 0.4, 3),
    ],
    ids=["position", "polar", "bearing", "position-3d", "bearing-3d"],
)
def test_uniform_false_plots_are_told_to_be_uniform_on_average(sensor: Sensor, cell: float, d: int) -> None:
    """Mean relative density at false plots, within 4 standard errors of runs that know nothing of each other."""
    of, stand, rng = model(sensor, cell, 30.0, 1.0), np.zeros(d), np.random.default_rng(5)
    means = []
    for _ in range(30):
        seen = clutter_map.start(d)
        told_of: list[Array] = []
        for k in range(50):
            places = sensor.field_of_view.draw(rng, int(rng.poisson(sensor.false_plots)), stand)
            z = sensor.measurement.draw_false(rng, places, stand)
            if k >= 30:
                told_of.append(np.exp(log_relative(seen, of, z, stand)))
            seen = learn(seen, of, z, np.ones(len(z)), k * 1_000_000_000, stand, stand)
        means.append(np.concatenate(told_of).mean())
    error = np.std(means) / np.sqrt(len(means))
    assert error < 0.04
    assert np.mean(means) == pytest.approx(1.0, abs=4.0 * error + 0.01)


def test_a_buoy_is_found_and_the_sea_around_it_is_clear() -> None:
    of, rng = model(), np.random.default_rng(2)
    scans = [np.array([[230.0, 170.0]]) + 20.0 * rng.standard_normal((1, 2)) for _ in range(50)]
    buoy, sea = relative(told(of, scans), of, [230.0, 170.0], [-300.0, -300.0])
    assert buoy > 5.0
    assert sea == pytest.approx(0.1 / (0.1 + 0.05 * 50.0), rel=1e-3)


def test_what_is_a_tracks_is_not_learned() -> None:
    scans = [np.array([[50.0, 50.0]])] * 20
    mine, nobodys = (told(model(), scans, false=false) for false in (0.01, 1.0))
    assert relative(mine, model(), [50.0, 50.0])[0] < 0.03 * relative(nobodys, model(), [50.0, 50.0])[0]


def test_it_forgets() -> None:
    of = model(memory_s=5.0)
    seen = told(of, [np.array([[50.0, 50.0]])] * 20)
    before = relative(seen, of, [50.0, 50.0])[0]
    nothing = np.empty((0, 2))
    later = learn(seen, of, nothing, np.empty(0), 25_000_000_000, HERE, HERE)
    assert 1.0 < relative(later, of, [50.0, 50.0])[0] < before
    long_after = learn(seen, of, nothing, np.empty(0), 500_000_000_000, HERE, HERE)
    assert not len(long_after.cells)
    assert relative(long_after, of, [50.0, 50.0])[0] == pytest.approx(0.1 / (0.1 + 0.05), rel=1e-3)


def test_of_many_scans_only_what_is_not_forgotten_is_kept() -> None:
    of, rng = model(cell=1.0, memory_s=5.0), np.random.default_rng(3)
    sizes = []
    seen = clutter_map.start(2)
    for k in range(300):
        z = rng.uniform(-500.0, 500.0, (20, 2))
        seen = learn(seen, of, z, np.ones(20), k * 1_000_000_000, HERE, HERE)
        sizes.append(len(seen.cells))
    assert max(sizes[150:]) < 1.1 * max(sizes[:150])
    assert (np.diff(seen.cells) > 0).all()


@pytest.mark.parametrize("measurement", [Position((20.0, 20.0), 4), Polar((20.0, 0.02), 4)])
def test_cells_stay_where_they_are_when_the_sensor_moves(measurement: Measurement) -> None:
    of = model(Sensor(measurement, 0.9, 5.0, DISC))
    stands = [np.array([10.0 * k, 0.0]) for k in range(30)]
    buoy = np.array([[250.0, 350.0, 0.0, 0.0]])
    seen = told(of, [measurement.observe(buoy, stand) for stand in stands], stands=stands)
    last = stands[-1]
    (there,) = relative(seen, of, *measurement.observe(buoy, last).tolist(), stand=last)
    elsewhere = measurement.observe(np.array([[-150.0, 350.0, 0.0, 0.0]]), last)
    assert there > 10.0 > 1.0 > relative(seen, of, *elsewhere.tolist(), stand=last)[0]


def test_only_scans_that_could_see_a_cell_count() -> None:
    of = model(Sensor(FIELD.measurement, 0.9, 5.0, DISC))
    stands = [np.array([0.0, 0.0])] * 10 + [np.array([2000.0, 0.0])] * 3
    seen = told(of, [np.empty((0, 2))] * 13, stands=stands)
    rate = 5.0 * 100.0**2 / DISC.volume
    first, second = relative(seen, of, [50.0, 50.0], [2050.0, 50.0], stand=stands[-1])
    assert first == pytest.approx(0.1 / (0.1 + 10.0 * rate))
    assert second == pytest.approx(0.1 / (0.1 + 3.0 * rate))
    assert len(seen.scans) == 2


def test_a_bearing_goes_around_the_circle() -> None:
    of = model(camera(), 0.1)
    seen = told(of, [np.array([[np.pi - 0.01]])] * 10)
    just, beyond, whole = relative(seen, of, [np.pi - 0.01], [-np.pi - 0.01], [3.0 * np.pi - 0.01])
    assert just == pytest.approx(beyond) == pytest.approx(whole)
    assert relative(seen, of, [-np.pi + 0.02])[0] > 5.0
    assert relative(seen, of, [0.0])[0] < 1.0


def test_directions_are_those_of_the_world() -> None:
    of = model(camera(), 0.1)
    stands = [np.array([100.0 * k, 0.0]) for k in range(10)]
    seen = told(of, [np.array([[1.0]])] * 10, stands=stands)
    assert relative(seen, of, [1.0], stand=stands[-1])[0] > 10.0
    assert seen.scans.tolist() == [10.0]


@pytest.mark.parametrize("view", [Sector(500.0, 100.0, 0.0, 1.0), Disc(0.5, 2), AllAround(2)])
def test_a_bearing_sensor_sees_all_its_directions_whatever_its_range(view: FieldOfView) -> None:
    of = model(Sensor(Bearing((0.02,), 4, 1.0), 0.7, 2.0, view), 0.1)
    seen = told(of, [np.empty((0, 1))] * 10)
    rate = 2.0 * of.sides(2)[0] / 1.0
    assert relative(seen, of, [0.1])[0] == pytest.approx(0.1 / (0.1 + 10.0 * rate))
