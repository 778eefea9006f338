"""Episodes over a Ray cluster: on this machine, or wherever its address leads.

Every episode is one task that may run twice without harm, so Ray starts it again when its worker or its node dies.
What this module sends is JSON in both directions; Ray itself pickles, and trusts whoever reaches the cluster.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import socket
import threading
from collections.abc import Generator, Iterable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from comvla.errors import ComVLAError, DependencyError
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.experiments.worker import Measured

LOCAL = "local"
"""An address: a cluster of this machine's own, for the length of the run."""

AUTO = "auto"
"""An address: the cluster that this machine belongs to, or that ``RAY_ADDRESS`` names."""

REACH_TIMEOUT_S = 5.0
JOIN_TIMEOUT_S = 45.0

STORE_BYTES = 200_000_000
"""Shared memory of a cluster of this machine's own: a row has some kilobytes."""

RETRIES = 5
"""How often an episode starts again when its worker or node died under it."""


def run_over_ray(
    settings: EvalSettings,
    specs: Iterable[EpisodeSpec],
    shared: dict[str, Any],
    *,
    address: str,
    workers: int = 0,
) -> Generator[Measured, None, None]:
    """Episodes as they end, in whatever order.

    Args:
        settings: of the evaluation; a checkpoint folder must lie at the same path on every node.
        specs: the episodes.
        shared: ``settings`` of the rows; a node with other versions or other weights is refused.
        address: :data:`LOCAL`, :data:`AUTO`, or ``host:port`` of the head node.
        workers: cores of a cluster of this machine's own; any other has its own number.

    Raises:
        DependencyError: Ray is not installed.
        EvaluationError: the cluster cannot be reached in time, its nodes differ, or they die again
            and again.
        ComVLAError: whatever an episode raised.
    """
    ray = _ray()
    if Path(settings.model).is_dir():
        settings = replace(settings, model=str(Path(settings.model).resolve()))
    with _cluster(ray, address, workers):
        task = ray.remote(num_cpus=1, max_retries=RETRIES)(episode_on_node)
        ahead = max(2, 2 * int(ray.cluster_resources().get("CPU", 1)))
        waiting = iter(specs)
        pending: dict[Any, EpisodeSpec] = {}
        asked = json.dumps(asdict(settings)), json.dumps(shared)
        try:
            for spec in waiting:
                pending[task.remote(*asked, json.dumps(spec.to_row()))] = spec
                if len(pending) >= ahead:
                    yield from _ended(ray, pending)
            while pending:
                yield from _ended(ray, pending)
        finally:
            for reference in pending:
                ray.cancel(reference, force=True)


def _ended(ray: Any, pending: dict[Any, EpisodeSpec]) -> Iterator[Measured]:
    done, _ = ray.wait(list(pending), num_returns=1)
    for reference in done:
        spec = pending.pop(reference)
        try:
            yield spec, json.loads(ray.get(reference))
        except ray.exceptions.RayTaskError as error:
            cause = error.cause
            if isinstance(cause, ComVLAError):
                raise cause from None
            raise EvaluationError(f"an episode failed on a node: {cause!r}") from error
        except ray.exceptions.RayError as error:
            raise EvaluationError(
                f"an episode was lost {RETRIES + 1} times, its worker or node died each time "
                f"({type(error).__name__}): look at the nodes' memory, then run the same command "
                "again to go on"
            ) from error


def episode_on_node(settings: str, shared: str, spec: str) -> str:
    """One episode, in a worker process of a node: JSON in, JSON out.

    Raises:
        EvaluationError: this node would measure something else.
        ComVLAError: whatever the episode raised.
    """
    import torch

    from comvla_sim.experiments.runner import package_versions
    from comvla_sim.experiments.worker import worker_of_this_process

    torch.set_num_threads(1)
    expected = json.loads(shared)
    worker = worker_of_this_process(EvalSettings(**json.loads(settings)))
    here = {"model_fingerprint": worker.fingerprint, **package_versions()}
    wanted = {"model_fingerprint": expected["model_fingerprint"], **expected["versions"]}
    for name, value in here.items():
        if wanted.get(name, value) != value:
            raise EvaluationError(
                f"node {socket.gethostname()} has {name} {value}, this machine has {wanted[name]}: "
                "install the same on all nodes"
            )
    _, values = worker.run(EpisodeSpec.from_row(json.loads(spec)))
    return json.dumps(values, allow_nan=False)


def _ray() -> Any:
    # Neither a report to its makers nor a web page: this is a measurement.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        import ray
    except ImportError as error:
        raise DependencyError("--ray needs Ray: pip install 'comvla[sim,ray]'") from error
    return ray


@contextlib.contextmanager
def _cluster(ray: Any, address: str, workers: int) -> Iterator[None]:
    if ray.is_initialized():  # the program that calls this has one
        yield
        return
    options: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    if address == LOCAL:
        options |= {"num_cpus": workers or None, "include_dashboard": False}
        options["object_store_memory"] = STORE_BYTES
    elif address != AUTO:
        _reach(address)
    _join(ray, address, options)
    try:
        yield
    finally:
        ray.shutdown()


def _reach(address: str) -> None:
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        raise EvaluationError(
            f"--ray expects {LOCAL}, {AUTO} or HOST:PORT of a cluster's head node, got {address!r}"
        )
    try:
        socket.create_connection((host.strip("[]"), int(port)), REACH_TIMEOUT_S).close()
    except (OSError, OverflowError) as error:
        raise EvaluationError(
            f"no Ray cluster answers at {address} ({error}): start one with ray start --head "
            f"--port={port}, or use --ray {LOCAL}"
        ) from error


def _join(ray: Any, address: str, options: dict[str, Any]) -> None:
    """Joins the cluster, or says why not before anyone's patience ends: Ray itself waits for minutes."""
    outcome: queue.Queue[BaseException | None] = queue.Queue()

    def join() -> None:
        try:
            ray.init(address=address, **options)
            outcome.put(None)
        except BaseException as error:
            outcome.put(error)

    threading.Thread(target=join, daemon=True).start()
    try:
        error = outcome.get(timeout=JOIN_TIMEOUT_S)
    except queue.Empty:
        error = TimeoutError(f"no answer within {JOIN_TIMEOUT_S:g} s")
    if error is not None:
        raise EvaluationError(
            f"cannot join the Ray cluster {address!r} ({error}): check the address and that all "
            "machines have the same version of Ray"
        ) from error
