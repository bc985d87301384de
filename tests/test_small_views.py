"""Vague tracks and small fields of view, in every mode, against the likelihood ratio that is integrated directly."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from builders import hypothesis_table, only, scenario, sensor_table
from numpy.typing import NDArray

from waldnet.common.config import Scenario
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.messages import Scan, Tracks
from waldnet.offline.centralised import Centralised
from waldnet.offline.replay import Replay
from waldnet.studies import baselines
from waldnet.studies.course import Look, Worlds

Array = NDArray[np.float64]

RADIUS, SPREAD, NOISE, P_D, FALSE = 100.0, 300.0, 10.0, 0.9, 1e-6
#: The target is somewhere within 300 m and does not move.
STILL: dict[str, Any] = {
    "hypothesis": [hypothesis_table(state=[40.0, -30.0, 0.0, 0.0], sigma=[SPREAD, SPREAD, 1e-6, 1e-6])],
    "motion": {"psd": 1e-15},
    "decision": {"enabled": False},
}
SMALL = sensor_table(
    "a",
    position=[0.0, 0.0],
    sigma=[NOISE, NOISE],
    p_d=P_D,
    false_plots=FALSE,
    field_of_view={"shape": "disc", "radius": RADIUS},
)
#: Never sees anything of the track, so that a factor is half of what is known.
ELSEWHERE = SMALL | {"name": "b", "position": [1e6, 0.0]}

#: Nothing is combined: a vague history is near every other one.
APART = {"components": 40, "prune": 0.0, "combine": 0.0}
NETWORKS: dict[str, tuple[tuple[dict[str, Any], ...], dict[str, Any]]] = {
    "tight": ((SMALL, ELSEWHERE), {}),
    "factor": ((SMALL,), {"association": "factor"}),
    "mirrored": ((SMALL, ELSEWHERE), {"association": "mirrored", "terms": 40, "mixture": APART}),
    "selected": ((SMALL, ELSEWHERE), {"mode": "selected", "mixture": APART}),
    "nearest": ((SMALL, ELSEWHERE), {"filter": "nearest"}),
    "advice": ((SMALL, ELSEWHERE), {"feedback": "advice"}),
    "reset": ((SMALL, ELSEWHERE), {"feedback": "reset"}),
}
Course = Callable[[Scenario, list[Scan]], list[float]]


def replayed(plot: Scenario, scans: list[Scan]) -> list[float]:
    return [float(tracks.log_lr_total[0]) for tracks in only(Tracks, Replay(plot, scans).run())]


def centralised(plot: Scenario, scans: list[Scan]) -> list[float]:
    return [float(tracks.log_lr_total[0]) for tracks in only(Tracks, Centralised.of(plot).run(scans))]


def exact(scans: list[list[tuple[float, float]]]) -> float:
    """Log of the integral of Eq. (1) over the places of a target, by quadrature in polar coordinates around the view.

    Outside it every scan gives the factor 1, so the integral there is the prior's.
    """
    nodes, weights = np.polynomial.legendre.leggauss(200)
    r, angle = 0.5 * RADIUS * (nodes + 1.0), 2.0 * np.pi * np.arange(400) / 400
    place = r[:, None, None] * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    area = (0.5 * RADIUS * weights * r)[:, None] * (2.0 * np.pi / 400)

    def normal(z: Any, sigma: float) -> Array:
        density: Array = np.exp(-0.5 * np.square((place - z) / sigma).sum(axis=-1)) / (2.0 * np.pi * sigma**2)
        return density

    prior, rho_f = area * normal([40.0, -30.0], SPREAD), FALSE / (np.pi * RADIUS**2)
    ratio = np.ones_like(prior)
    for plots in scans:
        ratio *= 1.0 - P_D + P_D / rho_f * sum((normal(z, NOISE) for z in plots), np.zeros_like(prior))
    return float(np.log(1.0 + (prior * (ratio - 1.0)).sum()))


def scan(plot: Scenario, number: int, plots: list[tuple[float, float]]) -> Scan:
    return Scan("a", plot.to_ns(2.0 * number), np.zeros(2), np.array(plots).reshape(-1, 2))


#: Amid the view, at its edge, outside, several. Far from each other, so that no mode has to merge what is alike.
SCANS: dict[str, list[tuple[float, float]]] = {
    "miss": [],
    "amid": [(30.0, 10.0)],
    "at the edge": [(0.0, 97.0)],
    "outside": [(-74.0, 84.0)],
    "far outside": [(250.0, 0.0)],
    "several": [(30.0, 10.0), (0.0, 97.0), (-104.0, 3.0)],
}


@pytest.mark.parametrize("plots", SCANS.values(), ids=SCANS.keys())
@pytest.mark.parametrize("network", ["tight", "factor", "mirrored", "selected", "advice", "reset"])
def test_one_scan_gives_the_exact_ratio(network: str, plots: list[tuple[float, float]]) -> None:
    """Eq. (6a). A gate of probability 0.9997 takes 3e-4."""
    sensors, fusion = NETWORKS[network]
    if len(plots) > 1 and network in ("tight", "advice", "reset"):
        sensors = (SMALL,)  # with several plots a wider factor is an approximation, whatever the view
    plot = scenario(*sensors, fusion=fusion, **STILL)
    assert replayed(plot, [scan(plot, 1, plots)])[-1] == pytest.approx(exact([plots]), abs=2e-3)


@pytest.mark.parametrize("plots", SCANS.values(), ids=SCANS.keys())
@pytest.mark.parametrize("fusion", [{}, {"filter": "mht", "mixture": APART}], ids=["pdaf", "mht"])
def test_one_scan_gives_the_exact_ratio_where_nothing_is_distributed(
    fusion: dict[str, Any], plots: list[tuple[float, float]]
) -> None:
    plot = scenario(SMALL, fusion=fusion, **STILL)
    one = scan(plot, 1, plots)
    assert centralised(plot, [one])[-1] == pytest.approx(exact([plots]), abs=2e-3)
    z = np.array(plots).reshape(1, -1, 2)
    looks = (Look(one.time_ns, 0, SensorPose(np.zeros(2)), baselines.Plots(z), np.array([len(plots)])),)
    worlds = Worlds(seeds=(1,), truth=np.empty((1, 0, 4)), times_ns=np.empty(0, np.int64), looks=looks)
    for study in (baselines.centralised(plot, worlds, **fusion), baselines.decentralised_mean(plot, worlds)):
        assert study.log_lr[0, -1] == pytest.approx(exact([plots]), abs=2e-3)


#: First a plot amid the view, after which the track is inside; then misses and more plots.
ROW: list[list[tuple[float, float]]] = [[(30.0, 10.0)], [], [(22.0, 3.0)], [], [(35.0, 14.0), (-60.0, 40.0)], []]


@pytest.mark.parametrize("network", ["tight", "mirrored", "selected", "advice", "reset"])
def test_a_track_that_was_found_costs_nothing_for_good(network: str) -> None:
    """With the prior probability in the weight of the first plot log LR would stay 2.9 too low."""
    sensors, fusion = NETWORKS[network]
    plot = scenario(*sensors, fusion=fusion, **STILL)
    course = replayed(plot, [scan(plot, number, plots) for number, plots in enumerate(ROW, start=1)])
    assert course == pytest.approx([exact(ROW[: k + 1]) for k in range(len(ROW))], abs=0.02)


def test_nearest_neighbour_takes_the_plot_that_is_in_view() -> None:
    """The plot outside is nearer to what was expected, and cannot be the target's."""
    sensors, fusion = NETWORKS["nearest"]
    plot = scenario(*sensors, fusion=fusion, **STILL)
    (log_lr,) = replayed(plot, [scan(plot, 1, [(120.0, -90.0), (-30.0, 20.0)])])
    assert log_lr == pytest.approx(exact([[(-30.0, 20.0)]]), abs=2e-3)
