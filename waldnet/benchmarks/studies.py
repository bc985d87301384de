"""The studies of docs/studies.md: each is one ``waldnet study``, whose table and figures go into the docs.

    python -m waldnet.benchmarks.studies NAME [--runs 1000] [--workers N]

It prints the command, the time it took, and a table for every variant; it copies figures to docs/images. A study that
was stopped goes on where it was, and says so in place of its time.
"""

from __future__ import annotations

import argparse
import csv
import os
import shlex
import shutil
import subprocess
import time
from collections.abc import Iterator
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

from waldnet.benchmarks.machine import described

PACKAGES = ("waldnet", "numpy")
IMAGES = Path("docs/images")
#: What a study of all modes with 32 sensors would spend most of its time on is left out.
_MANY_SENSORS = (
    "centralised,centralised-mht,naive,dkf,federated,federated-tight,federated-mirrored-1,federated-mirrored-3,"
    "federated-tight-advice,federated-tight-reset,selected-plots-float32"
)


class Published(NamedTuple):
    """A study of the docs.

    Attributes:
        words: after ``waldnet study``.
        figures: of its report, that the docs show.
    """

    words: str
    figures: tuple[str, ...]


STUDIES = {
    "webinar": Published("four-radars-0.2 --p-d 0.9,0.5,0.2 --no-target", ("log_lr",)),
    "heavy-clutter": Published("heavy-clutter --no-target", ("frontier", "calibration")),
    "rarely-seen": Published("rarely-seen --no-target", ("frontier", "calibration")),
    "thirty-two": Published(f"thirty-two --no-target --modes {_MANY_SENSORS}", ("frontier",)),
}

_COLUMNS = {
    "log LR": ("log_lr_mean", "{:.1f}"),
    "confirmed": ("p_confirmed", "{:.1%}"),
    "deleted": ("p_deleted", "{:.1%}"),
    "scans to decide": ("decision_scans_mean", "{:.2f}"),
    "lost": ("share_lost", "{:.1%}"),
    "RMSE [m]": ("rmse_scans_m", "{:.0f}"),
    "NEES": ("nees_mean", "{:.1f}"),
    "bytes": ("bytes_per_track_scan", "{:.0f}"),
}


def main() -> None:
    """Run a study and print what the docs say of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=STUDIES)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    words, figures = STUDIES[arguments.name]
    out = Path("runs/published") / arguments.name
    command = f"waldnet study {words} --runs {arguments.runs}"
    begun_before = (out / "parts").exists()
    began = time.perf_counter()
    subprocess.run([*shlex.split(command), "--workers", f"{arguments.workers}", "--out", out], check=True, stdout=2)
    minutes = (time.perf_counter() - began) / 60.0
    print(f"    {command}\n")
    took = (
        "begun before" if begun_before else f"{minutes:.0f} minutes with {arguments.workers} workers, report included"
    )
    print(f"{described(*PACKAGES)}: {took}")
    print(*_tables(out / "summary.csv"), sep="\n")
    for figure in figures:
        shown = IMAGES / f"study-{arguments.name}-{figure}.png"
        shutil.copyfile(out / "figures" / f"{figure}.png", shown)
        print(f"\n![{figure} of {arguments.name}]({shown.relative_to('docs')})")


def _tables(summary: Path) -> Iterator[str]:
    with summary.open(newline="", encoding="utf-8") as file:
        for variant, rows in groupby(csv.DictReader(file), itemgetter("variant")):
            yield f"\n{variant}:\n"
            listed = list(rows)
            columns = {head: at for head, at in _COLUMNS.items() if any(row[at[0]] for row in listed)}
            yield f"| mode | {' | '.join(columns)} |"
            yield "|---" + "|---:" * len(columns) + "|"
            for row in listed:
                cells = (form.format(float(row[key])) if row[key] else "" for key, form in columns.values())
                yield f"| {row['mode']} | {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
