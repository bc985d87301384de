"""The life of tracks: survival, coasting, and the end of those that nobody sees."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from builders import Stage, live_as_replayed, scenario, sensor_table

from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.estimation.pose import SensorPose
from waldnet.common.estimation.sprt import CONFIRMED, Existence, Status, decide_with_life, survive, thresholds
from waldnet.common.messages import Decision, Scan, Tracks
from waldnet.fusion_center.life import Life
from waldnet.fusion_center.picture import Picture
from waldnet.offline.centralised import Centralised
from waldnet.offline.replay import Replay

LIMITS = thresholds(1e-4, 0.99, 0.999)


# Survival -------------------------------------------------------------------------------------------------------------


def test_survival_is_that_of_all_times_at_which_the_target_may_leave() -> None:
    rng = np.random.default_rng(7)
    dt, log_lambda, stay = rng.uniform(0.1, 30.0, 12), rng.normal(0.0, 2.0, 12), 40.0
    # p(data | it leaves in step k): evidence of the steps before, then 1.
    left = np.exp(-np.concatenate([[0.0], np.cumsum(dt)]) / stay)
    evidence = np.exp(np.concatenate([[0.0], np.cumsum(log_lambda)]))
    there = left[-1] * evidence[-1]
    gone = sum((before - after) * evidence[k] for k, (before, after) in enumerate(pairwise(left)))
    existence = Existence(np.zeros(()), np.array(-np.inf))
    for elapsed, gain in zip(dt, log_lambda, strict=True):
        existence = survive(existence, elapsed, stay)
        existence = existence._replace(log_lr=existence.log_lr + gain)
    np.testing.assert_allclose(existence.log_lr, np.log(there), rtol=1e-12)
    np.testing.assert_allclose(existence.log_left, np.log(gone), rtol=1e-12)
    np.testing.assert_allclose(existence.log_odds, np.log(there / (1.0 + gone)), rtol=1e-12)


def test_targets_that_stay_for_ever_leave_all_as_it_was() -> None:
    before = Existence(np.array([1.5, -3.0]), np.array([-np.inf, -np.inf]))
    assert survive(before, np.array(1e9), np.inf) is before
    np.testing.assert_array_equal(before.log_odds, before.log_lr)


def test_the_odds_of_a_confirmed_track_follow_the_recursion_of_integrated_data_association() -> None:
    log_odds, status = np.array([2.0]), np.array([CONFIRMED])
    existence = Existence(log_odds, np.array([-np.inf]))
    for gain in (3.0, 8.0, -1.0, -1.0, 6.0):
        p_s = np.exp(-2.0 / 30.0)
        odds = p_s * np.exp(log_odds) / (1.0 + (1.0 - p_s) * np.exp(log_odds))
        log_odds = np.log(odds) + gain
        existence = survive(existence, np.array(2.0), 30.0)
        existence, verdict = decide_with_life(existence._replace(log_lr=existence.log_lr + gain), status, LIMITS)
        np.testing.assert_allclose(existence.log_lr, log_odds, rtol=1e-12)
        assert verdict.status == status


def test_existence_is_calibrated_where_targets_leave() -> None:
    """Half of the tracks have a target; it stays for 20 s on average; a detector of p_d 0.7 and false alarms 0.3."""
    rng, tracks, scans, stay = np.random.default_rng(11), 20_000, 15, 20.0
    there = rng.random(tracks) < 0.5
    existence = Existence(np.zeros(tracks), np.full(tracks, -np.inf))
    believed, true = [], []
    for _ in range(scans):
        there &= rng.random(tracks) < np.exp(-2.0 / stay)
        seen = rng.random(tracks) < np.where(there, 0.7, 0.3)
        existence = survive(existence, np.array(2.0), stay)
        existence = existence._replace(log_lr=existence.log_lr + np.where(seen, np.log(7 / 3), np.log(3 / 7)))
        believed.append(1.0 / (1.0 + np.exp(-existence.log_odds)))
        true.append(there.copy())
    p, is_there = np.array(believed)[-1], np.array(true)[-1]
    bins = np.minimum((p * 10).astype(int), 9)
    for number in range(10):
        chosen = bins == number
        if chosen.sum() > 100:
            mean, sd = p[chosen].mean(), np.sqrt(p[chosen].mean() * (1.0 - p[chosen].mean()) / chosen.sum())
            assert abs(is_there[chosen].mean() - mean) < 4.0 * sd, f"bin {number}"  # 99.99 % each


def test_a_tentative_track_that_was_there_is_confirmed_however_short_targets_stay() -> None:
    existence = Existence(np.array([9.5]), np.array([9.4]))  # odds of being there now are below 1
    after, verdict = decide_with_life(existence, np.array([0], np.uint8), LIMITS)
    assert verdict.accepted
    np.testing.assert_allclose(after.log_lr, existence.log_odds)


# Who is lost, who is coasting -----------------------------------------------------------------------------------------


def watched(*sensors: dict[str, Any], **tables: Any) -> Scenario:
    content = {"initiation": {"speed": 10.0}, "hypothesis": [], "target": [], "simulation": None}
    view = {"shape": "disc", "radius": 500.0}
    table = sensor_table("a", position=[0.0, 0.0], sigma=[5.0, 5.0], false_plots=0.1, field_of_view=view)
    return scenario(*(sensors or (table,)), **{"motion": {"psd": 0.1}, **content, **tables})


def tracks_at(plot: Scenario, places: list[list[float]], sigma: float = 5.0, **fields: Any) -> Picture:
    """Confirmed tracks that had a plot at time 0."""
    count, fuser = len(places), Stage(plot).center.fuser
    states = np.hstack([np.array(places), np.zeros((count, 2))])
    P = np.repeat(np.diag([sigma**2, sigma**2, 1.0, 1.0])[None], count, axis=0)
    whole = fuser.begin(fuser.empty(), np.arange(count), np.zeros(count, np.int64), Gaussian(states, P))
    return whole._replace(status=np.full(count, CONFIRMED), **fields)


def judged(plot: Scenario, picture: Picture, after_s: float, pose: list[float] | None = None) -> dict[int, str]:
    """What becomes of tracks without a plot for some time: lost, coasting, or confirmed."""
    outlooks = [look._replace(pose=SensorPose(np.array(pose or [0.0, 0.0]))) for look in Life.of(plot).begin()]
    after, decisions = Life.of(plot).judge(picture, round(after_s * 1e9), outlooks)
    found = dict.fromkeys(after.ids.tolist(), "confirmed") | dict.fromkeys(
        after.ids[after.coasting].tolist(), "coasting"
    )
    return found | {decision.track: decision.kind for decision in decisions}


def test_a_track_outside_every_field_of_view_is_lost_after_five_scans() -> None:
    plot = watched()
    picture = tracks_at(plot, [[0.0, 0.0], [700.0, 0.0], [495.0, 0.0]])
    assert judged(plot, picture, 4.0) == {0: "confirmed", 1: "confirmed", 2: "confirmed"}
    assert judged(plot, picture, 9.0) == {0: "confirmed", 1: "confirmed", 2: "confirmed"}
    assert judged(plot, picture, 10.0) == {0: "coasting", 1: "lost", 2: "coasting"}


def test_where_a_track_can_be_seen_depends_on_where_the_sensor_stands_now() -> None:
    plot = watched()
    picture = tracks_at(plot, [[0.0, 0.0], [900.0, 0.0]])
    assert judged(plot, picture, 10.0, [900.0, 0.0]) == {0: "lost", 1: "coasting"}


def test_a_track_of_which_nobody_knows_where_it_is_is_lost() -> None:
    wide = sensor_table("a", field_of_view={"shape": "everywhere", "area": 1e6})
    plot = watched(wide)
    assert plot.extent == 1000.0
    assert judged(plot, tracks_at(plot, [[0.0, 0.0]], sigma=240.0), 100.0) == {0: "coasting"}
    assert judged(plot, tracks_at(plot, [[0.0, 0.0]], sigma=260.0), 100.0) == {0: "lost"}


def test_tentative_tracks_are_lost_too() -> None:
    plot = watched()
    picture = tracks_at(
        plot,
        [[700.0, 0.0]],
    )._replace(status=np.zeros(1, np.uint8))
    assert judged(plot, picture, 10.0) == {0: "lost"}


def test_the_keys_of_the_scenario_are_followed() -> None:
    plot = watched(life={"coasting_after": 3.0, "lost_after": 20.0, "lost_below": 0.2, "lost_sigma": 50.0})
    picture = tracks_at(plot, [[700.0, 0.0], [503.0, 0.0]])
    assert judged(plot, picture, 3.0) == {0: "coasting", 1: "coasting"}
    assert judged(plot, picture, 19.0) == {0: "coasting", 1: "coasting"}
    assert judged(plot, picture, 20.0) == {0: "lost", 1: "coasting"}
    assert judged(plot, tracks_at(plot, [[0.0, 0.0]], sigma=51.0), 20.0) == {0: "lost"}


@pytest.mark.parametrize(
    ("change", "after_s"),
    [
        ({"p_d": 0.9}, 10.0),  # five scans of 2 s
        ({"p_d": 0.5}, 34.0),  # 17 misses in a row happen once in 100,000 times
        ({"p_d": 1.0}, 6.0),
        ({"p_d": 0.9, "spacing": 5.0}, 25.0),
        ({"p_d": 0.9, "visibility": {"visible_for": 60.0, "hidden_for": 12.0}}, 12.0),
    ],
)
def test_how_long_a_track_may_go_unseen_depends_on_the_sensor(change: dict[str, Any], after_s: float) -> None:
    plot = watched(sensor_table("a", position=[0.0, 0.0], **change), life={"lost_after": 1000.0})
    picture = tracks_at(plot, [[0.0, 0.0]])
    assert judged(plot, picture, after_s - 0.5) == {0: "confirmed"}
    assert judged(plot, picture, after_s) == {0: "coasting"}


def test_the_slowest_sensor_that_should_see_it_counts() -> None:
    small = {"shape": "disc", "radius": 100.0}
    fast = sensor_table("fast", position=[0.0, 0.0], scan_interval=0.5, field_of_view=small)
    slow = sensor_table("slow", position=[1000.0, 0.0], scan_interval=4.0, field_of_view=small)
    plot = watched(fast, slow, life={"lost_after": 1000.0})
    outlooks = Life.of(plot).begin()
    picture = tracks_at(plot, [[0.0, 0.0], [1000.0, 0.0]])
    for after_s, coasting in ((2.0, [False, False]), (2.5, [True, False]), (20.0, [True, True])):
        after, _ = Life.of(plot).judge(picture, round(after_s * 1e9), outlooks)
        assert after.coasting.tolist() == coasting


@pytest.mark.parametrize("claimed_s", [0.2, 20.0])
def test_how_often_a_sensor_scans_is_seen_from_its_scans(claimed_s: float) -> None:
    plot = watched(sensor_table("a", position=[0.0, 0.0], scan_interval=claimed_s), life={"lost_after": 1000.0})
    life, picture = Life.of(plot), tracks_at(plot, [[0.0, 0.0]])
    outlooks = life.begin()
    for _ in range(40):
        outlooks = life.look(outlooks, {0: outlooks[0].pose}, 2 * 10**9)
    for after_s, coasting in ((9.5, False), (10.5, True)):  # five scans of 2 s
        after, _ = life.judge(picture, round(after_s * 1e9), outlooks)
        assert after.coasting.tolist() == [coasting]


def test_given_hypotheses_live_as_before_unless_the_scenario_says_otherwise() -> None:
    given = scenario()
    assert given.life is None
    assert (given.stay, Life.of(given).ending) == (np.inf, None)
    asked = scenario(life={"stay": 100.0})
    assert asked.stay == 100.0
    assert Life.of(asked).ending is not None
    assert watched().stay == 1000.0 / 2.5  # a slow target, through the disc


# Whole networks -------------------------------------------------------------------------------------------------------

#: Ways to share a picture; the rest is the same.
WAYS = {
    "advice": {},
    "none": {"feedback": "none"},
    "reset": {"feedback": "reset"},
    "naive": {"mode": "naive"},
    "mirrored": {"association": "mirrored"},
    "selected": {"mode": "selected"},
    "centralised": {},
}


def leaving(fusion: dict[str, Any], **tables: Any) -> Scenario:
    """Two radars whose views end 500 m away."""
    view = {"shape": "disc", "radius": 500.0}
    radar = {"position": [0.0, 0.0], "sigma": [5.0, 5.0], "false_plots": 0.2, "field_of_view": view}
    return watched(sensor_table("a", **radar), sensor_table("b", first_scan=1.0, **radar), fusion=fusion, **tables)


def scans_of(plot: Scenario, paths: list[Any], until_s: float, seed: int = 1) -> list[Scan]:
    """Both radars, in turn; ``paths`` give places over time, None where a target is not there."""
    rng, scans = np.random.default_rng(seed), []
    for second in np.arange(1.0, until_s):
        name = "b" if second % 2 else "a"
        places = [place for path in paths if (place := path(second)) is not None and np.hypot(*place) < 500.0]
        z = [np.array(place) + 5.0 * rng.normal(size=2) for place in places if rng.random() < 0.9]
        if rng.random() < 0.2:
            z.append(rng.uniform(-350.0, 350.0, 2))
        scans.append(Scan(name, plot.to_ns(float(second)), np.zeros(2), np.array(z).reshape(-1, 2)))
    return scans


def said(plot: Scenario, scans: list[Scan], way: str) -> tuple[list[Tracks], list[Decision]]:
    """Pictures and decisions of a way to share."""
    messages = list(Centralised.of(plot).run(scans) if way == "centralised" else Replay(plot, scans).run())
    pictures = [message for message in messages if isinstance(message, Tracks)]
    return pictures, [message for message in messages if isinstance(message, Decision)]


@pytest.mark.parametrize("way", WAYS)
def test_a_target_that_leaves_the_view_is_lost_soon_in_every_mode(way: str) -> None:
    plot = leaving(WAYS[way], life={"coasting_after": 6.0})
    scans = scans_of(plot, [lambda t: (10.0 * t - 300.0, 50.0)], 140.0)  # it leaves at 80 s
    pictures, decisions = said(plot, scans, way)
    lost = [decision for decision in decisions if decision.kind in ("lost", "deleted") and decision.log_lr_total > 50.0]
    assert [decision.kind for decision in lost] == ["lost"]
    assert 80.0 < plot.to_seconds(lost[0].time_ns) < 100.0
    assert not (pictures[-1].status != Status.TENTATIVE).any()
    row = next(np.flatnonzero(tracks.ids == lost[0].track) for tracks in pictures if tracks.time_ns == lost[0].time_ns)
    tracks = next(tracks for tracks in pictures if tracks.time_ns == lost[0].time_ns)
    assert 75.0 < plot.to_seconds(int(tracks.supported_ns[row[0]])) < 81.0
    statuses = {
        int(tracks.status[place]) for tracks in pictures for place in np.flatnonzero(tracks.ids == lost[0].track)
    }
    assert statuses == set(Status)


def turning(plot: Scenario, path: Any, until_s: float, seed: int = 2) -> list[Scan]:
    """Every half second a sector looks an eighth of a circle on."""
    rng, scans = np.random.default_rng(seed), []
    for number in range(1, int(2.0 * until_s)):
        time_s, heading = 0.5 * number, (0.25 * np.pi * number) % (2.0 * np.pi)
        place = np.array(path(time_s))
        off = (np.arctan2(*place) - heading + np.pi) % (2.0 * np.pi) - np.pi
        seen = abs(off) < 0.5 and rng.random() < 0.9
        z = [place + 5.0 * rng.normal(size=2)] if seen else []
        scans.append(Scan("a", plot.to_ns(time_s), np.zeros(2), np.array(z).reshape(-1, 2), heading=float(heading)))
    return scans


@pytest.mark.parametrize("way", WAYS)
def test_a_target_between_two_looks_of_a_sector_that_turns_is_not_lost(way: str) -> None:
    view = {"shape": "sector", "radius": 500.0, "direction": 0.0, "width": 1.0}
    table = {"position": [0.0, 0.0], "sigma": [5.0, 5.0], "false_plots": 0.1, "scan_interval": 0.5}
    plot = watched(sensor_table("a", field_of_view=view, **table), fusion=WAYS[way])
    scans = turning(plot, lambda t: (5.0 * t - 200.0, 150.0), 80.0)
    pictures, decisions = said(plot, scans, way)
    assert [decision.kind for decision in decisions].count("confirmed") == 1
    assert not {"lost", "merged"} & {decision.kind for decision in decisions}
    shown = [tracks.status for tracks in pictures if np.isin(tracks.status, [Status.CONFIRMED, Status.COASTING]).any()]
    coasting = [bool((status == Status.COASTING).any()) for status in shown]
    assert len(coasting) > 80
    assert np.mean(coasting) < 0.2  # a turn takes 4 s; two looks in a row are seldom missed
    gone = turning(plot, lambda t: (5.0 * t - 200.0, 150.0) if t < 60.0 else (0.0, 900.0), 140.0)
    gone = [scan if len(scan.z) == 0 or abs(scan.z[0, 1]) < 500.0 else scan._replace(z=scan.z[:0]) for scan in gone]
    pictures, _ = said(plot, gone, way)
    assert not np.isin(pictures[-1].status, [Status.CONFIRMED, Status.COASTING]).any()


@pytest.mark.parametrize("way", ["advice", "selected", "centralised"])
def test_the_sum_of_log_lambda_does_not_know_of_survival(way: str) -> None:
    paths = [lambda t: (4.0 * t - 200.0, 0.0)]
    sums = []
    for stay in (30.0, 1e6):
        plot = leaving(WAYS[way], life={"stay": stay})
        pictures, decisions = said(plot, scans_of(plot, paths, 40.0), way)
        first = next(decision.track for decision in decisions if decision.kind == "confirmed")
        sums.append([float(tracks.log_lr_total[tracks.ids == first][0]) for tracks in pictures if first in tracks.ids])
    np.testing.assert_allclose(sums[0][:25], sums[1][:25], rtol=1e-9)


@pytest.mark.parametrize("way", ["advice", "none", "mirrored", "selected", "centralised"])
@pytest.mark.parametrize("seeing", ["a", "b"])
def test_misses_of_the_only_sensor_that_sees_a_track_count_in_full(way: str, seeing: str) -> None:
    view = {"shape": "disc", "radius": 500.0}
    places = {seeing: 0.0, "b" if seeing == "a" else "a": 5000.0}
    tables = [
        sensor_table(name, position=[places[name], 0.0], p_d=0.8, false_plots=0.1, field_of_view=view) for name in "ab"
    ]
    here = {"state": [0.0, 0.0, 0.0, 0.0], "sigma": [5.0, 5.0, 0.5, 0.5]}
    plot = scenario(
        *tables,
        motion={"psd": 0.01},
        hypothesis=[here],
        target=[],
        life={},
        decision={"enabled": False},
        fusion=WAYS[way],
    )
    scans = [
        Scan(name, plot.to_ns(2.0 * number), np.array([places[name], 0.0]), np.empty((0, 2)))
        for number in range(1, 4)
        for name in "ab"
    ]
    pictures, _ = said(plot, scans, way)
    miss = np.log(1.0 - 0.8 * 0.9997)  # the gate holds so many plots
    np.testing.assert_allclose([tracks.log_lr_total[0] for tracks in pictures], miss * np.arange(1, 4))


def test_live_is_as_replayed_where_tracks_are_lost() -> None:
    plot = leaving({})
    live = live_as_replayed(plot, scans_of(plot, [lambda t: (20.0 * t - 300.0, 50.0)], 70.0))
    assert "lost" in {decision.kind for decision in live.decisions}


# One target or two ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", WAYS)
def test_two_targets_nearer_than_a_plots_noise_stay_two(way: str) -> None:
    plot = leaving(WAYS[way], decision={"p0": 1e-4, "p1": 0.99, "keep": 0.9999})
    far = [
        lambda t: (4.0 * t - 200.0, max(60.0 - 3.0 * t, 4.0)),
        lambda t: (4.0 * t - 200.0, min(3.0 * t - 60.0, -4.0)),
    ]
    pictures, decisions = said(plot, scans_of(plot, far, 80.0), way)
    confirmed = [decision.track for decision in decisions if decision.kind == "confirmed"]
    ended = {decision.track for decision in decisions if decision.kind in ("deleted", "lost", "merged")}
    assert len(set(confirmed) - ended) == 2
    assert np.isin(pictures[-1].status, [Status.CONFIRMED]).sum() >= 2


@pytest.mark.parametrize("way", WAYS)
def test_of_two_tracks_one_goes_when_only_one_target_is_left(way: str) -> None:
    plot = leaving(
        WAYS[way], decision={"p0": 1e-4, "p1": 0.99, "keep": 0.999}, initiation={"speed": 10.0, "merge": 9.0}
    )

    def second(t: float) -> tuple[float, float] | None:
        return (4.0 * t - 200.0, 60.0 - 2.0 * t) if t < 30.0 else None  # it stops where the other one is

    pictures, _ = said(plot, scans_of(plot, [lambda t: (4.0 * t - 200.0, 0.0), second], 80.0), way)
    held = [int(np.isin(tracks.status, [Status.CONFIRMED]).sum()) for tracks in pictures]
    assert max(held) == 2
    assert held[-1] == 1
