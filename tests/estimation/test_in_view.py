"""What plots and misses weigh for tracks at the edge of a field of view (Eq. 6a), by brute force."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import norm, qmc

from waldnet.common.estimation import association
from waldnet.common.estimation.association import (
    Clutter,
    Plots,
    expect,
    innovations,
    update,
    weights_alone,
    within_reach,
)
from waldnet.common.estimation.cluster import ClusterTest, cluster, extract_cluster
from waldnet.common.estimation.detection import Notch, Swerling
from waldnet.common.estimation.extraction import Extractor, SensorScan, candidates, extract
from waldnet.common.estimation.field_of_view import AllAround, Box, Disc, Everywhere, FieldOfView, View
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.imm import Modes, imm_pdaf
from waldnet.common.estimation.mixture import EXACT, Mixture, step, step_traced
from waldnet.common.estimation.motion import ConstantVelocity
from waldnet.common.estimation.notch import hypotheses
from waldnet.common.estimation.polar import Bearing, Polar, PolarDoppler
from waldnet.common.estimation.sector import Sector
from waldnet.common.estimation.sensing import Measurement, Position, Sensor
from waldnet.common.estimation.sprt import thresholds

P_D, LOG_RHO_F = 0.8, -9.0
#: So far away that what is measured is a line in the state.
FLAT, SOLID = np.array([60_000.0, 200.0]), np.array([60_000.0, 200.0, 9000.0])
SECTOR = Sector(60_010.0, 1.0, np.pi / 2.0, 0.0072)
SOLID_SECTOR = Sector(60_695.0, 1.0, np.pi / 2.0, 0.0074, (0.1, 0.1492))


def track(place: Array, sigma: float, n: int) -> Gaussian:
    """One track in one filter, position and velocity correlated."""
    d, rng = len(place), np.random.default_rng(n)
    A = np.eye(n) + 0.3 * np.tril(rng.normal(size=(n, n)), -1)
    scale = np.r_[np.full(d, sigma), np.full(n - d, 8.0)]
    x = np.r_[place, np.full(n - d, 5.0)]
    return Gaussian(x[None], (scale[:, None] * A @ A.T * scale)[None])


KINDS: list[tuple[Measurement, FieldOfView, Array]] = [
    (Position((15.0, 20.0), 4), Box((90.0, 60.0)), np.array([59_960.0, 205.0])),
    (Position((15.0, 20.0), 4), Disc(50.0, 2), np.array([59_960.0, 205.0])),
    (Position((15.0, 20.0, 12.0), 6), Box((90.0, 60.0, 80.0)), np.array([59_960.0, 205.0, 8990.0])),
    (Position((15.0, 20.0, 12.0), 6), Disc(60.0, 3), np.array([59_970.0, 205.0, 8990.0])),
    (Polar((15.0, 3e-4), 4), SECTOR, np.zeros(2)),
    (Polar((15.0, 3e-4, 25e-5), 6), SOLID_SECTOR, np.zeros(3)),
    (PolarDoppler((15.0, 3e-4, 1.0), 4, 50.0), SECTOR, np.zeros(2)),
    (Bearing((3e-4,), 4, 0.0072), SECTOR, np.zeros(2)),
    (Bearing((3e-4, 25e-5), 6, 0.02), SOLID_SECTOR, np.zeros(3)),
]


@pytest.mark.parametrize(("measurement", "shape", "center"), KINDS)
def test_weights_are_integrals_over_the_view(measurement: Any, shape: FieldOfView, center: Array) -> None:
    """Quasi-Monte-Carlo over the true, unlinearised likelihood; 2 % hold both errors."""
    d = len(center)
    place, stand = (FLAT, SOLID)[d - 2], np.zeros(d)
    density = track(place, 30.0, measurement.n)
    expected = expect(
        density,
        measurement.linearise(density, stand),
        Clutter(np.asarray(P_D), np.array(LOG_RHO_F), 1.0, View(shape, center)),
    )
    rng = np.random.default_rng(1)
    states = density.x[0] + rng.multivariate_normal(np.zeros(measurement.n), density.P[0], 3)
    z = measurement.observe(states, stand) + rng.normal(size=(3, measurement.m)) * measurement.sigma
    ours = np.exp(weights_alone(expected, within_reach(expected, Plots(z))))
    uniform = qmc.Sobol(measurement.n, rng=2).random_base2(18)
    x = density.x[0] + norm.ppf(uniform.clip(1e-12, 1.0 - 1e-12)) @ np.linalg.cholesky(density.P[0]).T
    inside = shape.contains(x[:, :d], center)
    nu = innovations(z[:, None], measurement.observe(x, stand), measurement.angular)
    likelihood = (norm.pdf(nu / measurement.sigma) / measurement.sigma).prod(axis=-1)
    theirs = np.r_[1.0 - P_D * inside.mean(), P_D * np.exp(-LOG_RHO_F) * (likelihood * inside).mean(axis=-1)]
    assert 0.02 < inside.mean() < 0.9
    np.testing.assert_allclose(ours, theirs, rtol=0.02)


def flat(rows: int = 5) -> tuple[Gaussian, Array, View]:
    """Tracks in two filters, inside, at the edge and outside, shared plots, and the view."""
    x = np.zeros((rows, 4))
    x[:, 0] = [-1300.0, -900.0, -700.0, 0.0, 30.0][:rows]
    P = np.broadcast_to(np.diag([1e4, 1e4, 25.0, 25.0]), (rows, 4, 4))
    z = np.random.default_rng(2).uniform(-1500.0, 300.0, (60, 2)) * [1.0, 0.1]
    return Gaussian(np.stack([x, x + 10.0]), np.stack([3.0 * P, P])), z, View(Disc(900.0, 2), np.zeros(2))


def seen(both: Gaussian, view: View | None, p_g: float = 0.999) -> Any:
    sensor = Position((30.0, 40.0), 4)
    linear = sensor.linearise(both, np.zeros(2))
    return expect(both, linear, Clutter(np.full(both.x.shape[1:-1], P_D), np.array(LOG_RHO_F), p_g, view))


def test_amid_the_view_no_digit_changes_and_nothing_is_worked_out(monkeypatch: pytest.MonkeyPatch) -> None:
    both, z, _ = flat()
    wide = View(Disc(1e5, 2), np.zeros(2))
    everywhere, inside = seen(both, None), seen(both, wide)
    assert inside.edge is None
    monkeypatch.setattr(association, "_log_in_view", None)
    for ours, theirs in zip(update(inside, Plots(z)).density, update(everywhere, Plots(z)).density, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(inside.log_miss, everywhere.log_miss)
    np.testing.assert_array_equal(inside.log_hit, everywhere.log_hit)


def test_beside_a_vagueat_the_edge_the_others_keep_every_digit() -> None:
    both, z, view = flat()
    ours, alone = (update(seen(both, where), Plots(z)) for where in (view, None))
    assert seen(both, view).edge.tolist() == [True, True, True, False, False]
    for one, other in zip((*ours.density, ours.log_p_bar[None]), (*alone.density, alone.log_p_bar[None]), strict=True):
        np.testing.assert_array_equal(one[:, 3:], other[:, 3:])
        assert (one[:, :3] != other[:, :3]).any()


def test_only_pairs_in_the_gates_of_tracks_at_the_edge_are_looked_at() -> None:
    both, z, view = flat()

    class Counting(Disc):
        asked = 0

        def probability_inside(self, position: Gaussian, center: Array) -> Array:
            Counting.asked += len(position.x)
            return super().probability_inside(position, center)

    expected = seen(both, View(Counting(*view.shape), view.center))  # type: ignore[misc]
    Counting.asked = 0
    within_reach(expected, Plots(z))
    gated = np.isfinite(weights_alone(seen(both, None), Plots(z))[:3, 1:])
    assert 0 < Counting.asked == gated.sum() < z.shape[0] * 3 // 2


@pytest.mark.parametrize("field", [Everywhere(1e6, 2), AllAround(2)])
def test_who_sees_everything_has_no_edge(field: FieldOfView) -> None:
    assert Sensor(Position((1.0, 1.0), 4), P_D, 1.0, field).view(np.zeros(2)) is None


def test_a_vaguethat_is_surely_outside_learns_nothing() -> None:
    both, _, view = flat(1)
    far = Gaussian(both.x + np.array([5e4, 0.0, 0.0, 0.0]), both.P)
    after = update(seen(far, view), Plots(far.x[-1, :, :2]))
    assert after.log_p_bar.tolist() == [0.0]
    np.testing.assert_allclose(after.density.x, far.x)
    np.testing.assert_allclose(after.density.P, far.P)


def test_a_batch_with_boxes_and_padding_is_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    both, z, view = flat()
    whole = update(seen(both, view), Plots(z))
    monkeypatch.setattr(association, "_FEW_PAIRS", 1)
    for plots in (Plots(z), Plots(np.r_[z, np.full((2, 2), np.nan)], np.arange(len(z) + 2) < len(z))):
        boxed = update(seen(both, view), plots)
        np.testing.assert_allclose(boxed.log_p_bar, whole.log_p_bar, rtol=1e-12, atol=1e-14)
    for row in range(5):
        alone = Gaussian(both.x[:, row : row + 1], both.P[:, row : row + 1])
        log_p_bar = update(seen(alone, view), Plots(z)).log_p_bar
        np.testing.assert_allclose(log_p_bar, whole.log_p_bar[row], rtol=1e-12, atol=1e-14)
    own = Plots(np.repeat(z[None], 5, axis=0))
    np.testing.assert_allclose(update(seen(both, view), own).log_p_bar, whole.log_p_bar, rtol=1e-12, atol=1e-14)


def test_every_filter_weighs_alike() -> None:
    """Mixtures and their ancestry, several models, extraction, clusters, and a notch that covers nothing."""
    both, z, view = flat()
    one = Gaussian(both.x[-1:], both.P[-1:])
    sensor = Sensor(Position((30.0, 40.0), 4), P_D, 1.0, view.shape)
    log_rho_f = sensor.log_rho_f
    clutter = Clutter(np.full(5, P_D), np.array(log_rho_f), 0.999, view)
    linear = sensor.measurement.linearise(one, np.zeros(2))
    expected = expect(one, linear, clutter)
    log_p_bar = update(expected, Plots(z)).log_p_bar
    components = Gaussian(one.x[:, :, None], one.P[:, :, None])
    prior = Mixture(np.zeros((5, 1)), np.zeros((5, 1)), components)
    wide = expect(
        components, sensor.measurement.linearise(components, np.zeros(2)), clutter._replace(p_d=clutter.p_d[:, None])
    )
    for after in (step(prior, wide, Plots(z), EXACT), step_traced(prior, wide, Plots(z), EXACT)[0]):
        np.testing.assert_allclose(np.logaddexp.reduce(after.log_g, axis=-1), log_p_bar, rtol=1e-12)
    modes = Modes(np.zeros((5, 1)), Gaussian(one.x[0][:, None], one.P[0][:, None]))
    several = imm_pdaf(modes, Plots(z), sensor.measurement.linearise(modes.densities, np.zeros(2)), clutter)
    np.testing.assert_allclose(several.log_p_bar, log_p_bar, rtol=1e-12)
    clear = hypotheses(expected, Plots(z), Notch(1e-12), np.zeros(2)).log_p_star[0]
    np.testing.assert_allclose(np.logaddexp.reduce(clear, axis=-1), log_p_bar, rtol=1e-9)
    scan = SensorScan(0.0, sensor, np.zeros(2), np.zeros(2), Plots(z))
    limits, still = thresholds(1e-300, 1.0 - 1e-15), ConstantVelocity(2, 1e-12)
    start = candidates(np.arange(5), Gaussian(one.x[0][:, None], one.P[0][:, None]))
    found = next(extract(Extractor(still, limits, EXACT, 0.999), start, 0.0, [scan]))
    np.testing.assert_allclose(found.log_lr, log_p_bar, rtol=1e-9)
    group = cluster(Gaussian(one.x[0, 1:2], one.P[0, 1:2]), 1)
    last = next(extract_cluster(ClusterTest(still, limits, gate_probability=0.999), group, 0.0, [scan]))
    np.testing.assert_allclose(last.log_lr, log_p_bar[1:2], rtol=1e-9)


@pytest.mark.parametrize("shape", [Box((200.0, 160.0)), Disc(100.0, 2)])
def test_without_a_target_the_weight_sum_is_one_on_average(shape: FieldOfView) -> None:
    """Plots are then false ones, of the density rho_f in the view: else log LR would drift and its test err.

    What a target at the edge causes beyond it is missing: 5 % of the hits here.
    """
    vague = Gaussian(np.array([[60.0, -40.0, 0.0, 0.0]]), np.diag([9e4, 9e4, 1.0, 1.0])[None])
    linear = Position((5.0, 5.0), 4).linearise(vague, np.zeros(2))
    clutter = Clutter(np.asarray(P_D), np.array(LOG_RHO_F), 1.0, View(shape, np.zeros(2)))
    expected = expect(vague, linear, clutter)
    grid = np.linspace(-100.0, 100.0, 201)[:-1] + 0.5
    z = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    z = z[shape.contains(z, np.zeros(2))]
    weights = np.exp(weights_alone(expected, within_reach(expected, Plots(z))))
    hits = np.exp(LOG_RHO_F) * weights[1:].sum()
    assert 0.03 < 1.0 - weights[0] < 0.06
    assert hits == pytest.approx(1.0 - weights[0], rel=0.05)


def test_where_detection_depends_on_the_state_its_mean_stays() -> None:
    both, _, view = flat()
    swerling = Sensor(Position((30.0, 40.0), 4), P_D, 1.0, view.shape, Swerling(1e-4, 30.0, 1000.0))
    share = swerling.detection_probability(Gaussian(both.x[-1], both.P[-1]), np.zeros(2)) / P_D
    assert 0.2 < share.min() < share.max() < 1.0
    linear = swerling.measurement.linearise(both, np.zeros(2))
    ours = expect(both, linear, Clutter(P_D * share, np.array(LOG_RHO_F), 0.999, swerling.view(np.zeros(2))))
    plain = seen(both, view)
    hit = plain.edge
    np.testing.assert_allclose((ours.log_hit - plain.log_hit)[hit], np.log(share[hit]), rtol=1e-9)
    missed = 1.0 - (1.0 - np.exp(plain.log_miss)) * share
    np.testing.assert_allclose(np.exp(ours.log_miss), missed, rtol=1e-9)
