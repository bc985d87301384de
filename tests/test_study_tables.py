"""Tables: what stands in a column, and how it is written."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
import study_fakes
from builders import hypothesis_table, scenario

from waldnet.common.estimation.sprt import thresholds
from waldnet.studies import calibration
from waldnet.studies.metrics import reduce
from waldnet.studies.plan import Variant, with_p_d, world_seeds
from waldnet.studies.tables import (
    GRID,
    Play,
    csv_of,
    curves_table,
    decisions_table,
    judge,
    rows_of,
    runs_table,
    stack,
    summary_table,
    write_table,
)

PLOT = scenario(study={"lost_beyond": 500.0}, hypothesis=[hypothesis_table()])


def play(mode: str = "federated", *, runs: int = 40, target: bool = True, p_d: float = 0.9) -> Play:
    plot = with_p_d(PLOT, p_d)
    plot = plot if target else plot.model_copy(update={"targets": ()})
    seeds = world_seeds(1, 0, runs)
    worlds = study_fakes.draw(plot, seeds)
    return Play(Variant("v", plot), mode, seeds, reduce(study_fakes.play(plot, mode, worlds), worlds, 2))


def test_the_summary_says_what_the_runs_say() -> None:
    judged = judge(play())
    runs, row = runs_table(judged), {name: column[0] for name, column in summary_table(judged).items()}
    decided = runs["decision"] != "undecided"
    assert list(row)[:3] == ["variant", "mode", "runs"]
    assert row["runs"] == len(runs["run"]) == 40
    assert row["log_lr_mean"] == pytest.approx(runs["log_lr"].mean())
    assert row["log_lr_se"] == pytest.approx(runs["log_lr"].std(ddof=1) / np.sqrt(40))
    assert row["p_confirmed"] == (runs["decision"] == "confirmed").mean()
    assert row["p_deleted"] == (runs["decision"] == "deleted").mean()
    assert row["p_confirmed"] + row["p_deleted"] + row["p_undecided"] == pytest.approx(1.0)
    assert row["p_confirmed_low"] < row["p_confirmed"] <= row["p_confirmed_high"]
    assert row["decision_scans_mean"] == runs["decision_scans"][decided].mean()
    assert row["share_lost"] == runs["lost"].mean() == (runs["error_m"] > 500.0).mean() > 0.0
    assert row["rmse_m"] == pytest.approx(np.sqrt(np.square(runs["error_m"][~runs["lost"]]).mean()))
    assert row["gospa_mean_m"] == pytest.approx(runs["gospa_mean_m"].mean())
    assert row["bytes_per_track_scan"] == row["uplink_bytes"] + row["downlink_bytes"] == 132.0


def test_without_a_target_nothing_is_lost_and_nothing_is_off() -> None:
    row = {name: column[0] for name, column in summary_table(judge(play(target=False))).items()}
    for name in ("share_lost", "share_lost_low", "rmse_m", "rmse_scans_m", "nees_mean"):
        assert np.isnan(row[name]), name
    assert row["p_deleted"] > 0.9
    assert np.isfinite(row["gospa_mean_m"])


def test_nothing_decided_has_no_length() -> None:
    still = play()
    still = still._replace(result=still.result._replace(log_lr=np.zeros_like(still.result.log_lr)))
    row = {name: column[0] for name, column in summary_table(judge(still)).items()}
    assert row["p_undecided"] == 1.0
    assert np.isnan([row["decision_scans_mean"], row["decision_scans_q50"]]).all()
    assert np.isnan(runs_table(judge(still))["decision_scans"]).all()


def test_an_impossible_scan_does_no_harm_to_a_table() -> None:
    one = play(runs=3)
    log_lr = one.result.log_lr.copy()
    log_lr[1, 5:] = -np.inf
    row = summary_table(judge(one._replace(result=one.result._replace(log_lr=log_lr))))
    assert row["log_lr_mean"][0] == -np.inf
    assert "-inf" in csv_of(row)


def test_curves_end_where_the_summary_stands() -> None:
    judged = judge(play())
    curves, row = curves_table(judged), {name: column[0] for name, column in summary_table(judged).items()}
    assert curves["scan"].tolist() == list(range(1, 31))
    assert curves["time_s"].tolist() == [2.0 * k for k in range(1, 31)]
    assert curves["confirmed_by"][-1] == row["p_confirmed"]
    assert curves["deleted_by"][-1] == row["p_deleted"]
    assert curves["log_lr_mean"][-1] == pytest.approx(row["log_lr_mean"])
    assert curves["rmse_m"][-1] == pytest.approx(row["rmse_m"])
    assert (np.diff(curves["confirmed_by"]) >= 0.0).all()


@pytest.mark.parametrize("mode", ["federated", "decentralised-decisions"])
def test_the_grid_of_thresholds_has_the_scenarios_own_row(mode: str) -> None:
    one = play(mode)
    table, row = decisions_table(one), {k: v[0] for k, v in summary_table(judge(one)).items()}
    assert len(table["p0"]) == len(GRID)
    assert one.limits == thresholds(1e-4, 0.95)
    (at,) = np.flatnonzero((table["p0"] == 1e-4) & (table["p1"] == 0.95))
    for name in ("p_confirmed", "p_deleted", "p_undecided", "decision_scans_mean", "decision_scans_q90"):
        assert table[name][at] == row[name]


def test_calibration_counts_the_runs_that_ever_reached_b() -> None:
    judged = judge(play(runs=200, target=False))
    table, sup = calibration.direct(judged), runs_table(judged)["log_lr_sup"]
    assert (table["reached"] == [(sup >= np.log(b)).sum() for b in table["b"]]).all()
    assert table["reached"][0] > table["reached"][-1]
    assert ((table["low"] <= table["share"]) & (table["share"] <= table["high"])).all()
    np.testing.assert_allclose(table["bound"] * table["b"], 1.0)


def test_calibration_from_runs_with_a_target_tells_the_rate_of_runs_without() -> None:
    """A normal mean shift, whose exact rate the direct runs tell where they can; 1 / B bounds it everywhere."""
    rng, steps = np.random.default_rng(3), 40
    drawn = rng.normal(size=(4000, steps))
    with_target, without = (np.cumsum(shift + drawn - 0.5, axis=1) for shift in (1.0, 0.0))
    judged = [judge(play(runs=4000, target=target)) for target in (True, False)]
    one, none = (
        case._replace(seen=case.seen._replace(log_lr=log_lr))
        for case, log_lr in zip(judged, (with_target, without), strict=True)
    )
    rare, direct = calibration.by_importance(one, one), calibration.direct(none)
    assert rare["b"][-1] == pytest.approx(1e6)
    assert (rare["share"] <= rare["bound"]).all() and (rare["share"][-1] > 0.2 * rare["bound"][-1]).all()
    at_50 = [np.interp(np.log(50.0), np.log(table["b"]), table["share"]) for table in (rare, direct)]
    assert at_50[0] == pytest.approx(at_50[1], rel=0.5)  # some 40 of 4000 runs without a target reach it
    # An LR that is too sure by two is found out where an exact one is not.
    sure = calibration.by_importance(one._replace(seen=one.seen._replace(log_lr=with_target + 2.0)), one)
    assert (sure["low"][8:] > sure["bound"][8:]).all()


def test_csv_has_every_number_whole_and_nothing_for_none() -> None:
    table = {
        "mode": np.array(["a,b", "c"], dtype=object),
        "runs": np.array([1, 2]),
        "x": np.array([0.1, np.nan]),
        "lost": np.array([True, False]),
    }
    assert csv_of(table) == 'mode,runs,x,lost\n"a,b",1,0.1,true\nc,2,,false\n'


def test_parquet_says_what_csv_says(tmp_path: Path) -> None:
    table = runs_table(judge(play("decentralised-decisions", p_d=0.2)))
    files = write_table(tmp_path, "runs", table)
    assert [file.name for file in files] == ["runs.csv", "runs.parquet"]
    columns = pyarrow.parquet.read_table(files[1]).to_pydict()
    rows = list(csv.DictReader(io.StringIO(files[0].read_text())))
    assert list(columns) == list(rows[0])
    for name, values in columns.items():
        texts = [row[name] for row in rows]
        said = ["" if v is None else str(v).lower() if isinstance(v, bool) else str(v) for v in values]
        assert said == texts, name
    assert None in columns["decision_scans"]
    assert not list(tmp_path.glob("*.tmp"))


def test_without_pyarrow_there_is_csv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert [file.name for file in write_table(tmp_path, "runs", {"x": np.array([1])})] == ["runs.csv"]


def test_tables_are_stacked_and_picked_apart() -> None:
    one, two = (summary_table(judge(play(mode))) for mode in ("naive", "dkf"))
    both = stack([one, two])
    assert both["mode"].tolist() == ["naive", "dkf"]
    assert csv_of(rows_of(both, mode="dkf")) == csv_of(two)
    assert stack([]) == {}
