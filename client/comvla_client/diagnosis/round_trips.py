"""How long the way to the server and back takes, and how steadily."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass

from comvla.model_info import ModelInfo
from comvla_client.diagnosis.finding import Allowance, Finding
from comvla_client.errors import TransportError
from comvla_client.transport_protocol import Transport


@dataclass(frozen=True)
class RoundTrips:
    """Times of small calls, in seconds.

    Attributes:
        calls: how many were made.
        median_s: half of them were quicker.
        p99_s: 99 of 100 were quicker; the slowest, of fewer.
        jitter_s: mean difference between one and the next.
    """

    calls: int
    median_s: float
    p99_s: float
    jitter_s: float


def summary(elapsed_s: Sequence[float]) -> RoundTrips:
    """Median, 99th percentile and jitter of at least two calls."""
    ordered = sorted(elapsed_s)
    rank = min(len(ordered) - 1, int(0.99 * len(ordered)))
    differences = [abs(after - before) for before, after in itertools.pairwise(elapsed_s)]
    return RoundTrips(
        len(ordered), statistics.median(ordered), ordered[rank], statistics.fmean(differences)
    )


def round_trips(
    transport: Transport, calls: int, model: ModelInfo, allowance: Allowance, timeout_s: float
) -> tuple[Finding, RoundTrips | None]:
    """Times small calls over a connection that is already open.

    Args:
        transport: to the server.
        calls: how many to make, at most.
        model: whose control period they are compared with.
        allowance: a third of what is left of it may be spent, yet two calls are always made.
        timeout_s: longest to wait for one call.

    Returns:
        The finding, and the numbers where there are any.
    """
    ends = time.perf_counter() + allowance.at_most_s(3.0, 1 / 3)
    elapsed_s: list[float] = []
    try:
        while len(elapsed_s) < 2 or (len(elapsed_s) < calls and time.perf_counter() < ends):
            began = time.perf_counter()
            transport.get_model(timeout_s)
            elapsed_s.append(time.perf_counter() - began)
    except TransportError as error:
        return Finding(
            "round trip",
            "fail",
            f"lost after {len(elapsed_s)} calls ({error})",
            "the link or the server is unsteady: look at the server's log and the radio",
        ), None
    seen = summary(elapsed_s)
    values = {
        "calls": seen.calls,
        "median_s": seen.median_s,
        "p99_s": seen.p99_s,
        "jitter_s": seen.jitter_s,
    }
    found = (
        f"{seen.calls} small calls: median {1e3 * seen.median_s:.2f} ms, "
        f"p99 {1e3 * seen.p99_s:.2f} ms, jitter {1e3 * seen.jitter_s:.2f} ms"
    )
    period_ms = 1e3 * model.control_period_s
    if seen.p99_s <= model.control_period_s:
        return Finding("round trip", "ok", found, values=values), seen
    if seen.median_s > model.control_period_s:
        remedy = (
            f"longer than one control period ({period_ms:.0f} ms): move the server closer, or let "
            "the robot execute longer chunks before it asks again"
        )
    else:
        remedy = (
            f"now and then longer than one control period ({period_ms:.0f} ms): look for other "
            "traffic, a radio that roams or saves power, and a busy machine at either end"
        )
    return Finding("round trip", "fail", found, remedy, values), seen
