"""Episodes over processes of this machine; a process that dies costs nothing but its episode's second run."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.experiments.worker import Measured, worker_of_this_process

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

MOST_DEATHS = 3
"""Pools in a row that may die without an episode between them: then it is no accident."""


def run_over_processes(
    settings: EvalSettings, specs: Iterable[EpisodeSpec], workers: int
) -> Generator[Measured, None, None]:
    """Episodes as they end, in whatever order.

    When a process dies (killed, out of memory), the episodes that were running start again in new ones.

    Args:
        settings: of the evaluation.
        specs: the episodes.
        workers: processes.

    Raises:
        EvaluationError: processes die again and again.
        ComVLAError: whatever an episode raised.
    """
    left = dict.fromkeys(specs)
    deaths = 0
    while left:
        try:
            for spec, values in _one_pool(settings, list(left), workers):
                del left[spec]
                deaths = 0
                yield spec, values
        except BrokenProcessPool as error:
            deaths += 1
            if deaths == MOST_DEATHS:
                raise EvaluationError(
                    f"worker processes died {deaths} times in a row (out of memory, or their start "
                    "failed; the lines above say more): use fewer --workers, then run the same "
                    "command again to go on"
                ) from error
            print("a worker process died; what it ran starts again", file=sys.stderr, flush=True)


def _one_pool(
    settings: EvalSettings, specs: Iterable[EpisodeSpec], workers: int
) -> Generator[Measured, None, None]:
    waiting = iter(specs)
    context = multiprocessing.get_context("spawn")  # a forked OpenGL or torch is a broken one
    with _single_threaded_children():
        pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_prepare_process)
        pending: set[Future[Measured]] = set()
        try:
            # A few ahead keep the workers busy; more would only be thrown away on Ctrl-C.
            for spec in waiting:
                pending.add(pool.submit(_run_in_worker, settings, spec))
                if len(pending) >= 2 * workers:
                    done, pending = wait(pending, return_when=FIRST_COMPLETED)
                    yield from _results(done)
            while pending:
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                yield from _results(done)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _results(done: set[Future[Measured]]) -> Iterator[Measured]:
    """What ended well first: it is in the file before anything is raised."""
    for future in sorted(done, key=lambda future: future.exception() is not None):
        yield future.result()


def _prepare_process() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    import torch

    torch.set_num_threads(1)


def _run_in_worker(settings: EvalSettings, spec: EpisodeSpec) -> Measured:
    return worker_of_this_process(settings).run(spec)


@contextlib.contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Processes started meanwhile use one thread for linear algebra, unless the user said otherwise."""
    missing = [name for name in _THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(missing, "1"))
    try:
        yield
    finally:
        for name in missing:
            del os.environ[name]
