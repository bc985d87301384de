from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from waldnet.common.estimation import association
from waldnet.common.estimation.association import Clutter, Plots, expect, update, within_reach
from waldnet.common.estimation.gating import inside_boxes
from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.estimation.polar import Polar
from waldnet.common.estimation.sensing import Position

SENSOR = Position((50.0, 20.0), 4)
ORIGIN = np.zeros(2)


def tracks_on_a_field(rng: np.random.Generator, tracks: int, extent: float) -> Gaussian:
    x = np.concatenate([rng.uniform(-extent, extent, (tracks, 2)), rng.normal(0, 50, (tracks, 2))], axis=-1)
    root = rng.normal(0, 60, (tracks, 4, 4)) * rng.uniform(0.1, 5.0, (tracks, 1, 1))
    return Gaussian(x, root @ root.mT + np.eye(4))


def world(tracks: int, plots: int, extent: float = 3e4) -> tuple[Gaussian, Any]:
    rng = np.random.default_rng(tracks)
    density = tracks_on_a_field(rng, tracks, extent)
    near = density.x[:100, :2] + rng.normal(0, 100, (min(tracks, 100), 2))
    z = np.concatenate([rng.uniform(-extent, extent, (plots, 2)), near])
    return density, z[rng.permutation(len(z))]


def filtered(density: Gaussian, z: Any, p_g: float) -> list[Any]:
    """Both filters, flat."""
    clutter = Clutter(np.full(len(density.x), 0.9), np.array(-15.0), p_g)
    both = Gaussian(np.stack([density.x, density.x]), np.stack([4.0 * density.P, density.P]))
    (x, P), log_p_bar = update(expect(both, SENSOR.linearise(both, ORIGIN), clutter), Plots(z))
    return [x[1], P[1], log_p_bar, x[0], P[0]]


@pytest.mark.parametrize(("tracks", "plots"), [(300, 500), (1, 9000), (3000, 2), (80, 80)])
@pytest.mark.parametrize("p_g", [0.5, 0.9997, 1.0 - 1e-12, 1.0])
def test_plots_out_of_reach_change_nothing(
    tracks: int, plots: int, p_g: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    density, z = world(tracks, plots)
    few = filtered(density, z, p_g)
    monkeypatch.setattr(association, "_FEW_PAIRS", 10**9)
    for got, expected in zip(few, filtered(density, z, p_g), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize(("tracks", "plots"), [(0, 0), (0, 9000), (9000, 0), (1, 1)])
def test_no_track_or_no_plot(tracks: int, plots: int) -> None:
    density = Gaussian(np.zeros((tracks, 4)), np.repeat(np.eye(4)[None], tracks, axis=0))
    assert len(filtered(density, np.ones((plots, 2)), 0.99)[0]) == tracks


@pytest.mark.parametrize("shared", [True, False])
def test_near_plots_keep_their_numbers_and_are_chosen_once(shared: bool) -> None:
    density, z = world(300, 500)
    one = Gaussian(density.x[None, :, None], density.P[None, :, None])
    clutter = Clutter(np.full((300, 1), 0.9), np.array(-15.0), 0.99)
    expected = expect(one, SENSOR.linearise(one, ORIGIN), clutter)
    near = within_reach(expected, Plots(z if shared else np.tile(z, (300, 1, 1, 1))))
    assert near.number is not None
    assert near.valid is not None
    assert near.number.shape[-1] < len(z)
    np.testing.assert_array_equal(near.z[near.valid], z[near.number[near.valid]])
    assert within_reach(expected, near) is near


def test_a_scan_far_from_every_track_is_an_empty_scan() -> None:
    density, _ = world(1000, 0)
    x, _, log_p_bar, *_ = filtered(density, np.full((1000, 2), 1e8), 0.9997)
    np.testing.assert_array_equal(x, density.x)
    np.testing.assert_allclose(log_p_bar, np.log1p(-0.9 * 0.9997))


@pytest.mark.parametrize("m", [1, 2, 3])
def test_boxes_hold_what_brute_force_finds(m: int) -> None:
    rng = np.random.default_rng(m)
    z, centers = rng.uniform(0, 10, (200, m)), rng.uniform(0, 10, (150, m))
    reach = rng.uniform(0, 2, (150, m))
    near = inside_boxes(z, centers, reach)
    inside = (np.abs(z - centers[:, None]) <= reach[:, None]).all(axis=-1)
    for track in range(150):
        assert sorted(near.which[track][near.valid[track]]) == list(np.flatnonzero(inside[track]))
    assert near.valid.shape[1] == inside.sum(axis=1).max()


def test_boxes_around_the_circle_hold_what_brute_force_finds() -> None:
    rng = np.random.default_rng(4)
    z = np.stack([rng.uniform(0, 10, 200), rng.uniform(-np.pi, np.pi, 200)], axis=-1)
    centers = np.stack([rng.uniform(0, 10, 150), rng.uniform(-np.pi, np.pi, 150)], axis=-1)
    centers[:5, 1] = [np.pi, -np.pi, 3.1, -3.1, 0.0]
    reach = np.stack([rng.uniform(0, 2, 150), rng.uniform(0, 4, 150)], axis=-1)
    near = inside_boxes(z, centers, reach, angular=(1,))
    turned = np.abs(np.angle(np.exp(1j * (z[:, 1] - centers[:, None, 1]))))
    inside = (np.abs(z[:, 0] - centers[:, None, 0]) <= reach[:, None, 0]) & (turned <= reach[:, None, 1])
    for track in range(150):
        assert sorted(near.which[track][near.valid[track]]) == list(np.flatnonzero(inside[track]))


@pytest.mark.parametrize("stand", [[0.0, 0.0], [-4e4, 1e3]])
def test_plots_out_of_reach_change_nothing_for_a_radar_that_sees_all_around(
    stand: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    radar, place = Polar((15.0, 0.004), 4), np.array(stand)
    density, z = world(300, 500)
    z = radar.fold(radar.observe(np.hstack([z, np.zeros_like(z)]), place))
    both = Gaussian(np.stack([density.x, density.x]), np.stack([4.0 * density.P, density.P]))
    expected = expect(both, radar.linearise(both, place), Clutter(np.full(300, 0.9), np.array(-9.0), 0.9997))
    near = within_reach(expected, Plots(z))
    assert near.number is not None
    assert near.number.shape[-1] < len(z)
    few = update(expected, Plots(z))
    monkeypatch.setattr(association, "_FEW_PAIRS", 10**9)
    for got, all_of_them in zip(flat(few), flat(update(expected, Plots(z))), strict=True):
        np.testing.assert_allclose(got, all_of_them, rtol=1e-9, atol=1e-7)


def flat(filtered: Any) -> list[Any]:
    return [*filtered.density, filtered.log_p_bar]
