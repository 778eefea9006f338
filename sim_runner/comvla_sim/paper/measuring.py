"""Runs the cells that no earlier run has left behind, and counts what came out."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from comvla_sim.experiments import runner
from comvla_sim.experiments.command import default_path
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.methods import find_method
from comvla_sim.experiments.plan import EvalSettings, check_methods, chosen_tasks
from comvla_sim.experiments.results import Row
from comvla_sim.experiments.statistics import mcnemar, wilson_interval
from comvla_sim.figures.measuring import Study, kept, measure
from comvla_sim.paper.cells import Cell, of_method
from comvla_sim.paper.published import SUITES


@dataclass(frozen=True)
class Plan:
    """How the tables are measured.

    Attributes:
        world: ``"tabletop"`` or ``"libero"``.
        model: ``"mini"``, a checkpoint folder, or one with ``{suite}`` in its name.
        episodes: layouts for each instruction.
        seed: chooses the layouts.
        out: folder of results and documents.
        workers: processes; 0 for one per core.
        ray: address of a Ray cluster, ``"local"``, or None for processes of this machine.
        target: ``host:port`` of a running server, for models that are too large for this process; what only a server's
            start decides (FastV) and what looks inside the model are then left out.
        only: suites of LIBERO to run; empty for all.
        reuse: folders of other runs, whose episodes are taken over.
        measured_only: measure nothing, and report what is there.
        also: further methods, as ``comvla-sim eval --method`` takes them, for Table I.
    """

    world: str = "tabletop"
    model: str = "mini"
    episodes: int = 20
    seed: int = 0
    out: Path = Path("runs/paper")
    workers: int = 0
    ray: str | None = None
    target: str | None = None
    only: tuple[str, ...] = ()
    reuse: tuple[Path, ...] = ()
    measured_only: bool = False
    also: tuple[str, ...] = ()

    def check(self) -> None:
        """Refuses, before anything is loaded, further methods that could not be measured in the end.

        Raises:
            EvaluationError: names what is wrong.
        """
        if self.also:
            check_methods(self.also, ideal=True, option="--also")

    def more_cells(self) -> tuple[tuple[Cell, ...], ...]:
        """What ``also`` adds to Table I, a group for each method.

        Raises:
            UnknownMethodError: there is none of that name.
        """
        return tuple(of_method(name) for name in self.also)

    def suites(self) -> tuple[str, ...]:
        """Names of the columns: LIBERO's four suites, or the one world."""
        if self.world != "libero":
            return (self.world,)
        for name in self.only:
            if name not in SUITES:
                raise EvaluationError(
                    f"--suites {name!r} is unknown: choose among {', '.join(SUITES)}"
                )
        return tuple(suite for suite in SUITES if suite in (self.only or SUITES))

    def study(self, suite: str, quantization: str) -> Study:
        """What one suite's cells of one number format are measured on.

        Raises:
            CheckpointError, DependencyError, EvaluationError: world or model cannot be loaded.
        """
        world = f"libero:{suite}" if self.world == "libero" else suite
        model = self.model.replace("{suite}", suite)
        settings = EvalSettings(world, model, self.seed, quantization, self.target)
        subject = runner.inspect(settings)
        tasks = chosen_tasks(None, subject.tasks)
        return Study(
            settings, subject, tasks, self.episodes, self.out, self.workers, self.ray, self.reuse
        )


Measured = dict[tuple[str, Cell], list[Row]]
"""Rows by suite and cell; what was not measured is missing."""


def measure_cells(
    plan: Plan, groups: Sequence[tuple[Cell, ...]]
) -> tuple[Measured, dict[str, Any]]:
    """Measures cells group by group, and layout by layout within a group.

    Returns:
        Rows, and the ``settings`` that they were measured with, number format left out.

    Raises:
        KeyboardInterrupt: after Ctrl-C, with everything measured so far in the files.
        ComVLAError: whatever an episode raised.
    """
    found: Measured = {}
    studies: dict[tuple[str, str], Study] = {}
    for number, group in enumerate(groups, start=1):
        if plan.target is not None:
            group = tuple(cell for cell in group if not find_method(cell.method).server_option)
        for suite in plan.suites():
            for quantization in dict.fromkeys(cell.quantization for cell in group):
                cells = [cell for cell in group if cell.quantization == quantization]
                key = suite, quantization
                if key not in studies:
                    studies[key] = plan.study(suite, quantization)
                if not plan.measured_only:
                    names = ", ".join(cell.name for cell in cells)
                    print(f"{number} of {len(groups)}, {suite}: {names}", file=sys.stderr)
                rows = _rows(plan, studies[key], cells)
                found |= {(suite, cell): own for cell, own in rows.items() if own}
    shared: dict[str, Any] = {}
    for study in studies.values():
        shared |= study.subject.settings
    shared.pop("quantization", None)
    return found, shared


def _rows(plan: Plan, study: Study, cells: Sequence[Cell]) -> dict[Cell, list[Row]]:
    n = study.subject.num_tokens
    wanted = {
        spec: cell
        for episode in range(plan.episodes)
        for cell in cells
        for spec in cell.specs(study.tasks, episode, n)
    }
    name = default_path(study.settings, study.subject).stem
    read = kept if plan.measured_only else measure
    rows: dict[Cell, list[Row]] = {cell: [] for cell in cells}
    for spec, row in read(name, study, list(wanted)).items():
        rows[wanted[spec]].append(row)
    return rows


def counted(suite: str, cell: Cell, rows: Sequence[Row]) -> dict[str, Any]:
    """Counts of one cell as plain JSON values."""
    successes, queries = sum(r["success"] for r in rows), sum(r["queries"] for r in rows)
    low, high = wilson_interval(successes, len(rows))
    tasks: dict[str, list[int]] = {}
    for row in rows:
        count = tasks.setdefault(row["task"], [0, 0])
        count[0] += bool(row["success"])
        count[1] += 1

    def per_query(values: Iterable[float]) -> float:
        return round(math.fsum(values) / int(queries), 1)

    selection = [r["selection"] for r in rows]
    frames = sum(s["object_frames"] for s in selection)
    solved = [r["steps"] for r in rows if r["success"]]
    return {
        "suite": suite,
        **vars(cell),
        "episodes": len(rows),
        "successes": successes,
        "low": round(low, 6),
        "high": round(high, 6),
        "tasks": tasks,
        "queries": queries,
        "mean_steps_of_successes": round(sum(solved) / len(solved), 1) if solved else None,
        "payload_bytes": per_query(r["payload_bytes"] for r in rows),
        "wire_bytes": per_query(r["framed_bytes"] for r in rows),
        "edge_flops": per_query(r["edge_flops"] for r in rows),
        "cloud_flops": per_query(r["cloud_flops"] for r in rows),
        "object_hit_rate": round(sum(s["object_hits"] for s in selection) / frames, 4)
        if frames
        else None,
        "wall_s": round(math.fsum(r["wall_s"] for r in rows), 1),
    }


def paired(first: Sequence[Row], second: Sequence[Row]) -> dict[str, Any]:
    """Exact McNemar test on the episodes that both cells have, and in how many of them both succeeded."""
    outcomes = {_episode(row): bool(row["success"]) for row in second}
    pairs = [
        (bool(row["success"]), outcomes[_episode(row)])
        for row in first
        if _episode(row) in outcomes
    ]
    test = mcnemar([a for a, _ in pairs], [b for _, b in pairs])
    return {**vars(test), "both": sum(a and b for a, b in pairs)}


def _episode(row: Row) -> tuple[str, int, str]:
    return row["settings"]["world"], row["layout_seed"], row["task"]


def all_counts(measured: Measured) -> list[dict[str, Any]]:
    """Every cell of every suite."""
    return [counted(suite, cell, rows) for (suite, cell), rows in measured.items()]


def all_pairs(measured: Measured) -> list[dict[str, Any]]:
    """The comparisons that the tables rest on: with random, with soft voting, with all tokens, with our own votes
    at the same K, and between number formats; all suites together (``suite`` None), and each of LIBERO's.
    """
    cells = list(dict.fromkeys(cell for _, cell in measured))
    suites = dict.fromkeys(suite for suite, _ in measured if suite in SUITES)
    found = []
    for first in cells:
        for second in cells:
            if not _compared(first, second):
                continue
            for suite in (None, *suites):
                rows = [_pooled(measured, cell, suite) for cell in (first, second)]
                test = paired(rows[0], rows[1])
                if test["pairs"]:
                    of = {"first": vars(first), "second": vars(second), "suite": suite}
                    found.append({**of, **test})
    return found


def _compared(first: Cell, second: Cell) -> bool:
    if first == second:
        return False
    if first.method == second.method == "hard_voting" and first.k == second.k:
        return second.quantization in ("int8", "float16")
    if first.quantization != second.quantization:
        return False
    if second.method == "full":
        return True
    return first.k == second.k is not None and (
        second.method == "hard_voting" or (first.method, second.method) == ("hard_voting", "random")
    )


def _pooled(
    measured: Mapping[tuple[str, Cell], list[Row]], cell: Cell, suite: str | None
) -> list[Row]:
    return [
        row
        for (where, own), rows in measured.items()
        if own == cell and suite in (None, where)
        for row in rows
    ]
