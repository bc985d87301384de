"""Whole networks, replayed, against theory.md written out a second time: loops over sensors, plots and tracks.

Every track is associated as if it were alone; Eq. (21) has its own tests.

Nothing of ``common.estimation`` is used here: the reference below and in ``reference.py`` comes from the equations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import pytest
from reference import Array, Density, folded, log_normal, predicted
from scipy.integrate import quad
from scipy.special import logsumexp
from scipy.stats import chi2, norm

from waldnet.common.config import Scenario
from waldnet.common.messages import NEVER, Advice, Decision, Scan, Start, Tracks
from waldnet.offline.replay import Replay
from waldnet.sensor_node.state import State as NodeState
from waldnet.sensor_node.tracker import LocalTracker

Config: TypeAlias = dict[str, Any]

AREA = 9e6
PSD = 5.0


class Look(NamedTuple):
    """A scan of sensor number ``sensor``."""

    time: float
    sensor: int
    plots: Array


class Entry(NamedTuple):
    """A track at one measurement time."""

    log_lr: float
    x: Array
    P: Array


Course: TypeAlias = dict[float, Entry]


# ---- the reference


def in_view(density: Density, sensor: Config) -> float:
    """The probability that the position is inside the field of view."""
    view = sensor["field_of_view"]
    if view["shape"] == "everywhere":
        return 1.0
    (x, y), P = density.x[:2], density.P[:2, :2]
    (low_x, high_x), (low_y, high_y) = (
        (c - 0.5 * s, c + 0.5 * s) for c, s in zip(view["center"], view["size"], strict=True)
    )
    slope, rest = P[0, 1] / P[0, 0], np.sqrt(P[1, 1] - P[0, 1] ** 2 / P[0, 0])

    def strip(u: float) -> float:
        mean = y + slope * (u - x)
        return float(
            norm.pdf(u, x, np.sqrt(P[0, 0])) * (norm.cdf((high_y - mean) / rest) - norm.cdf((low_y - mean) / rest))
        )

    sigma = float(np.sqrt(P[0, 0]))
    low, high = max(low_x, x - 10 * sigma), min(high_x, x + 10 * sigma)
    return float(quad(strip, low, high, epsabs=1e-13, epsrel=1e-12)[0]) if low < high else 0.0


def area(sensor: Config) -> float:
    view = sensor["field_of_view"]
    return float(view["area"] if view["shape"] == "everywhere" else np.prod(view["size"]))


def weighed(
    density: Density, judge: Density, plots: Array, sensor: Config, p_g: float
) -> tuple[list[float], list[bool]]:
    """Eq. (6), (6a): log p*_j, and which plots are in the gate; the judge says whether the target is in view."""
    p_d, surely = float(sensor["p_d"]), [1.0] + [0.0] * len(plots)
    missed = 1.0 - p_d * p_g * in_view(judge, sensor)
    H, R = np.eye(len(sensor["sigma"]), len(density.x)), np.diag(np.square(sensor["sigma"]))
    S = H @ density.P @ H.T + R
    rho_f = sensor["false_plots"] / area(sensor)
    log_p_star, inside = [float(np.log(missed)) if missed > 0 else -np.inf], []
    for j, z in enumerate(plots):
        nu = z - H @ density.x
        p_j = p_d * in_view(updated(judge, plots, sensor, np.roll(surely, j + 1)), sensor)
        log_p_star.append(float(np.log(p_j / rho_f)) + log_normal(nu, S) if p_j > 0 else -np.inf)
        inside.append(bool(nu @ np.linalg.solve(S, nu) <= chi2.ppf(p_g, len(z))))
    return log_p_star, inside


def updated(density: Density, plots: Array, sensor: Config, p: Array) -> Density:
    """Eq. (7) with weights p."""
    H, R = np.eye(len(sensor["sigma"]), len(density.x)), np.diag(np.square(sensor["sigma"]))
    S = H @ density.P @ H.T + R
    K = density.P @ H.T @ np.linalg.inv(S)
    nu, spread = np.zeros(len(R)), np.zeros_like(R)
    for p_j, z in zip(p[1:], plots, strict=True):
        nu = nu + p_j * (z - H @ density.x)
        spread = spread + p_j * np.outer(z - H @ density.x, z - H @ density.x)
    P = density.P - (1 - p[0]) * K @ S @ K.T + K @ (spread - np.outer(nu, nu)) @ K.T
    return Density(density.x + K @ nu, P)


def filtered(
    factor: Density, honest: Density, plots: Array, sensor: Config, fusion: Config
) -> tuple[Density, Density, float]:
    """One scan: Eq. (6), (7), or (12), (13) with the honest density deciding, also on p_d and gate."""
    tight, p_g = fusion["association"] == "tight", fusion["gate_probability"]
    judge = honest if tight else factor
    log_q, inside = weighed(judge, judge, plots, sensor, p_g)
    log_q = [w if j == 0 or inside[j - 1] else -np.inf for j, w in enumerate(log_q)]
    q = np.exp(np.array(log_q) - logsumexp(log_q))
    log_p_star, _ = weighed(factor, judge, plots, sensor, p_g)
    if not tight:
        return updated(factor, plots, sensor, q), honest, float(logsumexp(log_q))
    log_p_bar = sum(float(q_j * (w - np.log(q_j))) for q_j, w in zip(q, log_p_star, strict=True) if q_j > 0)
    return updated(factor, plots, sensor, q), updated(honest, plots, sensor, q), log_p_bar


def reference(network: Config, hypothesis: Config, looks: Sequence[Look]) -> Course:
    """One track through a network: x, P and log LR after every measurement time, Eq. (10) and (11)."""
    sensors, fusion = network["sensor"], network["fusion"]
    share = 1.0 if fusion["mode"] == "naive" else float(len(sensors))
    now, psd = float(hypothesis["start"]), float(network["motion"]["psd"])
    prior = Density(np.array(hypothesis["state"]), np.diag(np.square(hypothesis["sigma"])))
    factors = [Density(prior.x, share * prior.P) for _ in sensors]
    honest, log_lr, course = [prior for _ in sensors], 0.0, {}
    for time in sorted({look.time for look in looks if look.time > now}):
        factors = [predicted(factor, time - now, psd, share) for factor in factors]
        honest = [predicted(density, time - now, psd, 1.0) for density in honest]
        log_lr -= folded(factors)[0]
        for look in (look for look in looks if look.time == time):
            s = look.sensor
            factors[s], honest[s], log_p_bar = filtered(factors[s], honest[s], look.plots, sensors[s], fusion)
            log_lr += log_p_bar
        log_c, fused = folded(factors)
        log_lr += log_c
        now, course[time] = time, Entry(log_lr, *fused)
        if fusion["feedback"] != "none":
            honest = [fused for _ in sensors]
        if fusion["feedback"] == "reset":
            factors = [Density(fused.x, share * fused.P) for _ in sensors]
    return course


def reset_late(network: Config, hypothesis: Config, looks: Sequence[Look], delay: float) -> Course:
    """One track where all begin anew before every scan, from the newest fused track older than ``delay`` seconds.

    All sensors scan at the same times.
    """
    sensors, fusion, psd = network["sensor"], network["fusion"], float(network["motion"]["psd"])
    share, start = float(len(sensors)), float(hypothesis["start"])
    # While nothing is old enough nothing begins anew.
    course = reference(network | {"fusion": fusion | {"feedback": "none"}}, hypothesis, looks)
    for time in course:
        since = max((past for past in course if past < time - delay), default=start)
        if since == start:
            continue
        log_lr, *fused = course[since]
        begun = Density(fused[0], share * fused[1])
        factors, evidence = [], 0.0
        for s in range(len(sensors)):
            factor, honest, now = begun, Density(*fused), since
            for look in (look for look in looks if look.sensor == s and since < look.time <= time):
                factor = predicted(factor, look.time - now, psd, share)
                honest = predicted(honest, look.time - now, psd, 1.0)
                factor, honest, log_p_bar = filtered(factor, honest, look.plots, sensors[s], fusion)
                now, evidence = look.time, evidence + log_p_bar
            factors.append(factor)
        before, _ = folded([predicted(begun, time - since, psd, share)] * len(sensors))
        after, density = folded(factors)
        course[time] = Entry(log_lr + evidence + after - before, *density)
    return course


def kalman(network: Config, hypothesis: Config, looks: Sequence[Look]) -> Course:
    """The centralised Kalman filter, plot after plot, with p_d = 1: log LR is the sum of log (N(nu; 0, S) / rho_f)."""
    now, psd = float(hypothesis["start"]), float(network["motion"]["psd"])
    state = Density(np.array(hypothesis["state"]), np.diag(np.square(hypothesis["sigma"])))
    log_lr, course = 0.0, {}
    for look in sorted((look for look in looks if look.time > now), key=lambda look: look.time):
        sensor = network["sensor"][look.sensor]
        state = predicted(state, look.time - now, psd, 1.0)
        H, R = np.eye(len(sensor["sigma"]), len(state.x)), np.diag(np.square(sensor["sigma"]))
        S, nu = H @ state.P @ H.T + R, look.plots[0] - H @ state.x
        K = state.P @ H.T @ np.linalg.inv(S)
        log_lr += log_normal(nu, S) - float(np.log(sensor["false_plots"] / area(sensor)))
        A = np.eye(len(state.x)) - K @ H
        state = Density(state.x + K @ nu, A @ state.P @ A.T + K @ R @ K.T)
        now, course[look.time] = look.time, Entry(log_lr, *state)
    return course


# ---- networks and what they see


def radar(name: str, sigma: Sequence[float], p_d: float, false_plots: float) -> Config:
    view = {"shape": "everywhere", "area": AREA}
    return {"name": name, "sigma": tuple(sigma), "p_d": p_d, "false_plots": false_plots, "field_of_view": view}


def box(size: tuple[float, float], center: tuple[float, float]) -> Config:
    return {"shape": "box", "size": size, "center": center}


def three_radars(dimensions: int = 2, **fusion: Any) -> Config:
    """A network that is no two ways symmetric, with a target, a decoy, and tracks that begin late."""
    up = (0.0,) * (dimensions - 2)
    sigma = (300.0,) * dimensions + (20.0,) * dimensions
    return {
        "name": "three",
        "motion": {"dimensions": dimensions, "psd": PSD},
        "decision": {"enabled": False},
        "fusion": {
            "mode": "federated",
            "association": "tight",
            "feedback": "none",
            "gate_probability": 1.0,
            "joint": False,
        }
        | fusion,
        "sensor": [
            radar("a", (30.0, 40.0, 35.0)[:dimensions], 0.9, 4.0),
            radar("b", (60.0, 50.0, 90.0)[:dimensions], 0.6, 8.0),
            radar("c", (20.0, 25.0, 10.0)[:dimensions], 0.4, 2.0),
        ],
        "hypothesis": [
            {"start": 0.0, "state": (120.0, -90.0, *up, 40.0, -10.0, *up), "sigma": sigma},
            {"start": 0.0, "state": (-700.0, 800.0, *up, -5.0, 30.0, *up), "sigma": sigma},
            # At the very time of a scan of b, which it must not use.
            {"start": 4.0, "state": (200.0, -50.0, *up, 35.0, -15.0, *up), "sigma": sigma},
            {"start": 6.25, "state": (300.0, -100.0, *up, 40.0, -10.0, *up), "sigma": sigma},
        ],
    }


#: First scan, interval, last scan [s]: a and b meet at times, c falls silent.
TIMES = ((1.0, 2.0, 30.0), (1.0, 3.0, 30.0), (0.5, 2.5, 16.0))


def cluttered(network: Config, seed: int = 1) -> list[Look]:
    """Scans of a target that moves as hypothesis 0 says, among false plots; every fourth scan of b is empty."""
    rng, looks = np.random.default_rng(seed), []
    x0 = np.array(network["hypothesis"][0]["state"])
    d = len(x0) // 2
    for s, (sensor, (first, interval, last)) in enumerate(zip(network["sensor"], TIMES, strict=True)):
        for k, time in enumerate(np.arange(first, last, interval)):
            true = x0[:d] + time * x0[d:] + rng.normal(0.0, sensor["sigma"])
            seen = [true] if rng.random() < sensor["p_d"] else []
            false = rng.uniform(-1500.0, 1500.0, (rng.poisson(sensor["false_plots"]), d))
            plots = np.array([*seen, *false]).reshape(-1, d)
            looks.append(Look(float(time), s, plots[:0] if s == 1 and k % 4 == 1 else rng.permutation(plots)))
    return looks


def one_plot_each(
    sensors: Sequence[tuple[tuple[float, float], float, float]], **fusion: Any
) -> tuple[Config, list[Look]]:
    """Sensors (sigma, first scan, interval) that see one target in each of their 100 scans, and nothing else."""
    network = three_radars(**fusion)
    network["sensor"] = [radar(f"s{s}", sigma, 1.0, 1.0) for s, (sigma, _, _) in enumerate(sensors)]
    rng, looks, x0 = np.random.default_rng(2), [], np.array(network["hypothesis"][0]["state"])
    for s, (sigma, first, interval) in enumerate(sensors):
        for time in first + interval * np.arange(100):
            z = x0[:2] + time * x0[2:] + rng.normal(0.0, sigma)
            looks.append(Look(float(time), s, z[None]))
    return network, looks


def replayed(network: Config, looks: Sequence[Look]) -> Iterator[tuple[float, Tracks | Decision]]:
    """What the system makes of it, with the time in seconds."""
    scenario = Scenario.model_validate(network)
    scans = [
        Scan(
            network["sensor"][look.sensor]["name"], scenario.to_ns(look.time), np.zeros(look.plots.shape[1]), look.plots
        )
        for look in sorted(looks, key=lambda look: (look.time, look.sensor))
    ]
    for message in Replay(scenario, scans).run():
        yield scenario.to_seconds(message.time_ns), message


def courses(network: Config, looks: Sequence[Look]) -> dict[int, Course]:
    """The replayed tracks; at its start a track is its prior."""
    result: dict[int, Course] = {number: {} for number in range(len(network["hypothesis"]))}
    for time, message in replayed(network, looks):
        if not isinstance(message, Tracks):
            continue
        np.testing.assert_array_equal(message.log_lr, message.log_lr_total)
        for row, track in enumerate(message.ids):
            if time > network["hypothesis"][track]["start"]:
                result[int(track)][time] = Entry(float(message.log_lr_total[row]), message.x[row], message.P[row])
    return result


def assert_same(ours: Course, expected: Course, tolerance: float = 1e-9) -> None:
    """Relative to the size of log LR (at least 1), of the state and of the covariance."""
    assert list(ours) == list(expected)
    for time, entry in expected.items():
        assert ours[time].log_lr == pytest.approx(entry.log_lr, rel=tolerance, abs=tolerance), time
        # Positions and velocities have their own sizes.
        scale = np.sqrt(np.diagonal(entry.P))
        assert (np.abs(ours[time].x - entry.x) <= tolerance * (np.abs(entry.x) + scale)).all(), time
        assert (np.abs(ours[time].P - entry.P) <= tolerance * np.outer(scale, scale)).all(), time


def last(course: Course) -> Entry:
    return course[max(course)]


# ---- tests


@pytest.mark.parametrize("gate_probability", [1.0, 0.9])
@pytest.mark.parametrize("feedback", ["none", "advice", "reset"])
@pytest.mark.parametrize("association", ["factor", "tight"])
@pytest.mark.parametrize("mode", ["naive", "federated"])
def test_a_network_is_what_the_equations_say(
    mode: str, association: str, feedback: str, gate_probability: float
) -> None:
    network = three_radars(mode=mode, association=association, feedback=feedback, gate_probability=gate_probability)
    looks = cluttered(network)
    assert sum(len(look.plots) == 0 for look in looks) >= 3
    ours = courses(network, looks)
    for track, hypothesis in enumerate(network["hypothesis"]):
        assert_same(ours[track], reference(network, hypothesis, looks))


@pytest.mark.parametrize("feedback", ["none", "advice"])
@pytest.mark.parametrize("association", ["factor", "tight"])
def test_a_network_in_space(association: str, feedback: str) -> None:
    network = three_radars(3, association=association, feedback=feedback)
    looks = cluttered(network, 3)
    ours = courses(network, looks)
    for track, hypothesis in enumerate(network["hypothesis"]):
        assert_same(ours[track], reference(network, hypothesis, looks))


@pytest.mark.parametrize("association", ["factor", "tight"])
def test_a_network_that_sees_only_part_of_the_plane(association: str) -> None:
    """The target leaves the box of a, the decoy the box of b; c sees neither."""
    network = three_radars(association=association)
    a, b, c = network["sensor"]
    a["field_of_view"] = box((1500.0, 1800.0), (0.0, 0.0))
    b["field_of_view"] = box((3000.0, 2600.0), (400.0, -200.0))
    c["field_of_view"] = box((500.0, 500.0), (5000.0, 5000.0))
    network["hypothesis"] = network["hypothesis"][:2]
    looks = cluttered(network, 4)
    ours = courses(network, looks)
    for track, hypothesis in enumerate(network["hypothesis"]):
        assert_same(ours[track], reference(network, hypothesis, looks))


def test_the_variants_of_a_network_differ() -> None:
    """Else the comparisons above would show nothing: every switch moves log LR by more than 0.01 on the target."""
    variants: list[Config] = [
        {"mode": "naive"},
        {"association": "factor"},
        {"feedback": "advice"},
        {"gate_probability": 0.9},
    ]
    networks = [three_radars(), *(three_radars(**variant) for variant in variants)]
    plain, *others = (last(courses(network, cluttered(network))[0]).log_lr for network in networks)
    assert all(abs(other - plain) > 0.01 for other in others)


@pytest.mark.parametrize("delay", [0.0, 2.0, 4.0])
@pytest.mark.parametrize("association", ["factor", "tight"])
def test_a_network_that_begins_anew_from_what_was_some_time_ago(association: str, delay: float) -> None:
    """All sensors scan together, so that every rebase is followed by everyone's evidence since."""
    network = three_radars(association=association, feedback="reset", feedback_delay=delay)
    network["hypothesis"] = network["hypothesis"][:2]
    times = (1.0, 2.0, 3.5, 5.0, 7.0, 8.0, 10.0)
    looks, few = [], cluttered(network)
    for s in range(3):
        own = [look for look in few if look.sensor == s]
        looks += [look._replace(time=time) for look, time in zip(own, times, strict=False)]
    ours = courses(network, looks)
    for track, hypothesis in enumerate(network["hypothesis"]):
        assert_same(ours[track], reset_late(network, hypothesis, looks, delay))


UNLIKE = [((50.0, 50.0), 1.0, 1.0), ((10.0, 80.0), 1.0, 1.0), ((300.0, 20.0), 1.0, 1.0)]
ASYNCHRONOUS = [((50.0, 50.0), 1.0, 1.0), ((10.0, 80.0), 0.25, 1.75), ((300.0, 20.0), 3.0, 0.5)]
ALIKE = [((50.0, 50.0), 1.0, 1.0)] * 4


@pytest.mark.parametrize("association", ["factor", "tight"])
@pytest.mark.parametrize(
    ("mode", "sensors"), [("dkf", UNLIKE), ("dkf", ASYNCHRONOUS), ("dkf", ALIKE), ("federated", ALIKE)]
)
def test_without_doubt_the_network_is_the_centralised_kalman_filter(
    mode: str, sensors: list[tuple[tuple[float, float], float, float]], association: str
) -> None:
    """For the target's track, for the decoy, which is drawn onto the target, and for those that begin late."""
    network, looks = one_plot_each(sensors, mode=mode, association=association)
    ours = courses(network, looks)
    for track, hypothesis in enumerate(network["hypothesis"]):
        assert_same(ours[track], kalman(network, hypothesis, looks))


@pytest.mark.parametrize("association", ["factor", "tight", "mirrored"])
@pytest.mark.parametrize("sensors", [UNLIKE, ASYNCHRONOUS, ALIKE], ids=["unlike", "asynchronous", "alike"])
def test_without_doubt_a_network_that_begins_anew_is_the_centralised_kalman_filter(
    sensors: list[tuple[tuple[float, float], float, float]], association: str
) -> None:
    """However unlike the sensors are.

    The federated prediction is exact for factors that are alike: n factors N(x, n P) become N(F x, n (F P F' + Q)), the
    roots of the predicted density. After every scan the reset makes them so, from the exact posterior.
    """
    network, looks = one_plot_each(sensors, association=association, feedback="reset")
    ours = courses(network, looks)
    for track, hypothesis in enumerate(network["hypothesis"]):
        assert_same(ours[track], kalman(network, hypothesis, looks))


@pytest.mark.parametrize(("mode", "sensors"), [("naive", ALIKE), ("federated", UNLIKE), ("federated", ASYNCHRONOUS)])
def test_other_representations_are_not_the_centralised_kalman_filter(
    mode: str, sensors: list[tuple[tuple[float, float], float, float]]
) -> None:
    network, looks = one_plot_each(sensors, mode=mode)
    ours, expected = courses(network, looks)[0], kalman(network, network["hypothesis"][0], looks)
    difference = abs(last(ours).log_lr - last(expected).log_lr)
    assert difference > (10.0 if mode == "naive" else 0.1)


@pytest.mark.parametrize("mode", ["dkf", "federated"])
@pytest.mark.parametrize(("wide", "sharp"), [(1e3, 1.0), (1e5, 0.1), (1e6, 0.01)])
def test_a_wide_prior_does_not_spoil_sharp_plots(wide: float, sharp: float, mode: str) -> None:
    network, looks = one_plot_each([((sharp, sharp), 1.0, 1.0)] * 4, mode=mode)
    hypothesis = network["hypothesis"][0] | {"sigma": (wide, wide, 20.0, 20.0)}
    network["hypothesis"] = [hypothesis]
    assert_same(courses(network, looks)[0], kalman(network, hypothesis, looks), 1e-6)


def test_a_track_at_its_start_is_its_prior() -> None:
    network = three_radars()
    at_start = [message for time, message in replayed(network, cluttered(network)) if time == 4.0]
    assert len(at_start) == 1
    tracks = at_start[0]
    assert isinstance(tracks, Tracks)
    row = int(np.flatnonzero(tracks.ids == 2)[0])
    np.testing.assert_array_equal(tracks.x[row], network["hypothesis"][2]["state"])
    np.testing.assert_array_equal(tracks.P[row], np.diag(np.square(network["hypothesis"][2]["sigma"])))
    assert (tracks.log_lr_total[row], tracks.scans[row]) == (0.0, 0)


def test_every_sensor_is_credited_for_its_own_scans() -> None:
    network = three_radars()
    looks = cluttered(network)
    counted = dict.fromkeys(range(len(network["hypothesis"])), 0)
    for time, message in replayed(network, looks):
        assert isinstance(message, Tracks)
        reported = [any(look.time == time and look.sensor == s for look in looks) for s in range(3)]
        for row, track in enumerate(message.ids):
            begun = time > network["hypothesis"][track]["start"]
            counted[int(track)] += begun
            np.testing.assert_array_equal(message.contributing[row], reported if begun else [False] * 3)
            assert message.scans[row] == counted[int(track)]


@pytest.mark.parametrize("association", ["factor", "tight"])
@pytest.mark.parametrize("mode", ["naive", "federated"])
def test_a_blind_sensor_is_a_silent_sensor(mode: str, association: str) -> None:
    """p_d = 0: what b says changes neither log LR nor the fused track, as if it had never spoken."""
    network = three_radars(mode=mode, association=association)
    network["sensor"][1]["p_d"] = 0.0
    looks = cluttered(network)
    spoken, silent = courses(network, looks), courses(network, [look for look in looks if look.sensor != 1])
    for track, course in silent.items():
        assert_same({time: spoken[track][time] for time in course}, course)
    lonely = {look.time for look in looks if look.sensor == 1} - {look.time for look in looks if look.sensor != 1}
    assert lonely
    for course in spoken.values():
        for before, after in pairwise(course):
            if after in lonely:
                assert course[after].log_lr == pytest.approx(course[before].log_lr, abs=1e-10)


def judged(course: Course) -> Iterator[tuple[float, int, float, float]]:
    """Wald's rules with P0 = 0.01, P1 = 0.9: time, status, log LR of the running test, log LR at the crossing or 0."""
    before, log_lr, status = 0.0, 0.0, 0
    for time, entry in course.items():
        log_lr, before = log_lr + entry.log_lr - before, entry.log_lr
        crossing = log_lr
        if log_lr < np.log(0.1 / 0.99):
            yield time, 2, log_lr, crossing
            return
        if log_lr > np.log(0.9 / 0.01):
            log_lr, status = 0.0, 1
        yield time, status, log_lr, crossing


@pytest.mark.parametrize("association", ["factor", "tight"])
def test_decisions_follow_from_the_log_lr(association: str) -> None:
    """Confirmed once, monitored from log LR 0, reset whenever it exceeds log B again, deleted once and then gone."""
    network = three_radars(association=association)
    network["decision"] = {"p0": 0.01, "p1": 0.9}
    looks = cluttered(network)
    rows: dict[tuple[float, int], tuple[int, float]] = {}
    decisions: dict[tuple[int, str], tuple[float, float, float]] = {}
    for time, message in replayed(network, looks):
        if isinstance(message, Decision):
            assert (message.track, message.kind) not in decisions
            decisions[message.track, message.kind] = time, message.log_lr, message.log_lr_total
            continue
        for row, track in enumerate(message.ids):
            if time > network["hypothesis"][track]["start"]:
                rows[time, int(track)] = int(message.status[row]), float(message.log_lr[row])
    resets = 0
    for track, hypothesis in enumerate(network["hypothesis"]):
        course, before = reference(network, hypothesis, looks), 0
        for time, status, log_lr, crossing in judged(course):
            assert rows.pop((time, track)) == pytest.approx((status, log_lr), rel=1e-9, abs=1e-9)
            if status != before:
                decided = decisions.pop((track, ["", "confirmed", "deleted"][status]))
                assert decided == pytest.approx((time, crossing, course[time].log_lr), rel=1e-9, abs=1e-9)
            resets, before = resets + (status == before == 1 and log_lr == 0.0), status
    assert resets > 0
    assert not rows
    assert not decisions


# ---- advice


def lone_radar(**fusion: Any) -> tuple[Config, list[Look]]:
    network = three_radars(**fusion)
    looks = [look for look in cluttered(network) if look.sensor == 0]
    network["sensor"], network["hypothesis"] = network["sensor"][:1], network["hypothesis"][:1]
    return network, looks


@pytest.mark.parametrize("feedback", ["none", "advice"])
@pytest.mark.parametrize("association", ["factor", "tight"])
def test_a_network_of_one_is_the_plain_pdaf(association: str, feedback: str) -> None:
    network, looks = lone_radar(association=association, feedback=feedback)
    plain = network | {
        "fusion": {"mode": "naive", "association": "factor", "feedback": "none", "gate_probability": 1.0}
    }
    assert_same(courses(network, looks)[0], reference(plain, network["hypothesis"][0], looks))


def started(tracker: LocalTracker, hypothesis: Config, astray: float) -> NodeState:
    """A node whose association filter starts ``astray`` metres off the prior."""
    x, P = np.array([hypothesis["state"]]), np.diag(np.square(hypothesis["sigma"]))[None]
    zero, t_ns = np.zeros(1, np.int64), np.array([Scenario.model_validate(three_radars()).epoch_ns])
    return tracker.start(tracker.initial(), Start("a", 1, zero, t_ns, np.zeros(1), x, P, x + astray, P))


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_advice_however_late_makes_the_association_filter_the_plain_pdaf(delay: int) -> None:
    """The advice of ``delay`` scans ago, and the scans since: what the plain filter with the honest prior has now."""
    network, looks = lone_radar(feedback="advice")
    scenario = Scenario.model_validate(network)
    plain = reference(
        network | {"fusion": network["fusion"] | {"association": "factor"}}, network["hypothesis"][0], looks
    )
    tracker = LocalTracker.of(scenario, "a")
    state = started(tracker, network["hypothesis"][0], 100.0)
    times = [look.time for look in looks]
    for k, look in enumerate(looks):
        scan = Scan("a", scenario.to_ns(look.time), np.zeros(2), look.plots)
        state, _ = tracker.scan(state, scan, NEVER)
        if k > delay:
            now = {look.time: Entry(0.0, state.tracks.x_a[0, 0], state.tracks.P_a[0, 0])}
            assert_same(now, {look.time: plain[look.time]._replace(log_lr=0.0)})
        else:
            assert (np.abs(state.tracks.x_a[0, 0] - plain[look.time].x) > 1e-3).any()
        if k >= delay:
            advised = plain[times[k - delay]]
            given_ns, time_ns = scenario.to_ns(look.time), scenario.to_ns(times[k - delay])
            advice = Advice(given_ns, time_ns, np.zeros(1, np.int64), advised.x[None], advised.P[None])
            state = tracker.advise(state, advice)
