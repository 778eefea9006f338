"""Made-up results of the paper command."""

from __future__ import annotations

from typing import Any

from eval_stubs import SETTINGS, made_up_row

from comvla_sim.experiments.results import Row
from comvla_sim.paper.cells import Cell
from comvla_sim.paper.measuring import Measured, all_counts, all_pairs
from comvla_sim.paper.results import FORMAT, Results

TASKS = ("drawer-open", "lever-down")


def rows(cell: Cell, successes: int, episodes: int, suite: str = "tabletop") -> list[Row]:
    """So many episodes of each of two tasks, the first ones successful."""
    return [
        made_up_row(
            method=cell.method,
            k=cell.k or 512,
            task=task,
            episode=episode,
            success=episode < successes,
            quantization=cell.quantization,
            world=suite,
        )
        for task in TASKS
        for episode in range(episodes)
    ]


def results(measured: Measured, *, episodes: int = 20, **story: Any) -> Results:
    """Results as the command would gather them."""
    return Results(
        {
            "format": FORMAT,
            "story": {
                "world": "tabletop",
                "suites": list(dict.fromkeys(suite for suite, _ in measured)),
                "model": "mini",
                "settings": {k: v for k, v in SETTINGS.items() if k != "quantization"},
                "tasks": list(TASKS),
                "episodes": episodes,
                "seed": 0,
                "machine": {"cpu": "abacus", "cores": 2, "python": "3.11"},
                "packages": {"torch": "2"},
                "last_run_s": 1,
                **story,
            },
            "cells": all_counts(measured),
            "pairs": all_pairs(measured),
        }
    )


def a_few_cells(episodes: int = 20) -> Measured:
    """Full, votes and random tokens at K = 32, and two number formats."""
    counts = {
        Cell("full"): episodes,
        Cell("hard_voting", 32): episodes - 1,
        Cell("hard_voting", 32, "float16"): episodes - 1,
        Cell("hard_voting", 32, "int4"): episodes // 2,
        Cell("soft_voting", 32): episodes - 1,
        Cell("random", 32): 2,
        Cell("jpeg-75"): episodes,
    }
    return {("tabletop", cell): rows(cell, count, episodes) for cell, count in counts.items()}
