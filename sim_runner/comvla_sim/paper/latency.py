"""How long one query takes by every method: on the robot, in the cloud, on this machine, without a network."""

from __future__ import annotations

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
    ``cloud_ms`` decoding and the forward pass; the network takes no time.

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
        rows = []
        for cell in cells:
            edge_s, cloud_s = [], []
            with _client(worker, cell) as client:
                for number in range(WARM_UP + repetitions):
                    shown = {"images": list(film[number % len(film)]), "proprio": proprio}
                    report = client.step(shown, task.instruction).report
                    if number >= WARM_UP:
                        edge_s.append(report.timings_s["total"] - report.timings_s["call"])
                        cloud_s.append(report.server_timings_s["total"])
            rows.append(
                {
                    **vars(cell),
                    "edge_ms": round(1000 * median(edge_s), 2),
                    "cloud_ms": round(1000 * median(cloud_s), 2),
                    "total_ms": round(
                        1000 * median(a + b for a, b in zip(edge_s, cloud_s, strict=True)), 2
                    ),
                }
            )
    finally:
        worker.close()
        torch.set_num_threads(threads)
    return {
        "rows": rows,
        "repetitions": repetitions,
        "processor": environment.describe()["cpu"],
    }


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
