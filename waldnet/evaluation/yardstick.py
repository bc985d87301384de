"""The centralised run beside runs of a network: one tracker for the same plots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from waldnet.common.errors import EvaluationError
from waldnet.common.messages import Tracks
from waldnet.evaluation.runs import Run, run_of
from waldnet.offline.centralised import Centralised
from waldnet.recording.inputs import Input, kept


class Beside(NamedTuple):
    """Runs and their yardsticks.

    Attributes:
        runs: those given, each followed by the centralised run of its plots.
        without: names of those whose plots nobody knows.
    """

    runs: list[Run]
    without: list[str]


def with_centralised(runs: Sequence[Run], paths: Sequence[Path], of: Input | None, d: int) -> Beside:
    """Put beside each run a centralised one of the same plots.

    Args:
        runs: of a network.
        paths: their folders or files.
        of: what the runs had to go on that kept nothing of it; they have one centralised run in common, after the last
            of them.
        d: dimensions of the truth.

    Raises:
        ConfigError: when a scenario that was kept is wrong.
        PlotsError: when plots that were kept are.
        EvaluationError: truth and scenario differ in their dimensions, or ``of`` is of use to no run.
    """
    inputs = [kept(path) for path in paths]
    bare = [run.name for run, its in zip(runs, inputs, strict=True) if its is None]
    if of is not None and not bare:
        raise EvaluationError("--scenario: every run here keeps its own scenario and plots; leave it out")
    beside: list[Run] = []
    for run, its in zip(runs, inputs, strict=True):
        beside.append(run)
        if its is not None:
            beside.append(centralised(its, (run.name,), d))
        elif of is not None and run.name == bare[-1]:
            beside.append(centralised(of, tuple(bare), d))
    return Beside(beside, [] if of is not None else bare)


def centralised(of: Input, names: tuple[str, ...], d: int) -> Run:
    """What one tracker makes of all plots that a network had.

    Args:
        of: the network, and its plots.
        names: of the runs of that network.
        d: dimensions of the truth.

    Raises:
        EvaluationError: the network has other dimensions.
    """
    dimensions = of.scenario.motion.dimensions
    if dimensions < d:
        raise EvaluationError(f"scenario {of.scenario.name}: has {dimensions} dimensions, the truth has {d}")
    said = Centralised.of(of.scenario).run(of.scans)
    pictures = [message for message in said if isinstance(message, Tracks)]
    run = run_of(f"{', '.join(names)} (centralised)", pictures, of.scenario, d)
    return run._replace(centralised_of=names)
