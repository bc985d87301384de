"""What a scan costs against the number of tracks, where these start by themselves and share plots.

Three polar radars as in scenario `solent` look at 10, 100, 1000 targets in a square: of an area that grows with their
number (a target in 0.9 km^2), or of the same area for all (900 km^2). Their false plots are as dense as a fifth of the
targets, or 20 a scan in all. Tracks start from plots (``[initiation]``) and are associated jointly.
"""

from __future__ import annotations

import datetime
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from waldnet.common.codec import decode, encode
from waldnet.common.config import Scenario
from waldnet.common.estimation.gaussian import Array, Gaussian
from waldnet.common.estimation.sensing import Sensor
from waldnet.common.estimation.sprt import CONFIRMED, DELETED
from waldnet.common.messages import NEVER, Keys, Scan, Tracks
from waldnet.offline.loopback import Loopback
from waldnet.recording.lines import TrackLines
from waldnet.scenarios.world import simulate_all

Area: TypeAlias = Literal["grows", "same"]

#: Area of a target where the area grows, and the side of the area that stays [m^2, m].
_EACH_M2, _SIDE_M = 0.9e6, 30_000.0
_SPEED, _INTERVAL_S = 8.0, 3.0
#: Stone Soup interleaves position and velocity.
_ORDER = [0, 2, 1, 3]


class Cell(NamedTuple):
    """What is measured in one row.

    Attributes:
        targets: that are there.
        area: whether it grows with their number.
        warm_up: scans of every radar before the first that is timed.
        scans: of every radar that are timed.
    """

    targets: int
    area: Area
    warm_up: int = 8
    scans: int = 8

    @property
    def scenario(self) -> Scenario:
        """Three radars at the edges of the area, and the targets in it, where chance put them."""
        side = _SIDE_M if self.area == "same" else float(np.sqrt(self.targets * _EACH_M2))
        false_plots = 20.0 if self.area == "same" else 0.2 * self.targets
        rng = np.random.default_rng(self.targets)
        places = rng.uniform(-side / 2.0, side / 2.0, (self.targets, 2))
        velocities = rng.normal(0.0, _SPEED / 2.0, (self.targets, 2))
        radar = {"kind": "polar", "sigma": [15.0, 0.004], "p_d": 0.9, "scan_interval": _INTERVAL_S}
        view = {"shape": "box", "center": [0.0, 0.0], "size": [1.2 * side, 1.2 * side]}
        stands = ([-0.6 * side, 0.0], [0.6 * side, 0.0], [0.0, -0.6 * side])
        return Scenario.model_validate(
            {
                "name": f"{self.targets}-targets",
                "motion": {"psd": 0.1},
                "decision": {"p0": 1e-4, "p1": 0.99, "keep": 0.9999},
                "initiation": {"speed": _SPEED, "max_speed": 25.0},
                "sensor": [
                    radar
                    | {
                        "name": f"radar-{number}",
                        "position": stand,
                        "false_plots": false_plots,
                        "field_of_view": view,
                        "first_scan": float(number),
                    }
                    for number, stand in enumerate(stands)
                ],
                "simulation": {"duration": (self.warm_up + self.scans) * _INTERVAL_S - 0.5},
                "target": [{"state": [*x, *v]} for x, v in zip(places.tolist(), velocities.tolist(), strict=True)],
            }
        )


class Steps:
    """Nodes and center in this process, each step and its codec timed."""

    def __init__(self, scenario: Scenario) -> None:
        self.network = Loopback.of(scenario)
        self.keys = Keys(scenario.name)
        self.lines = TrackLines(scenario)
        self.tracks: Tracks | None = None

    def join(self, first_ns: dict[str, int]) -> None:
        """All nodes join; the first scan of each is due at the given times."""
        for name, time_ns in first_ns.items():
            self.network.join(name, time_ns)

    def scan(self, scan: Scan, next_ns: int) -> dict[str, float]:
        """Milliseconds of the parts of one scan."""
        network, began = self.network, time.process_time()
        payload = encode(network.report(scan, next_ns))
        reported = time.process_time()
        message = decode(self.keys.report(scan.sensor), payload)
        assert not isinstance(message, Tracks)
        said = network.fuse(message)  # type: ignore[arg-type]
        for one in said:
            encode(one)
        fused = time.process_time()
        network.tell(said)
        told = time.process_time()
        pictures = [one for one in said if isinstance(one, Tracks)]
        for picture in pictures:
            self.tracks = picture
            for _ in self.lines.of(picture):
                pass
        parts = {"node": reported - began, "center": fused - reported, "told": (told - fused) / len(network.nodes)}
        return {part: 1e3 * took for part, took in {**parts, "lines": time.process_time() - told}.items()}


def measure(cell: Cell, peer_up_to: int = 100) -> dict[str, Any]:
    """Medians of the parts of a scan [ms], and the same scan in Stone Soup for up to so many targets."""
    scenario = cell.scenario
    scans = simulate_all(scenario, 1)
    network = Steps(scenario)
    network.join({scan.sensor: scan.time_ns for scan in reversed(scans)})
    rows: list[dict[str, float]] = []
    live: list[int] = []
    for at, scan in enumerate(scans):
        later = (other.time_ns for other in scans[at + 1 :] if other.sensor == scan.sensor)
        parts = network.scan(scan, next(later, NEVER))
        assert network.tracks is not None
        if at >= cell.warm_up * len(scenario.sensors):
            rows.append(parts)
            live.append(int((network.tracks.status != DELETED).sum()))
    median = {part: round(statistics.median(row[part] for row in rows), 3) for part in rows[0]}
    total = round(statistics.median(sum(row.values()) for row in rows), 3)
    assert network.tracks is not None
    peer = None
    if cell.targets <= peer_up_to:
        peer = round(_milliseconds(stone_soup_scan(scenario, network.tracks, scans[-1])), 1)
    return {
        "targets": cell.targets,
        "area": cell.area,
        "confirmed": int((network.tracks.status == CONFIRMED).sum()),
        "live": round(statistics.median(live)),
        **{f"{part}_ms": took for part, took in median.items()},
        "total_ms": total,
        "stone_soup_ms": peer,
    }


def _milliseconds(work: Callable[[], object], repetitions: int = 2) -> float:
    times = []
    for _ in range(repetitions):
        began = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - began))
    return statistics.median(times)


def stone_soup_scan(scenario: Scenario, tracks: Tracks, scan: Scan) -> Callable[[], object]:
    """Stone Soup's JPDA by belief propagation on the plots of a scan: predict, hypothesise, associate, update.

    Args:
        scenario: a 2-D network of polar sensors, constant velocity.
        tracks: as many tracks as are confirmed, where they are.
        scan: whose plots.
    """
    from stonesoup.dataassociator.probability import JPDAwithLBP
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel
    from stonesoup.models.transition.linear import ConstantVelocity as SoupVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.updater.probability import PDAUpdater

    motion, config = scenario.motion.build(), scenario.sensor(scan.sensor)
    sensor: Sensor = config.build(motion)
    start = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
    then = start + datetime.timedelta(seconds=_INTERVAL_S)
    sigma_r, sigma_a = 15.0, 0.004
    model = CartesianToBearingRange(
        4, (0, 2), np.diag([sigma_a**2, sigma_r**2]), translation_offset=scan.position[:, None]
    )
    noise = CombinedLinearGaussianTransitionModel([SoupVelocity(scenario.motion.psd)] * 2)
    # In plot space false plots are as dense as the mean over the area: bearing-range cells differ in size.
    density = _plot_density(sensor, scan)
    updater = PDAUpdater(model)
    hypothesiser = PDAHypothesiser(
        KalmanPredictor(noise), updater, density, prob_detect=0.9, prob_gate=scenario.fusion.gate_probability
    )
    associator = JPDAwithLBP(hypothesiser)
    confirmed = tracks.status == CONFIRMED
    priors = Gaussian(tracks.x[confirmed][:, _ORDER], tracks.P[confirmed][:, _ORDER][:, :, _ORDER])
    soup = {Track([GaussianState(x[:, None], P, timestamp=start)]) for x, P in zip(*priors, strict=True)}
    plots = {Detection(_bearing_range(plot), timestamp=then, measurement_model=model) for plot in scan.z}

    def work() -> object:
        hypotheses = associator.associate(soup, plots, then)
        return [updater.update(hypotheses[track]) for track in soup]

    return work


def _plot_density(sensor: Sensor, scan: Scan) -> float:
    near = sensor.log_relative(scan.z, scan.position)
    relative = np.zeros(len(scan.z)) if near is None else near
    return float(np.exp(sensor.log_rho_f + np.median(relative)))


def _bearing_range(plot: Array) -> Any:
    """A plot as Stone Soup has it; azimuth is measured from north, clockwise."""
    from stonesoup.types.angle import Bearing
    from stonesoup.types.array import StateVector

    distance, azimuth = plot
    return StateVector([Bearing(np.pi / 2.0 - azimuth), distance])


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows for people; ratios are of the cost per target to that of the row before."""
    return "\n".join(_lines(rows))


def _lines(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    yield (
        "| area | targets | confirmed | live tracks | node | told | center | JSON lines | total | "
        "total per live track [µs] | to row before | Stone Soup | ratio |"
    )
    yield "|---" + "|---:" * 12 + "|"
    before: dict[str, Any] = {}
    for row in rows:
        each = row["total_ms"] / row["live"]
        same = before.get("area") == row["area"]
        ratio = f"{each / (before['total_ms'] / before['live']):.2f}" if same else ""
        peer = row["stone_soup_ms"]
        yield (
            f"| {row['area']} | {row['targets']} | {row['confirmed']} | {row['live']} | {row['node_ms']:.2f} "
            f"| {row['told_ms']:.2f} | {row['center_ms']:.2f} | {row['lines_ms']:.2f} | {row['total_ms']:.2f} "
            f"| {1e3 * each:.1f} | {ratio} | {'' if peer is None else peer} "
            f"| {'' if peer is None else round(peer / (row['node_ms'] + row['told_ms']), 1)} |"
        )
        before = row
