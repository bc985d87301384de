"""What a study consists of: variants of a scenario, worlds, blocks of runs."""

from __future__ import annotations

import difflib
import hashlib
import json
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.errors import ConfigError
from waldnet.common.messages import IntArray
from waldnet.scenarios.world import scan_times_ns

#: Seeds of one study's worlds; those of the next begin here.
MAX_RUNS = 1_000_000
#: So that the seed of every world is an exact number in any table.
MAX_SEED = 2**53 // MAX_RUNS - 1
#: What has no part in what a mode computes.
_NO_MATTER = {"name", "origin", "network", "recording", "study"}
#: Packages that compute, and the modules of this one that only work on what was computed.
_COMPUTING = ("common", "fusion_center", "scenarios", "sensor_node", "studies")
_SHOWING = {"calibration", "cli", "importance", "progress", "shares", "tables"}


class Order(NamedTuple):
    """What was asked for.

    Attributes:
        modes: names, in the order of the tables.
        runs: per variant and mode.
        seed: of the study.
        p_d: detection probabilities, a variant each; none: those of the scenario.
        no_target: whether there is a variant without targets.
        block: runs that are computed together.
    """

    modes: tuple[str, ...]
    runs: int
    seed: int
    p_d: tuple[float, ...] = ()
    no_target: bool = False
    block: int = 100


class Variant(NamedTuple):
    """A scenario as it is studied.

    Attributes:
        name: in tables, and of its folder.
        scenario: with the variant's p_d and targets.
    """

    name: str
    scenario: Scenario

    @property
    def has_target(self) -> bool:
        """Whether h1 is true."""
        return bool(self.scenario.targets)


class Job(NamedTuple):
    """Runs that are computed together: their plots are drawn once, and all modes play on the same.

    Attributes:
        variant: what is studied.
        modes: that are still to play.
        first: number of the first run.
        seeds: of the worlds, shape (R,).
        program: digest of the program that must do it.
    """

    variant: Variant
    modes: tuple[str, ...]
    first: int
    seeds: IntArray
    program: str


def world_seeds(seed: int, first: int, count: int) -> IntArray:
    """Seeds of the worlds of runs ``first``, ``first + 1``, ...: 1,000,000 times the study's seed, plus the run.

    So a run's world depends neither on how many runs there are nor on who computes it, and
    ``waldnet simulate --seed`` draws it again.
    """
    return seed * MAX_RUNS + np.arange(first, first + count, dtype=np.int64)


def blocks(order: Order) -> Iterator[IntArray]:
    """Seeds of the runs that are computed together."""
    for first in range(0, order.runs, order.block):
        yield world_seeds(order.seed, first, min(order.block, order.runs - first))


def variants(scenario: Scenario, order: Order) -> list[Variant]:
    """The scenario with each p_d, and without a target.

    Without any p_d asked for, it is ``as-given``. The variant ``no-target`` has the scenario's own p_d; a scenario
    that has no target gives ``no-target`` variants only.
    """
    listed = (
        [("as-given", scenario)] if not order.p_d else [(f"p_d={p_d:g}", with_p_d(scenario, p_d)) for p_d in order.p_d]
    )
    if not scenario.targets:
        return [Variant("no-target" if name == "as-given" else f"no-target-{name}", one) for name, one in listed]
    if order.no_target:
        listed.append(("no-target", scenario.model_copy(update={"targets": ()})))
    return [Variant(name, one) for name, one in listed]


def with_p_d(scenario: Scenario, p_d: float) -> Scenario:
    """The scenario with all sensors at one detection probability."""
    sensors = tuple(sensor.model_copy(update={"p_d": p_d}) for sensor in scenario.sensors)
    return scenario.model_copy(update={"sensors": sensors})


def check(scenario: Scenario, order: Order, known: Sequence[str]) -> None:
    """Find out now what would go wrong.

    Args:
        scenario: to study.
        order: what was asked for.
        known: names of all modes.

    Raises:
        ConfigError: naming every fault.
    """
    faults = [*_scenario_faults(scenario), *_order_faults(order), *_mode_faults(order.modes, known)]
    if faults:
        raise ConfigError("\n".join(faults))


def _scenario_faults(scenario: Scenario) -> Iterator[str]:
    for sensor in scenario.sensors:
        if sensor.visibility is not None:
            yield f"{scenario.name}: sensor {sensor.name!r} has a visibility; the modes of a study know none"
    if scenario.simulation is None:
        yield f"{scenario.name}: has no [simulation]; a study draws its worlds, give a duration"
    elif scenario.simulation.truth is not None:
        yield f"{scenario.name}: simulation.truth: a study draws its targets, recorded ones are the same in every world"
    if scenario.clutter_sources or any(sensor.clutter_map is not None for sensor in scenario.sensors):
        yield f"{scenario.name}: has clutter_source or clutter_map; the false plots of a study are uniform"
    if not scenario.hypotheses:
        yield f"{scenario.name}: has no [[hypothesis]]; a study follows the track of hypothesis 0"
    elif scenario.simulation is not None:
        start_ns = scenario.to_ns(scenario.hypotheses[0].start)
        if not any((scan_times_ns(scenario, sensor) > start_ns).any() for sensor in scenario.sensors):
            yield f"{scenario.name}: no sensor scans after hypothesis 0 starts; there is nothing to decide on"


def _order_faults(order: Order) -> Iterator[str]:
    if not 1 <= order.runs <= MAX_RUNS:
        yield f"--runs: {order.runs} is not between 1 and {MAX_RUNS:,}"
    if not 0 <= order.seed <= MAX_SEED:
        yield f"--seed: {order.seed} is not between 0 and {MAX_SEED:,}"
    if order.block < 1:
        yield f"--block: {order.block} is not positive"
    for p_d in order.p_d:
        if not 0.0 <= p_d <= 1.0:
            yield f"--p-d: {p_d:g} is not a probability (0 to 1)"


def _mode_faults(modes: Sequence[str], known: Sequence[str]) -> Iterator[str]:
    unknown = [mode for mode in modes if mode not in known]
    for mode in unknown:
        close = difflib.get_close_matches(mode, known, 1)
        yield f"--modes: {mode!r} is no mode" + (f"; did you mean {close[0]!r}?" if close else "")
    if unknown:
        yield f"modes are {', '.join(known)}"
    if not modes:
        yield f"--modes: none given; modes are {', '.join(known)}"


def scenario_digest(scenario: Scenario) -> str:
    """Of all that has a part in what modes compute of the scenario; seeds are told apart elsewhere."""
    content = scenario.model_dump(mode="json", exclude=_NO_MATTER)
    if content["simulation"] is not None:
        del content["simulation"]["seed"]
    return _digest(json.dumps(content, sort_keys=True))


def part_digest(job: Job, mode: str) -> str:
    """Of all that a part depends on."""
    return _digest(f"{scenario_digest(job.variant.scenario)} {mode} {job.seeds.tolist()} {job.program}")


@cache
def program_digest() -> str:
    """Of the code that computes, and the versions of what it computes with."""
    here = Path(__file__).parent.parent
    files = [file for package in _COMPUTING for file in sorted((here / package).rglob("*.py"))]
    computing = [file for file in files if not _only_shows(file)]
    code = b"".join(file.relative_to(here).as_posix().encode() + file.read_bytes() for file in computing)
    return _digest(f"{version('waldnet')} {np.__version__} {hashlib.sha256(code).hexdigest()}")


def _only_shows(file: Path) -> bool:
    here = Path(__file__).parent
    if not file.is_relative_to(here):
        return False
    name = Path(file.relative_to(here).parts[0]).stem
    return name in _SHOWING or name.startswith("report")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def to_toml(scenario: Scenario) -> str:
    """A scenario as a file that ``load_scenario`` reads."""
    content = scenario.model_dump(mode="json", by_alias=True, exclude_none=True, exclude={"recording"})
    return "".join(f"{key} = {_value(value)}\n" for key, value in content.items())


def _value(value: Any) -> str:
    match value:
        case dict():
            return "{ " + ", ".join(f"{key} = {_value(inner)}" for key, inner in value.items()) + " }"
        case list():
            return "[" + ", ".join(map(_value, value)) + "]"
        case _:
            return json.dumps(value)
