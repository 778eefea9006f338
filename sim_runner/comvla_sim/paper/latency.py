"""How long one query takes by every method: on the robot, in the cloud, on this machine, without a network."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from statistics import median
from typing import Any

from comvla_client import ComVLAClient
from comvla_sim.bench import environment
from comvla_sim.experiments.methods import find_method
from comvla_sim.experiments.rollout import expert_pictures
from comvla_sim.experiments.worker import Worker
from comvla_sim.figures.measuring import Study
from comvla_sim.paper.cells import Cell

REPETITIONS = 15
WARM_UP = 3


def measure_latency(
    study: Study, cells: Sequence[Cell], repetitions: int = REPETITIONS
) -> dict[str, Any]:
    """Median compute time of a query, one thread, both halves in this process.

    All methods see the same pictures of an expert's episode. ``edge_ms`` is everything on the robot but the call,
    ``cloud_ms`` decoding and the forward pass; the network takes no time. Methods take turns, query by query, so that
    whatever else the machine does meanwhile meets all of them, and is no difference between them.

    Args:
        study: world and model.
        cells: ways of sending.
        repetitions: timed queries of each.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    worker = Worker(study.settings)
    try:
        task = worker.world.find_task(study.tasks[0])
        film = expert_pictures(worker.world, task.name, 0, worker.edge.info.action_horizon)
        proprio = worker.world.proprio()
        edge_s: dict[Cell, list[float]] = {cell: [] for cell in cells}
        cloud_s: dict[Cell, list[float]] = {cell: [] for cell in cells}
        with contextlib.ExitStack() as open_clients:
            clients = {cell: open_clients.enter_context(_client(worker, cell)) for cell in cells}
            for number in range(WARM_UP + repetitions):
                shown = {"images": list(film[number % len(film)]), "proprio": proprio}
                for cell, client in clients.items():
                    report = client.step(shown, task.instruction).report
                    if number >= WARM_UP:
                        edge_s[cell].append(report.timings_s["total"] - report.timings_s["call"])
                        cloud_s[cell].append(report.server_timings_s["total"])
    finally:
        worker.close()
        torch.set_num_threads(threads)
    return {
        "rows": [{**vars(cell), **_medians(edge_s[cell], cloud_s[cell])} for cell in cells],
        "repetitions": repetitions,
        "processor": environment.describe()["cpu"],
    }


def _medians(edge_s: Sequence[float], cloud_s: Sequence[float]) -> dict[str, float]:
    total_s = [edge + cloud for edge, cloud in zip(edge_s, cloud_s, strict=True)]
    named = {"edge_ms": edge_s, "cloud_ms": cloud_s, "total_ms": total_s}
    return {name: round(1000 * median(times_s), 2) for name, times_s in named.items()}


def _client(worker: Worker, cell: Cell) -> ComVLAClient:
    method = find_method(cell.method)
    form = method.form()
    budget: Any = (cell.k or worker.edge.info.num_tokens) if form.in_pieces else "paper"
    return ComVLAClient(
        worker.target(method),
        edge=worker.edge,
        uplink=form,
        budget=budget,
        quantization=cell.quantization,
        deadline_s=600.0,
    )
