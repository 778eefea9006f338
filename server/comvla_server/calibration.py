"""A first idea of what passes cost, before the first robot calls."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from comvla_server.cost_model import CostModel, Work

if TYPE_CHECKING:
    from comvla_server.engine import Engine

BUDGET_S = 0.5
"""Longest that calibration may take, in seconds, beyond its first pass."""


def calibrate(
    engine: Engine,
    max_batch: int,
    costs: CostModel,
    *,
    budget_s: float = BUDGET_S,
    clock: Callable[[], float] = time.monotonic,
) -> None:
    """Times passes of few and many requests with few and many tokens, so that they tell apart what each costs.

    Runs in the inference thread after the warm-up. A model that is too slow for the budget is
    learned from the robots' own requests instead.

    Args:
        engine: warm.
        max_batch: most requests in one pass.
        costs: learns from each pass.
        budget_s: no pass begins that would end later, by what the others took.
        clock: monotonic seconds.
    """
    most = engine.info.num_tokens
    sizes = sorted({1, max_batch})
    works = [Work(b, b * k) for k in sorted({1, most // 4 or 1, most}) for b in sizes]
    began_s = clock()
    for work in works + works:
        if costs.known and clock() - began_s + costs.predict(work) > budget_s:
            continue
        requests = [engine.blank_request(work.tokens // work.requests)] * work.requests
        started_s = clock()
        engine.predict(requests)
        costs.observe(work, clock() - started_s)
