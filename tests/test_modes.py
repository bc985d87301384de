"""The modes of a study: every run is what ``waldnet replay`` makes of the world of its seed."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from builders import hypothesis_table, scenario, sensor_table
from reference import Density, Seer, corrected, predicted

from waldnet.common.codec import Rounding, encode
from waldnet.common.config import Scenario
from waldnet.common.messages import Advice, Decision, Message, Picked, Rebase, Report, Scan, Tracks
from waldnet.offline.loopback import Sent
from waldnet.offline.replay import Replay
from waldnet.scenarios.world import simulate_all, truth
from waldnet.studies.baselines import with_fusion
from waldnet.studies.course import Course
from waldnet.studies.modes import MODES, play
from waldnet.studies.worlds import draw

SEEDS = np.array([4, 1, 7])
DISTRIBUTED = {name: mode for name, mode in MODES.items() if "fusion" not in name and hasattr(mode, "keywords")}
DISTRIBUTED = {name: mode for name, mode in DISTRIBUTED.items() if not name.startswith("centralised")}


SAME = {"decentralised-decisions", "selected-plots", "selected-plots-float32"}


def world(*sensors: dict[str, Any], **tables: Any) -> Scenario:
    """Two hypotheses, of which the second is studied; ragged scans, and sensors that are unlike and asynchronous."""
    few = {"p_d": 0.7, "false_plots": 40.0}
    unlike = sensor_table("a", **few), sensor_table("b", sigma=[30.0, 80.0], scan_interval=3.0, **few)
    hypotheses = [hypothesis_table(9000.0), hypothesis_table(100.0, 50.0, start=1.0)]
    target = [{"hypothesis": 1, "start": 1.0}]
    return scenario(
        *(sensors or unlike), **{"hypothesis": hypotheses, "target": target, "simulation": {"duration": 12.0}} | tables
    )


def fusion_of(name: str) -> dict[str, Any]:
    mode = MODES[name]
    assert isinstance(mode, partial)
    return dict(mode.keywords)


class Overheard(Replay):
    """A replay that remembers what went up and down."""

    def __init__(self, plot: Scenario, scans: list[Scan]) -> None:
        super().__init__(plot, scans, self._overhear)
        self.up: list[Message] = []
        self.down: list[Message] = []

    def _overhear(self, sent: Sent) -> None:
        if isinstance(sent.message, Report | Picked):
            self.up.append(sent.message)
        if isinstance(sent.message, Advice | Rebase):
            self.down.append(sent.message)


def pictures(plot: Scenario, seed: int) -> tuple[list[Tracks], Overheard]:
    """The replay of a world with only the studied track, after its start."""
    studied = plot.hypotheses[1]
    start_ns = plot.to_ns(studied.start)
    replay = Overheard(plot.model_copy(update={"hypotheses": (studied,)}), simulate_all(plot, seed))
    told = list(replay.run())
    assert not any(isinstance(message, Decision) for message in told)
    return [tracks for tracks in told if isinstance(tracks, Tracks) and tracks.time_ns > start_ns], replay


@pytest.mark.parametrize("name", DISTRIBUTED)
def test_a_run_is_the_replay_of_its_world(name: str) -> None:
    plot = world()
    worlds = draw(plot, SEEDS)
    course = play(plot, name, worlds)
    assert course.log_lr.shape == (len(SEEDS), len(worlds.times_ns))
    # Many runs in one report are rounded relative to a point near all of them.
    rtol = 1e-5 if name.endswith("float32") else 1e-9
    for run, seed in enumerate(SEEDS):
        replayed, _ = pictures(with_fusion(plot, **fusion_of(name)), int(seed))
        assert [tracks.time_ns for tracks in replayed] == worlds.times_ns.tolist()
        for k, tracks in enumerate(replayed):
            np.testing.assert_allclose(course.log_lr[run, k], tracks.log_lr_total[0], rtol=rtol, atol=rtol)
            np.testing.assert_allclose(course.x[run, k], tracks.x[0], rtol=rtol, atol=rtol)
            np.testing.assert_allclose(
                course.P[run, k], tracks.P[0], rtol=10 * rtol, atol=10 * rtol * tracks.P[0].max()
            )


@pytest.mark.parametrize("name", ["federated-tight", "federated-mirrored-3", "selected-plots"])
def test_so_it_is_with_sensors_of_other_kinds(name: str) -> None:
    """Plots of range and azimuth, whose false ones are denser near by, and a radar with a clutter notch."""
    view = {"shape": "disc", "radius": 9000.0}
    few = {"kind": "polar", "p_d": 0.8, "false_plots": 30.0, "field_of_view": view, "sigma": [40.0, 0.01]}
    notch = {"detection": {"model": "notch", "mdv": 20.0}}
    plot = world(sensor_table("a", **few), sensor_table("b", **few, **notch, position=[0.0, -3000.0]))
    worlds = draw(plot, SEEDS)
    course = play(plot, name, worlds)
    assert np.isfinite(course.log_lr).all() and (course.log_lr[:, -1] > 5.0).any()
    for run, seed in enumerate(SEEDS):
        replayed, _ = pictures(with_fusion(plot, **fusion_of(name)), int(seed))
        for k, tracks in enumerate(replayed):
            np.testing.assert_allclose(course.log_lr[run, k], tracks.log_lr_total[0], rtol=1e-8, atol=1e-8)


def test_modes_differ() -> None:
    """Else the comparison above would show nothing. ``SAME`` have the log LR of another mode, at other bytes."""
    plot = world()
    worlds = draw(plot, SEEDS)
    last = {name: play(plot, name, worlds).log_lr[:, -1] for name in MODES if name not in SAME}
    names = list(last)
    for i, one in enumerate(names):
        for other in names[:i]:
            assert (np.abs(last[one] - last[other]) > 1e-6).any(), (one, other)


def test_selected_plots_decide_as_all_plots_where_none_that_matters_is_missing() -> None:
    plot = world()
    worlds = draw(plot, SEEDS)
    selected, everything = (play(plot, name, worlds) for name in ("selected-plots", "centralised-mht"))
    np.testing.assert_allclose(selected.log_lr, everything.log_lr, rtol=1e-9, atol=1e-9)
    assert selected.uplink_bytes < everything.uplink_bytes


@pytest.mark.parametrize("name", DISTRIBUTED)
def test_bytes_are_those_of_the_codec(name: str) -> None:
    plot = world()
    worlds = draw(plot, SEEDS[:1])
    course = play(plot, name, worlds)
    _, replay = pictures(with_fusion(plot, **fusion_of(name)), int(SEEDS[0]))
    # The first scan of a is after the start of the track, so that all are looked at.
    assert len(replay.up) == len(worlds.looks)
    rounding = Rounding(2, plots=True) if fusion_of(name).get("precision") == "float32" else None
    assert course.uplink_bytes == pytest.approx(np.mean([len(encode(sent, rounding=rounding)) for sent in replay.up]))
    assert course.downlink_bytes == pytest.approx(sum(len(encode(message)) for message in replay.down) / len(replay.up))
    assert (course.downlink_bytes > 0.0) == (fusion_of(name).get("feedback", "none") != "none")


def test_the_bytes_of_many_runs_are_shared() -> None:
    """The envelope is that of one message with a track for every run; rounded reports take less."""
    plot = world(fusion={"precision": "float32"})
    whole, rounded = play(world(), "federated", draw(plot, SEEDS)), play(plot, "federated", draw(plot, SEEDS))
    assert 125.0 < whole.uplink_bytes < 125.0 + 20.0
    assert 69.0 < rounded.uplink_bytes < 69.0 + 20.0
    assert np.abs(whole.log_lr - rounded.log_lr).max() < 0.01


def test_worlds_are_those_that_are_simulated() -> None:
    plot = world()
    worlds = draw(plot, SEEDS)
    for run, seed in enumerate(SEEDS):
        scans = [scan for scan in simulate_all(plot, int(seed)) if scan.time_ns > plot.to_ns(1.0)]
        states = truth(plot, int(seed))
        np.testing.assert_array_equal(worlds.truth[run], states.x[0, np.isin(states.times_ns, worlds.times_ns)])
        for look, scan in zip(worlds.looks, scans, strict=True):
            assert (look.time_ns, plot.sensor_names[look.sensor]) == (scan.time_ns, scan.sensor)
            assert look.plots.valid is not None
            np.testing.assert_array_equal(look.plots.z[run][look.plots.valid[run]], scan.z)
            assert look.counts[run] == len(scan.z)


# Baselines ------------------------------------------------------------------------------------------------------------


def test_without_doubt_the_centralised_one_is_the_kalman_filter() -> None:
    sigmas = ([50.0, 50.0], [20.0, 90.0])
    certain = {"p_d": 1.0, "false_plots": 1e-6}
    sensors = [
        sensor_table(name, sigma=sigma, scan_interval=interval, **certain)
        for name, sigma, interval in zip("ab", sigmas, (2.0, 3.0), strict=True)
    ]
    plot = world(*sensors, fusion={"gate_probability": 1.0})
    worlds = draw(plot, SEEDS)
    rho_f = 1e-6 / 20_000.0**2
    for name in ("centralised", "centralised-mht"):
        course = play(plot, name, worlds)
        for run in range(len(SEEDS)):
            density, now, log_lr = Density(*plot.hypotheses[1].density), 1.0, 0.0
            for look in worlds.looks:
                time = plot.to_seconds(look.time_ns)
                density = predicted(density, time - now, 10.0, 1.0)
                density, log_n = corrected(density, look.plots.z[run, 0], Seer(sigmas[look.sensor], 1.0, rho_f))
                log_lr, now = log_lr + log_n - np.log(rho_f), time
            np.testing.assert_allclose(course.log_lr[run, -1], log_lr, rtol=1e-9)
            np.testing.assert_allclose(course.x[run, -1], density.x, rtol=1e-9)
            np.testing.assert_allclose(course.P[run, -1], density.P, rtol=1e-7, atol=1e-6)


def test_centralised_is_a_network_of_one_that_sees_everything() -> None:
    """One sensor: its plots at the center or its factor, that is the same."""
    plot = world(sensor_table("a", p_d=0.7, false_plots=400.0))
    worlds = draw(plot, SEEDS)
    for one, other in (("centralised", "federated"), ("centralised-mht", "federated-mirrored-1")):
        central, network = play(plot, one, worlds), play(plot, other, worlds)
        if one == "centralised":
            np.testing.assert_allclose(central.log_lr, network.log_lr, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(central.x, network.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(central.P, network.P, rtol=1e-8, atol=1e-5)


def test_decentralised_sensors_are_networks_of_one() -> None:
    plot = world()
    worlds = draw(plot, SEEDS)
    mean, decisions = (play(plot, name, worlds) for name in ("decentralised-mean", "decentralised-decisions"))
    assert mean.local_log_lr is None
    local = decisions.local_log_lr
    assert local is not None
    np.testing.assert_allclose(mean.log_lr, local.mean(axis=-1))
    for number, sensor in enumerate(plot.sensors):
        own = worlds._replace(looks=tuple(look._replace(sensor=0) for look in worlds.looks if look.sensor == number))
        solo: Course = play(plot.model_copy(update={"sensors": (sensor,)}), "naive", own)
        seen = np.isin(worlds.times_ns, [look.time_ns for look in own.looks])
        np.testing.assert_allclose(local[:, seen, number], solo.log_lr, rtol=1e-9, atol=1e-9)
    # A plain log LR takes 8 bytes; a decision is sent once.
    assert mean.uplink_bytes == 8.0
    assert decisions.uplink_bytes < 10.0
