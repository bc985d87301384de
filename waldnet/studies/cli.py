"""``waldnet study``: Monte Carlo, modes side by side on the same plots."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from waldnet.common.config import load_scenario
from waldnet.common.errors import ConfigError
from waldnet.scenarios.catalogue import find

if TYPE_CHECKING:
    from waldnet.studies.study import Study


def study(
    scenario: str,
    *,
    modes: str | None = None,
    runs: int = 1000,
    seed: int | None = None,
    p_d: Annotated[str | None, Parameter(name="--p-d")] = None,
    no_target: Annotated[bool, Parameter(negative=())] = False,
    out: Path | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    block: int = 100,
    fresh: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Monte Carlo: modes of fusion side by side on the same plots; tables, figures, a report.

    It goes on where it was stopped: the same command plays only what is missing, as do more runs or further modes.

    Args:
        scenario: scenario file, or name of one that comes along (see: waldnet scenarios).
        modes: names with commas between; default: all.
        runs: per variant and mode.
        seed: of the study, instead of the scenario's; run i is the world with seed 1,000,000 times this plus i.
        p_d: detection probabilities with commas between, each makes a variant; default: the scenario's.
        no_target: a variant without targets, too.
        out: folder of tables and report; default runs/study-SCENARIO.
        workers: processes on this machine.
        scheduler: address of a dask.distributed scheduler instead, such as tcp://192.168.1.7:8786.
        block: runs that are computed together; fewer take less memory.
        fresh: discard the parts of another study in the folder.
    """
    from rich.console import Console

    from waldnet.studies import modes as known
    from waldnet.studies.plan import Order, check
    from waldnet.studies.study import Study

    loaded = load_scenario(find(scenario))
    if workers < 1:
        raise ConfigError(f"--workers: {workers} is not positive")
    order = Order(
        modes=tuple(dict.fromkeys(_words(modes))) if modes is not None else tuple(known.MODES),
        runs=runs,
        seed=seed if seed is not None else loaded.simulation.seed if loaded.simulation else 0,
        p_d=tuple(dict.fromkeys(map(_number, _words(p_d or "")))),
        no_target=no_target,
        block=block,
    )
    check(loaded, order, tuple(known.MODES))
    folder = out or Path("runs") / f"study-{loaded.name}"
    opened = Study(loaded, order, folder, fresh=fresh)
    _follow(opened, workers, scheduler, Console(stderr=True, highlight=False))
    _finish(opened, Console(stderr=True, highlight=False), Console(highlight=False))


def _follow(opened: Study, workers: int, scheduler: str | None, console: Any) -> None:
    """Play what is missing; stopped, say how to go on."""
    from waldnet.studies.progress import Teller

    if done := opened.plays - opened.plays_to_do:
        console.print(f"{opened.store.folder}: {done} of {opened.plays} runs x modes are there already", soft_wrap=True)
    try:
        with _ended_by_sigterm(), Teller(console, opened.to_do) as teller:
            opened.play(workers, scheduler, teller.part)
    except (KeyboardInterrupt, SystemExit):
        console.print(
            f"stopped; what is finished is in {opened.store.folder}. The same command goes on", soft_wrap=True
        )
        raise


def _finish(opened: Study, aside: Any, console: Any) -> None:
    from waldnet.studies.progress import show
    from waldnet.studies.report import write_report

    with aside.status("tables and report"):
        outcome = opened.judge()
        files = opened.write(outcome)
        files.append(write_report(opened, outcome, sys.argv[1:]))
    show(console, outcome.summary, files)


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """SIGTERM ends as Ctrl-C does: with what is under way given up, and nothing left behind."""

    def end(number: int, _: object) -> None:
        sys.exit(128 + number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ConfigError(f"--p-d: {word!r} is not a number") from None
