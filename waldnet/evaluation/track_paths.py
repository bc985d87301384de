"""Where targets are expected if nobody knows: the confirmed tracks of a centralised run, each predicted from before.

A track is expected at a scan where it was before it, so that the plots of that scan have no part in it. It counts from
its confirmation to the last plot near it: later it may have lost its target.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.estimation.motion import predict
from waldnet.common.estimation.sprt import CONFIRMED
from waldnet.common.messages import Scan, Tracks
from waldnet.common.quantities import NS_PER_S
from waldnet.offline.centralised import Centralised
from waldnet.scenarios.measure import GATE, Path, look


def track_paths(scenario: Scenario, used: Sequence[Scan], seen: Mapping[str, Sequence[Scan]]) -> dict[str, list[Path]]:
    """Paths of all confirmed tracks.

    Args:
        scenario: the network.
        used: scans of all sensors, by time, as the tracker gets them.
        seen: scans of each sensor during which the paths are wanted, by time.

    Returns:
        for each sensor the paths of all tracks that were confirmed before one of its scans, by their numbers.
    """
    pictures = [said for said in Centralised.of(scenario).run(used) if isinstance(said, Tracks)]
    paths = {name: _predicted(scenario, pictures, own) for name, own in seen.items()}
    last_ns = _last_supported(scenario, seen, paths)
    return {
        name: [_until(path, seen[name], last_ns.get(path.number, -1)) for path in own] for name, own in paths.items()
    }


def _predicted(scenario: Scenario, pictures: Sequence[Tracks], scans: Sequence[Scan]) -> list[Path]:
    """Tracks that were confirmed before a scan, predicted to it."""
    motion = scenario.motion.build()
    n, count = motion.n, len(scans)
    paths: dict[int, Path] = {}
    before = np.searchsorted([picture.time_ns for picture in pictures], [scan.time_ns for scan in scans]) - 1
    for k, row in enumerate(before.tolist()):
        if row < 0:
            continue
        picture = pictures[row]
        rows = np.flatnonzero(picture.status == CONFIRMED)
        dt = np.full(len(rows), (scans[k].time_ns - picture.time_ns) / NS_PER_S)
        at = predict(Gaussian(picture.x[rows], picture.P[rows]), motion.transition(dt), motion.noise(dt))
        for number, x, P in zip(picture.ids[rows].tolist(), at.x, at.P, strict=True):
            blank = Path(number, np.full((count, n), np.nan), np.zeros((count, n, n)))
            path = paths.setdefault(number, blank)
            path.x[k], path.P[k] = x, P
    return [paths[number] for number in sorted(paths)]


def _last_supported(
    scenario: Scenario, seen: Mapping[str, Sequence[Scan]], paths: Mapping[str, Sequence[Path]]
) -> dict[int, int]:
    """When each track last had a plot near it."""
    last_ns: dict[int, int] = {}
    for name, own in paths.items():
        config = scenario.sensor(name)
        looks = look(config, config.build(scenario.motion.build()), seen[name], own, GATE)
        for path, one in zip(own, looks, strict=True):
            for k in np.flatnonzero(one.found)[-1:].tolist():
                last_ns[path.number] = max(seen[name][k].time_ns, last_ns.get(path.number, -1))
    return last_ns


def _until(path: Path, scans: Sequence[Scan], last_ns: int) -> Path:
    late = np.array([scan.time_ns > last_ns for scan in scans], dtype=np.bool_)
    return path._replace(x=np.where(late[:, None], np.nan, path.x))
