"""Tables of a study: tidy, one meaning per column, the same bytes for the same study."""

from __future__ import annotations

import csv
import importlib.util
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.sprt import CONFIRMED, DELETED, TENTATIVE, Status, StatusArray, Thresholds, thresholds
from waldnet.common.files import write_atomically
from waldnet.common.messages import IntArray
from waldnet.studies.metrics import Decided, Evidence, Result, evidence, first_decisions, gospa_per_scan, lost, monitor
from waldnet.studies.plan import Variant
from waldnet.studies.shares import mean, quantile, share_of

#: Columns by name, all of one length. No number (an undecided run has no decision time) is NaN, in a file: empty.
Table: TypeAlias = dict[str, NDArray[Any]]

#: Pairs of thresholds to look at.
GRID = tuple((p0, p1) for p1 in (0.8, 0.9, 0.95, 0.99, 0.999) for p0 in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6))
_QUANTILES = {"q10": 0.1, "q50": 0.5, "q90": 0.9}


class Play(NamedTuple):
    """All runs of one mode on one variant.

    Attributes:
        variant: what was studied.
        mode: name.
        seeds: of the worlds, shape (R,).
        result: of all runs.
    """

    variant: Variant
    mode: str
    seeds: IntArray
    result: Result

    @property
    def lost_beyond_m(self) -> float:
        """Farther from its target after the last scan, a track is lost."""
        return self.variant.scenario.study.lost_beyond

    @property
    def limits(self) -> Thresholds:
        """Thresholds of the scenario."""
        return self.variant.scenario.decision.thresholds


class Judged(NamedTuple):
    """A play at the scenario's thresholds.

    Attributes:
        play: what is judged.
        seen: log LR as the network knows it.
        first: first decision of every run.
        life: status after every measurement time, shape (R, K).
        gospa_m: shape (R, K).
    """

    play: Play
    seen: Evidence
    first: Decided
    life: StatusArray
    gospa_m: Array


def judge(play: Play) -> Judged:
    """Decide on every run."""
    seen = evidence(play.result, play.limits)
    life = monitor(seen)
    return Judged(play, seen, first_decisions(seen), life, gospa_per_scan(play.result, life, play.lost_beyond_m))


def runs_table(judged: Judged) -> Table:
    """One row a run: its world, what was decided when, and how good the track was."""
    play, first = judged.play, judged.first
    count, result = len(play.seeds), play.result
    words = np.array([status.name.lower() if status else "undecided" for status in Status], dtype=object)
    return {
        **_keys(play, count),
        "run": np.arange(count),
        "world_seed": play.seeds,
        "log_lr": judged.seen.log_lr[:, -1],
        "log_lr_sup": judged.seen.log_lr.max(axis=1),
        "decision": words[first.kind],
        "decision_scans": np.where(first.kind == TENTATIVE, np.nan, first.scans),
        "confirmed_at_end": judged.life[:, -1] == CONFIRMED,
        "lost": lost(result, play.lost_beyond_m),
        "error_m": result.error_m[:, -1],
        "rmse_scans_m": np.sqrt(np.square(result.error_m).mean(axis=1)),
        "nees_mean": result.nees.mean(axis=1),
        "gospa_mean_m": judged.gospa_m.mean(axis=1),
    }


def curves_table(judged: Judged) -> Table:
    """One row a measurement time: log LR, decisions so far, errors of the tracks that are not lost."""
    play, first = judged.play, judged.first
    times_s = np.array([play.variant.scenario.to_seconds(time_ns) for time_ns in play.result.times_ns.tolist()])
    count, log_lr = len(times_s), judged.seen.log_lr
    kept = ~lost(play.result, play.lost_beyond_m)
    scans = np.arange(1, count + 1)
    by_now = first.scans[:, None] <= scans
    return {
        **_keys(play, count),
        "scan": scans,
        "time_s": times_s,
        "log_lr_mean": log_lr.mean(axis=0),
        **{f"log_lr_{name}": _quantiles(log_lr, q) for name, q in _QUANTILES.items()},
        "confirmed_by": (by_now & (first.kind == CONFIRMED)[:, None]).mean(axis=0),
        "deleted_by": (by_now & (first.kind == DELETED)[:, None]).mean(axis=0),
        "confirmed_now": (judged.life == CONFIRMED).mean(axis=0),
        "rmse_m": np.sqrt(_each(np.square(play.result.error_m[kept]).T, mean)),
        "nees_mean": _each(play.result.nees[kept].T, mean),
        "gospa_mean_m": judged.gospa_m.mean(axis=0),
    }


def summary_table(judged: Judged) -> Table:
    """One row: the play in figures."""
    play, result, first = judged.play, judged.play.result, judged.first
    decision = play.variant.scenario.decision
    log_lr, sup = judged.seen.log_lr[:, -1], judged.seen.log_lr.max(axis=1)
    runs, is_lost = len(log_lr), lost(result, play.lost_beyond_m)
    kept = ~is_lost
    spread = float(log_lr.std(ddof=1)) if runs > 1 and np.isfinite(log_lr).all() else float("nan")
    row: dict[str, Any] = {
        "runs": runs,
        "p0": decision.p0,
        "p1": decision.p1,
        "log_lr_mean": mean(log_lr),
        "log_lr_std": spread,
        "log_lr_se": spread / np.sqrt(runs),
        **{f"log_lr_{name}": quantile(log_lr, q) for name, q in _QUANTILES.items()},
        "log_lr_sup_mean": mean(sup),
        "log_lr_sup_q99": quantile(sup, 0.99),
        **_share("p_sup_reaches_b", int((sup >= play.limits.log_b).sum()), runs),
        **_decided(first),
        **_share("share_lost", int(is_lost.sum()), runs if play.variant.has_target else 0),
        "rmse_m": np.sqrt(mean(np.square(result.error_m[kept, -1]))),
        "rmse_scans_m": np.sqrt(mean(np.square(result.error_m[kept]))),
        "nees_mean": mean(result.nees[kept]),
        "gospa_mean_m": mean(judged.gospa_m),
        "uplink_bytes": result.uplink_bytes,
        "downlink_bytes": result.downlink_bytes,
        "bytes_per_track_scan": result.uplink_bytes + result.downlink_bytes,
    }
    return {**_keys(play, 1), **_one(row)}


def decisions_table(play: Play) -> Table:
    """One row for each pair of thresholds of the grid."""
    rows = []
    for p0, p1 in GRID:
        first = first_decisions(evidence(play.result, thresholds(p0, p1)))
        rows.append({**_keys(play, 1), **_one({"p0": p0, "p1": p1, **_decided(first)})})
    return stack(rows)


def _decided(first: Decided) -> dict[str, float]:
    runs, scans = len(first.kind), first.scans[first.kind != TENTATIVE]
    return {
        **_share("p_confirmed", int((first.kind == CONFIRMED).sum()), runs),
        **_share("p_deleted", int((first.kind == DELETED).sum()), runs),
        "p_undecided": float((first.kind == TENTATIVE).mean()),
        "decision_scans_mean": mean(scans),
        **{f"decision_scans_{name}": quantile(scans, q) for name, q in _QUANTILES.items()},
    }


def _share(name: str, count: int, runs: int) -> dict[str, float]:
    share = share_of(count, runs)
    return {name: share.share, f"{name}_low": share.low, f"{name}_high": share.high}


def _keys(play: Play, count: int) -> Table:
    names = {"variant": play.variant.name, "mode": play.mode}
    return {key: np.full(count, name, dtype=object) for key, name in names.items()}


def _one(row: Mapping[str, Any]) -> Table:
    return {key: np.array([value]) for key, value in row.items()}


def _quantiles(values: Array, q: float) -> Array:
    return np.quantile(values, q, axis=0, method="inverted_cdf")


def _each(rows: Array, figure: Callable[[Array], float]) -> Array:
    return np.array([figure(row) for row in rows])


def stack(tables: Iterable[Table]) -> Table:
    """Tables of the same columns, one under the other."""
    every = list(tables)
    return {name: np.concatenate([table[name] for table in every]) for name in every[0]} if every else {}


def rows_of(table: Table, **keys: str) -> Table:
    """The rows in which columns have given values."""
    chosen = np.ones(len(next(iter(table.values()))), bool)
    for name, value in keys.items():
        chosen &= table[name] == value
    return {name: column[chosen] for name, column in table.items()}


def write_table(folder: Path, name: str, table: Table) -> list[Path]:
    """Write a table as CSV, and as Parquet when pyarrow is there.

    Returns:
        the files written.
    """
    files = [folder / f"{name}.csv"]
    write_atomically(files[0], csv_of(table).encode())
    if importlib.util.find_spec("pyarrow") is not None:
        files.append(folder / f"{name}.parquet")
        write_atomically(files[1], _parquet_of(table))
    return files


def csv_of(table: Table) -> str:
    """A table as text: numbers so that they read back the same, no number as nothing."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*(_texts(column) for column in table.values()), strict=True))
    return text.getvalue()


def _texts(column: NDArray[Any]) -> Sequence[str]:
    return [_text(value) for value in column.tolist()]


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return "" if np.isnan(value) else repr(value)
    return str(value)


def _parquet_of(table: Table) -> bytes:
    import pyarrow
    from pyarrow import parquet

    columns = {
        name: pyarrow.array(column.tolist() if column.dtype == object else column, from_pandas=True)
        for name, column in table.items()
    }
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(pyarrow.table(columns), sink)
    return bytes(sink.getvalue().to_pybytes())
