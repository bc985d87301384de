"""Mode selected: nodes send the plots that matter to their tracks, and the center tracks with them (Eq. 20)."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import Node, Stage, hypothesis_table, only, scenario, sensor_table
from numpy.typing import NDArray
from scipy.stats import chi2

from waldnet.common.codec import decode, encode
from waldnet.common.config import ConfigError, Scenario, load_scenario
from waldnet.common.estimation.association import Clutter, Plots, expect
from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.estimation.selection import Selection, select
from waldnet.common.estimation.sensing import Position
from waldnet.common.messages import NEVER, Keys, Picked, Report, Scan, Tracks
from waldnet.offline.network import run_in_memory
from waldnet.offline.replay import Replay
from waldnet.scenarios.world import simulate_all

Array = NDArray[np.float64]

CLUTTERED = {"p_d": 0.7, "false_plots": 60.0}


def selecting(*sensors: dict[str, Any], fusion: dict[str, Any] | None = None, **tables: Any) -> Scenario:
    """Two sensors in clutter, a target and a decoy."""
    few = sensor_table("a", **CLUTTERED), sensor_table("b", scan_interval=3.0, **CLUTTERED)
    hypotheses = [hypothesis_table(), hypothesis_table(3000.0, 2000.0, start=1.0)]
    plain = {"hypothesis": hypotheses, "decision": {"enabled": False}}
    return scenario(*(sensors or few), fusion={"mode": "selected"} | (fusion or {}), **plain | tables)


def pictures(plot: Scenario, scans: list[Scan]) -> list[Tracks]:
    return [message for message in Replay(plot, scans).run() if isinstance(message, Tracks)]


def chosen(log_w: Array, density: Gaussian, z: Array, how: Selection) -> Array:
    """Eq. (20), written out."""
    H, R = np.eye(2, 4), np.diag([2500.0, 2500.0])
    found = np.zeros((len(log_w), len(z)), bool)
    for track, weights in enumerate(log_w):
        for component, weight in enumerate(weights):
            S = H @ density.P[0, track, component] @ H.T + R
            nu = z - H @ density.x[0, track, component]
            distance = (nu * np.linalg.solve(S, nu.T).T).sum(axis=1)
            found[track] |= (np.exp(weight) >= how.weight) & (distance <= chi2.ppf(how.probability, 2))
    return found


@pytest.mark.parametrize("tracks", [3, 300])  # the second looks at the pairs inside boxes only
def test_what_is_selected_is_in_the_gate_of_a_component_that_counts(tracks: int) -> None:
    rng, how = np.random.default_rng(1), Selection(0.95, 0.02)
    weights = rng.dirichlet([0.2, 1.0, 1.0], tracks)
    x = np.concatenate([rng.uniform(-3000.0, 3000.0, (1, tracks, 3, 2)), np.zeros((1, tracks, 3, 2))], axis=-1)
    A = rng.normal(size=(1, tracks, 3, 4, 4)) * 40.0
    density = Gaussian(x, A @ A.mT + 400.0 * np.eye(4))
    z = rng.uniform(-3000.0, 3000.0, (150, 2))
    linear = Position((50.0, 50.0), 4).linearise(density, np.zeros(2))
    expected = expect(density, linear, Clutter(np.full((tracks, 3), 0.5), np.array(-12.0), 0.9997))
    ours = select(np.log(weights), expected, Plots(z), how)
    theirs = chosen(np.log(weights), density, z, how)
    assert 0.0 < theirs.mean() < 0.2 and (np.exp(np.log(weights)) < how.weight).any()
    np.testing.assert_array_equal(ours, theirs)
    own = Plots(np.repeat(z[None, None], tracks, axis=0), np.ones((tracks, 1, 150), bool))
    np.testing.assert_array_equal(select(np.log(weights), expected, own, how), theirs)


def test_a_node_sends_every_plot_that_matters_once() -> None:
    plot = selecting(hypothesis=[hypothesis_table(), hypothesis_table(50.0)])
    stage = Stage(plot)
    node = Node(plot, "a", stage.join_all(a=2.0, b=3.0)["a"])
    z = np.array([[300.0, 0.0], [9000.0, 9000.0], [320.0, 30.0]])
    sent = node.scan(Scan("a", plot.to_ns(2.0), np.array([3000.0, 0.0]), z))
    assert isinstance(sent, Picked)
    np.testing.assert_array_equal(sent.z, z[[0, 2]])
    assert (sent.plots.tolist(), sent.which.tolist()) == ([2, 2], [0, 1, 0, 1])
    assert isinstance(decode(Keys("n").of(sent), encode(sent)), Picked)


def test_a_scan_without_such_plots_is_evidence() -> None:
    plot = selecting(sensor_table("a", **CLUTTERED))
    scans = [Scan("a", plot.to_ns(2.0), np.array([3000.0, 0.0]), np.empty((0, 2)))]
    (tracks,) = pictures(plot, scans)
    miss = np.log(1.0 - 0.7 * plot.fusion.gate_probability)
    np.testing.assert_allclose(tracks.log_lr_total, miss, rtol=1e-12)


def test_it_does_not_matter_in_which_order_reports_come() -> None:
    plot = selecting(fusion={"window": 100.0})
    whole = pictures(plot, simulate_all(plot, 5))[-1]
    for order in list(permutations(range(4)))[::5]:
        stage = Stage(plot)
        starts = stage.join_all(a=2.0, b=3.0)
        nodes = {name: Node(plot, name, start) for name, start in starts.items()}
        reports = [nodes[scan.sensor].scan(scan) for scan in simulate_all(plot, 5)]
        # Four of them are shuffled, of different sensors and times.
        shuffled = [reports[2 + at] for at in order]
        for report in [*reports[:2], *shuffled, *reports[6:]]:
            stage.tell(report, 1000.0)
        stage.tick(2000.0)
        np.testing.assert_allclose(stage.tracks.log_lr_total, whole.log_lr_total, rtol=1e-12)
        np.testing.assert_allclose(stage.tracks.x, whole.x, rtol=1e-12)


def test_sensors_of_one_time_take_turns_in_the_order_of_the_scenario() -> None:
    """Hypotheses are combined in between, so that another order would give other digits."""
    dense = {"p_d": 0.5, "false_plots": 4000.0}
    plot = selecting(sensor_table("a", **dense), sensor_table("b", **dense))
    scans = simulate_all(plot, 5)
    whole = pictures(plot, scans)[-1]
    stage = Stage(plot)
    starts = stage.join_all(a=2.0, b=2.0)
    nodes = {name: Node(plot, name, start) for name, start in starts.items()}
    reports = [nodes[scan.sensor].scan(scan) for scan in scans]
    for one, other in zip(reports[::2], reports[1::2], strict=True):
        stage.tell(other._replace(next_ns=other.time_ns + 1), 1.0)
        stage.tell(one._replace(next_ns=other.time_ns + 1), 1.0)
    np.testing.assert_array_equal(stage.tracks.log_lr_total, whole.log_lr_total)


def test_a_network_in_memory_says_what_replay_says() -> None:
    plot = selecting(decision={"p0": 1e-4, "p1": 0.95})
    scans = simulate_all(plot, 2)
    record = run_in_memory(plot, scans)
    told = list(Replay(plot, scans).run())
    assert {decision.kind for decision in record.decisions} == {"confirmed", "deleted"}
    assert list(record.decisions) == [message for message in told if not isinstance(message, Tracks)]


def test_a_sensor_that_joins_late_begins_with_the_fused_tracks() -> None:
    plot = selecting()
    stage = Stage(plot)
    node = Node(plot, "a", stage.join_all(a=2.0, b=3.0)["a"])
    for scan in (scan for scan in simulate_all(plot, 5) if scan.sensor == "a"):
        stage.tell(node.scan(scan, scan.time_ns + 1), 100.0)
    stage.tick(200.0)
    (start,) = only(type(stage.join_all(b=30.0)["b"]), stage.join("b", 30.0, incarnation=7, at_s=300.0))
    np.testing.assert_array_equal(start.x, stage.tracks.x)
    np.testing.assert_array_equal(start.times_ns, stage.state.picture.times_ns)


def test_reports_of_another_kind_are_refused() -> None:
    factors, plots = scenario(sensor_table("a")), selecting(sensor_table("a"))
    for ours, theirs in ((factors, plots), (plots, factors)):
        stage = Stage(ours)
        start = stage.join_all(a=2.0)["a"]
        sent = Node(theirs, "a", start).scan(Scan("a", ours.to_ns(2.0), np.zeros(2), np.zeros((1, 2))), NEVER)
        assert isinstance(sent, Report | Picked)
        stage.tell(sent, 1.0)
        assert stage.state.counts.refused == 1 and not stage.state.history


def test_plots_of_another_size_are_refused() -> None:
    plot = selecting(sensor_table("a"))
    stage = Stage(plot)
    sent = Node(plot, "a", stage.join_all(a=2.0)["a"]).scan(Scan("a", plot.to_ns(2.0), np.zeros(2), np.zeros((1, 2))))
    assert isinstance(sent, Picked)
    stage.tell(sent._replace(z=np.zeros((len(sent.z), 3))), 1.0)
    stage.tell(sent._replace(position=np.zeros(3)), 1.0)
    assert stage.state.counts.refused == 2


@pytest.mark.parametrize("key", ['association = "tight"', 'feedback = "reset"'])
def test_what_only_factors_have_is_a_fault(key: str, tmp_path: Path) -> None:
    text = Path("scenarios/four-radars.toml").read_text()
    file = tmp_path / "bad.toml"
    lines = [line for line in text.splitlines() if not line.startswith(("association", "mode ="))]
    file.write_text("\n".join(lines).replace("[fusion]", f'[fusion]\nmode = "selected"\n{key}'))
    with pytest.raises(ConfigError, match=r"fusion.mode: 'selected' has no factors: no association, no feedback"):
        load_scenario(file)
