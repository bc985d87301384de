"""Calibration: how often the LR of nothing at all reaches B, against 1/B (Ville; theory.md §7).

Every row says by which ``method`` its share was found. ``direct`` counts runs, so it knows nothing of shares far below
one in so many runs as there are; methods that can, add rows of the same columns.
"""

from __future__ import annotations

import numpy as np

from studies.shares import share_of
from studies.tables import Judged, Table, stack

#: Values of B to look at.
LEVELS = np.logspace(0.25, 4.0, 16)


def direct(judged: Judged) -> Table:
    """Share of the runs without a target whose LR ever reached B, with Clopper-Pearson bounds of 95 %.

    One row for each B. Where sensors send decisions only, LR is that of their decisions at the scenario's thresholds.
    """
    sup, rows = judged.seen.log_lr.max(axis=1), []
    for level in LEVELS:
        reached, runs = int((sup >= np.log(level)).sum()), len(sup)
        share = share_of(reached, runs)
        rows.append(
            {
                "variant": np.array([judged.play.variant.name], dtype=object),
                "mode": np.array([judged.play.mode], dtype=object),
                "method": np.array(["direct"], dtype=object),
                "b": np.array([level]),
                "bound": np.array([1.0 / level]),
                "runs": np.array([runs]),
                "reached": np.array([reached]),
                "share": np.array([share.share]),
                "low": np.array([share.low]),
                "high": np.array([share.high]),
            }
        )
    return stack(rows)
