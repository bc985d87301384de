"""The library behind ``import waldnet``: scenarios, scans, pictures of the tracks, their evaluation.

Times are seconds since the scenario's epoch, lengths metres, angles radians. Plots are as recordings have them: in the
sensor's own measurement space, as docs/how-to/sensors.md says.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from waldnet.common.config import Scenario, make_scenario
from waldnet.common.config import load_scenario as load_file
from waldnet.common.errors import ConfigError as ConfigError
from waldnet.common.errors import EvaluationError as EvaluationError
from waldnet.common.errors import PlotsError as PlotsError
from waldnet.common.errors import PlotsWarning
from waldnet.common.errors import TruthError as TruthError
from waldnet.common.errors import WaldnetError as WaldnetError
from waldnet.common.estimation.gaussian import Array
from waldnet.common.estimation.sprt import Status
from waldnet.common.messages import Decision as DecisionMessage
from waldnet.common.messages import Scan as ScanMessage
from waldnet.common.messages import Tracks
from waldnet.offline.centralised import Centralised
from waldnet.offline.replay import Replay, measurement_times
from waldnet.scenarios.catalogue import find, names
from waldnet.scenarios.plots import plots_entry, read_entries, scan_of
from waldnet.scenarios.world import simulate_all, truth
from waldnet.sensor_node.sources import Spacing, seed_of

#: A scenario by its name, by the path of its file, or as the dict that such a file holds.
ScenarioSource: TypeAlias = str | os.PathLike[str] | Mapping[str, Any]

_AXES = ("east", "north", "up")


@dataclass(frozen=True, init=False, eq=False)
class Scan:
    """All plots of one sensor at one time.

    Lists, tuples and arrays are welcome. What only the scenario knows, such as the size of a plot, is checked where
    the scan is used.

    Attributes:
        sensor: name of the sensor.
        time: of the scan, since the scenario's epoch [s].
        plots: in the sensor's measurement space [m, rad, m/s], shape (M, m), of an empty scan (0, 0).
        position: of the sensor: east, north(, up) [m], shape (d,); None: where the scenario says.
        velocity: of the sensor over ground [m/s], shape (d,); None: as the scenario says.
        heading: of its platform, clockwise from north [rad]; None: as the scenario says.
    """

    sensor: str
    time: float
    plots: Array
    position: Array | None
    velocity: Array | None
    heading: float | None

    def __init__(
        self,
        sensor: str,
        time: float,
        plots: ArrayLike,
        position: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        heading: float | None = None,
    ) -> None:
        where = f"scan of {sensor} at {time} s"
        values = {
            "sensor": sensor,
            "time": _number(time, "time", where),
            "plots": _plots(plots, where),
            "position": None if position is None else _vector(position, "position", where),
            "velocity": None if velocity is None else _vector(velocity, "velocity", where),
            "heading": None if heading is None else _number(heading, "heading", where),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @classmethod
    def _of(cls, entry: Mapping[str, Any]) -> Scan:
        """The scan of a line of a recording."""
        return cls(**entry)

    def _message(self, scenario: Scenario) -> ScanMessage | None:
        """The scan as nodes take it; None if the scenario ignores its sensor."""
        entry: dict[str, Any] = {"sensor": self.sensor, "time": self.time, "plots": self.plots.tolist()}
        if self.position is not None:
            entry["position"] = self.position.tolist()
        if self.velocity is not None:
            entry["velocity"] = self.velocity.tolist()
        try:
            return scan_of({**entry, "heading": self.heading}, scenario)
        except ValueError as error:
            raise PlotsError(f"scan of {self.sensor} at {self.time} s: {error}") from None


@dataclass(frozen=True, eq=False)
class Track:
    """A track at one measurement time.

    Attributes:
        id: number of the track.
        status: "tentative"; "confirmed"; "coasting": confirmed, but not seen lately; or "deleted".
        log_lr: natural logarithm of the likelihood ratio of the test.
        log_lr_total: sum of all its steps since the track's start.
        scans: measurement times used so far.
        supported: time of the last scan with a plot that was the track's, at first the track's start [s].
        x: mean of the state, as ``Picture.state`` names its numbers [m, m/s(, m/s^2)], shape (n,).
        P: covariance of the state, shape (n, n).
        sensors: names of the sensors that reported the track at this time.
    """

    id: int
    status: str
    log_lr: float
    log_lr_total: float
    scans: int
    supported: float
    x: Array
    P: Array
    sensors: tuple[str, ...]


@dataclass(frozen=True)
class Decision:
    """One decision about one track.

    Attributes:
        kind: "confirmed"; "deleted": there is no target; "lost": no sensor can see where it may be, or that is not
            known any more; "merged": it was another track's target.
        track: number of the track.
        time: of the scans that decided [s].
        log_lr: natural logarithm of the likelihood ratio that crossed the threshold.
        log_lr_total: sum of all its steps since the track's start.
        scans: measurement times used since the track's start.
        into: of a merged track, number of the one that stays; else None.
    """

    kind: str
    track: int
    time: float
    log_lr: float
    log_lr_total: float
    scans: int
    into: int | None


@dataclass(frozen=True, eq=False)
class Picture:
    """All tracks after the scans of one measurement time.

    Attributes:
        time: of the scans [s].
        tracks: by number; deleted ones are repeated as they were at their end where the scenario gives all tracks,
            and are there once where tracks start by themselves.
        decisions: made at this time.
        state: names of the numbers of a track's state: "east", "north" [m], "v_east", "v_north" [m/s], and so on.
    """

    time: float
    tracks: tuple[Track, ...]
    decisions: tuple[Decision, ...]
    state: tuple[str, ...]


def scenario_names() -> list[str]:
    """Names of the scenarios that come with the package.

    Returns:
        the names, for ``load_scenario``.
    """
    return names()


def load_scenario(source: ScenarioSource) -> Scenario:
    """Load and validate a scenario.

    Args:
        source: name of a scenario that comes with the package, path of a scenario file (TOML), or a dict with the keys
            of such a file. In a dict, arrays may stand for lists, and relative paths count from the working folder.

    Returns:
        the scenario.

    Raises:
        ConfigError: naming every fault: where, what was got, what was expected.
    """
    if isinstance(source, Mapping):
        name = source.get("name")
        return make_scenario(_plain(source), Path(), name if isinstance(name, str) else "scenario")
    if isinstance(source, str | os.PathLike):
        return load_file(find(os.fspath(source)))
    raise ConfigError(f"scenario: got {type(source).__name__}, expected a name, a path or a dict")


def simulate(scenario: Scenario, seed: int | None = None) -> list[Scan]:
    """Simulate the scans of all sensors.

    Args:
        scenario: with a table [simulation].
        seed: of everything random; default: the scenario's.

    Returns:
        the scans, by time; those of one time in the order of the scenario's sensors.

    Raises:
        ConfigError: when the scenario describes no simulation.
    """
    return [Scan._of(plots_entry(scan, scenario)) for scan in simulate_all(scenario, seed_of(scenario, seed))]


def simulate_truth(scenario: Scenario, seed: int | None = None) -> dict[str, NDArray[Any]]:
    """Tell where the targets of a simulation truly are.

    Args:
        scenario: with a table [simulation].
        seed: of everything random, as for ``simulate``; default: the scenario's.

    Returns:
        columns "target" (number), "time" [s], "position" [m], shapes (K,), (K,), (K, d); one row for every target and
        scan time. ``evaluate`` takes it as it is.

    Raises:
        ConfigError: when the scenario describes no simulation.
    """
    times_ns, x = truth(scenario, seed_of(scenario, seed))
    positions = x[..., : scenario.motion.dimensions]
    target, k = np.nonzero(np.isfinite(positions).all(axis=-1))
    times = np.array([scenario.to_seconds(time_ns) for time_ns in times_ns.tolist()], np.float64)
    return {"target": target.astype(np.int64), "time": times[k], "position": positions[target, k]}


def read_plots(path: str | os.PathLike[str], scenario: Scenario) -> list[Scan]:
    """Read and validate a file of recorded plots (JSON Lines).

    Args:
        path: of the file.
        scenario: names the sensors; those that it ignores are left out.

    Returns:
        the scans, by time; those of one time in the order of the scenario's sensors.

    Raises:
        PlotsError: naming file, line and reason of every fault.
    """
    return [Scan._of(entry) for _, entry in read_entries(Path(path), scenario)]


def replay(scenario: Scenario, scans: Iterable[Scan], *, centralised: bool = False) -> Iterator[Picture]:
    """Let a network decide on scans, in this process.

    The pictures are those of ``waldnet replay``. Scans are taken one by one as pictures are asked for, so there may be
    no end of them, and memory stays bounded. A picture is there once the scans of its time are complete: when all
    sensors have scanned, else with the first later scan, or the last of all.

    Args:
        scenario: the network.
        scans: of all sensors, by time.
        centralised: let one tracker have all plots instead of a network.

    Yields:
        the picture after each measurement time.

    Raises:
        PlotsError: when a scan is not what its sensor can give, is older than the one before, or is of a sensor that
            the scenario does not have.

    Warns:
        UserWarning: when a part of a report could not be worked in.
    """
    messages = _spaced_messages(scenario, scans)
    if centralised:
        return _pictures(scenario, _run_centralised(scenario, messages))
    network = Replay(scenario, messages)
    return _pictures(scenario, network.run(), network)


def _spaced_messages(scenario: Scenario, scans: Iterable[Scan]) -> Iterator[ScanMessage]:
    """Scans as nodes take them, without those that come too soon after the last one of their sensor."""
    spacing = Spacing.of(scenario)
    for scan in scans:
        if not isinstance(scan, Scan):
            raise PlotsError(f"scans: got {type(scan).__name__}, expected waldnet.Scan")
        message = scan._message(scenario)
        if message is not None and spacing.keeps(message.sensor, message.time_ns):
            yield message


def _run_centralised(scenario: Scenario, scans: Iterable[ScanMessage]) -> Iterator[Tracks | DecisionMessage]:
    tracker = Centralised.of(scenario)
    state = tracker.initial()
    for group in measurement_times(scans, scenario):
        state, said = tracker.step(state, group)
        yield from said


def _pictures(
    scenario: Scenario, messages: Iterable[Tracks | DecisionMessage], network: Replay | None = None
) -> Iterator[Picture]:
    """Pictures of what a network says."""
    motion = scenario.motion.build()
    axes = _AXES[: motion.dimensions]
    state = tuple(f"{prefix}{axis}" for prefix in ("", "v_", "a_") for axis in axes)[: motion.n]
    ended: dict[int, Track] = {}
    decisions: list[Decision] = []
    left_out: dict[str, int] = {}
    for message in messages:
        if isinstance(message, DecisionMessage):
            decisions.append(_decision(message, scenario))
            continue
        tracks = {track.id: track for track in _tracks(message, scenario)}
        tracks = {**ended, **tracks}
        if scenario.initiation is None:
            ended.update((number, track) for number, track in tracks.items() if track.status == "deleted")
        time = scenario.to_seconds(message.time_ns)
        yield Picture(time, tuple(tracks[number] for number in sorted(tracks)), tuple(decisions), state)
        decisions = []
        if network is not None:
            for what, count in network.left_out.items():
                if more := count - left_out.get(what, 0):
                    warnings.warn(f"{scenario.name}: at {time} s: {more} {what}", PlotsWarning, stacklevel=2)
            left_out = network.left_out


def _tracks(tracks: Tracks, scenario: Scenario) -> Iterator[Track]:
    for row, number in enumerate(tracks.ids.tolist()):
        yield Track(
            id=number,
            status=Status(tracks.status[row]).name.lower(),
            log_lr=float(tracks.log_lr[row]),
            log_lr_total=float(tracks.log_lr_total[row]),
            scans=int(tracks.scans[row]),
            supported=scenario.to_seconds(int(tracks.supported_ns[row])),
            x=tracks.x[row],
            P=tracks.P[row],
            sensors=tuple(np.array(tracks.sensors)[tracks.contributing[row]].tolist()),
        )


def _decision(decision: DecisionMessage, scenario: Scenario) -> Decision:
    return Decision(
        kind=decision.kind,
        track=decision.track,
        time=scenario.to_seconds(decision.time_ns),
        log_lr=decision.log_lr,
        log_lr_total=decision.log_lr_total,
        scans=decision.scans,
        into=decision.into if decision.kind == "merged" else None,
    )


def columns(pictures: Iterable[Picture]) -> dict[str, NDArray[Any]]:
    """Put the tracks of pictures into columns, one row for every track at every time.

    ``pandas.DataFrame(columns)``, ``polars.DataFrame(columns)`` and ``pyarrow.table(columns)`` take the result as it
    is. Correlations of the state are left out; ``Track.P`` has them.

    Args:
        pictures: from ``replay``.

    Returns:
        one-dimensional arrays of the same length: "time" [s], "track", "status", "log_lr", "log_lr_total", "scans",
        "supported" [s]; then the numbers of the state ("east" [m], "north" [m], "v_east" [m/s], ...), and their
        standard deviations ("sd_east" and so on).
    """
    state: tuple[str, ...] = ()
    times: list[float] = []
    tracks: list[Track] = []
    for picture in pictures:
        state = picture.state
        times += [picture.time] * len(picture.tracks)
        tracks += picture.tracks
    x = np.array([track.x for track in tracks], np.float64).reshape(len(tracks), len(state))
    variances = np.array([track.P.diagonal() for track in tracks], np.float64).reshape(len(tracks), len(state))
    table: dict[str, NDArray[Any]] = {
        "time": np.array(times, np.float64),
        "track": np.array([track.id for track in tracks], np.int64),
        "status": np.array([track.status for track in tracks], np.str_),
        "log_lr": np.array([track.log_lr for track in tracks], np.float64),
        "log_lr_total": np.array([track.log_lr_total for track in tracks], np.float64),
        "scans": np.array([track.scans for track in tracks], np.int64),
        "supported": np.array([track.supported for track in tracks], np.float64),
    }
    for column, name in enumerate(state):
        table[name] = x[:, column].copy()
    for column, name in enumerate(state):
        table[f"sd_{name}"] = np.sqrt(variances[:, column])
    return table


def evaluate(
    pictures: Iterable[Picture],
    truth: str | os.PathLike[str] | Mapping[str, ArrayLike],
    *,
    cutoff: float = 100.0,
    order: float = 2.0,
    window: float = 10.0,
    gap: float = 5.0,
) -> dict[str, Any]:
    """Tell how well the confirmed tracks found the targets, as ``waldnet evaluate`` does.

    Args:
        pictures: from ``replay``.
        truth: path of a file of true positions (JSON Lines), or columns "target" (number), "time" [s] and "position"
            [m], shapes (K,), (K,), (K, d), in any order of rows.
        cutoff: farther from a target, a track is not of it [m].
        order: p of GOSPA and OSPA(2), at least 1.
        window: of OSPA(2) [s].
        gap: positions of a target that are farther apart in time are not joined [s].

    Returns:
        the summary: numbers of targets and tracks, "confirmed_after_s" [s], "held_share", "rmse_m" [m], "breaks",
        "swaps", and dicts "gospa_m" and "ospa2_m" of means over time [m]. None where there is nothing to measure.

    Raises:
        TruthError: when the truth is wrong.
        EvaluationError: when pictures and truth have no time in common, or an option is not positive.
    """
    from waldnet.evaluation.evaluation import Rules, judge
    from waldnet.evaluation.paths import judged_times, targets_at
    from waldnet.evaluation.runs import Line, make_run
    from waldnet.scenarios.truth import read_truth, truth_of

    for name, value, least in (
        ("cutoff", cutoff, 0.0),
        ("order", order, 1.0),
        ("window", window, 0.0),
        ("gap", gap, 0.0),
    ):
        if not (value > 0.0 and value >= least and np.isfinite(value)):
            raise EvaluationError(f"{name}: got {value!r}, expected a number {'of at least 1' if least else 'above 0'}")
    pictures = list(pictures)
    known = truth_of(truth) if isinstance(truth, Mapping) else read_truth(Path(truth))
    axes = [sum(name in _AXES for name in picture.state) for picture in pictures[:1]]
    d = next((target.positions.shape[1] for target in known.values()), axes[0] if axes else 2)
    if axes and axes[0] != d:
        raise EvaluationError(f"truth: has {d} coordinates, the tracks have {axes[0]}")
    lines = [
        Line(picture.time, track.id, track.x[:d].tolist() if track.status == "confirmed" else None)
        for picture in pictures
        for track in picture.tracks
    ]
    run = make_run("pictures", lines, d)
    if pictures:
        run = run._replace(span_s=(pictures[0].time, pictures[-1].time))
    times = judged_times(known, [run])
    rules = Rules(cutoff_m=cutoff, order=order, window_s=window, gap_s=gap)
    return judge(run, targets_at(known, times, gap, d), times, rules).summary()


def _plain(value: Any) -> Any:
    """Dicts, lists, numbers and texts of what may hold mappings, tuples and arrays."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_plain(entry) for entry in value]
    return value


def _number(value: Any, name: str, where: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        raise PlotsError(f"{where}: {name}: got {value!r}, expected a finite number")
    return number


def _array(value: ArrayLike, name: str, where: str, expected: str) -> Array:
    try:
        return np.array(value, np.float64)
    except (TypeError, ValueError):
        raise PlotsError(f"{where}: {name}: got {value!r}, expected {expected}") from None


def _vector(value: ArrayLike, name: str, where: str) -> Array:
    array = _array(value, name, where, "a list of numbers")
    if array.ndim != 1:
        raise PlotsError(f"{where}: {name}: got shape {array.shape}, expected (d,)")
    return array


def _plots(value: ArrayLike, where: str) -> Array:
    expected = "a list of plots, each a list of as many numbers"
    array = _array(value, "plots", where, expected)
    if not array.size and array.ndim < 3:
        return np.empty((0, array.shape[1] if array.ndim == 2 else 0))
    if array.ndim != 2:
        raise PlotsError(f"{where}: plots: got shape {array.shape}, expected (M, m): {expected}")
    return array
