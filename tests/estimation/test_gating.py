from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from common.estimation.association import Clutter, pdaf
from common.estimation.gating import candidates
from common.estimation.gaussian import Gaussian
from common.estimation.sensing import Position

SENSOR = Position((50.0, 20.0), 4)
ORIGIN = np.zeros(2)


def world(rng: np.random.Generator, tracks: int, plots: int, extent: float = 3e4) -> tuple[Gaussian, Any]:
    x = np.concatenate([rng.uniform(-extent, extent, (tracks, 2)), rng.normal(0, 50, (tracks, 2))], axis=-1)
    root = rng.normal(0, 60, (tracks, 4, 4)) * rng.uniform(0.1, 5.0, (tracks, 1, 1))
    z = np.concatenate([rng.uniform(-extent, extent, (plots, 2)), x[:, :2] + rng.normal(0, 100, (tracks, 2))])
    return Gaussian(x, root @ root.mT + np.eye(4)), z[rng.permutation(len(z))]


def filtered(tracks: Gaussian, plots: Any, p_g: float) -> Any:
    clutter = Clutter(np.full(len(tracks.x), 0.9), np.array(-15.0), p_g)
    return pdaf(tracks, plots, SENSOR.linearise(tracks.x, ORIGIN), clutter)


@pytest.mark.parametrize(("tracks", "plots"), [(300, 500), (1, 9000), (3000, 2), (80, 80)])
@pytest.mark.parametrize("p_g", [0.5, 0.9997, 1.0 - 1e-12])
def test_a_filter_does_not_miss_the_plots_left_out(tracks: int, plots: int, p_g: float) -> None:
    density, z = world(np.random.default_rng(tracks), tracks, plots)
    few = candidates(z, density, SENSOR.linearise(density.x, ORIGIN), p_g)
    assert few.z.shape[:-1] == few.valid.shape == (tracks, few.valid.shape[1])
    assert few.valid.sum() < 0.5 * tracks * len(z)
    everything = candidates(z, density, SENSOR.linearise(density.x, ORIGIN), 1.0)
    (few_x, few_P), few_log = filtered(density, few, p_g)
    (all_x, all_P), all_log = filtered(density, everything, p_g)
    np.testing.assert_allclose(few_x, all_x, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(few_P, all_P, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(few_log, all_log, rtol=1e-12, atol=1e-12)


def test_without_a_gate_every_plot_counts() -> None:
    density, z = world(np.random.default_rng(1), 100, 100)
    plots = candidates(z, density, SENSOR.linearise(density.x, ORIGIN), 1.0)
    assert plots.z is z
    assert plots.valid.all()


@pytest.mark.parametrize(("tracks", "plots"), [(0, 0), (0, 9000), (9000, 0), (1, 1)])
def test_no_track_or_no_plot(tracks: int, plots: int) -> None:
    density = Gaussian(np.zeros((tracks, 4)), np.repeat(np.eye(4)[None], tracks, axis=0))
    found = candidates(np.ones((plots, 2)), density, SENSOR.linearise(density.x, ORIGIN), 0.99)
    assert len(found.z) == plots


def test_a_scan_far_from_every_track_is_an_empty_scan() -> None:
    density, _ = world(np.random.default_rng(1), 1000, 0)
    z = np.full((1000, 2), 1e8)
    found = candidates(z, density, SENSOR.linearise(density.x, ORIGIN), 0.9997)
    assert not found.valid.any()
    (x, _), log_p_bar = filtered(density, found, 0.9997)
    np.testing.assert_array_equal(x, density.x)
    np.testing.assert_allclose(log_p_bar, np.log1p(-0.9 * 0.9997))
