"""Fixed lag: the center's tracks a few seconds ago, against batch least squares, and how much closer to the truth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from builders import scenario, sensor_table
from enumeration import Problem, least_squares
from scipy.stats import chi2, t

from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.motion import ConstantVelocity, predict
from waldnet.common.messages import Tracks
from waldnet.common.process import main
from waldnet.common.quantities import NS_PER_S
from waldnet.fusion_center.lag import FixedLag, Past
from waldnet.launch.cli import app
from waldnet.studies.course import Worlds
from waldnet.studies.modes import play
from waldnet.studies.worlds import draw

MOTION = ConstantVelocity(2, 3.0)
H, R = np.eye(2, 4), np.diag([16.0, 49.0])
PRIOR = Gaussian(np.array([0.0, 0.0, 6.0, -4.0]), np.diag([900.0, 400.0, 64.0, 100.0]))


def tracks(time_s: float, ids: Sequence[int], x: Array, P: Array) -> Tracks:
    count = len(ids)
    return Tracks(
        time_ns=round(time_s * NS_PER_S),
        sensors=("a",),
        ids=np.array(ids, np.int64),
        status=np.full(count, 1, np.uint8),
        scans=np.ones(count, np.int64),
        contributing=np.ones((count, 1), np.bool_),
        log_lr=np.arange(count) + 10.0 * time_s,
        log_lr_total=np.arange(count) + 10.0 * time_s,
        x=x,
        P=P,
        supported_ns=np.zeros(len(ids), np.int64),
    )


def kalman(times_s: Sequence[float], seed: int) -> tuple[list[Array], list[Gaussian]]:
    """Plots of each time, and what a Kalman filter says after them."""
    rng, density, now = np.random.default_rng(seed), PRIOR, 0.0
    plots, densities = [], []
    for time_s in times_s:
        dt = np.array(time_s - now)
        density, now = predict(density, MOTION.transition(dt), MOTION.noise(dt)), time_s
        z = rng.normal(0.0, 20.0, (1, 2))
        K = density.P @ H.T @ np.linalg.inv(H @ density.P @ H.T + R)
        density = Gaussian(density.x + K @ (z[0] - H @ density.x), density.P - K @ H @ density.P)
        plots.append(z)
        densities.append(density)
    return plots, densities


def smoothed(times_s: Sequence[float], plots: Sequence[Array], then_s: float) -> tuple[Array, Array]:
    """Batch least squares of all plots, with the state of a further time among the unknowns."""
    every = sorted({*times_s, then_s})
    dt = np.diff([0.0, *every])
    seen = dict(zip(times_s, plots, strict=True))
    scans = [seen.get(time_s, np.zeros((0, 2))) for time_s in every]
    count = len(every)
    F, Q = list(MOTION.transition(dt)), list(MOTION.noise(dt))
    problem = Problem(*PRIOR, F, Q, scans, count * [H], count * [R], count * [0.5], count * [1.0])
    x, P = least_squares(problem, tuple(len(scan) - 1 for scan in scans))
    at = every.index(then_s)
    return x[at], P[at]


TIMES = (1.0, 2.5, 3.0, 5.0, 5.5, 8.0)


@pytest.mark.parametrize("lag_s", [0.0, 1.0, 2.5, 3.0, 4.2])
def test_the_lagged_state_is_a_batch_least_squares_solution(lag_s: float) -> None:
    """At measurement times and between them; two tracks at once, one of which starts later."""
    lag, past = FixedLag(MOTION, round(lag_s * NS_PER_S), window_ns=0), ()
    runs = [kalman(TIMES, 1), kalman(TIMES[2:], 2)]
    compared = 0
    for k, time_s in enumerate(TIMES):
        there = [
            (number, densities[k - late])
            for number, (late, (_, densities)) in enumerate(zip((0, 2), runs, strict=True))
            if k >= late
        ]
        x, P = (np.stack(parts) for parts in zip(*(density for _, density in there), strict=True))
        past, lagged = lag.step(past, tracks(time_s, [10 + number for number, _ in there], x, P))
        then_s = time_s - lag_s
        assert lagged.time_ns == round(then_s * NS_PER_S)
        expected = [number for number, _ in there if then_s >= TIMES[2 * number] - 1e-9]
        assert lagged.ids.tolist() == [10 + number for number in expected]
        assert lagged.log_lr.tolist() == [number + 10.0 * time_s for number in expected]
        for row, number in enumerate(expected):
            times = TIMES[2 * number : k + 1]
            x_then, P_then = smoothed(times, runs[number][0][: len(times)], round(then_s, 9))
            np.testing.assert_allclose(lagged.x[row], x_then, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(lagged.P[row], P_then, rtol=1e-8, atol=1e-8)
            compared += 1
    assert compared >= 3


def test_pictures_that_a_late_report_changes_take_the_place_of_the_others() -> None:
    lag = FixedLag(MOTION, 2 * NS_PER_S, window_ns=4 * NS_PER_S)
    _, densities = kalman(TIMES, 1)
    right = [
        tracks(time_s, [3], *(part[None] for part in density)) for time_s, density in zip(TIMES, densities, strict=True)
    ]
    wrong = [picture._replace(x=picture.x + 100.0) for picture in right]

    def last(pictures: Sequence[Tracks]) -> tuple[Past, Tracks]:
        past: Past = ()
        for picture in pictures:
            past, lagged = lag.step(past, picture)
        return past, lagged

    _, straight = last(right)
    past, late = last([*right[:2], *wrong[2:5], *right[2:]])
    assert straight.x.tolist() == late.x.tolist()
    assert [picture.time_ns / NS_PER_S for picture in past] == [1.0, 2.5, 3.0, 5.0, 5.5, 8.0]
    past, _ = lag.step(past, tracks(12.0, [3], right[-1].x, right[-1].P))
    assert [picture.time_ns / NS_PER_S for picture in past] == [5.5, 8.0, 12.0]


def test_a_track_that_is_no_more_is_not_said() -> None:
    lag = FixedLag(MOTION, 2 * NS_PER_S, window_ns=0)
    _, densities = kalman(TIMES, 1)
    both = np.stack([densities[0].x, densities[0].x]), np.stack([densities[0].P, densities[0].P])
    past, _ = lag.step((), tracks(1.0, [3, 5], *both))
    _, lagged = lag.step(past, tracks(3.0, [5], densities[1].x[None], densities[1].P[None]))
    assert lagged.ids.tolist() == [5]


# ---- closer to the truth


def lagged_states(plot: Scenario, mode: str, worlds: Worlds, lag_scans: int) -> tuple[Array, Array, Array, Array]:
    """Filtered and lagged states and covariances of all runs at the same times, shapes (R, K, n), (R, K, n, n)."""
    course = play(plot, mode, worlds)
    interval_s = (worlds.times_ns[1] - worlds.times_ns[0]) / NS_PER_S
    lag, past = FixedLag.of(plot, lag_scans * interval_s), ()
    x, P = [], []
    for k, time_ns in enumerate(worlds.times_ns):
        past, lagged = lag.step(
            past, tracks(time_ns / NS_PER_S, range(len(worlds.seeds)), course.x[:, k], course.P[:, k])
        )
        if k >= lag_scans:
            assert lagged.time_ns == worlds.times_ns[k - lag_scans]
            x.append(lagged.x)
            P.append(lagged.P)
    return course.x[:, :-lag_scans], course.P[:, :-lag_scans], np.stack(x, axis=1), np.stack(P, axis=1)


@pytest.mark.parametrize("mode", ["federated-tight", "federated-mirrored-3", "centralised-mht"])
def test_lagged_positions_are_closer_to_the_truth(mode: str) -> None:
    """In clutter, factors relaxed: root mean square error per run, paired over 40 runs, one-sided at 99.9 %."""
    sensors = [sensor_table(name, p_d=0.7, false_plots=20.0) for name in "ab"]
    plot = scenario(*sensors, simulation={"duration": 40.0})
    worlds = draw(plot, np.arange(40))
    x, _, x_lag, _ = lagged_states(plot, mode, worlds, 4)
    truth = worlds.truth[:, : x.shape[1], :2]
    filtered, lagged = (np.sqrt(np.square(states[..., :2] - truth).sum(axis=-1).mean(axis=-1)) for states in (x, x_lag))
    # Tracks that clutter has led away say nothing about smoothing.
    kept = filtered < 200.0
    assert kept.sum() >= 36
    gain = np.log(filtered[kept] / lagged[kept])
    bound = gain.mean() - t.ppf(0.999, kept.sum() - 1) * gain.std(ddof=1) / np.sqrt(kept.sum())
    assert np.exp(bound) > 1.15


def test_undisturbed_the_lagged_covariance_is_what_it_says() -> None:
    """One sensor, next to no clutter: NEES over 200 runs within 99.9 %, and smaller in mean square than filtered."""
    plot = scenario(sensor_table("a", p_d=0.99, false_plots=1e-6), simulation={"duration": 16.0})
    worlds = draw(plot, np.arange(200))
    x, P, x_lag, P_lag = lagged_states(plot, "centralised", worlds, 3)
    truth = worlds.truth[:, : x.shape[1]]
    for states, covariances in ((x, P), (x_lag, P_lag)):
        d = states - truth
        nees = np.einsum("rki,rki->rk", d, np.linalg.solve(covariances, d[..., None])[..., 0]).sum(axis=0)
        low, high = chi2.ppf([0.0005, 0.9995], 4 * len(worlds.seeds))
        # Of every measurement time on its own: five bounds.
        assert nees.shape == (5,)
        assert ((low < nees) & (nees < high)).all()
    ratio = np.linalg.det(P_lag[..., :2, :2]) / np.linalg.det(P[..., :2, :2])
    assert np.median(ratio) < 0.5


# ---- on the command line


def replayed(capsys: pytest.CaptureFixture[str], *words: str) -> list[dict[str, Any]]:
    with pytest.raises(SystemExit) as ended:
        app(["replay", "four-radars", "--json", *words])
    assert ended.value.code in (None, 0)
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_replay_says_where_the_tracks_were(capsys: pytest.CaptureFixture[str]) -> None:
    plain, lagged = replayed(capsys), replayed(capsys, "--lag", "6")
    assert [{key: value for key, value in line.items() if not key.endswith("_lag")} for line in lagged] == plain
    own = [line for line in lagged if line["track"] == 0]
    assert [line["x_lag"] for line in own[:3]] == 3 * [None]
    assert [line["time_lag"] for line in own[3:]] == [line["time"] - 6.0 for line in own[3:]]
    # Deleted at once: they never get as far back, and stay as they were.
    assert all(line["time_lag"] is None for line in lagged if line["track"] in (1, 2, 3))
    before = {line["time"]: line for line in own}
    for line in own[3:]:
        now, then = np.array(line["P_lag"]), np.array(before[line["time_lag"]]["P"])
        assert (np.diag(now)[:2] < np.diag(then)[:2]).all()


def test_a_lag_of_nothing_is_the_track_itself(capsys: pytest.CaptureFixture[str]) -> None:
    for line in (line for line in replayed(capsys, "--lag", "0") if line["status"] != "deleted"):
        assert (line["time_lag"], line["x_lag"], line["P_lag"]) == (line["time"], line["x"], line["P"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--lag", "2"), "--lag: the states of tracks are in JSON lines only: give --json too"),
        (("--json", "--lag", "-1"), "-1.0 is no number of seconds"),
        (("--json", "--lag", "nan"), "nan is no number of seconds"),
    ],
)
def test_a_lag_that_cannot_be_shown(words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(app, ["replay", "four-radars", *words])
    assert ended.value.code != 0
    heard = " ".join("".join(capsys.readouterr()).replace("│", " ").split())
    assert said in heard
