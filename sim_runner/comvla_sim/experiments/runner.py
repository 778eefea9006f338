"""Runs a grid of episodes, here or over worker processes, and appends each result as it comes."""

from __future__ import annotations

import contextlib
import platform
import sys
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.experiments.policy import load_edge_half, shown_model
from comvla_sim.experiments.results import FORMAT, ResultsFile, Row
from comvla_sim.experiments.worker import Measured
from comvla_sim.experiments.worker import Worker as Worker

if TYPE_CHECKING:
    from comvla_sim.worlds.base import Task


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

    A server that runs its model in some way of its own (``--fastv``, another dtype) gives other answers under the
    same fingerprint, so its ``run_options`` are a part of the settings. Where there are none nothing is written, as
    in files of versions that did not ask.

    Raises:
        CheckpointError, DependencyError, EvaluationError: they cannot be loaded, or the server says nothing.
        HandshakeError: the target is no address.
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
            **package_versions(),
            **elsewhere,
        },
        **labels,
    }
    if settings.target is not None and (options := server_options(settings.target)):
        shared["run_options"] = options
    return Subject(shared, info.num_tokens, info.token_dim, tasks)


def server_options(target: str) -> list[str]:
    """How a server runs its model where that changes its answers.

    Args:
        target: ``host:port``.

    Raises:
        EvaluationError: it does not answer.
        HandshakeError: the target is no address.
    """
    from comvla import handshake
    from comvla_client.errors import TransportError
    from comvla_client.reaching import make_transport
    from comvla_sim.experiments import rollout

    with contextlib.closing(make_transport(target)) as transport:
        try:
            answer = transport.get_model(rollout.CONNECT_TIMEOUT_S)
        except TransportError as error:
            raise EvaluationError(
                f"--target {target}: the server does not say how it runs its model ({error}): check "
                "that it is up, then run the same command again"
            ) from error
    return list(handshake.run_options(answer))


def package_versions() -> dict[str, str]:
    """Versions of the packages that decide how an episode goes."""
    return {name: _version(name) for name in ("comvla", "metaworld", "mujoco")}


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
    ray: str | None = None,
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
        ray: address of a Ray cluster, ``"local"`` for one of this machine's; None for none.
        on_row: called with each new row.

    Raises:
        ComVLAError: whatever an episode raised.
    """
    missing = [spec for spec in specs if spec not in results.rows]
    if not missing:
        return
    _tell_of_other_sources(missing, results)
    with contextlib.closing(_measured(settings, missing, shared, workers, ray)) as measured:
        for spec, values in measured:
            row: Row = {"format": FORMAT, **spec.to_row(), **values}
            row.update(settings=shared, environment=story)
            results.append(row)
            on_row(row)


def _tell_of_other_sources(missing: list[EpisodeSpec], results: ResultsFile) -> None:
    own = {spec.method: spec.source_sha256 for spec in missing if spec.source_sha256}
    for method, digest in own.items():
        others = sum(s.method == method and s.source_sha256 != digest for s in results.rows)
        if others:
            print(
                f"{results.path}: {others} episodes of {method} do not count, its source was another one when they "
                "were measured: it is measured anew",
                file=sys.stderr,
            )


def _measured(
    settings: EvalSettings,
    specs: list[EpisodeSpec],
    shared: dict[str, Any],
    workers: int,
    ray: str | None,
) -> Generator[Measured, None, None]:
    """One episode after another, wherever they are run."""
    if ray is not None:
        from comvla_sim.experiments.over_ray import run_over_ray

        return run_over_ray(settings, specs, shared, address=ray, workers=workers)
    count = min(workers, len(specs))
    if count == 1:
        return _run_here(settings, specs)
    from comvla_sim.experiments.over_processes import run_over_processes

    return run_over_processes(settings, specs, count)
