"""More robots than a server can answer, on a real server over real sockets.

The server's capacity is measured first, in a closed loop. Then every robot asks at a fixed rate, whatever becomes of
its requests, so that together they ask for 1.5 or 10 times as much. The same with admission off stands beside it.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

from comvla.errors import ComVLAError
from comvla_sim.bench import environment, policy_server
from comvla_sim.bench.fleet import Fleet, Tally, jain_index, percentile_s
from comvla_sim.bench.processes import serving
from comvla_sim.bench.server_account import ServerAccount

IN_TIME_GOAL, GOODPUT_GOAL, JAIN_GOAL = 0.99, 0.9, 0.9


CASES = ("admission off", "admission", "advised K", "back-off")
"""Ways to run server and robots. Each of the last two includes the one before it."""


class OverloadError(ComVLAError, ValueError):
    """A way of running that does not exist."""


@dataclass(frozen=True)
class OverloadParameters:
    """The robots, the server and the load.

    Attributes:
        robots: how many.
        loads: offered, as multiples of the capacity measured.
        token_budget: K that each robot would like to send.
        max_batch: of the server.
        model: ``"stub"`` (a pass takes a fixed time and no processor), ``"mini"``, ``"random"`` or a checkpoint.
        threads: of torch in the server, 0 for its own choice.
        seconds: of each load. settle_s: before them, not counted. capacity_s: in which capacity is measured.
        deadline_passes: deadline of a request, in forward passes of a full batch as measured.
        cases: which of :data:`CASES`.
        seed: of tokens and times.
    """

    robots: int = 64
    loads: tuple[float, ...] = (1.5, 10.0)
    token_budget: int = 128
    max_batch: int = 8
    model: str = "stub"
    threads: int = 1
    seconds: float = 10.0
    settle_s: float = 3.0
    capacity_s: float = 5.0
    deadline_passes: float = 4.0
    cases: tuple[str, ...] = CASES
    seed: int = 0


_OFF = {
    "admission": False,
    "fair_shares": False,
    "earliest_deadline_first": False,
    "advise_tokens": False,
}
_SETTINGS: dict[str, dict[str, Any]] = {
    "admission off": _OFF,
    "admission": {"advise_tokens": False},
}


def run(
    parameters: OverloadParameters, on_case: Callable[[str], None] = lambda name: None
) -> dict[str, Any]:
    """Measures every case at every load.

    Args:
        parameters: the robots, the server and the load.
        on_case: told what is measured now.

    Returns:
        An object with ``environment``, ``parameters``, ``rows``, ``goals`` and ``met``, JSON-able.

    Raises:
        OverloadError: a case that does not exist.
        RuntimeError: the server did not answer while its capacity was measured.
    """
    unknown = set(parameters.cases) - set(CASES)
    if unknown or not parameters.cases:
        raise OverloadError(f"expected cases among {', '.join(CASES)}, got {', '.join(unknown)!r}")
    rows: list[dict[str, Any]] = []
    for case in parameters.cases:
        rows += _measure(case, parameters, on_case)
    judged = [row for row in rows if row["name"] in ("admission", "advised K")]
    return {
        "bench": "overload",
        "environment": environment.describe(),
        "parameters": asdict(parameters),
        "rows": rows,
        "goals": {
            "in_time_share": IN_TIME_GOAL,
            "goodput_ratio": GOODPUT_GOAL,
            "jain": JAIN_GOAL,
        },
        "met": bool(judged)
        and all(
            row["in_time_share"] >= IN_TIME_GOAL
            and row["goodput_ratio"] >= GOODPUT_GOAL
            and row["jain"] >= JAIN_GOAL
            for row in judged
        ),
    }


def _measure(
    case: str, parameters: OverloadParameters, on_case: Callable[[str], None]
) -> Iterator[dict[str, Any]]:
    arguments = (
        parameters.model,
        parameters.max_batch,
        parameters.threads,
        _SETTINGS.get(case, {}),
    )
    with serving(policy_server.serve, *arguments) as addresses:
        target, admin_url = addresses.split()
        on_case(f"{case}: capacity")
        capacity = asyncio.run(_capacity(target, parameters))
        for load in parameters.loads:
            on_case(f"{case}: load {load:g}")
            yield asyncio.run(_offer(case, parameters, target, admin_url, capacity, load))


async def _capacity(target: str, parameters: OverloadParameters) -> float:
    in_flight = 3 * parameters.max_batch
    fleet = _fleet(target, parameters, min(parameters.robots, in_flight))
    async with fleet:
        return await fleet.capacity(in_flight, parameters.capacity_s)


def _fleet(target: str, parameters: OverloadParameters, robots: int, **options: bool) -> Fleet:
    return Fleet(
        target, robots=robots, tokens=parameters.token_budget, seed=parameters.seed, **options
    )


async def _offer(
    case: str,
    parameters: OverloadParameters,
    target: str,
    admin_url: str,
    capacity: float,
    load: float,
) -> dict[str, Any]:
    period_s = parameters.robots / (load * capacity)
    deadline_s = parameters.deadline_passes * parameters.max_batch / capacity
    fleet = _fleet(
        target,
        parameters,
        parameters.robots,
        follow_advice=case in ("advised K", "back-off"),
        back_off=case == "back-off",
    )
    async with fleet:
        fleet.begin(period_s)
        await fleet.offer(period_s, deadline_s, parameters.settle_s)
        before = await asyncio.to_thread(ServerAccount.read, admin_url)
        began, cpu_began = time.perf_counter(), time.process_time()
        tallies, lag_s = await fleet.offer(period_s, deadline_s, parameters.seconds)
        took_s, cpu_s = time.perf_counter() - began, time.process_time() - cpu_began
        after = await asyncio.to_thread(ServerAccount.read, admin_url)
    return {
        "name": case,
        "load": load,
        "capacity_per_s": capacity,
        "period_s": period_s,
        "deadline_s": deadline_s,
        **_summary(tallies, capacity, parameters.seconds),
        "memory_growth_mib": (after.resident_bytes - before.resident_bytes) / 2**20,
        "descriptors_growth": after.descriptors - before.descriptors,
        "server_cpu": (after.cpu_s - before.cpu_s) / took_s,
        "generator_cpu": cpu_s / took_s,
        "generator_lag_s": lag_s,
    }


def _summary(tallies: list[Tally], capacity: float, seconds: float) -> dict[str, Any]:
    answered = sum(t.answered for t in tallies)
    late = sum(t.late for t in tallies)
    offered = max(1, sum(t.offered for t in tallies))
    durations_s = [duration for tally in tallies for duration in tally.durations_s]
    return {
        "offered_per_s": offered / seconds,
        "goodput_ratio": answered / seconds / capacity,
        # Whoever asked anew while it waited took its own request back: neither in time nor late.
        "in_time_share": answered / max(1, answered + late),
        "served_share": answered / offered,
        "shed_share": sum(t.shed for t in tallies) / offered,
        "superseded_share": sum(t.superseded for t in tallies) / offered,
        "late_share": late / offered,
        "paused_share": sum(t.paused for t in tallies) / offered,
        "failed": sum(t.failed for t in tallies),
        "failed_codes": dict(sum((t.codes for t in tallies), Counter())),
        "jain": jain_index([t.answered for t in tallies]),
        "least_answers": min(t.answered for t in tallies),
        "mean_tokens": sum(t.tokens for t in tallies) / max(1, answered),
        "p50_s": percentile_s(durations_s, 50),
        "p99_s": percentile_s(durations_s, 99),
    }
