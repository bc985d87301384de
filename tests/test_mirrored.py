"""Networks whose nodes keep several hypotheses, against the enumeration of all pairs of histories (Eq. 17, 18)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from builders import Node, Stage, hypothesis_table, only, same, scenario, sensor_table
from reference import (
    Array,
    Density,
    History,
    Seer,
    Term,
    aged,
    branched,
    mean_of,
    multiplied,
    predicted,
    told,
)
from scipy.special import logsumexp

from waldnet.common.codec import as_sent
from waldnet.common.config import Scenario
from waldnet.common.messages import Report, Scan, Start, Tracks
from waldnet.offline.replay import Replay
from waldnet.scenarios.world import simulate_all

AREA = 4e6
PSD = 5.0
SENSORS = (Seer((40.0, 30.0), 0.8, 2.0 / AREA), Seer((60.0, 80.0), 0.6, 3.0 / AREA))
PRIOR = Density(np.array([100.0, -50.0, 20.0, 5.0]), np.diag(np.square([80.0, 80.0, 10.0, 10.0])))
#: Nothing is dropped, nothing combined.
ALL: dict[str, Any] = {"components": 64, "prune": 0.0, "combine": 0.0}


def mirrored(terms: int, **fusion: Any) -> Scenario:
    """Two sensors that are unlike and see everywhere; without gate."""
    view = {"shape": "everywhere", "area": AREA}
    sensors = [
        sensor_table(name, sigma=seer.sigma, p_d=seer.p_d, false_plots=seer.rho_f * AREA, field_of_view=view)
        for name, seer in zip("ab", SENSORS, strict=True)
    ]
    exact = {"association": "mirrored", "terms": terms, "mixture": ALL, "gate_probability": 1.0}
    prior = {"state": PRIOR.x.tolist(), "sigma": np.sqrt(np.diagonal(PRIOR.P)).tolist()}
    return scenario(
        *sensors, fusion=exact | fusion, motion={"psd": PSD}, hypothesis=[prior], decision={"enabled": False}
    )


#: Time, sensor, number of plots.
TOGETHER = [(1.0, 0, 1), (1.0, 1, 1), (2.0, 0, 2), (2.0, 1, 0), (3.5, 0, 0), (3.5, 1, 1)]
APART = [(1.0, 0, 2), (1.5, 1, 1), (2.0, 0, 0), (3.0, 1, 2), (4.0, 0, 1), (4.5, 1, 1)]
Look = tuple[float, int, Array]


def seen(counts: Sequence[tuple[float, int, int]], seed: int = 1) -> list[Look]:
    """Plots so near that every history counts."""
    rng = np.random.default_rng(seed)
    x, v = PRIOR.x[:2], PRIOR.x[2:]
    return [(time, sensor, x + time * v + rng.normal(0.0, 120.0, (count, 2))) for time, sensor, count in counts]


def replayed(plot: Scenario, looks: Sequence[Look]) -> list[Tracks]:
    scans = [Scan("ab"[sensor], plot.to_ns(time), np.zeros(2), plots) for time, sensor, plots in looks]
    return only(Tracks, Replay(plot, scans).run())


def expected(looks: Sequence[Look], terms: int) -> list[tuple[float, Density]]:
    """log LR and fused track after every measurement time, Eq. (17) and (18) over all pairs of histories."""
    factor, log_lr, now, course = Density(PRIOR.x, 2.0 * PRIOR.P), 0.0, 0.0, []
    histories = [[History(0.0, 0.0, PRIOR, factor)] for _ in SENSORS]
    reported = [[Term(0.0, factor)] for _ in SENSORS]
    for time in sorted({time for time, _, _ in looks}):
        histories = [aged(own, time - now, PSD, 2.0) for own in histories]
        reported = [
            [term._replace(density=predicted(term.density, time - now, PSD, 2.0)) for term in own] for own in reported
        ]
        before, _ = multiplied(reported)
        for _, sensor, plots in (look for look in looks if look[0] == time):
            histories[sensor] = branched(histories[sensor], plots, SENSORS[sensor])
            reported[sensor] = told(histories[sensor], terms)
        after, fused = multiplied(reported)
        log_lr, now = log_lr + after - before, time
        course.append((log_lr, fused))
    return course


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("terms", [1, 2, 3, 64])
@pytest.mark.parametrize("counts", [TOGETHER, APART], ids=["together", "apart"])
def test_a_network_is_the_sum_over_all_pairs_of_histories(
    counts: Sequence[tuple[float, int, int]], terms: int, seed: int
) -> None:
    looks = seen(counts, seed)
    ours = replayed(mirrored(terms), looks)
    for tracks, (log_lr, fused) in zip(ours, expected(looks, terms), strict=True):
        assert tracks.log_lr_total[0] == pytest.approx(log_lr, rel=1e-9, abs=1e-9)
        # The center keeps 25 products: of more, the moments are those of the heaviest.
        tolerance = 1e-9 if terms <= 5 else 0.02
        scale = np.sqrt(np.diagonal(fused.P))
        assert (np.abs(tracks.x[0] - fused.x) <= tolerance * (scale + np.abs(fused.x))).all()
        assert (np.abs(tracks.P[0] - fused.P) <= max(tolerance, 5.0 * tolerance) * np.outer(scale, scale)).all()


def test_the_number_of_terms_matters() -> None:
    """Else the comparison above would show nothing."""
    looks = seen(TOGETHER)
    ratios = [replayed(mirrored(terms), looks)[-1].log_lr_total[0] for terms in (1, 2, 3, 64)]
    assert all(abs(one - other) > 1e-3 for one, other in pairwise(ratios))


# Reports --------------------------------------------------------------------------------------------------------------

CLUTTERED = {"motion": {"psd": 10.0}, "decision": {"enabled": False}}


def cluttered(terms: int = 3, **tables: Any) -> Scenario:
    sensors = [sensor_table(name, p_d=0.6, false_plots=4000.0) for name in "ab"]
    fusion = {"association": "mirrored", "terms": terms} | tables.pop("fusion", {})
    return scenario(*sensors, fusion=fusion, **CLUTTERED | tables)


def test_rounded_reports_have_terms_too() -> None:
    plot = cluttered(fusion={"precision": "float32"})
    node = Node(plot, "a", Stage(plot).join_all()["a"])
    for scan in (scan for scan in simulate_all(plot, 1) if scan.sensor == "a"):
        report = node.scan(scan)
        sent = as_sent(report, node.tracker.rounding)
        assert same(sent._replace(x=report.x, P=report.P), report)
        np.testing.assert_allclose(sent.x, report.x, rtol=1e-6, atol=1e-3)
        np.testing.assert_allclose(sent.P, report.P, rtol=1e-6)
    assert report.terms.tolist() == [3]
    whole, rounded = (
        only(Tracks, Replay(cluttered(fusion={"precision": precision}), simulate_all(plot, 1)).run())[-1]
        for precision in ("float64", "float32")
    )
    assert 0.0 < abs(rounded.log_lr_total[0] - whole.log_lr_total[0]) < 0.01


#: A track in clutter, and one that no sensor can see: it keeps one hypothesis.
UNLIKE = [hypothesis_table(), hypothesis_table(90_000.0)]


def test_tracks_may_have_different_numbers_of_terms() -> None:
    both = cluttered(hypothesis=UNLIKE)
    scans = simulate_all(both, 1)
    node = Node(both, "a", Stage(both).join_all()["a"])
    report = node.scan(scans[0])
    assert (report.terms.tolist(), report.log_g.shape, report.x.shape) == ([3, 1], (4,), (4, 4))
    together = only(Tracks, Replay(both, scans).run())
    for number in range(2):
        alone = cluttered(hypothesis=[UNLIKE[number]])
        for one, pair in zip(only(Tracks, Replay(alone, scans).run()), together, strict=True):
            np.testing.assert_allclose(pair.log_lr_total[number], one.log_lr_total[0], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(pair.x[number], one.x[0], rtol=1e-9)
            np.testing.assert_allclose(pair.P[number], one.P[0], rtol=1e-8, atol=1e-6)


def with_terms(report: Report, count: int) -> Report:
    """The report with a first track of ``count`` terms."""
    n = report.x.shape[-1]
    return report._replace(
        terms=np.array([count]),
        log_g=-np.arange(float(count)),
        x=np.arange(float(count * n)).reshape(count, n),
        P=np.tile(1e4 * np.eye(n), (count, 1, 1)),
    )


@pytest.mark.parametrize(("count", "refused"), [(1, 0), (2, 0), (3, 0), (4, 1), (64, 1)])
def test_more_terms_than_the_scenario_allows_are_refused(count: int, refused: int) -> None:
    stage = Stage(cluttered())
    stage.join_all()
    stage.tell(with_terms(stage.report("a", 2.0), count))
    assert stage.state.counts.refused == refused
    # The network goes on without it.
    stage.tell(stage.report("b", 2.0))
    assert len(only(Tracks, stage.said)) == 1


def test_a_report_with_fewer_terms_leaves_none_of_those_before() -> None:
    """Of the terms of the report before, the center must not go on with any."""
    few, many = Stage(cluttered()), Stage(cluttered())
    for stage in (few, many):
        stage.join_all()
        stage.tell(with_terms(stage.report("a", 2.0), 3 if stage is many else 1))
        stage.tell(stage.report("b", 2.0))
        for name in "ab":
            stage.tell(with_terms(stage.report(name, 4.0), 2))
    np.testing.assert_allclose(many.tracks.x, few.tracks.x, rtol=1e-12)
    np.testing.assert_allclose(many.tracks.P, few.tracks.P, rtol=1e-12)


def test_a_sensor_that_starts_anew_gets_its_factor_back_as_moments() -> None:
    plot = cluttered(hypothesis=[hypothesis_table(), hypothesis_table(200.0)])
    stage = Stage(plot)
    nodes = {name: Node(plot, name, start) for name, start in stage.join_all().items()}
    for scan in simulate_all(plot, 1)[:6]:
        report = nodes[scan.sensor].scan(scan, scan.time_ns + 2_000_000_000)
        stage.tell(report)
    (back,) = only(Start, stage.join("b", 8.0, incarnation=2))
    assert report.sensor == "b"
    assert report.terms.tolist() == [3, 3]
    for track in range(2):
        own = slice(3 * track, 3 * track + 3)
        moments = mean_of(
            report.log_g[own].tolist(), [Density(*term) for term in zip(report.x[own], report.P[own], strict=True)]
        )
        np.testing.assert_allclose(back.x[track], moments.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(back.P[track], moments.P, rtol=1e-9, atol=1e-6)
        assert back.log_p_bar[track] == pytest.approx(logsumexp(report.log_g[own]))
    assert same(back._replace(x=stage.tracks.x, P=stage.tracks.P), back._replace(x=back.x_a, P=back.P_a))


def test_terms_that_are_all_impossible_count_alike() -> None:
    stage = Stage(cluttered())
    stage.join_all()
    report = with_terms(stage.report("a", 2.0), 3)
    stage.tell(report._replace(log_g=np.full(3, -np.inf)))
    stage.tell(stage.report("b", 2.0))
    (back,) = only(Start, stage.join("a", 4.0, incarnation=2))
    moments = mean_of(np.zeros(3).tolist(), [Density(*term) for term in zip(report.x, report.P, strict=True)])
    np.testing.assert_allclose(back.x[0], moments.x, rtol=1e-12)
    np.testing.assert_allclose(back.P[0], moments.P, rtol=1e-12, atol=1e-9)
    assert back.log_p_bar.tolist() == stage.tracks.log_lr_total.tolist() == [-np.inf]


def test_a_center_whose_tracks_are_all_gone_goes_on() -> None:
    stage = Stage(cluttered(decision={"enabled": True}))
    stage.join_all()
    for time_s in (2.0, 4.0, 6.0):
        for name in "ab":
            stage.tell(stage.report(name, time_s)._replace(log_g=np.array([-100.0])))
    assert [tracks.ids.tolist() for tracks in only(Tracks, stage.said)] == [[0], [], []]


def test_a_scan_that_cannot_be_is_minus_infinity_and_stays_so() -> None:
    sensors = [sensor_table(name, p_d=1.0) for name in "ab"]
    fusion = {"association": "mirrored", "terms": 3, "gate_probability": 1.0}
    plot = scenario(*sensors, fusion=fusion, decision={"enabled": False})
    some, none = np.array([[300.0, 0.0], [350.0, 20.0]]), np.empty((0, 2))
    scans = [
        Scan(name, plot.to_ns(time_s), np.array([3000.0, 0.0]), plots)
        for time_s, plots in ((1.0, some), (2.0, none), (3.0, some))
        for name in "ab"
    ]
    first, *others = only(Tracks, Replay(plot, scans).run())
    assert np.isfinite(first.log_lr_total).all()
    assert [tracks.log_lr_total.tolist() for tracks in others] == 2 * [[-np.inf]]
    assert all(np.isfinite(tracks.x).all() for tracks in others)
