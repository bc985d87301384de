"""Who computes the parts of a study: this process, processes beside it, or a cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from waldnet.common.errors import ConfigError, StudyError, TransportError
from waldnet.studies.metrics import Result, reduce
from waldnet.studies.plan import Job, program_digest

#: A process of its own gets one thread of linear algebra: more of them than cores only wait for each other.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
#: For a scheduler to answer [s].
_PATIENCE_S = 10


class Part(NamedTuple):
    """What one mode made of the runs of one job.

    Attributes:
        job: whose runs.
        mode: its name.
        result: what is kept.
    """

    job: Job
    mode: str
    result: Result


#: Closing it ends all work that is under way.
Parts: TypeAlias = Generator[Part, None, None]


def play_job(job: Job) -> Iterator[Part]:
    """Draw the worlds of a job once, and let its modes play on them.

    Raises:
        StudyError: when this is another version of the program than the one that asks.
    """
    from waldnet.studies import modes, worlds

    if job.program != program_digest():
        raise StudyError(
            "a worker runs another version of waldnet or of NumPy than this machine; install the same on all"
        )
    drawn = worlds.draw(job.variant.scenario, job.seeds)
    dimensions = job.variant.scenario.motion.dimensions
    for mode in job.modes:
        result = reduce(modes.play(job.variant.scenario, mode, drawn), drawn, dimensions)
        assert result.log_lr.shape == (len(job.seeds), len(drawn.times_ns))
        assert not np.isnan(result.log_lr).any()
        yield Part(job, mode, result)


def play_jobs(jobs: Sequence[Job], workers: int, scheduler: str | None) -> Parts:
    """Parts of all jobs, in whatever order they are finished.

    Closing the iterator ends all work at once.

    Args:
        jobs: to do.
        workers: processes on this machine; 1: this one.
        scheduler: address of a dask.distributed scheduler, instead.
    """
    if not jobs:
        return _in_turn(jobs)
    if scheduler is not None:
        return _on_cluster(jobs, scheduler)
    if workers > 1:
        return _in_processes(jobs, workers)
    return _in_turn(jobs)


def _in_turn(jobs: Sequence[Job]) -> Parts:
    for job in jobs:
        yield from play_job(job)


def _all_of(job: Job) -> list[Part]:
    return list(play_job(job))


def _in_processes(jobs: Sequence[Job], workers: int) -> Parts:
    others = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    with _environment(_ONE_THREAD):
        pool = ProcessPoolExecutor(min(workers, len(jobs)), context, _begin)
        try:
            with _deaf_to_ctrl_c():
                futures = [pool.submit(_all_of, job) for job in jobs]
            for future in as_completed(futures):
                yield from future.result()
        except BrokenProcessPool:
            raise StudyError(
                "a worker process died; with too little memory, give fewer --workers or a smaller --block"
            ) from None
        except BaseException:
            for child in set(multiprocessing.active_children()) - others:
                child.terminate()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Workers that are started here never hear of Ctrl-C, not even while they begin; this process hears of it after."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _begin() -> None:
    """A worker ends when the process that started it is gone, however it went."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _environment(changes: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _on_cluster(jobs: Iterable[Job], address: str) -> Parts:
    try:
        from distributed import Client, KilledWorker
        from distributed import as_completed as as_done
    except ImportError:
        raise ConfigError("--scheduler needs dask.distributed: pip install 'waldnet[study]'") from None
    try:
        client: Any = Client(address, timeout=_PATIENCE_S)
    except (OSError, ValueError) as error:
        raise TransportError(f"no dask scheduler at {address}: {error}") from None
    with client:
        futures = [client.submit(_all_of, job, pure=False) for job in jobs]
        try:
            for future in as_done(futures):
                yield from future.result()
                future.release()
        except (CancelledError, KilledWorker) as error:
            raise StudyError(f"the cluster at {address} gave up: {error}") from None
        except BaseException:
            client.cancel(futures)
            raise
