"""How many bits a second reach the server."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass

from comvla_client.diagnosis.finding import Allowance, Finding, out_of_time
from comvla_client.diagnosis.probes import upload_request, upload_s, wire_bytes
from comvla_client.errors import TransportError
from comvla_client.transport_protocol import Transport

SMALLEST_BYTES, LARGEST_BYTES = 4 << 10, 4 << 20
REPEATS = 3
LONG_ENOUGH_S = 0.25
"""An upload that takes this long, and five round trips, is mostly transfer."""


@dataclass(frozen=True)
class Goodput:
    """What the uplink carried.

    Attributes:
        bits_per_s: slope of time over size between the largest uploads and those of a quarter, so
            that what every call costs, the round trip first of all, is left out.
        upload_bytes: size of the largest.
        upload_s: what it took, round trip included.
    """

    bits_per_s: float
    upload_bytes: int
    upload_s: float


def goodput(
    transport: Transport, round_trip_s: float, cap_bytes: int, allowance: Allowance
) -> tuple[Finding, Goodput | None]:
    """Sends uploads of growing size back to back; the server reads and refuses them.

    Each size is sent three times and its median counts. It stops at a size that takes long enough, at
    the server's cap, or when its share of the time is used up.

    Args:
        transport: to the server.
        round_trip_s: of a small call.
        cap_bytes: largest request that the server reads; 0 for unknown.
        allowance: half of what is left of it may be spent.

    Returns:
        The finding, and the numbers where there are any.
    """
    if allowance.left_s() <= 0.0:
        return out_of_time("goodput", allowance), None
    ends = time.perf_counter() + allowance.at_most_s(5.0, 0.5)
    largest = min(LARGEST_BYTES, cap_bytes - 1024 if cap_bytes else LARGEST_BYTES)
    medians: list[tuple[int, float]] = []
    size, failure = SMALLEST_BYTES, None
    while size <= largest:
        request = upload_request(size)
        took: list[float] = []
        try:
            while len(took) < REPEATS and (not took or time.perf_counter() < ends):
                left_s = max(ends - time.perf_counter(), 0.05)
                took.append(upload_s(transport, request, left_s))
        except TransportError as error:
            failure = error
        if took:
            medians.append((wire_bytes(request), statistics.median(took)))
        long_enough = bool(took) and medians[-1][1] > max(LONG_ENOUGH_S, 5.0 * round_trip_s)
        if failure is not None or long_enough or time.perf_counter() >= ends:
            break
        size *= 2
    if not medians:
        return _nothing_arrives(size, failure), None
    seen = _slope(medians, round_trip_s)
    values = {
        "bits_per_s": seen.bits_per_s,
        "upload_bytes": seen.upload_bytes,
        "upload_s": seen.upload_s,
    }
    found = (
        f"{_rate(seen.bits_per_s)} up, from uploads of up to {seen.upload_bytes / 1024:.0f} KiB; "
        f"with its round trip the largest ran at {_rate(8 * seen.upload_bytes / seen.upload_s)}"
    )
    return Finding("goodput", "ok", found, values=values), seen


def _slope(medians: list[tuple[int, float]], round_trip_s: float) -> Goodput:
    largest, took_s = medians[-1]
    smaller = [(size, s) for size, s in medians if size <= largest / 3]
    if smaller and took_s > 1.2 * smaller[-1][1]:
        transfer_s, moved = took_s - smaller[-1][1], largest - smaller[-1][0]
    else:
        # Sizes do not differ in time, or there is only one: all but the round trip is transfer,
        # and a tenth at least.
        transfer_s, moved = max(took_s - round_trip_s, 0.1 * took_s), largest
    return Goodput(8.0 * moved / transfer_s, largest, took_s)


def _nothing_arrives(size: int, failure: TransportError | None) -> Finding:
    if failure is not None and failure.code == "DEADLINE_EXCEEDED":
        return Finding(
            "goodput",
            "fail",
            f"small calls are answered, an upload of {size / 1024:.0f} KiB is not",
            "the link is very slow, or packets of full size are lost on the way (a tunnel with a "
            "smaller MTU): try `ping -M do -s 1472 HOST`, and lower the MTU until it answers",
        )
    return Finding(
        "goodput",
        "skip",
        f"the server did not read an upload of {size / 1024:.0f} KiB ({failure})",
        "it may be busy, limit the rate of calls, or want to know who calls: try again later",
    )


def _rate(bits_per_s: float) -> str:
    for unit, name in ((1e9, "Gbit/s"), (1e6, "Mbit/s")):
        if bits_per_s >= unit:
            return f"{bits_per_s / unit:.3g} {name}"
    return f"{bits_per_s / 1e3:.3g} kbit/s"
