"""Every motion model through a whole network: without doubt about plots it is the centralised Kalman filter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builders import scenario, sensor_table
from scipy.linalg import expm
from scipy.stats import multivariate_normal

from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Array
from waldnet.common.messages import Scan, Tracks
from waldnet.offline.replay import Replay
from waldnet.scenarios.world import simulate_all, truth

AREA = 1e8
SIGMA, INTERVALS = {"a": 40.0, "b": 25.0}, {"a": 2.0, "b": 3.5}


def swept(left: float, q: float) -> tuple[Array, Array]:
    """Drift and diffusion of a velocity that turns."""
    A = np.eye(4, k=2)
    A[3, 2], A[2, 3] = left, -left
    return A, np.diag([0.0, 0.0, q, q])


#: Motion table; drift and diffusion of what it says.
MOTIONS: dict[str, tuple[dict[str, Any], tuple[Array, Array]]] = {
    "cv": ({"psd": 2.0}, swept(0.0, 2.0)),
    "ca": ({"model": "ca", "psd": 0.1}, (np.eye(6, k=2), np.diag([0.0] * 4 + [0.1] * 2))),
    "ct": ({"model": "ct", "psd": 2.0, "turn_rate": -0.1}, swept(-0.1, 2.0)),
}


def network(motion: dict[str, Any], n: int) -> Scenario:
    sensors = [
        sensor_table(
            name,
            sigma=[SIGMA[name]] * 2,
            p_d=1.0,
            false_plots=1.0,
            field_of_view={"shape": "everywhere", "area": AREA},
            scan_interval=INTERVALS[name],
        )
        for name in SIGMA
    ]
    prior = {"state": [0.0, 0.0, 60.0, 10.0, 0.5, -0.5][:n], "sigma": [100.0, 100.0, 20.0, 20.0, 2.0, 2.0][:n]}
    return scenario(
        *sensors,
        motion=motion,
        hypothesis=[prior],
        fusion={"mode": "dkf", "gate_probability": 1.0},
        decision={"enabled": False},
        simulation={"duration": 42.0},
    )


def true_plots(plot: Scenario) -> list[Scan]:
    """One plot a scan, of the target."""
    world, rng, scans = truth(plot, 3), np.random.default_rng(4), []
    for scan in simulate_all(plot, 3):
        state = world.x[0, np.searchsorted(world.times_ns, scan.time_ns)]
        scans.append(scan._replace(z=state[None, :2] + rng.normal(0.0, SIGMA[scan.sensor], (1, 2))))
    return scans


@pytest.mark.parametrize("kind", MOTIONS)
def test_a_network_of_sensors_that_see_all_is_the_kalman_filter(kind: str) -> None:
    motion, (A, G) = MOTIONS[kind]
    n = len(A)
    plot = network(motion, n)
    scans = true_plots(plot)
    x, P = plot.hypotheses[0].density
    log_lr, now_ns = 0.0, plot.epoch_ns
    for scan in scans:
        dt = (scan.time_ns - now_ns) / 1e9
        M = expm(np.block([[-A, G], [np.zeros((n, n)), A.T]]) * dt)
        F = M[n:, n:].T
        x, P = F @ x, F @ P @ F.T + F @ M[:n, n:]
        S = P[:2, :2] + SIGMA[scan.sensor] ** 2 * np.eye(2)
        log_lr += float(multivariate_normal(x[:2], S).logpdf(scan.z[0])) + np.log(AREA)
        K = P[:, :2] @ np.linalg.inv(S)
        x, P, now_ns = x + K @ (scan.z[0] - x[:2]), P - K @ S @ K.T, scan.time_ns
    ours = [message for message in Replay(plot, scans).run() if isinstance(message, Tracks)][-1]
    assert ours.log_lr_total[0] == pytest.approx(log_lr, rel=1e-9)
    np.testing.assert_allclose(ours.x[0], x, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(ours.P[0], P, rtol=1e-6, atol=1e-7)
