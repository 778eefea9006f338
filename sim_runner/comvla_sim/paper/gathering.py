"""Everything that the paper command measures, in one object; each part is resumable or takes seconds."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from comvla_sim.bench import environment
from comvla_sim.experiments.errors import EvaluationError, NothingMeasuredError
from comvla_sim.experiments.layouts import evaluation_layout
from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.experiments.methods import find_method
from comvla_sim.experiments.policy import shown_model
from comvla_sim.figures.measuring import Study
from comvla_sim.paper.cells import GROUPS, PAPER_CELLS, ordered
from comvla_sim.paper.measuring import Plan, all_counts, all_pairs, measure_cells
from comvla_sim.paper.published import TABLE_K
from comvla_sim.paper.results import FORMAT, Json, Results, write

TABLES = ("table1", "table2", "table3", "table4")
FIGURES = ("fig3", "fig4", "fig5")
SWEEP_OF = {"fig4": "fading", "fig5": "csi-delay"}

FIG4_SERIES = ("full", "unenforced", "random", "drop", "progressive+floor")
FIG5_SERIES = ("unenforced", "drop", "prefix", "progressive")

FILM_TASK_EPISODE, FILM_K = 0, 16
"""Which of a table's first instructions is filmed, and with how many tokens."""


def gather(plan: Plan, parts: Sequence[str], *, quick: bool = False) -> Results:
    """Measures what the parts need and no earlier run has left behind.

    Args:
        plan: how.
        parts: names of tables and figures.
        quick: fewer points in Figs. 4 and 5.

    Raises:
        KeyboardInterrupt: after Ctrl-C, with everything measured so far in files.
        ComVLAError: something cannot be run.
    """
    began = time.monotonic()
    plan.check()
    study = plan.study(plan.suites()[0], "int8")
    study.check()
    data: Json = {"format": FORMAT, "story": {}, "cells": [], "pairs": []}
    tables = tuple(part for part in parts if part in TABLES)
    settings: Json = study.subject.settings
    if any(GROUPS[name] for name in tables):
        also = plan.more_cells() if "table1" in tables else ()
        groups = ordered(tables, also)
        measured, settings = measure_cells(plan, groups)
        there = {cell for _, cell in measured}
        data["missing"] = [
            cell.name
            for group in groups
            for cell in group
            if cell not in there
            and (plan.target is None or not find_method(cell.method).server_option)
        ]
        data["cells"], data["pairs"] = all_counts(measured), all_pairs(measured)
    inside = plan.target is None
    if inside and {"table1", "table2"} & set(tables):
        data |= _kept_or(plan, "latency", lambda: _latency(plan, study))
    if inside and "table1" in tables and plan.world != "libero":
        data |= _kept_or(plan, "pictures", lambda: _pictures(plan, study, data))
    if inside and "table4" in tables:
        data |= _kept_or(plan, "layers", lambda: _layers(study))
    if inside and "fig3" in parts:
        data |= _kept_or(plan, "figure3", lambda: _figure3(plan, study))
    for part in (part for part in parts if part in SWEEP_OF):
        data[SWEEP_OF[part]] = _sweep(plan, study, part, quick=quick)
    data["story"] = _story(plan, study, settings, time.monotonic() - began)
    return Results(data)


def _kept_or(plan: Plan, name: str, make: Callable[[], Json]) -> Json:
    """A part under its name: measured anew or, where nothing may run, as it was measured last, if it ever was."""
    path = plan.out / f"{name}.json"
    if plan.measured_only:
        if not path.exists():
            print(f"{name}: left out, {path} is not there yet", file=sys.stderr)
            return {}
        return {name: _read(path)}
    print(name, file=sys.stderr)
    made = make()
    write(path, (json.dumps(made, indent=1) + "\n").encode())
    return {name: made}


def _read(path: Path) -> Json:
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(kept, dict):
            raise ValueError(f"expected a JSON object, got {type(kept).__name__}")
    except (OSError, ValueError) as error:
        raise EvaluationError(
            f"{path} cannot be read or is damaged ({error}): run the same command without --measured-only, which "
            "measures it again, or remove the file to leave that part out"
        ) from error
    return kept


def _latency(plan: Plan, study: Study) -> Json:
    from comvla_sim.paper.latency import measure_latency

    groups = (*GROUPS["table1"], *plan.more_cells())
    cells = [*PAPER_CELLS, *(cell for group in groups for cell in group)]
    return measure_latency(study, list(dict.fromkeys(cells)))


def _pictures(plan: Plan, study: Study, data: Json) -> Json:
    from comvla_sim.experiments.worker import Worker
    from comvla_sim.paper.picture_bytes import measure_picture_bytes

    worker = Worker(study.settings)
    try:
        return measure_picture_bytes(worker, plan.seed, [c["method"] for c in data["cells"]])
    finally:
        worker.close()


def _layers(study: Study) -> Json:
    from comvla_sim.paper.layer_error import measure_errors

    return measure_errors(study, TABLE_K)


def _figure3(plan: Plan, study: Study) -> Json:
    """The pictures of kept tokens and the film; a film needs a world that draws here."""
    from comvla_sim.experiments.worker import Worker
    from comvla_sim.paper import film, kept_tokens

    worker = Worker(study.settings)
    try:
        layout = evaluation_layout(plan.seed, 0)
        scene = kept_tokens.select_on_one_picture(worker, layout)
        write(plan.out / "fig3.png", kept_tokens.draw(scene))
        found: Json = {
            "layout_seed": layout,
            "instructions": [s.instruction for s in scene.selections if s.instruction],
            "overlaps": kept_tokens.overlaps(scene),
            "budgets": list(kept_tokens.BUDGETS),
            "film": None,
        }
        found["instructions"] = list(dict.fromkeys(found["instructions"]))
        if worker.world.model is not None:
            task = worker.world.possible_tasks()[FILM_TASK_EPISODE].name
            made = film.shoot(worker, task, layout, FILM_K)
            write(plan.out / "film.webp", made.data)
            found["film"] = {
                "task": task,
                "instruction": worker.world.find_task(task).instruction,
                "k": FILM_K,
                "success": made.success,
                "periods": made.periods,
                "queries": made.queries,
            }
    finally:
        worker.close()
    return found


def _sweep(plan: Plan, study: Study, part: str, *, quick: bool) -> Json:
    from comvla_sim.figures.command import QUICK_DELAYS, QUICK_SNR_DB, figure_bandwidth_hz
    from comvla_sim.figures.running import run_sweep
    from comvla_sim.figures.series import chosen
    from comvla_sim.figures.sweeps import SWEEPS

    figure = SWEEP_OF[part]
    sweep = SWEEPS[figure]
    snrs = QUICK_SNR_DB if quick and part == "fig4" else sweep.mean_snr_db
    delays = QUICK_DELAYS if quick and part == "fig5" else sweep.csi_delay
    links = [
        LinkCase(
            channel=channel,
            mean_snr_db=snr_db,
            csi_delay=delay,
            bandwidth_hz=figure_bandwidth_hz(study.subject.token_dim),
        )
        for channel in sweep.channels
        for snr_db in snrs
        for delay in delays
    ]
    series = chosen(FIG4_SERIES if part == "fig4" else FIG5_SERIES)
    print(part, file=sys.stderr)
    try:
        printed, _ = run_sweep(figure, study, series, links, measured_only=plan.measured_only)
    except NothingMeasuredError:
        return {"points": [], "comparisons": [], "caption": ""}
    return {
        "caption": printed["caption"],
        "points": [_point(point) for point in printed["points"]],
        "comparisons": [test for test in printed["comparisons"] if test["link"] is None],
    }


def _point(point: Json) -> Json:
    use = point["link_use"] or {}
    names = ("series", "axes", "episodes", "successes", "low", "high", "periods", "bytes_per_query")
    return {name: point[name] for name in names} | {"answered": use.get("answered_share")}


def _story(plan: Plan, study: Study, settings: Json, wall_s: float) -> Json:
    machine = environment.describe()
    return {
        "world": plan.world,
        "suites": list(plan.suites()),
        "model": shown_model(plan.model),
        "settings": {k: v for k, v in settings.items() if k not in ("world", "quantization")},
        "tasks": [task.instruction for task in study.subject.tasks],
        "episodes": plan.episodes,
        "seed": plan.seed,
        "machine": {"cpu": machine["cpu"], "cores": machine["cores"], "python": machine["python"]},
        "packages": {
            name: machine["versions"][name]
            for name in ("torch", "numpy")
            if name in machine["versions"]
        },
        "last_run_s": round(wall_s),
    }


def default_reuse() -> tuple[Path, ...]:
    """Where other commands leave episodes that may be taken over."""
    return tuple(path for path in (Path("runs/figure"), Path("runs/eval")) if path.is_dir())
