"""A tracker of Stone Soup's own components on the plots of a scenario: what a peer makes of what waldnet sees.

    python -m waldnet.benchmarks.peer_tracker SCENARIO [--plots FILE] [--json-lines OUT] [--set NAME=VALUE ...]
    python -m waldnet.benchmarks.peer_tracker --tune autoferry|joyride|solent [--seconds S] [--json OUT]

JPDA of all plots of a scan, sensor by sensor in order of time; tracks are held by a multi-measurement initiator until
enough plots were near, and deleted when none was near for too long or their position is no longer known. Each sensor
has the measurement model, p_d, density of false plots and field of view of the scenario. Lines are those of
``waldnet replay --json``, as far as ``waldnet evaluate`` reads them: all tracks at all scan times, held ones too.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from datetime import datetime, timedelta
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from scipy.stats import chi2
from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
from stonesoup.dataassociator.probability import JPDAwithEHM2
from stonesoup.deleter.error import CovarianceBasedDeleter
from stonesoup.deleter.multi import CompositeDeleter
from stonesoup.deleter.time import UpdateTimeDeleter
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.hypothesiser.probability import PDAHypothesiser
from stonesoup.initiator.simple import MultiMeasurementInitiator
from stonesoup.measures import Mahalanobis

from waldnet.benchmarks.peer_models import (
    PLACE,
    Eye,
    Nearby,
    absorb,
    detections_of,
    eyes_of,
    instant,
    place_of,
    predictor_of,
    seen_share,
    start_of,
    x_of,
)
from waldnet.common.config import Scenario, load_scenario
from waldnet.common.messages import Scan
from waldnet.scenarios.catalogue import find
from waldnet.sensor_node.sources import all_scans


class Settings(NamedTuple):
    """What is tuned.

    Attributes:
        min_points: plots near a held track that confirm it.
        holding_s: a held track without a plot for longer is forgotten.
        holding_gate: a plot is near a held track within so many sigmas.
        deleter_s: a track without a plot for longer is deleted.
        max_sigma_m: a track whose position is less certain, either way on average, is deleted.
        gate: probability that a track's own plot is in its gate.
        p_d: factor on the sensors' p_d.
        clutter: factor on the sensors' density of false plots.
        bearings: "ignore" them, let them "steer" tracks only, or "keep" tracks alive too.
        bearing_sigma: factor on the noise of bearings, whose errors go on from scan to scan.
    """

    min_points: int = 6
    holding_s: float = 3.0
    holding_gate: float = 3.0
    deleter_s: float = 5.0
    max_sigma_m: float = 30.0
    gate: float = 0.99
    p_d: float = 1.0
    clutter: float = 1.0
    bearings: str = "ignore"
    bearing_sigma: float = 1.0


class PeerTracker:
    """Tracks that are worked on scan by scan."""

    def __init__(self, scenario: Scenario, settings: Settings) -> None:
        """Set up Stone Soup's components for a scenario."""
        self._scenario, self._settings = scenario, settings
        self._eyes = eyes_of(scenario, settings.bearing_sigma)
        self._predictor = predictor_of(scenario)
        self._associators = {name: self._associator(eye) for name, eye in self._eyes.items()}
        self._initiator = self._initiation()
        deleters = [UpdateTimeDeleter(timedelta(seconds=settings.deleter_s)), self._vague]
        self._deleter = CompositeDeleter(deleters, intersect=False)
        self._tracks: set[Any] = set()
        self._numbers: dict[str, int] = {}

    @property
    def _vague(self) -> Any:
        return CovarianceBasedDeleter(2.0 * self._settings.max_sigma_m**2, mapping=list(PLACE))

    def _associator(self, eye: Eye) -> Any:
        settings, gate = self._settings, self._settings.gate
        inner = PDAHypothesiser(
            self._predictor,
            eye.updater,
            clutter_spatial_density=1.0,
            prob_detect=min(settings.p_d * seen_share(eye.model), 0.999),
            prob_gate=gate,
            normalise=False,
        )
        return JPDAwithEHM2(Nearby(inner, float(chi2.ppf(gate, len(eye.config.sigma))), settings.clutter))

    def _initiation(self) -> Any:
        settings = self._settings
        updater = next(eye.updater for eye in self._eyes.values() if eye.locates)
        near = DistanceHypothesiser(self._predictor, updater, Mahalanobis(), missed_distance=settings.holding_gate)
        return MultiMeasurementInitiator(
            prior_state=start_of(self._scenario),
            deleter=UpdateTimeDeleter(timedelta(seconds=settings.holding_s)),
            data_associator=GNNWith2DAssignment(Nearby(near, settings.holding_gate**2)),
            updater=updater,
            min_points=settings.min_points,
        )

    def scan(self, scan: Scan) -> None:
        """Work through the plots of one scan."""
        eye = self._eyes[scan.sensor]
        if not eye.locates and self._settings.bearings == "ignore":
            return
        time = instant(self._scenario, scan.time_ns)
        detections = detections_of(eye, scan, time)
        seen = {track for track in self._tracks if self._sees(eye, scan, track, time)}
        associations = self._associators[scan.sensor].associate(seen, detections, time) if seen else {}
        counts = eye.locates or self._settings.bearings == "keep"
        for track, hypotheses in associations.items():
            detections -= absorb(track, hypotheses, eye.updater, counts=counts)
        self._tracks -= self._deleter.delete_tracks(self._tracks, timestamp=time)
        if eye.locates:
            self._tracks |= self._initiator.initiate(detections, time)

    def _sees(self, eye: Eye, scan: Scan, track: Any, time: datetime) -> bool:
        """Whether a track is in the field of view of a sensor."""
        place = place_of(self._predictor.predict(track, timestamp=time))
        return bool(eye.model.at(scan.pose).field_of_view.contains(place, eye.config.view_center(scan.position)))

    def lines(self, t_ns: int) -> Iterator[dict[str, Any]]:
        """All tracks at a time, and those held that were worked on then."""
        time = instant(self._scenario, t_ns)
        held = {track for track in self._initiator.holding_tracks if track.timestamp == time}
        for status, tracks in (("confirmed", self._tracks), ("tentative", held)):
            for number, track in sorted(
                ((self._number(each), each) for each in sorted(tracks, key=x_of)), key=itemgetter(0)
            ):
                entry = {"time": self._scenario.to_seconds(t_ns), "track": number, "status": status}
                yield {**entry, "x": x_of(track, (time - track.timestamp).total_seconds())}

    def _number(self, track: Any) -> int:
        return self._numbers.setdefault(track.id, len(self._numbers))


def run(scenario: Scenario, scans: Sequence[Scan], settings: Settings) -> Iterator[dict[str, Any]]:
    """The lines of all tracks at all scan times.

    Args:
        scenario: the network.
        scans: by time; also those of sensors that the settings ignore, to say where tracks are then.
        settings: of the tracker.
    """
    tracker = PeerTracker(scenario, settings)
    for t_ns, together in groupby(scans, key=lambda scan: scan.time_ns):
        for scan in together:
            tracker.scan(scan)
        yield from tracker.lines(t_ns)


#: What a search like ``--tune`` found: mean GOSPA of 20.4 m over the five recordings of the ferry, where the best with
#: 8 points had 23.2 m; 22.0 m over the first half of Joyride, 336 s, and 22.2 m with 4 points; 101 m over the first
#: 120 s of the Solent, 106 m with 4 points.
TUNED = {
    "autoferry": Settings(min_points=30, holding_s=3.0, deleter_s=8.0),
    "joyride": Settings(min_points=3, holding_s=6.0, deleter_s=9.0, max_sigma_m=60.0),
    "solent": Settings(min_points=3, holding_s=3.5, deleter_s=10.0, max_sigma_m=150.0, gate=0.95),
}


#: Where the search found that late is best: what to change for a tracker that reports early.
EARLY = {"autoferry": ("min_points=8",)}


def early(scenario: Scenario) -> tuple[str, ...]:
    """Changes of the tuned settings to report early; none where they do."""
    return next((changes for name, changes in EARLY.items() if scenario.name.startswith(name)), ())


def tuned(scenario: Scenario) -> Settings:
    """The settings of a scenario: those tuned for its family, else for the ferry."""
    return next((found for name, found in TUNED.items() if scenario.name.startswith(name)), TUNED["autoferry"])


def changed(settings: Settings, changes: Sequence[str]) -> Settings:
    """Settings with changes of the form ``name=value``."""
    pairs = [change.split("=", 1) for change in changes]
    return settings._replace(**{name: type(getattr(settings, name))(value) for name, value in pairs})


def main() -> None:
    """Track, or tune."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", nargs="?", help="scenario file, or name of one that comes along")
    parser.add_argument("--plots", type=Path, help="recorded plots instead of the scenario's")
    parser.add_argument("--json-lines", type=Path, help="file to write tracks to; default standard output")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting other than tuned")
    parser.add_argument("--tune", choices=TUNED, help="search the settings of these scenarios")
    parser.add_argument("--seconds", type=float, help="of each scenario to tune on; default: all")
    parser.add_argument("--json", type=Path, help="file of everything tried; default runs/tune-FAMILY.json")
    arguments = parser.parse_args()
    if arguments.tune:
        from waldnet.benchmarks.peer_tuning import tune

        out = arguments.json or Path(f"runs/tune-{arguments.tune}.json")
        tune(arguments.tune, changed(TUNED[arguments.tune], arguments.set), arguments.seconds, out)
        return
    if arguments.scenario is None:
        parser.error("a scenario, or --tune")
    scenario = load_scenario(find(arguments.scenario))
    lines = run(scenario, all_scans(scenario, plots=arguments.plots), changed(tuned(scenario), arguments.set))
    with arguments.json_lines.open("w") if arguments.json_lines else nullcontext(sys.stdout) as file:
        file.writelines(json.dumps(line) + "\n" for line in lines)


if __name__ == "__main__":
    main()
