"""Calibration: how often the LR of nothing at all reaches B, against 1/B (Ville; theory.md §7).

Every row says by which ``method`` its share was found. ``direct`` counts runs without a target, so it knows nothing of
shares far below one in so many runs as there are. ``importance`` takes runs with a target, of which each counts with
the inverse of the true LR of its data; the centralised multi-hypothesis tracker's stands for that.
"""

from __future__ import annotations

import numpy as np

from waldnet.common.estimation.gaussian import Array
from waldnet.studies.importance import calibration
from waldnet.studies.shares import share_of
from waldnet.studies.tables import Judged, Table

#: The mode whose LR is taken for the true one.
EXACT = "centralised-mht"
#: Values of B to look at.
LEVELS = np.logspace(0.25, 4.0, 16)
RARE_LEVELS = np.logspace(0.25, 6.0, 24)


def direct(judged: Judged) -> Table:
    """Share of the runs without a target whose LR ever reached B, with Clopper-Pearson bounds of 95 %.

    One row for each B. Where sensors send decisions only, LR is that of their decisions at the scenario's thresholds.
    """
    sup, runs = judged.seen.log_lr.max(axis=1), len(judged.seen.log_lr)
    reached = [int((sup >= np.log(level)).sum()) for level in LEVELS]
    shares = [share_of(count, runs) for count in reached]
    bounds = np.array([(share.share, share.low, share.high) for share in shares])
    effective = np.full(len(LEVELS), float(runs))
    return _rows(judged, "direct", LEVELS, np.array(reached), bounds, effective)


def by_importance(judged: Judged, exact: Judged) -> Table:
    """The same from runs with a target, down to B = 1e6.

    The bounds hold both a normal and a bootstrap interval of 95 %. Few ``effective_runs`` mean that few runs hold most
    of the sum: then they hold less than they promise.

    Args:
        judged: the mode that is looked at.
        exact: ``EXACT`` on the same plots.
    """
    found = calibration(judged.seen.log_lr, exact.seen.log_lr, RARE_LEVELS, np.random.default_rng(0))
    low = np.minimum(found.normal.low, found.bootstrap.low)
    high = np.minimum(np.maximum(found.normal.high, found.bootstrap.high), 1.0)
    bounds = np.stack([found.probability, low, high], axis=-1)
    return _rows(judged, "importance", RARE_LEVELS, found.crossed, bounds, found.effective_runs)


def _rows(judged: Judged, method: str, levels: Array, reached: Array, bounds: Array, effective: Array) -> Table:
    """One row for each B; bounds are share, low, high."""
    size = len(levels)
    words = {"variant": judged.play.variant.name, "mode": judged.play.mode, "method": method}
    return {name: np.full(size, word, dtype=object) for name, word in words.items()} | {
        "b": levels,
        "bound": 1.0 / levels,
        "runs": np.full(size, len(judged.seen.log_lr)),
        "reached": np.asarray(reached),
        "effective_runs": effective,
        "share": bounds[:, 0],
        "low": bounds[:, 1],
        "high": bounds[:, 2],
    }
