"""Scenario and network files, validated once: every fault at once, each with its path."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator
from pydantic_core import ErrorDetails

from waldnet.common.errors import ConfigError
from waldnet.common.estimation.gaussian import Gaussian
from waldnet.common.estimation.representation import Share
from waldnet.common.estimation.sprt import Thresholds, thresholds
from waldnet.common.fusion_config import FusionConfig, can_use_advice, fusion_faults
from waldnet.common.initiation_config import InitiationConfig, initiation_faults
from waldnet.common.life_config import LifeConfig
from waldnet.common.limits import MAX_SCANS, MAX_SECONDS, MIN_SECONDS
from waldnet.common.motion_config import MotionConfig, motion_faults, numbers_per_axis
from waldnet.common.quantities import (
    NS_PER_S,
    Count,
    Duration,
    Finite,
    InnerProbability,
    Instant,
    Model,
    Name,
    Positive,
    Probability,
    Seconds,
    Size,
)
from waldnet.common.sensor_config import BoxConfig as BoxConfig
from waldnet.common.sensor_config import DiscConfig as DiscConfig
from waldnet.common.sensor_config import SectorConfig as SectorConfig
from waldnet.common.sensor_config import SensorConfig as SensorConfig
from waldnet.common.sensor_config import sensor_faults, wrong_length

#: What nodes and center must have in common.
_COMMON = {"epoch", "motion", "initiation", "life", "fusion", "sensors"}
#: Slow targets have this share of the usual speed.
_SLOW = 0.25
#: Tables that come in kinds, and the key that tells which.
_TAGGED = {"field_of_view": "shape", "detection": "model"}


class Network(Model):
    """How one process takes part in a Zenoh network; endpoints look like ``tcp/192.168.1.7:7447``.

    ``link_bit_s`` is the rate of its slowest link, where that is below some Mbit/s: reports then overtake plots there.
    """

    name: Name = "waldnet"
    mode: Literal["peer", "client", "router"] = "peer"
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    multicast: bool = False
    link_bit_s: Positive | None = None


class Origin(Model):
    """Origin of the local east-north frame."""

    latitude: Annotated[float, Field(ge=-90.0, le=90.0, strict=True)]
    longitude: Annotated[float, Field(ge=-180.0, le=180.0, strict=True)]


class DecisionConfig(Model):
    """Wald's test.

    Attributes:
        p0: probability of accepting h1 (a target) under h0 (none).
        p1: probability of accepting h1 under h1.
        keep: the same for the tests of a confirmed track, one after every confirmation; default: p1.
        enabled: if not, LR is computed and nothing decided.
    """

    p0: InnerProbability = 1e-4
    p1: InnerProbability = 0.95
    keep: InnerProbability | None = None
    enabled: bool = True

    @property
    def thresholds(self) -> Thresholds:
        """Log A and log B."""
        return thresholds(self.p0, self.p1, self.keep)


class StudyConfig(Model):
    """What ``waldnet study`` asks of a track: farther from the truth after the last scan [m], it is lost."""

    lost_beyond: Positive = 1000.0


class SimulationConfig(Model):
    """The simulated world.

    Attributes:
        duration: how long [s].
        seed: of everything random.
        truth: recorded trajectories of further targets (JSON Lines), path relative to the scenario file.
    """

    duration: Duration
    seed: Count = 1
    truth: Path | None = None


class RecordingConfig(Model):
    """Recorded plots.

    Attributes:
        plots: JSON Lines, path relative to the scenario file.
        ignore: sensors of the recording that the scenario does without.
    """

    plots: Path
    ignore: tuple[Name, ...] = ()


class TargetConfig(Model):
    """A simulated target: a state at its start, or drawn from the density of a hypothesis; it moves as ``motion`` says.

    Attributes:
        start: when it appears [s].
        state: position and velocity [m, m/s]; where targets accelerate, acceleration too [m/s^2].
        hypothesis: index of the hypothesis whose density it is drawn from.
    """

    start: Seconds = 0.0
    state: tuple[Finite, ...] | None = None
    hypothesis: Count | None = None


class ClutterSourceConfig(Model):
    """A simulated thing that stands still and is no target: a buoy, a part of a quay.

    Attributes:
        position: east, north (, up) [m].
        p_d: probability that a sensor that has it in its field of view gives a plot of it, scan by scan.
        sensors: names of those that see it; default: all.
    """

    position: tuple[Finite, ...]
    p_d: Probability
    sensors: tuple[Name, ...] | None = None


class HypothesisConfig(Model):
    """A track to be decided on: start [s], mean and standard deviations of a state as ``TargetConfig`` has it."""

    start: Seconds = 0.0
    state: tuple[Finite, ...]
    sigma: tuple[Size, ...]

    @property
    def density(self) -> Gaussian:
        """The prior N(x0, P0)."""
        return Gaussian(np.array(self.state), np.diag(np.square(self.sigma)))


class Scenario(Model):
    """One file: a network and, if wanted, the simulated world or the recorded plots it looks at.

    Attributes:
        name: of the network.
        origin: of the local east-north frame, in latitude and longitude; None: not told.
        epoch: the instant of scenario time 0.
        network: how processes find each other.
        motion: how targets move.
        decision: Wald's test.
        initiation: how tracks start by themselves; None: they do not.
        life: how tracks end that nobody sees; None: they do not.
        fusion: what nodes send, and what the center makes of it.
        sensors: at least one.
        simulation: the simulated world; None: there is none.
        study: what ``waldnet study`` asks of a track.
        recording: the recorded plots; None: there are none.
        clutter_sources: things of the simulated world that stand still and are no targets.
        targets: of the simulated world.
        hypotheses: tracks to be decided on from the start.
    """

    name: Name
    origin: Origin | None = None
    epoch: Instant = datetime(2026, 1, 1, tzinfo=UTC)
    network: Network = Network()
    motion: MotionConfig
    decision: DecisionConfig = DecisionConfig()
    initiation: InitiationConfig | None = None
    life: LifeConfig | None = None
    fusion: FusionConfig = FusionConfig()
    sensors: Annotated[tuple[SensorConfig, ...], Field(alias="sensor", min_length=1)]
    simulation: SimulationConfig | None = None
    study: StudyConfig = StudyConfig()
    recording: RecordingConfig | None = None
    clutter_sources: Annotated[tuple[ClutterSourceConfig, ...], Field(alias="clutter_source")] = ()
    targets: Annotated[tuple[TargetConfig, ...], Field(alias="target")] = ()
    hypotheses: Annotated[tuple[HypothesisConfig, ...], Field(alias="hypothesis")] = ()

    @model_validator(mode="before")
    @classmethod
    def _where_tracks_start(cls, data: Any) -> Any:
        """Where tracks start by themselves they have a life, and nodes are told where to look if they can use it."""
        if not isinstance(data, dict) or data.get("initiation") is None:
            return data
        fusion = data.get("fusion", {})
        if isinstance(fusion, dict) and "feedback" not in fusion and can_use_advice(fusion):
            fusion = {**fusion, "feedback": "advice"}
        return {**data, "fusion": fusion, "life": data.get("life", {})}

    @property
    def epoch_ns(self) -> int:
        """The epoch in nanoseconds since the Unix epoch."""
        since = self.epoch - datetime(1970, 1, 1, tzinfo=UTC)
        return ((since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds) * 1_000

    def to_ns(self, time_s: float) -> int:
        """Scenario seconds to nanoseconds since the Unix epoch."""
        return self.epoch_ns + round(time_s * NS_PER_S)

    def to_seconds(self, t_ns: int) -> float:
        """Nanoseconds since the Unix epoch to scenario seconds."""
        return (t_ns - self.epoch_ns) / NS_PER_S

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names in the order of the file."""
        return tuple(sensor.name for sensor in self.sensors)

    def sensor(self, name: str) -> SensorConfig:
        """The sensor of that name.

        Raises:
            ConfigError: when there is none.
        """
        for sensor in self.sensors:
            if sensor.name == name:
                return sensor
        raise ConfigError(f"{self.name}: no sensor {name!r}; there are {', '.join(self.sensor_names)}")

    @property
    def digest(self) -> str:
        """Of what node and center must have in common, or LR would be wrong without a word: models, fusion, sensors."""
        return _digest(self.model_dump_json(include=_COMMON))

    @property
    def digests(self) -> dict[str, str]:
        """The same of each part by itself, to tell in which part two scenarios differ."""
        return {part: _digest(self.model_dump_json(include={part})) for part in sorted(_COMMON)}

    @property
    def joint(self) -> bool:
        """Whether tracks that share plots are associated jointly."""
        return self.initiation is not None if self.fusion.joint is None else self.fusion.joint

    @property
    def extent(self) -> float:
        """Of the largest field of view [m]; infinite where none has an end."""
        extents = [sensor.field_of_view.extent(self.motion.dimensions) for sensor in self.sensors]
        return max((extent for extent in extents if extent is not None), default=np.inf)

    @property
    def stay(self) -> float:
        """Mean time that targets stay [s]."""
        if self.life is None:
            return np.inf
        if self.life.stay is not None:
            return self.life.stay
        return np.inf if self.initiation is None else self.extent / (_SLOW * self.initiation.speed)

    @property
    def share(self) -> Share:
        """A sensor's share of prior and process noise."""
        return Share(1.0 if self.fusion.mode in ("naive", "selected") else float(len(self.sensors)))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def load_scenario(path: Path) -> Scenario:
    """Read and validate a scenario file.

    Raises:
        ConfigError: naming every fault.
    """
    return make_scenario(_read_toml(path), path.parent, str(path))


def make_scenario(data: Mapping[str, Any], folder: Path, where: str) -> Scenario:
    """Validate the tables of a scenario.

    Args:
        data: as a scenario file has them: dicts, lists, numbers, texts.
        folder: from which relative paths count.
        where: the tables come from, for messages.

    Raises:
        ConfigError: naming every fault.
    """
    data = dict(data)
    if isinstance(name := data.get("name"), str) and isinstance(network := data.get("network", {}), dict):
        data["network"] = {"name": name, **network}
    faults = list(_cross_faults(data))
    try:
        scenario = Scenario.model_validate(data)
    except ValidationError as error:
        faults = [*_describe_all(error), *faults]
    if faults:
        raise ConfigError("\n".join(f"{where}: {fault}" for fault in faults))
    return _beside(folder, scenario)


def _beside(folder: Path, scenario: Scenario) -> Scenario:
    """The scenario with its files where they are: relative paths count from its own folder."""
    recording, simulation = scenario.recording, scenario.simulation
    if recording is not None:
        recording = recording.model_copy(update={"plots": folder / recording.plots})
    if simulation is not None and simulation.truth is not None:
        simulation = simulation.model_copy(update={"truth": folder / simulation.truth})
    return scenario.model_copy(update={"recording": recording, "simulation": simulation})


def load_network(path: Path) -> Network:
    """Read and validate a network file: the keys of ``[network]`` at its top level.

    Raises:
        ConfigError: naming every fault.
    """
    try:
        return Network.model_validate(_read_toml(path))
    except ValidationError as error:
        raise ConfigError("\n".join(f"{path}: {fault}" for fault in _describe_all(error))) from None


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is no UTF-8 text: {error.reason} at byte {error.start}") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is no TOML: {error}") from None


def _describe_all(error: ValidationError) -> Iterator[str]:
    details = error.errors(include_url=False)
    for detail in details:
        # A list whose entries are all wrong is also reported as too short; one fault is enough.
        inner = any(other["loc"][: len(detail["loc"])] == detail["loc"] for other in details if other is not detail)
        if not (detail["type"] == "too_short" and inner):
            yield _describe(detail)


def _describe(detail: ErrorDetails) -> str:
    """One fault as ``path: what was got, what was expected``."""
    # A tagged union puts the tag into the location; it is no key of the file.
    parts = [str(part) for part in detail["loc"]]
    where = ".".join(part for i, part in enumerate(parts) if i == 0 or parts[i - 1] not in _TAGGED or i < 3)
    kind, got, context = detail["type"], detail["input"], detail.get("ctx", {})
    if kind == "missing":
        text = "is missing"
    elif kind == "extra_forbidden":
        text = "is no known key"
    elif kind == "literal_error":
        text = f"{got!r} is not one of {context['expected']}"
    elif kind == "union_tag_invalid":
        text = f"{_TAGGED[parts[-1]]} {context['tag']!r} is not one of {context['expected_tags']}"
    elif kind == "union_tag_not_found":
        text = f"{_TAGGED[parts[-1]]} is missing"
    elif kind == "value_error":
        text = str(context["error"])
    else:
        message = detail["msg"]
        text = f"got {got!r}: {message[0].lower()}{message[1:]}"
    return f"{where}: {text}"


def _cross_faults(data: Mapping[str, Any]) -> Iterator[str]:
    """Faults between keys; tolerant of whatever else is wrong, so that all faults are named at once."""
    motion = _table(data, "motion")
    yield from motion_faults(data.get("motion"))
    dimensions, per_axis = motion.get("dimensions", 2), numbers_per_axis(motion)
    sensors, hypotheses = _tables(data, "sensor"), _tables(data, "hypothesis")
    if dimensions in (2, 3):
        for i, sensor in enumerate(sensors):
            yield from sensor_faults(sensor, dimensions, f"sensor.{i}")
        size = per_axis * dimensions
        why = f"this scenario's dimensions and motion need {size}"
        for kind in ("hypothesis", "target"):
            for i, entry in enumerate(_tables(data, kind)):
                yield from wrong_length(entry, ("state", "sigma"), size, f"{kind}.{i}", why)
    yield from _repeated_names(sensors)
    yield from _recording_faults(_table(data, "recording"), sensors)
    for i, target in enumerate(_tables(data, "target")):
        drawn = target.get("hypothesis")
        if (drawn is None) == (target.get("state") is None):
            yield f"target.{i}: give either state or hypothesis"
        elif isinstance(drawn, int) and drawn >= len(hypotheses):
            yield f"target.{i}.hypothesis: {drawn} is not one of the {len(hypotheses)} hypotheses (counted from 0)"
    yield from _scan_faults(_table(data, "simulation").get("duration"), sensors)
    yield from _decision_faults(_table(data, "decision"))
    kinds = [sensor.get("kind", "position") for sensor in sensors]
    yield from initiation_faults(data.get("initiation"), _table(data, "fusion").get("window", 10.0), kinds)
    yield from fusion_faults(_table(data, "fusion"), motion.get("model"))
    yield from _mode_faults(_table(data, "fusion").get("mode"), sensors)
    yield from _source_faults(_tables(data, "clutter_source"), sensors, dimensions)


def _mode_faults(mode: Any, sensors: list[Mapping[str, Any]]) -> Iterator[str]:
    """What a mode of fusion cannot do with the sensors there are."""
    if mode == "dkf":
        yield from _dkf_faults(sensors)
    for i, sensor in enumerate(sensors):
        if mode == "selected" and "clutter_map" in sensor:
            yield f"fusion.mode: 'selected' associates at the center, which has no clutter_map; sensor.{i} has one"
        if mode in ("dkf", "selected") and "visibility" in sensor:
            yield f"sensor.{i}.visibility: mode {mode!r} takes targets for visible all the time; leave it out"


def _source_faults(
    sources: list[Mapping[str, Any]], sensors: list[Mapping[str, Any]], dimensions: Any
) -> Iterator[str]:
    names = {sensor.get("name") for sensor in sensors if isinstance(sensor.get("name"), str)}
    for i, source in enumerate(sources):
        if dimensions in (2, 3):
            yield from wrong_length(source, ("position",), dimensions, f"clutter_source.{i}")
        seeing = source.get("sensors")
        for name in seeing if isinstance(seeing, list) else ():
            if name not in names:
                yield f"clutter_source.{i}.sensors: {name!r} is no sensor of this scenario"


def _dkf_faults(sensors: list[Mapping[str, Any]]) -> Iterator[str]:
    """What keeps the covariances of all sensors from being known without data."""
    for i, sensor in enumerate(sensors):
        if (kind := sensor.get("kind", "position")) != "position":
            yield f"fusion.mode: 'dkf' needs covariances known without data; those of sensor.{i}, {kind}, are not"
        if (model := _table(sensor, "detection").get("model", "constant")) != "constant":
            yield f"fusion.mode: 'dkf' needs a constant detection probability; sensor.{i} has detection {model!r}"


def _table(data: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = data.get(key)
    return value if isinstance(value, dict) else {}


def _tables(data: Mapping[str, Any], key: str) -> list[Mapping[str, Any]]:
    value = data.get(key)
    return [entry if isinstance(entry, dict) else {} for entry in value] if isinstance(value, list) else []


def _repeated_names(sensors: list[Mapping[str, Any]]) -> Iterator[str]:
    seen: set[Any] = set()
    for i, sensor in enumerate(sensors):
        name = sensor.get("name")
        if isinstance(name, str) and name in seen:
            yield f"sensor.{i}.name: {name!r} is taken already"
        if name == "center":
            yield f"sensor.{i}.name: 'center' is the name of the fusion center"
        seen.add(name if isinstance(name, str) else None)


def _recording_faults(recording: Mapping[str, Any], sensors: list[Mapping[str, Any]]) -> Iterator[str]:
    ignored = recording.get("ignore")
    for name in ignored if isinstance(ignored, list) else ():
        if any(sensor.get("name") == name for sensor in sensors):
            yield f"recording.ignore: {name!r} is a sensor of this scenario"


def _scan_faults(duration: Any, sensors: list[Mapping[str, Any]]) -> Iterator[str]:
    """Simulated scans that are too many to be kept."""
    for i, sensor in enumerate(sensors):
        interval = sensor.get("scan_interval", 1.0)
        numbers = isinstance(duration, int | float) and isinstance(interval, int | float)
        if numbers and interval >= MIN_SECONDS and interval * MAX_SCANS < duration <= MAX_SECONDS:
            yield (
                f"sensor.{i}.scan_interval: {interval:g} s makes {duration / interval:.3g} scans in the "
                f"{duration:g} s of the simulation, expected at most {MAX_SCANS:g}"
            )


def _decision_faults(decision: Mapping[str, Any]) -> Iterator[str]:
    p0 = decision.get("p0", 1e-4)
    for key, default in (("p1", 0.95), ("keep", 1.0)):
        p = decision.get(key, default)
        if isinstance(p0, float) and isinstance(p, float) and 0.0 < p <= p0 < 1.0:
            yield f"decision.{key}: {p:g} is not above p0 = {p0:g}; no threshold lies between"
