"""Runs a grid of episodes, here or over worker processes, and appends each result as it comes."""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import platform
import signal
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.methods import Method, find_method
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.experiments.policy import load_edge_half, load_policy, shown_model
from comvla_sim.experiments.results import FORMAT, ResultsFile, Row

if TYPE_CHECKING:
    from comvla_client.edge import EdgeModel
    from comvla_client.transport import Transport
    from comvla_sim.experiments.rollout import OnQuery
    from comvla_sim.worlds.base import Task, World
    from comvla_vla import CloudModel

Measured = tuple[EpisodeSpec, dict[str, Any]]

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Subject:
    """What is evaluated, as far as it must be the same in all rows of a file.

    Attributes:
        settings: ``settings`` of every row.
        num_tokens: N of the model.
        token_dim: D of the model.
        tasks: of the world.
    """

    settings: dict[str, Any]
    num_tokens: int
    token_dim: int
    tasks: tuple[Task, ...]


def inspect(settings: EvalSettings) -> Subject:
    """Loads world and model once to learn what is being evaluated.

    Raises:
        CheckpointError, DependencyError, EvaluationError: they cannot be loaded.
    """
    from comvla_sim.worlds import make

    info = load_edge_half(settings.model).info
    try:
        world = make(settings.world, render=False)
    except ValueError as error:
        raise EvaluationError(f"--world: {error}") from error
    tasks, labels, elsewhere = world.tasks, dict(world.labels), dict(world.versions)
    world.close()
    shared = {
        "world": settings.world,
        "seed": settings.seed,
        "model": info.name,
        "model_fingerprint": info.fingerprint,
        "quantization": settings.quantization,
        "versions": {
            **{name: _version(name) for name in ("comvla", "metaworld", "mujoco")},
            **elsewhere,
        },
        **labels,
    }
    return Subject(shared, info.num_tokens, info.token_dim, tasks)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


def environment(settings: EvalSettings, command: str) -> dict[str, Any]:
    """What may differ between rows of one file, but belongs to their story."""
    return {
        "command": command,
        "model_source": shown_model(settings.model),
        "transport": "grpc" if settings.target else "in-process",
        "python": platform.python_version(),
        "machine": platform.machine(),
        "versions": {name: _version(name) for name in ("torch", "numpy", "gymnasium")},
    }


class Worker:
    """One world and one policy, made once and used for episode after episode.

    Args:
        settings: of the evaluation.
    """

    def __init__(self, settings: EvalSettings) -> None:
        from comvla_sim.worlds import make

        self._settings = settings
        self._edge: EdgeModel
        self._cloud: CloudModel | None = None
        self._targets: dict[str, Transport] = {}
        if settings.target is None:
            self._edge, self._cloud = load_policy(settings.model)
        else:
            self._edge = load_edge_half(settings.model)
        height, width = self._edge.info.image_size
        if height != width:
            raise EvaluationError(
                f"the worlds draw square pictures, the model sees {height}×{width}"
            )
        # Where the model resizes pictures itself, it gets them in the world's own size.
        resizes = bool(getattr(self._edge, "any_image_size", False))
        self._world: World = make(settings.world, image_size=None if resizes else height)

    def run(self, spec: EpisodeSpec, on_query: OnQuery | None = None) -> Measured:
        """One episode; ``on_query`` as for :func:`comvla_sim.experiments.rollout.run_episode`."""
        from comvla_sim.experiments.rollout import run_episode

        heard = () if on_query is None else (on_query,)
        target = self._target(find_method(spec.method))
        return spec, run_episode(self._world, self._edge, target, spec, self._settings, *heard)

    def _target(self, method: Method) -> Transport | str:
        """Where a method's requests go: the user's server, or the cloud half here, run as the method needs."""
        from comvla_server.vision import VisionHalf
        from comvla_sim.experiments.in_process import InProcessTransport

        if self._settings.target is not None:
            return self._settings.target
        cloud = self._cloud
        assert cloud is not None, "without a server both halves are here"
        key = method.server_option
        if key not in self._targets:
            if method.in_cloud is not None:
                cloud = cloud.with_options(method.in_cloud(cloud.config.backbone.layers))
            vision = VisionHalf(self._edge)  # type: ignore[arg-type]
            self._targets[key] = InProcessTransport(cloud, vision)
        return self._targets[key]

    def close(self) -> None:
        """Frees the world."""
        self._world.close()


def _prepare_process() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    import torch

    torch.set_num_threads(1)


@functools.lru_cache(maxsize=1)
def _worker_of_this_process(settings: EvalSettings) -> Worker:
    # Made with the first episode, not by the pool's initializer: an error then reaches the user.
    return Worker(settings)


def _run_in_worker(settings: EvalSettings, spec: EpisodeSpec) -> Measured:
    return _worker_of_this_process(settings).run(spec)


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


def _run_over_processes(
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
                    yield from (future.result() for future in done)
            while pending:
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        except BrokenProcessPool as error:
            raise EvaluationError(
                "a worker process died (out of memory, or its start failed; the lines above say "
                "more): use fewer --workers, then run the same command again to go on"
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _run_here(
    settings: EvalSettings, specs: Iterable[EpisodeSpec]
) -> Generator[Measured, None, None]:
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    worker = Worker(settings)
    try:
        for spec in specs:
            yield worker.run(spec)
    finally:
        worker.close()
        torch.set_num_threads(threads)


def run(
    settings: EvalSettings,
    specs: Iterable[EpisodeSpec],
    results: ResultsFile,
    *,
    shared: dict[str, Any],
    story: dict[str, Any],
    workers: int,
    on_row: Callable[[Row], None] = lambda row: None,
) -> None:
    """Runs the episodes that ``results`` lacks and appends them.

    Interrupted at any point, it can be called again and goes on where it stopped.

    Args:
        settings: of the evaluation.
        specs: episodes that are wanted.
        results: is appended to.
        shared: ``settings`` of the rows (:func:`inspect`).
        story: ``environment`` of the rows (:func:`environment`).
        workers: processes; 1 runs in this one.
        on_row: called with each new row.

    Raises:
        ComVLAError: whatever an episode raised.
    """
    missing = [spec for spec in specs if spec not in results.rows]
    if not missing:
        return
    count = min(workers, len(missing))
    measured = (
        _run_here(settings, missing)
        if count == 1
        else _run_over_processes(settings, missing, count)
    )
    with contextlib.closing(measured):
        for spec, values in measured:
            row: Row = {"format": FORMAT, **spec.to_row(), **values}
            row.update(settings=shared, environment=story)
            results.append(row)
            on_row(row)
