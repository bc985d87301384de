"""Measures the ship's radar against the truth of the boat, on each half of the recording.

``python -m waldnet.scenarios.joyride.measure`` prints tables in Markdown from the files beside this module. The plot
nearest to the boat is the boat's where it lies within 50 m of it; all others are false.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from waldnet.common.estimation.gaussian import Array
from waldnet.scenarios.persistence import Watch, fitted

#: How far from the boat its plot may be [m].
NEAR_M = 50.0
_SEEN = ("part", "from [s]", "scans", "turns", "p_d", "false plots", "farthest plot [m]", "boat at [m]")
_ERRORS = ("part", "bias [m]", "sigma [m]", "rms [m]", "bias of azimuth [rad]")
_PERSISTENCE = ("part", "p_d while visible", "visible [s]", "hidden [s]", "gained per scan")


class Comparison(NamedTuple):
    """Scans, compared with the truth.

    Attributes:
        times_s: of the scans, shape (K,).
        boat: from the ship to the boat, east, north [m], shape (K, 2).
        errors: of the boat's plot, plot minus truth, east, north [m], shape (K, 2); NaN where it has none.
        ranges: from the ship to every plot of a scan [m], one array per scan.
    """

    times_s: Array
    boat: Array
    errors: Array
    ranges: tuple[Array, ...]

    @property
    def found(self) -> Array:
        """Whether the boat has a plot, shape (K,)."""
        there: Array = np.isfinite(self.errors[:, 0])
        return there

    def part(self, rows: slice) -> Comparison:
        """Some of the scans."""
        return Comparison(self.times_s[rows], self.boat[rows], self.errors[rows], self.ranges[rows])


def compare(folder: Path) -> Comparison:
    """All scans of a recording, compared with its truth."""
    scans, truth = _lines(folder / "joyride.jsonl"), _lines(folder / "joyride-truth.jsonl")
    times_s = np.array([scan["time"] for scan in scans])
    ship = np.array([scan["position"] for scan in scans])
    known_s, known = np.array([point["time"] for point in truth]), np.array([point["position"] for point in truth])
    boat = np.stack([np.interp(times_s, known_s, axis) for axis in known.T], axis=-1)
    plots = [np.array(scan["plots"]).reshape(-1, 2) for scan in scans]
    errors = np.stack([_nearest(z - place) for z, place in zip(plots, boat, strict=True)])
    ranges = tuple(np.linalg.vector_norm(z - place, axis=-1) for z, place in zip(plots, ship, strict=True))
    return Comparison(times_s, boat - ship, errors, ranges)


def _nearest(errors: Array) -> Array:
    """The shortest of some errors, shape (2,); NaN if none is short enough."""
    distances = np.append(np.linalg.vector_norm(errors, axis=-1), NEAR_M)
    nearest: Array = np.vstack([errors, np.full((1, 2), np.nan)])[distances.argmin()]
    return nearest


def parts(seen: Comparison) -> dict[str, Comparison]:
    """Both halves, and all."""
    middle = len(seen.times_s) // 2
    return {"first half": seen.part(slice(middle)), "second half": seen.part(slice(middle, None)), "all": seen}


def settings(part: Comparison) -> dict[str, Any]:
    """The keys of the sensor that are measured: ``sigma`` is the rms of the errors, with their bias in it."""
    errors = part.errors[part.found]
    return {
        "sigma": tuple(np.sqrt(np.square(errors).mean(axis=0)).round().tolist()),
        "p_d": round(float(part.found.mean()), 2),
        "false_plots": round(_false_plots(part), 1),
    }


def _false_plots(part: Comparison) -> float:
    """Per scan."""
    return float(sum(map(len, part.ranges)) - part.found.sum()) / len(part.times_s)


def _seen(part: Comparison) -> list[str]:
    interval_s = np.median(np.diff(part.times_s))
    boat_m = np.linalg.vector_norm(part.boat, axis=-1)
    return [
        f"{part.times_s[0]:.0f}",
        f"{len(part.times_s)}",
        f"{(part.times_s[-1] - part.times_s[0]) / interval_s + 1.0:.0f}",
        f"{part.found.mean():.2f}",
        f"{_false_plots(part):.2f}",
        f"{max(ranges.max(initial=0.0) for ranges in part.ranges):.0f}",
        f"{boat_m.min():.0f} - {boat_m.max():.0f}",
    ]


def _errors(part: Comparison) -> list[str]:
    errors, boat = part.errors[part.found], part.boat[part.found]
    # Clockwise from north: to the right of the direction to the boat is positive.
    turned = (errors[:, 0] * boat[:, 1] - errors[:, 1] * boat[:, 0]) / np.vecdot(boat, boat)
    figures = (errors.mean(axis=0), errors.std(axis=0), np.sqrt(np.square(errors).mean(axis=0)))
    return [*(", ".join(f"{axis:.1f}" for axis in figure) for figure in figures), f"{turned.mean():.3f}"]


def _persistence(part: Comparison) -> list[str]:
    found = fitted([Watch(part.times_s, part.found, part.errors)])
    return [f"{found.p_d:.2f}", *(f"{time_s:.0f}" for time_s in found.visibility), f"{found.gained:.2f}"]


def tables(folder: Path) -> str:
    """All tables, in Markdown."""
    named = parts(compare(folder))
    made = ((_SEEN, _seen), (_ERRORS, _errors), (_PERSISTENCE, _persistence))
    return "\n\n".join("\n".join(_table(head, {name: row(part) for name, part in named.items()})) for head, row in made)


def _table(head: Sequence[str], rows: Mapping[str, Sequence[str]]) -> Iterator[str]:
    for cells in (head, ["---"] * len(head), *([name, *cells] for name, cells in rows.items())):
        yield f"| {' | '.join(cells)} |"


def _lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m waldnet.scenarios.joyride.measure", description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).parent, help="of joyride.jsonl")
    sys.stdout.write(tables(parser.parse_args(arguments).folder) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
