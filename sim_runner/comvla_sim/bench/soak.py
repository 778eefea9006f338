"""A server under steady load for a long time: does it keep its memory and its descriptors?"""

from __future__ import annotations

import asyncio
import statistics
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from comvla_sim.bench import environment, policy_server
from comvla_sim.bench.fleet import Fleet, percentile_s
from comvla_sim.bench.processes import serving
from comvla_sim.bench.server_account import ServerAccount

MOST_GROWTH = 0.02
_SPARE_DESCRIPTORS = 4  # a scrape, and what the interpreter opens for a moment


@dataclass(frozen=True)
class SoakParameters:
    """The robots, the server and the time.

    Attributes:
        minutes: of load.
        load: offered, as a multiple of the capacity measured.
        robots: how many.
        token_budget: K that each sends.
        max_batch: of the server.
        model: as for :class:`comvla_sim.bench.overload.OverloadParameters`.
        threads: of torch in the server, 0 for its own choice.
        capacity_s: in which capacity is measured.
        deadline_s: of a request.
        seed: of tokens and times.
    """

    minutes: float = 30.0
    load: float = 0.8
    robots: int = 64
    token_budget: int = 32
    max_batch: int = 8
    model: str = "mini"
    threads: int = 1
    capacity_s: float = 10.0
    deadline_s: float = 1.0
    seed: int = 0


def run(
    parameters: SoakParameters, on_second: Callable[[float], None] | None = None
) -> dict[str, Any]:
    """Loads a server, and compares its memory and descriptors at the end with those after warming up.

    Warming up takes the first sixth of the time: 5 of 30 minutes.

    Args:
        parameters: the robots, the server and the time.
        on_second: told about once a second how many have passed.

    Returns:
        An object with ``environment``, ``parameters``, ``rows`` (one a tenth of the time), ``growth`` of the resident
        memory as a share, ``descriptors_growth`` and ``passed``, JSON-able.

    Raises:
        RuntimeError: the server did not answer while its capacity was measured.
    """
    arguments = (parameters.model, parameters.max_batch, parameters.threads)
    with serving(policy_server.serve, *arguments) as addresses:
        target, admin_url = addresses.split()
        return asyncio.run(_soak(parameters, target, admin_url, on_second))


async def _soak(
    parameters: SoakParameters,
    target: str,
    admin_url: str,
    on_second: Callable[[float], None] | None,
) -> dict[str, Any]:
    seconds = 60.0 * parameters.minutes
    fleet = Fleet(
        target,
        robots=parameters.robots,
        tokens=parameters.token_budget,
        follow_advice=True,
        back_off=True,
        seed=parameters.seed,
    )
    async with fleet:
        capacity = await fleet.capacity(3 * parameters.max_batch, parameters.capacity_s)
        period_s = parameters.robots / (parameters.load * capacity)
        fleet.begin(period_s)
        with _Samples(admin_url, every_s=min(5.0, seconds / 120.0)) as samples:
            tallies, _ = await fleet.offer(
                period_s, parameters.deadline_s, seconds, on_second=on_second
            )
    durations_s = [duration for tally in tallies for duration in tally.durations_s]
    warm = samples.between(seconds / 6.0, seconds / 6.0 + seconds / 30.0)
    last = samples.between(seconds - seconds / 30.0, seconds)
    answered = sum(t.answered for t in tallies)
    return {
        "bench": "soak",
        "environment": environment.describe(),
        "parameters": asdict(parameters),
        "capacity_per_s": capacity,
        "answered": answered,
        "answered_share": answered / max(1, sum(t.offered for t in tallies)),
        "failed": sum(t.failed for t in tallies),
        "p99_s": percentile_s(durations_s[-100_000:], 99),
        "rows": [
            _row(samples.between(i * seconds / 10.0, (i + 1) * seconds / 10.0), i + 1, seconds)
            for i in range(10)
        ],
        **judge(warm, last),
    }


def judge(warm: list[ServerAccount], last: list[ServerAccount]) -> dict[str, Any]:
    """Whether memory and descriptors stayed as they were.

    Args:
        warm: the server when it was warm.
        last: the server at the end.

    Returns:
        ``growth`` of the resident memory as a share, ``descriptors_growth``, and whether it ``passed``.
    """
    growth = _median(last, "resident_bytes") / _median(warm, "resident_bytes") - 1.0
    descriptors_growth = _median(last, "descriptors") - _median(warm, "descriptors")
    return {
        "growth": growth,
        "descriptors_growth": descriptors_growth,
        "passed": growth < MOST_GROWTH and descriptors_growth <= _SPARE_DESCRIPTORS,
    }


class _Samples:
    """Asks the server how it is, now and then, in a thread of its own."""

    def __init__(self, admin_url: str, every_s: float) -> None:
        self._admin_url, self._every_s = admin_url, every_s
        self._found: list[tuple[float, ServerAccount]] = []
        self._over = threading.Event()
        self._began = time.monotonic()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def __enter__(self) -> _Samples:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def between(self, start_s: float, end_s: float) -> list[ServerAccount]:
        """What was found in a span of time; the nearest where it is too short for any."""
        inside = [account for at_s, account in self._found if start_s <= at_s <= end_s]
        middle_s = 0.5 * (start_s + end_s)
        return inside or [min(self._found, key=lambda pair: abs(pair[0] - middle_s))[1]]

    def _work(self) -> None:
        while True:
            account = ServerAccount.read(self._admin_url)
            self._found.append((time.monotonic() - self._began, account))
            if self._over.wait(self._every_s):
                return


def _median(accounts: list[ServerAccount], name: str) -> float:
    return float(statistics.median(getattr(account, name) for account in accounts))


def _row(accounts: list[ServerAccount], tenth: int, seconds: float) -> dict[str, Any]:
    return {
        "name": f"until {tenth * seconds / 600.0:.1f} min",
        "resident_mib": _median(accounts, "resident_bytes") / 2**20,
        "descriptors": _median(accounts, "descriptors"),
    }
