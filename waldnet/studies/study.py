"""A study from order to tables: what is there is kept, what is missing is played, and all of it is judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from waldnet.common.config import Scenario
from waldnet.common.errors import StudyError
from waldnet.common.files import write_atomically
from waldnet.studies import calibration, tables
from waldnet.studies.metrics import Result
from waldnet.studies.parts import Store
from waldnet.studies.plan import (
    Job,
    Order,
    Variant,
    blocks,
    program_digest,
    scenario_digest,
    to_toml,
    variants,
)
from waldnet.studies.tables import Play, Table
from waldnet.studies.workers import Part, play_jobs


class Outcome(NamedTuple):
    """All tables of a study.

    Attributes:
        summary: one row per variant and mode.
        curves: one row per measurement time.
        decisions: one row per pair of thresholds.
        calibration: of the variants without a target, one row per B; empty when there is none.
        runs: one row per run.
    """

    summary: Table
    curves: Table
    decisions: Table
    calibration: Table
    runs: Table


class Study:
    """A study in its folder."""

    def __init__(self, scenario: Scenario, order: Order, folder: Path, *, fresh: bool = False) -> None:
        """Open the folder, make it if need be, and see what is still to do.

        Args:
            scenario: what is studied; checked (`studies.plan.check`).
            order: what was asked for.
            folder: of parts, tables and report.
            fresh: discard what is there.

        Raises:
            ConfigError: when the folder holds another study.
        """
        self.scenario, self.order = scenario, order
        self.variants = variants(scenario, order)
        manifest = {
            "waldnet": version("waldnet"),
            "program": program_digest(),
            "scenario": f"{scenario.name} {scenario_digest(scenario)}",
            "seed": order.seed,
            "block": order.block,
        }
        self.store = Store(folder, manifest, fresh=fresh)
        self._jobs = [job for variant in self.variants for job in self._jobs_of(variant, order.modes)]
        missing = [job._replace(modes=self._missing(job)) for job in self._jobs]
        self.to_do = [job for job in missing if job.modes]

    def _jobs_of(self, variant: Variant, modes: tuple[str, ...]) -> list[Job]:
        program, size = program_digest(), self.order.block
        return [Job(variant, modes, at * size, seeds, program) for at, seeds in enumerate(blocks(self.order))]

    def _missing(self, job: Job) -> tuple[str, ...]:
        return tuple(mode for mode in job.modes if not self.store.has(job, mode))

    @property
    def plays(self) -> int:
        """Runs times modes times variants, done or not."""
        return sum(len(job.seeds) * len(job.modes) for job in self._jobs)

    @property
    def plays_to_do(self) -> int:
        """Those that are still to do."""
        return sum(len(job.seeds) * len(job.modes) for job in self.to_do)

    def play(self, workers: int, scheduler: str | None, on_part: Callable[[Part], None]) -> None:
        """Play what is missing.

        Args:
            workers: processes on this machine.
            scheduler: address of a dask.distributed scheduler, instead.
            on_part: is told of every part once it is safe.
        """
        with closing(play_jobs(self.to_do, workers, scheduler)) as parts:
            for part in parts:
                self.store.save(part.job, part.mode, part.result)
                on_part(part)

    def judge(self) -> Outcome:
        """Work out all tables from the parts."""
        summary, curves, decisions, calibrations, runs = [], [], [], [], []
        for variant in self.variants:
            exact = None
            if variant.has_target and calibration.EXACT in self.order.modes:
                exact = tables.judge(self._gather(variant, calibration.EXACT))
            for mode in self.order.modes:
                play = self._gather(variant, mode)
                judged = tables.judge(play)
                if exact is not None:
                    calibrations.append(calibration.by_importance(judged, exact))
                summary.append(tables.summary_table(judged))
                curves.append(tables.curves_table(judged))
                decisions.append(tables.decisions_table(play))
                runs.append(tables.runs_table(judged))
                if not variant.has_target:
                    calibrations.append(calibration.direct(judged))
        return Outcome(*map(tables.stack, (summary, curves, decisions, calibrations, runs)))

    def _gather(self, variant: Variant, mode: str) -> Play:
        jobs = self._jobs_of(variant, (mode,))
        result = join([self._load(job, mode) for job in jobs])
        return Play(variant, mode, np.concatenate([job.seeds for job in jobs]), result)

    def _load(self, job: Job, mode: str) -> Result:
        result = self.store.load(job, mode)
        if result is None:
            raise StudyError(
                f"{self.store.folder}: a part of {job.variant.name}, {mode} vanished; run the command again"
            )
        return result

    def write(self, outcome: Outcome) -> list[Path]:
        """Write the tables, and a scenario file for each variant.

        Returns:
            the files written.
        """
        folder, files = self.store.folder, []
        for name, table in outcome._asdict().items():
            if table:
                files += tables.write_table(folder, name, table)
        for variant in self.variants:
            file = folder / "variants" / f"{variant.name}.toml"
            file.parent.mkdir(exist_ok=True)
            write_atomically(file, to_toml(variant.scenario).encode())
        return files


def join(results: Sequence[Result]) -> Result:
    """Results of blocks of runs as one; bytes are weighted by runs."""
    weights = [len(result.log_lr) for result in results]
    local = [result.local_log_lr for result in results if result.local_log_lr is not None]
    return Result(
        times_ns=results[0].times_ns,
        log_lr=np.concatenate([result.log_lr for result in results]),
        error_m=np.concatenate([result.error_m for result in results]),
        nees=np.concatenate([result.nees for result in results]),
        uplink_bytes=float(np.average([result.uplink_bytes for result in results], weights=weights)),
        downlink_bytes=float(np.average([result.downlink_bytes for result in results], weights=weights)),
        local_log_lr=np.concatenate(local) if local else None,
    )
