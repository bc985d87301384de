"""One tracker that gets the plots of all sensors: beside the network, a Kalman filter, and the studies' baseline."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from builders import hypothesis_table, scenario, sensor_table

from waldnet.common.config import Scenario, load_scenario
from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.messages import Decision, Scan, Tracks
from waldnet.common.process import main
from waldnet.launch.cli import app
from waldnet.offline.centralised import Centralised
from waldnet.offline.replay import Replay
from waldnet.scenarios.catalogue import find
from waldnet.scenarios.world import simulate_all
from waldnet.studies import baselines
from waldnet.studies.worlds import draw

FERRY = {"shape": "disc", "radius": 20_000.0}
#: Of every kind, some of them at the same times.
KINDS = (
    sensor_table("a"),
    sensor_table("b", kind="polar", sigma=[40.0, 0.01], p_d=0.7),
    sensor_table("c", kind="polar-doppler", sigma=[40.0, 0.01, 1.0], first_scan=1.0),
    sensor_table("d", kind="bearing", sigma=[0.01], update="sigma-point", field_of_view=FERRY, scan_interval=1.0),
)


def pictures(messages: Any) -> list[Tracks]:
    return [message for message in messages if isinstance(message, Tracks)]


def decisions(messages: Any) -> list[Decision]:
    return [message for message in messages if isinstance(message, Decision)]


def centralised(plot: Scenario, scans: list[Scan]) -> list[Tracks | Decision]:
    return list(Centralised.of(plot).run(scans))


def undecided(*sensors: dict[str, Any], **tables: Any) -> Scenario:
    return scenario(*sensors, **{"decision": {"enabled": False}} | tables)


def boats(*sensors: dict[str, Any], **tables: Any) -> Scenario:
    """Two targets that nobody knows of."""
    targets = [{"state": [-1000.0, 0.0, 60.0, 0.0]}, {"state": [2000.0, 3000.0, 0.0, -80.0]}]
    fixed = {"motion": {"psd": 1e-6}, "decision": {"p1": 0.9999}, "simulation": {"duration": 40.0}}
    begins = {"initiation": {"speed": 100.0}, "hypothesis": [], "target": targets}
    return scenario(*sensors, **fixed | begins | tables)


@pytest.mark.parametrize("fusion", [{}, {"association": "mirrored"}, {"filter": "nearest"}])
def test_with_one_sensor_it_is_the_network(fusion: dict[str, Any]) -> None:
    # Deleted tracks, which nodes keep for a while, claim nothing, but belief propagation takes other steps with them.
    alone = {"fusion": {"joint": False} | fusion}
    for plot in (scenario(sensor_table("a"), **alone), boats(sensor_table("a", false_plots=5.0), **alone)):
        scans = simulate_all(plot, 3)
        network, one = pictures(Replay(plot, scans).run()), pictures(centralised(plot, scans))
        assert len(network) == len(one) == len(scans)
        for theirs, ours in zip(network, one, strict=True):
            for name in ("time_ns", "sensors", "ids", "status", "scans", "contributing"):
                np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
            for name in ("log_lr", "log_lr_total", "x", "P"):
                np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-8, atol=1e-6)
        assert len(one[-1].ids)


def test_without_clutter_it_is_the_kalman_filter() -> None:
    sure = {"p_d": 1.0, "false_plots": 1e-9, "sigma": [50.0, 50.0]}
    plot = undecided(sensor_table("a", **sure), sensor_table("b", **sure), sensor_table("c", first_scan=1.0, **sure))
    scans = simulate_all(plot, 2)
    motion, (x, P), now = plot.motion.build(), plot.hypotheses[0].density, plot.epoch_ns
    H, R, log_lr = np.eye(2, 4), 2500.0 * np.eye(2), 0.0
    rho_f = 1e-9 / 20_000.0**2
    after: dict[int, tuple[float, Gaussian]] = {}
    for scan in scans:
        dt, now = np.array((scan.time_ns - now) / 1e9), scan.time_ns
        F, Q = motion.transition(dt), motion.noise(dt)
        x, P = F @ x, F @ P @ F.T + Q
        S, nu = H @ P @ H.T + R, scan.z[0] - H @ x
        K = P @ H.T @ np.linalg.inv(S)
        log_lr += -0.5 * nu @ np.linalg.solve(S, nu) - 0.5 * np.linalg.slogdet(2 * np.pi * S)[1] - np.log(rho_f)
        x, P = x + K @ nu, P - K @ S @ K.T
        after[now] = log_lr, Gaussian(x, P)
    found = pictures(centralised(plot, scans))
    assert [tracks.time_ns for tracks in found] == list(after)
    for tracks, (wanted, density) in zip(found, after.values(), strict=True):
        np.testing.assert_allclose(tracks.log_lr_total, wanted, rtol=1e-9)
        np.testing.assert_allclose(tracks.x[0], density.x, rtol=1e-9, atol=1e-7)
        np.testing.assert_allclose(tracks.P[0], density.P, rtol=1e-8, atol=1e-8)


MODES = [
    {},
    {"mode": "naive", "association": "factor"},
    {"feedback": "reset"},
    {"feedback": "advice", "precision": "float32"},
    {"filter": "kalman"},
    {"association": "mirrored", "terms": 3},
    {"mode": "selected"},
]


@pytest.mark.parametrize("fusion", MODES)
@pytest.mark.parametrize("sensors", [(sensor_table("a"), sensor_table("b")), KINDS])
def test_it_is_the_baseline_of_the_studies(sensors: tuple[dict[str, Any], ...], fusion: dict[str, Any]) -> None:
    plot = undecided(*sensors, fusion=fusion)
    choice = fusion.get("filter") or (
        "mht" if "mirrored" in fusion.values() or "selected" in fusion.values() else "pdaf"
    )
    baseline = baselines.centralised(plot, draw(plot, np.array([4])), filter=choice)
    found = pictures(centralised(plot, simulate_all(plot, 4)))
    np.testing.assert_allclose([tracks.log_lr_total[0] for tracks in found], baseline.log_lr[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose([tracks.x[0] for tracks in found], baseline.x[0], rtol=1e-9, atol=1e-6)


def test_several_motion_models() -> None:
    models = [{"model": "cv", "psd": 1.0}, {"model": "cv", "psd": 100.0}]
    plot = undecided(motion={"model": "imm", "models": models, "sojourn": 20.0})
    baseline = baselines.centralised(plot, draw(plot, np.array([4])), filter="pdaf")
    found = pictures(centralised(plot, simulate_all(plot, 4)))
    np.testing.assert_allclose([tracks.log_lr_total[0] for tracks in found], baseline.log_lr[0], rtol=1e-9, atol=1e-9)


def test_the_mode_of_a_network_says_nothing() -> None:
    dkf = undecided(fusion={"mode": "dkf"})
    scans = simulate_all(dkf, 1)
    other = pictures(centralised(undecided(), scans))
    for one, two in zip(pictures(centralised(dkf, scans)), other, strict=True):
        np.testing.assert_array_equal(one.log_lr_total, two.log_lr_total)


def test_a_hypothesis_counts_from_its_start_on() -> None:
    """Scans of its very start are not for it, however many sensors scan then."""
    at = undecided(hypothesis=[hypothesis_table(start=4.0)], target=[])
    scans = simulate_all(at, 1)
    assert len([scan for scan in scans if at.to_seconds(scan.time_ns) == 4.0]) == 2
    found = pictures(centralised(at, scans))
    assert [len(tracks.ids) for tracks in found[:3]] == [0, 1, 1]
    assert [tracks.scans.tolist() for tracks in found[1:4]] == [[0], [1], [2]]
    assert [tracks.log_lr_total.tolist() == [0.0] for tracks in found[1:3]] == [True, False]
    for theirs, ours in zip(pictures(Replay(at, scans).run()), found, strict=True):
        np.testing.assert_array_equal(theirs.contributing, ours.contributing)
    later = pictures(centralised(at, [scan for scan in scans if at.to_seconds(scan.time_ns) > 4.0]))
    np.testing.assert_array_equal(found[-1].log_lr_total, later[-1].log_lr_total)


def test_a_track_that_has_ended_claims_nothing() -> None:
    plot = boats(sensor_table("a"), sensor_table("b", first_scan=1.0))
    steps = Centralised.of(plot)
    state, ended = steps.initial(), set[int]()
    for scan in simulate_all(plot, 5):
        state, said = steps.step(state, [scan])
        assert not ended & set(state.filtered.tracks.ids.tolist())
        ended |= {decision.track for decision in decisions(said) if decision.kind in ("deleted", "merged")}
    assert len(ended) > 10


@pytest.mark.parametrize(
    "tables",
    [
        {},
        {"initiation": {"speed": 100.0, "plots": 2}},
        {"fusion": {"feedback": "advice"}},
        {"fusion": {"association": "mirrored"}},
        {"fusion": {"mode": "selected"}},
    ],
)
def test_it_finds_targets_nobody_knows_of(tables: dict[str, Any]) -> None:
    quiet = {"false_plots": 0.5, "sigma": [30.0, 30.0]}
    bearing = sensor_table("c", kind="bearing", sigma=[0.01], field_of_view=FERRY)
    plot = boats(sensor_table("a", **quiet), sensor_table("b", **quiet), bearing, **tables)
    said = centralised(plot, simulate_all(plot, 5))
    last = pictures(said)[-1]
    held = last.x[last.status == 1, :2]
    truth = np.array([[-1000.0 + 60.0 * 40.0, 0.0], [2000.0, 3000.0 - 80.0 * 40.0]])
    assert len(held) == 2
    assert np.linalg.norm(held[:, None] - truth, axis=-1).min(axis=0).max() < 100.0
    assert len([decision for decision in decisions(said) if decision.kind == "confirmed"]) == 2


def test_replayed_from_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    def lines(*words: str) -> list[str]:
        with pytest.raises(SystemExit) as caught:
            main(app, ["replay", "mixed-sensors", "--centralised", *words])
        assert caught.value.code == 0
        return capsys.readouterr().out.splitlines()

    plot = load_scenario(find("mixed-sensors"))
    said = centralised(plot, simulate_all(plot, 1))
    assert lines()[-2].startswith("track 0: confirmed, log LR in total +")
    entries = [json.loads(line) for line in lines("--json", "--lag", "3")]
    assert [entry["log_lr_total"] for entry in entries if entry["track"] == 0] == [
        tracks.log_lr_total[tracks.ids == 0][0] for tracks in pictures(said)
    ]
    (last,) = [entry for entry in entries if entry["track"] == 0 and entry["time"] == 60.0]
    assert last["time_lag"] == 57.0
