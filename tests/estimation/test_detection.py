"""Detection probabilities against dense quadrature and simulation."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from waldnet.common.estimation.detection import (
    Constant,
    Detection,
    Notch,
    Swerling,
    cumulative,
    cumulative_rate,
    revisit_interval,
)
from waldnet.common.estimation.field_of_view import Disc, Everywhere
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.sensing import Position, Sensor

Draw: TypeAlias = Callable[..., Gaussian]

SEEDS = st.integers(0, 2**32 - 1)
SWERLING, NOTCH = Swerling(1e-4, 10.0**1.3, 10_000.0), Notch(4.0)
STAND = np.array([300.0, -200.0])


def state(distance: float) -> Array:
    return np.array([STAND[0] + 0.6 * distance, STAND[1] - 0.8 * distance, 10.0, 20.0])


def test_swerling_is_the_formula() -> None:
    """13 dB, that is 20 times the noise, at 10 km; 16 times that at 5 km, a 16th at 20 km."""
    for distance, snr in ((10_000.0, 10.0**1.3), (5000.0, 16.0 * 10.0**1.3), (20_000.0, 10.0**1.3 / 16.0)):
        assert SWERLING.share(state(distance), STAND) == pytest.approx(1e-4 ** (1.0 / (1.0 + snr)), rel=1e-9)
    assert SWERLING.share(state(0.0), STAND) == 1.0
    assert SWERLING.share(state(1e9), STAND) == pytest.approx(1e-4, rel=1e-6)


def test_the_notch_is_the_formula() -> None:
    for speed in (0.0, 1.0, 4.0, -8.0, 30.0):
        x = np.array([STAND[0], STAND[1] + 5000.0, 99.0, speed])
        assert NOTCH.share(x, STAND) == pytest.approx(1.0 - 2.0 ** (-((speed / 4.0) ** 2)), abs=1e-12)
    c_n = np.sqrt(2.0 * np.pi * NOTCH.v_n)
    normal = np.exp(-0.5 * 3.0**2 / NOTCH.v_n) / np.sqrt(2.0 * np.pi * NOTCH.v_n)
    assert NOTCH.share(np.array([0.0, 5000.0, 0.0, 3.0]), np.zeros(2)) == pytest.approx(1.0 - c_n * normal)


def dense(model: Detection, track: Gaussian, nodes: int = 30) -> float:
    """Mean of the share by a product rule over all four numbers of the state."""
    node, weight = np.polynomial.hermite_e.hermegauss(nodes)
    w = np.stack(np.meshgrid(*[weight / weight.sum()] * 4, indexing="ij")).prod(axis=0).ravel()
    xi = np.stack(np.meshgrid(*[node] * 4, indexing="ij"), axis=-1).reshape(-1, 4)
    return float(w @ model.share(track.x + xi @ np.linalg.cholesky(track.P).T, STAND))


@pytest.mark.parametrize("distance", [3000.0, 8000.0, 10_000.0, 14_000.0, 25_000.0])
@pytest.mark.parametrize(("sigma", "tolerance"), [(100.0, 1e-9), (500.0, 1e-8), (1000.0, 1e-7)])
def test_the_mean_of_swerling_is_that_of_dense_quadrature(distance: float, sigma: float, tolerance: float) -> None:
    track = Gaussian(state(distance), np.diag([sigma**2, 0.5 * sigma**2, 100.0, 100.0]))
    assert SWERLING.mean_share(track, STAND) == pytest.approx(dense(SWERLING, track, 16), abs=tolerance)


@pytest.mark.parametrize("speed", [0.0, 3.0, 20.0])
@pytest.mark.parametrize(("sigma", "tolerance"), [(1.0, 1e-6), (100.0, 5e-4)])
def test_the_mean_of_the_notch_is_that_of_dense_quadrature(speed: float, sigma: float, tolerance: float) -> None:
    """At 10 km; only that the line of sight turns with the position is left out."""
    track = Gaussian(np.array([STAND[0], STAND[1] + 10_000.0, 20.0, speed]), np.diag([sigma**2, sigma**2, 9.0, 9.0]))
    assert NOTCH.mean_share(track, STAND) == pytest.approx(dense(NOTCH, track, 24), abs=tolerance)


@settings(max_examples=50, deadline=None, derandomize=True, database=None)
@given(SEEDS, st.floats(1e-3, 1e6), st.sampled_from([SWERLING, NOTCH, Constant()]))
def test_means_are_probabilities(draw: Draw, seed: int, spread: float, model: Detection) -> None:
    track = draw(np.random.default_rng(seed), (5,), 4, spread)
    mean = model.mean_share(track, STAND)
    assert ((mean >= 0.0) & (mean <= 1.0 + 1e-12)).all()


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2)])
@pytest.mark.parametrize("model", [SWERLING, NOTCH, Constant()])
@pytest.mark.parametrize("d", [2, 3])
def test_a_batch_equals_the_loop(draw: Draw, model: Detection, shape: tuple[int, ...], d: int) -> None:
    x, P = draw(np.random.default_rng(2), shape, 2 * d, 3000.0)
    stand = np.zeros(d)
    means, shares = model.mean_share(Gaussian(x, P), stand), model.share(x, stand)
    assert means.shape == shares.shape == shape
    for i in np.ndindex(shape):
        assert means[i] == pytest.approx(float(model.mean_share(Gaussian(x[i], P[i]), stand)), abs=1e-12)
        assert shares[i] == pytest.approx(float(model.share(x[i], stand)), abs=1e-12)


def test_a_sensor_weights_it_with_p_d() -> None:
    track = Gaussian(np.array([1000.0, 0.0, 0.0, 0.0]), np.diag([1e4, 1e4, 9.0, 9.0]))
    sensor = Sensor(Position((1.0, 1.0), 4), 0.8, 1.0, Disc(1000.0, 2), NOTCH)
    p_d = sensor.detection_probability(track, np.zeros(2))
    assert p_d == pytest.approx(0.8 * float(NOTCH.mean_share(track, np.zeros(2))))


@pytest.mark.parametrize("model", [SWERLING, NOTCH])
def test_simulated_detections_have_the_probability(model: Detection) -> None:
    """5 standard deviations."""
    sensor = Sensor(Position((1.0, 1.0), 4), 0.8, 1.0, Everywhere(1.0, 2), model)
    x = np.tile(np.array([12_000.0, 500.0, 5.0, 40.0]), (50_000, 1))
    seen = sensor.draw_seen(np.random.default_rng(1), x, STAND, np.zeros(2)).mean()
    p = 0.8 * float(model.share(x[0], STAND))
    assert 0.1 < p < 0.75
    assert abs(seen - p) < 5.0 * np.sqrt(p * (1.0 - p) / len(x))


def test_cumulative_detection_is_that_of_simulated_sensors() -> None:
    """5 standard deviations."""
    p_d = np.array([0.1, 0.5, 0.3])
    hits = np.random.default_rng(1).random((100_000, 3)) < p_d
    p = float(cumulative(p_d))
    assert abs(hits.any(axis=-1).mean() - p) < 5.0 * np.sqrt(p * (1.0 - p) / len(hits))
    assert cumulative(np.array([[1.0, 0.2], [0.0, 0.0]])).tolist() == [1.0, 0.0]


def test_the_revisit_interval_is_that_of_simulated_scans() -> None:
    """Scans at random phases in an hour: as many as one sensor with the mean interval would make."""
    intervals = np.array([2.0, 5.0, 0.7])
    rng = np.random.default_rng(2)
    count = sum(len(np.arange(rng.uniform(0.0, dt), 3600.0, dt)) for dt in intervals)
    assert 3600.0 / float(revisit_interval(intervals)) == pytest.approx(count, abs=3.0)
    assert revisit_interval(np.full((2, 4), 8.0)).tolist() == [2.0, 2.0]


def test_the_mean_cumulative_probability_is_that_of_simulated_scans() -> None:
    """Its complement to the power of the number of mean intervals is the chance that nobody ever detects."""
    p_d, intervals = np.array([0.02, 0.1]), np.array([1.0, 3.0])
    rng, span = np.random.default_rng(3), 12.0
    missed = (rng.random((200_000, 12)) >= 0.02).all(axis=-1) & (rng.random((200_000, 4)) >= 0.1).all(axis=-1)
    never = (1.0 - float(cumulative_rate(p_d, intervals))) ** (span / float(revisit_interval(intervals)))
    assert abs(missed.mean() - never) < 5.0 * np.sqrt(never * (1.0 - never) / len(missed))
    assert cumulative_rate(np.full(3, 0.4), np.full(3, 6.0)) == pytest.approx(0.4)
    assert cumulative_rate(np.array([1.0, 0.4]), np.ones(2)) == 1.0
