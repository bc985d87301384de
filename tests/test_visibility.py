"""Targets that a sensor loses for a while, and scans that it does not need."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from builders import hypothesis_table, only, scenario, sensor_table

from waldnet.common.config import Scenario, load_scenario
from waldnet.common.errors import ConfigError
from waldnet.common.estimation.visibility import Visibility, seen
from waldnet.common.messages import Scan, Tracks
from waldnet.offline.replay import Replay
from waldnet.scenarios.world import simulate, simulate_all
from waldnet.sensor_node.sources import all_scans, source
from waldnet.studies.plan import Order, check

LOSES = {"visible_for": 12.0, "hidden_for": 6.0}
#: Covers all: every target is inside.
FAR = {"shape": "box", "center": [0.0, 0.0], "size": [1e6, 1e6]}

LOST_TOML = """
name = "lost"
motion = {{ psd = 1.0 }}
fusion = {{ mode = "{mode}" }}
[[sensor]]
name = "a"
sigma = [50.0, 50.0]
p_d = 0.9
visibility = {{ visible_for = 12.0, hidden_for = 6.0 }}
false_plots = 1.0
field_of_view = {{ shape = "disc", radius = 5000.0 }}
"""


def log_lr(plot: Scenario, scans: list[Scan]) -> list[float]:
    """After every scan, of the only track."""
    return [tracks.log_lr_total[0] for tracks in only(Tracks, list(Replay(plot, scans).run()))]


def test_log_lr_is_that_of_the_hidden_markov_model() -> None:
    """Where plots do not move the track, the forward algorithm over visible and hidden gives the same."""
    still = hypothesis_table(0.0, 0.0, state=[0.0] * 4, sigma=[1e-4] * 4)
    sensor = sensor_table("a", p_d=0.9, visibility=LOSES, field_of_view=FAR)
    plot = scenario(sensor, hypothesis=[still], motion={"psd": 1e-12}, decision={"p0": 1e-300, "p1": 1 - 1e-15})
    hit = np.random.default_rng(1).random(40) < 0.5
    hit[10:25] = False
    scans = [
        Scan("a", plot.to_ns(2.0 * k), np.zeros(2), np.zeros((int(found), 2))) for k, found in enumerate(hit, start=1)
    ]
    density, rho_f, p_g = 1.0 / (2.0 * np.pi * 50.0**2), 2.0 / 1e12, plot.fusion.gate_probability
    visible, hidden = 12.0 / 18.0, 6.0 / 18.0
    expected = []
    for k, found in enumerate(hit):
        if k:
            stay = 2.0 / 3.0 + np.exp(-2.0 / 12.0 - 2.0 / 6.0) / 3.0
            back = 2.0 / 3.0 - np.exp(-2.0 / 12.0 - 2.0 / 6.0) * 2.0 / 3.0
            visible, hidden = visible * stay + hidden * back, visible * (1.0 - stay) + hidden * (1.0 - back)
        visible *= 1.0 - 0.9 * p_g + 0.9 * density / rho_f * found
        expected.append(np.log(visible + hidden))
    assert log_lr(plot, scans) == pytest.approx(expected, abs=1e-6)


def test_a_row_of_misses_costs_less_where_targets_hide() -> None:
    always, sometimes = (
        scenario(sensor_table("a", **more), decision={"p0": 1e-9, "p1": 1 - 1e-9})
        for more in ({}, {"visibility": {"visible_for": 60.0, "hidden_for": 20.0}})
    )
    scans = [Scan("a", always.to_ns(2.0 * k), np.zeros(2), np.empty((0, 2))) for k in range(1, 4)]
    assert log_lr(always, scans)[-1] == pytest.approx(3 * np.log(0.1), rel=0.01)
    assert log_lr(sometimes, scans)[-1] > 1.5 * np.log(0.1)


def test_what_was_impossible_tells_nothing() -> None:
    v = seen(np.array([0.3, 0.3, 1.0]), np.array([-np.inf, 0.0, -2.0]))
    assert v.tolist() == [0.3, pytest.approx(0.3), 1.0]


def test_drawn_times_are_as_long_as_they_should_be() -> None:
    """Over 20,000 s: shares within four standard errors."""
    chain = Visibility(12.0, 6.0)
    visible = chain.draw(np.random.default_rng(1), np.full(39_999, 0.5))
    assert visible.mean() == pytest.approx(2 / 3, abs=4 * np.sqrt(2 / 9 * 2 * 4.0 / 20_000.0))
    runs = np.diff(np.flatnonzero(np.diff(visible.astype(int), prepend=2, append=2)))
    shown, lost = runs[:: 2 if visible[0] else 1], runs[1::2]
    mean_lost = 0.5 * (lost if visible[0] else runs[::2]).mean()
    assert mean_lost == pytest.approx(6.0, rel=4 / np.sqrt(len(shown)) + 0.05)


def test_simulated_targets_are_lost_in_rows() -> None:
    sensor = sensor_table("a", p_d=1.0, visibility=LOSES, false_plots=1e-9, field_of_view=FAR)
    still = {"motion": {"psd": 1e-6}, "hypothesis": [], "target": [{"state": [0.0] * 4}]}
    plot = scenario(sensor, simulation={"duration": 20_000.0}, **still)
    found = np.array([len(scan.z) for scan in simulate(plot, "a", 1)])
    assert found.mean() == pytest.approx(2 / 3, abs=0.04)
    after_a_miss = found[1:][found[:-1] == 0].mean()
    assert after_a_miss == pytest.approx(2.0 / 3.0 * (1.0 - np.exp(-0.5)), abs=0.04)


@pytest.mark.parametrize("mode", ["dkf", "selected"])
def test_modes_that_know_no_visibility_refuse_it(tmp_path: Path, mode: str) -> None:
    path = tmp_path / "lost.toml"
    path.write_text(LOST_TOML.format(mode=mode), encoding="utf-8")
    with pytest.raises(ConfigError, match=f"sensor.0.visibility: mode '{mode}' takes targets for visible all the time"):
        load_scenario(path)


def test_studies_refuse_it() -> None:
    plot = scenario(sensor_table("a", visibility=LOSES))
    with pytest.raises(ConfigError, match="test: sensor 'a' has a visibility; the modes of a study know none"):
        check(plot, Order(modes=("naive",), runs=1, seed=0, p_d=()), ("naive",))


def test_scans_that_come_too_soon_are_passed_over() -> None:
    whole = scenario(sensor_table("a", scan_interval=0.5), sensor_table("b"))
    spaced = scenario(sensor_table("a", scan_interval=0.5, spacing=1.2), sensor_table("b"))
    kept = all_scans(spaced, seed=3)
    times = [spaced.to_seconds(scan.time_ns) for scan in kept if scan.sensor == "a"]
    assert times == pytest.approx(np.arange(0.5, 20.1, 1.5))
    assert [scan.time_ns for scan in kept if scan.sensor == "b"] == [
        scan.time_ns for scan in simulate_all(whole, 3) if scan.sensor == "b"
    ]
    own = source(spaced, "a", seed=3)
    assert [scan.time_ns for scan in own.scans] == [scan.time_ns for scan in kept if scan.sensor == "a"]
    assert list(own.schedule.times_ns) == sorted({scan.time_ns for scan in kept})
