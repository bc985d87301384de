"""Variants, worlds, and what is wrong with an order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from builders import hypothesis_table, scenario, sensor_table

from waldnet.common.config import Scenario, load_scenario
from waldnet.common.errors import ConfigError
from waldnet.scenarios import catalogue
from waldnet.studies.plan import (
    Job,
    Order,
    Variant,
    blocks,
    check,
    part_digest,
    program_digest,
    scenario_digest,
    to_toml,
    variants,
    with_p_d,
    world_seeds,
)

KNOWN = ("centralised", "federated", "federated-tight")
GOOD = Order(modes=("centralised",), runs=10, seed=1)


def faults(order: Order, plot: Scenario | None = None) -> list[str]:
    with pytest.raises(ConfigError) as error:
        check(plot or scenario(), order, KNOWN)
    return str(error.value).splitlines()


def test_worlds_depend_on_nothing_but_seed_and_number() -> None:
    assert world_seeds(7, 0, 3).tolist() == [7_000_000, 7_000_001, 7_000_002]
    few = list(blocks(Order((), runs=5, seed=7, block=4)))
    many = list(blocks(Order((), runs=9, seed=7, block=4)))
    assert [len(block) for block in few] == [4, 1]
    assert [len(block) for block in many] == [4, 4, 1]
    np.testing.assert_array_equal(np.concatenate(many)[:5], np.concatenate(few))


def test_variants_are_what_was_asked_for() -> None:
    plot = scenario()
    assert [(v.name, v.has_target) for v in variants(plot, GOOD)] == [("as-given", True)]
    asked = variants(plot, GOOD._replace(p_d=(0.9, 0.25), no_target=True))
    assert [(v.name, v.has_target) for v in asked] == [("p_d=0.9", True), ("p_d=0.25", True), ("no-target", False)]
    assert [[s.p_d for s in v.scenario.sensors] for v in asked] == [[0.9, 0.9], [0.25, 0.25], [0.9, 0.9]]
    assert asked[1].scenario.targets == plot.targets


def test_variants_of_a_scenario_without_target_say_so() -> None:
    plot = scenario(target=[])
    assert [v.name for v in variants(plot, GOOD._replace(no_target=True))] == ["no-target"]
    assert [v.name for v in variants(plot, GOOD._replace(p_d=(0.5, 0.2)))] == ["no-target-p_d=0.5", "no-target-p_d=0.2"]


def test_a_good_order_has_no_faults() -> None:
    check(scenario(), GOOD._replace(modes=KNOWN, p_d=(0.0, 1.0)), KNOWN)


def test_every_fault_of_an_order_is_named() -> None:
    order = Order(("federated-tigth", "qqq"), runs=0, seed=-1, p_d=(1.4, float("nan"), 0.5), block=0)
    assert faults(order) == [
        "--runs: 0 is not between 1 and 1,000,000",
        "--seed: -1 is not between 0 and 9,007,199,253",
        "--block: 0 is not positive",
        "--p-d: 1.4 is not a probability (0 to 1)",
        "--p-d: nan is not a probability (0 to 1)",
        "--modes: 'federated-tigth' is no mode; did you mean 'federated-tight'?",
        "--modes: 'qqq' is no mode",
        "modes are centralised, federated, federated-tight",
    ]
    assert faults(GOOD._replace(modes=())) == [f"--modes: none given; modes are {', '.join(KNOWN)}"]


def test_what_a_scenario_lacks_is_named() -> None:
    assert faults(GOOD, scenario(simulation=None, hypothesis=[], target=[])) == [
        "test: has no [simulation]; a study draws its worlds, give a duration",
        "test: has no [[hypothesis]]; a study follows the track of hypothesis 0",
    ]
    assert faults(GOOD, scenario(simulation={"duration": 20.0, "truth": "ships.jsonl"})) == [
        "test: simulation.truth: a study draws its targets, recorded ones are the same in every world",
    ]
    late = scenario(hypothesis=[hypothesis_table(start=20.0)])
    assert faults(GOOD, late) == ["test: no sensor scans after hypothesis 0 starts; there is nothing to decide on"]


def job(plot: Scenario, first: int = 0, program: str = "p") -> Job:
    return Job(Variant("v", plot), ("centralised",), first, world_seeds(1, first, 4), program)


def test_digests_tell_apart_what_matters_and_nothing_else() -> None:
    plot = scenario()
    other = {
        "p_d": with_p_d(plot, 0.8),
        "sensor": scenario(sensor_table("a")),
        "target": plot.model_copy(update={"targets": ()}),
        "duration": scenario(simulation={"duration": 18.0}),
        "decision": scenario(decision={"p0": 1e-3}),
    }
    same = {
        "name": scenario(name="other"),
        "lost": scenario(study={"lost_beyond": 5.0}),
        "seed": scenario(simulation={"duration": 20.0, "seed": 5}),
    }
    assert {name for name, changed in other.items() if scenario_digest(changed) == scenario_digest(plot)} == set()
    assert {name for name, changed in same.items() if scenario_digest(changed) != scenario_digest(plot)} == set()
    digests = [
        part_digest(job(plot), "centralised"),
        part_digest(job(plot), "federated"),
        part_digest(job(plot, first=4), "centralised"),
        part_digest(job(plot, program="q"), "centralised"),
        part_digest(job(other["p_d"]), "centralised"),
    ]
    assert len(set(digests)) == len(digests)
    assert len(program_digest()) == 16


@pytest.mark.parametrize("name", catalogue.names())
def test_a_scenario_reads_as_it_is_written(tmp_path: Path, name: str) -> None:
    plot = load_scenario(catalogue.find(name)).model_copy(update={"recording": None})
    file = tmp_path / "again.toml"
    file.write_text(to_toml(plot))
    assert load_scenario(file) == plot
