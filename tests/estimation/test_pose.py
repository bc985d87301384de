"""Sensors that move and turn: range rates by differences of distance, starts and likelihood ratios by Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from waldnet.common.estimation import clutter_map
from waldnet.common.estimation.association import Clutter, Plots, pdaf
from waldnet.common.estimation.clutter_map import ClutterModel
from waldnet.common.estimation.detection import Notch
from waldnet.common.estimation.field_of_view import Box, Disc, Everywhere, FieldOfView
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.initiation import from_plots
from waldnet.common.estimation.polar import Bearing, Polar, PolarDoppler
from waldnet.common.estimation.pose import Outlook, SensorPose
from waldnet.common.estimation.sector import Sector
from waldnet.common.estimation.sensing import Measurement, Position, Sensor
from waldnet.common.estimation.sight import radial_speed
from waldnet.common.estimation.sigma_points import SigmaPoint

SEEDS = st.integers(0, 2**32 - 1)
#: Probability that a statistical test fails though the code is right; seeds are fixed, so it fails always or never.
Z = 3.3
DOPPLER = {2: PolarDoppler((5.0, 0.01, 0.5), 4, 60.0), 3: PolarDoppler((5.0, 0.01, 0.02, 0.5), 6, 60.0)}
SIGMA_POINT = {d: SigmaPoint(measurement, d, doppler=True) for d, measurement in DOPPLER.items()}
OWN = {2: np.array([12.0, -20.0]), 3: np.array([12.0, -20.0, 3.0])}


def sensor(measurement: Measurement, view: FieldOfView, **changes: object) -> Sensor:
    return Sensor(measurement, 0.9, 2.0, view)._replace(**changes)


def target(rng: np.random.Generator, d: int) -> Array:
    """Some hundred metres away, as fast as a car."""
    return np.concatenate([rng.normal(0.0, 300.0, d), rng.normal(0.0, 20.0, d)])


# Range rates ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [2, 3])
@settings(deadline=None, derandomize=True, database=None)
@given(SEEDS)
def test_a_range_rate_is_how_fast_the_distance_of_two_that_move_grows(d: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, origin, dt = target(rng, d), rng.normal(0.0, 50.0, d), 1e-4
    before, after = (np.linalg.norm(x[:d] + t * x[d:] - origin - t * OWN[d]) for t in (-dt, dt))
    z = DOPPLER[d].moving(OWN[d]).observe(x, origin)
    assert z[-1] == pytest.approx((after - before) / (2.0 * dt), abs=1e-4)
    assert z[:-1] == pytest.approx(DOPPLER[d].observe(x, origin)[:-1])


@pytest.mark.parametrize("d", [2, 3])
def test_slopes_of_a_moving_sensor(d: int) -> None:
    """Central differences, a batch of targets all around."""
    rng = np.random.default_rng(1)
    tracks = Gaussian(np.array([target(rng, d) for _ in range(6)]), np.broadcast_to(np.eye(2 * d), (6, 2 * d, 2 * d)))
    measurement, origin = DOPPLER[d].moving(OWN[d]), rng.normal(0.0, 50.0, d)
    linear = measurement.linearise(tracks, origin)
    for i in range(2 * d):
        step = 0.001 * np.eye(2 * d)[i]
        slope = measurement.observe(tracks.x + step, origin) - measurement.observe(tracks.x - step, origin)
        slope[:, 1] = (slope[:, 1] + np.pi) % (2.0 * np.pi) - np.pi
        np.testing.assert_allclose(linear.H[..., i], slope / 0.002, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(linear.z, measurement.observe(tracks.x, origin))


@pytest.mark.parametrize("d", [2, 3])
def test_sigma_points_of_a_moving_sensor_have_the_moments_of_its_plots(d: int) -> None:
    """100,000 draws of a target 150 m away and known to 15 m and 5 m/s."""
    rng = np.random.default_rng(2)
    x, origin = np.concatenate([[120.0, 90.0, 20.0][:d], [4.0, -7.0, 1.0][:d]]), np.zeros(d)
    P = np.diag([225.0] * d + [25.0] * d)
    measurement = SIGMA_POINT[d].moving(OWN[d])
    linear = measurement.linearise(Gaussian(x, P), origin)
    plots = measurement.observe(rng.multivariate_normal(x, P, 100_000), origin)
    np.testing.assert_allclose(linear.z, plots.mean(axis=0), atol=0.15, rtol=0.01)
    spread = np.sqrt(np.diagonal(linear.H @ P @ linear.H.T + linear.R - measurement.R))
    np.testing.assert_allclose(spread, plots.std(axis=0), rtol=0.03)


@pytest.mark.parametrize("ekf", [True, False])
def test_what_a_scan_tells_is_the_same_in_the_frame_of_the_sensor(ekf: bool) -> None:
    """Densities and evidence of a sensor that moves, and of one that stands among targets that move the other way."""
    rng = np.random.default_rng(3)
    measurement = DOPPLER[2] if ekf else SIGMA_POINT[2]
    tracks = Gaussian(
        np.array([[120.0, 90.0, 4.0, -7.0], [-80.0, 200.0, 0.0, 15.0]]), np.diag([400.0, 400.0, 9.0, 9.0])
    )
    tracks = Gaussian(tracks.x, np.broadcast_to(tracks.P, (2, 4, 4)))
    shift = np.concatenate([np.zeros(2), OWN[2]])
    plots = Plots(measurement.moving(OWN[2]).observe(tracks.x, np.zeros(2)) + rng.normal(0.0, [5.0, 0.01, 0.5], (2, 3)))
    clutter = Clutter(np.array(0.9), np.array(-12.0), 0.999)
    moving = pdaf(tracks, plots, measurement.moving(OWN[2]).linearise(tracks, np.zeros(2)), clutter)
    there = Gaussian(tracks.x - shift, tracks.P)
    standing = pdaf(there, plots, measurement.linearise(there, np.zeros(2)), clutter)
    np.testing.assert_allclose(moving.log_p_bar, standing.log_p_bar, rtol=1e-10)
    np.testing.assert_allclose(moving.density.x, standing.density.x + shift, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(moving.density.P, standing.density.P, rtol=1e-9, atol=1e-9)


# False plots, starts --------------------------------------------------------------------------------------------------


def test_false_plots_of_a_moving_sensor_tell_nothing_on_average() -> None:
    """The mean likelihood ratio without a target is 1: false range rates are uniform relative to the sensor."""
    rng = np.random.default_rng(4)
    view, own = Disc(300.0, 2), OWN[2]
    model = sensor(PolarDoppler((20.0, 0.1, 3.0), 4, 60.0), view, false_plots=6.0).at(SensorPose(np.zeros(2), own))
    track = Gaussian(np.array([120.0, 90.0, 4.0, -7.0]), np.diag([900.0, 900.0, 64.0, 64.0]))
    seen = model.measurement.linearise(track, np.zeros(2))
    clutter = Clutter(np.array(0.9), np.array(model.log_rho_f), 1.0)
    ratios = []
    for _ in range(4000):
        places = view.draw(rng, int(rng.poisson(model.false_plots)), np.zeros(2))
        z = model.measurement.draw_false(rng, places, np.zeros(2))
        plots = Plots(z, log_relative=model.log_relative(z, np.zeros(2)))
        ratios.append(np.exp(pdaf(track, plots, seen, clutter).log_p_bar))
    assert abs(np.mean(ratios) - 1.0) < Z * np.std(ratios) / np.sqrt(len(ratios)) < 0.2


@pytest.mark.parametrize("d", [2, 3])
def test_what_starts_from_a_plot_of_a_moving_sensor_is_as_wrong_as_it_says(d: int) -> None:
    """Mean squared errors of 4000 starts in units of their covariances: the size of the state, to within chance."""
    rng = np.random.default_rng(5)
    spread, n, stand = np.full(d, 15.0), 2 * d, np.array([30.0, -40.0, 10.0])[:d]
    places = rng.uniform(150.0, 300.0, (4000, d)) * rng.choice([-1.0, 1.0], (4000, d))
    places[:, 2:] *= 0.2
    x = np.concatenate([stand + places, rng.normal(0.0, 15.0, (4000, d))], axis=1)
    measurement = PolarDoppler((1.0, *[0.002] * (d - 1), 0.5), n, 60.0).moving(OWN[d])
    z = measurement.observe(x, stand) + rng.normal(0.0, measurement.sigma, (4000, d + 1))
    start = from_plots(z, measurement, stand, spread)
    error = x - start.x
    nees = np.vecdot(error, np.linalg.solve(start.P, error[..., None])[..., 0])
    assert abs(nees.mean() - n) < Z * np.sqrt(2.0 * n / len(nees))
    along = (x[:, :d] - stand) / np.linalg.norm(x[:, :d] - stand, axis=1, keepdims=True)
    sigma = np.sqrt(np.einsum("ki,kij,kj->k", along, start.P[:, d:, d:], along))
    assert sigma.max() < 0.6 < 15.0


# Clutter notch --------------------------------------------------------------------------------------------------------


def test_the_notch_of_a_moving_radar_is_where_the_ground_has_the_range_rate_of_the_target() -> None:
    """It depends on the radial speed over ground alone, however fast the radar is."""
    rng = np.random.default_rng(6)
    x, stand = np.array([target(rng, 2) for _ in range(50)]), np.array([30.0, -40.0])
    ground = np.concatenate([x[:, :2], np.zeros((50, 2))], axis=1)
    model = sensor(DOPPLER[2], Disc(1e4, 2), detection=Notch(3.0)).at(SensorPose(stand, OWN[2]))
    apart = model.measurement.observe(x, stand)[:, -1] - model.measurement.observe(ground, stand)[:, -1]
    np.testing.assert_allclose(apart, radial_speed(x, stand), atol=1e-9)
    np.testing.assert_allclose(model.detection.share(x, stand), 1.0 - 2.0 ** -((apart / 3.0) ** 2), atol=1e-12)


# Fields of view -------------------------------------------------------------------------------------------------------

VIEWS = [
    Box((40.0, 90.0)),
    Box((40.0, 90.0, 30.0)),
    Sector(80.0, 10.0, 0.4, 1.1),
    Sector(80.0, 0.0, 0.4, 1.1, (-0.3, 0.9)),
    Disc(60.0, 2),
    Disc(60.0, 3),
    Everywhere(1e4, 2),
]


def turned(points: Array, heading: float) -> Array:
    """Points carried along by a platform that turns from north to a heading, clockwise."""
    azimuth, r = np.arctan2(points[..., 0], points[..., 1]) + heading, np.hypot(points[..., 0], points[..., 1])
    return np.concatenate([np.stack([r * np.sin(azimuth), r * np.cos(azimuth)], axis=-1), points[..., 2:]], axis=-1)


@pytest.mark.parametrize("view", VIEWS, ids=str)
@settings(deadline=None, derandomize=True, database=None, max_examples=8)
@given(SEEDS, st.floats(-6.0, 6.0))
def test_a_field_of_view_turns_with_its_sensor(view: FieldOfView, seed: int, heading: float) -> None:
    rng = np.random.default_rng(seed)
    d = 3 if view in (VIEWS[1], VIEWS[3], VIEWS[5]) else 2
    center, points = rng.normal(0.0, 100.0, d), rng.normal(0.0, 50.0, (12, d))
    there = view.turned(heading)
    np.testing.assert_array_equal(
        there.contains(center + turned(points, heading), center), view.contains(points, np.zeros(d))
    )
    root = rng.normal(0.0, 20.0, (12, d, d))
    P = root @ root.mT + np.eye(d)
    axes = turned(np.eye(d), heading).T
    p = there.probability_inside(Gaussian(center + turned(points, heading), axes @ P @ axes.T), center)
    np.testing.assert_allclose(p, view.probability_inside(Gaussian(points, P), np.zeros(d)), atol=2e-8)
    assert there.volume == view.volume
    assert there.contains(there.draw(rng, 50, center), center).all()


@pytest.mark.parametrize("view", VIEWS, ids=str)
def test_the_probability_inside_does_not_depend_on_the_batch_to_the_last_digit(view: FieldOfView) -> None:
    rng = np.random.default_rng(7)
    d = 3 if view in (VIEWS[1], VIEWS[3], VIEWS[5]) else 2
    x, root = rng.normal(0.0, 50.0, (40, d)), rng.normal(0.0, 20.0, (40, d, d))
    P, field = root @ root.mT + np.eye(d), view.turned(0.7)
    whole = field.probability_inside(Gaussian(x, P), np.zeros(d))
    for first in range(1, 40, 2):
        part = field.probability_inside(Gaussian(x[first:], P[first:]), np.zeros(d))
        np.testing.assert_array_equal(part, whole[first:])


@pytest.mark.parametrize("view", VIEWS, ids=str)
@settings(deadline=None, derandomize=True, database=None, max_examples=20)
@given(SEEDS, st.floats(0.0, 4.0), st.floats(0.0, 4.0))
def test_what_is_swept_holds_the_view_at_every_heading_on_the_way(
    view: FieldOfView, seed: int, left: float, right: float
) -> None:
    rng = np.random.default_rng(seed)
    d = 3 if view in (VIEWS[1], VIEWS[3], VIEWS[5]) else 2
    swept, center = view.swept(left, right), np.zeros(d)
    for heading in (-left, right, rng.uniform(-left, right)):
        assert swept.contains((1.0 - 1e-9) * view.turned(heading).draw(rng, 40, center), center).all()
    assert view.swept(0.0, 0.0) == view
    assert swept.volume >= view.volume


def test_an_outlook_knows_how_far_its_platform_has_turned_and_forgets_it() -> None:
    def headed(headings: Array, memory_s: float) -> Outlook:
        outlook = Outlook(SensorPose(np.zeros(2)), 1.0)
        for heading in headings:
            outlook = outlook.after(SensorPose(np.zeros(2), heading=float(heading)), 10**9, memory_s)
        return outlook

    round_and_round = headed(np.arange(3.0, 63.0, 0.5) % 6.28, 100.0)
    assert round_and_round.left + round_and_round.right >= 2.0 * np.pi
    to_and_fro = headed(0.5 * np.sin(np.arange(60.0)), np.inf)
    np.testing.assert_allclose((to_and_fro.left + to_and_fro.right), 1.0, atol=0.01)
    np.testing.assert_allclose(to_and_fro.left, 0.5 + 0.5 * np.sin(59.0), atol=0.01)
    once = headed(np.array([3.1, -3.1, *np.full(30, -3.1)]), 5.0)  # 0.083 to the right, across south
    assert once.left < 1e-3
    assert headed(np.array([3.1, -3.1]), np.inf).left == pytest.approx(2.0 * np.pi - 6.2)
    assert headed(np.array([2.0]), np.inf).left == 0.0  # where it heads at first is no turn


def test_an_outlook_learns_how_often_its_sensor_scans() -> None:
    outlook = Outlook(SensorPose(np.zeros(2)), 0.2)
    for second in range(1, 60):
        outlook = outlook.after(SensorPose(np.zeros(2)) if second % 2 else None, 10**9, np.inf)
    assert outlook.interval_s == pytest.approx(2.0, rel=0.01)


def test_what_does_not_turn_and_what_stands_still() -> None:
    pose = SensorPose(np.zeros(2), OWN[2], 0.5 * np.pi)
    fixed = sensor(Position((1.0, 1.0), 4), Box((40.0, 90.0)), fixed_view=True)
    assert fixed.at(pose).field_of_view == Box((40.0, 90.0))
    assert fixed._replace(fixed_view=False).at(pose).field_of_view == Box((40.0, 90.0), 0.5 * np.pi)
    still = sensor(DOPPLER[2], Sector(80.0, 10.0, 0.4, 1.1))
    assert still.at(SensorPose(np.ones(2))) is still
    assert still.at(SensorPose(np.ones(2), np.zeros(2))) is still
    for measurement in (Position((1.0, 1.0), 4), Polar((5.0, 0.01), 4), Bearing((0.01,), 4, 1.0)):
        assert measurement.moving(OWN[2]) == measurement


def test_a_map_of_false_plots_knows_which_way_the_sensor_looked() -> None:
    """Three scans to the north, one to the south: a place in the north was watched three times."""
    north = Sector(1000.0, 0.0, 0.0, 1.0)
    model = ClutterModel(sensor(Polar((5.0, 0.005), 4), north), 20.0, 1e9, 0.5)
    seen, stand = clutter_map.start(2), np.zeros(2)
    nothing = np.empty((0, 2))
    for k, heading in enumerate((0.0, np.pi, 0.0, 2.0 * np.pi)):
        seen = clutter_map.learn(seen, model, nothing, np.empty(0), k, stand, stand, heading)
    relative = clutter_map.log_relative(
        seen, model, np.array([[500.0, 0.0], [500.0, np.pi], [500.0, 0.5 * np.pi]]), stand
    )
    rate = model.prior_rate(2)
    expected = -np.log1p(rate * np.array([3.0, 1.0, 0.0]) / model.shape)
    np.testing.assert_allclose(relative, expected, atol=1e-9)
