"""Sets the link's capacity at every control period, as a channel has it."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable
from multiprocessing.connection import Connection
from pathlib import Path

from comvla.errors import LinkError
from comvla_client import LinkProfile
from comvla_sim.bench.processes import announce
from comvla_sim.netlink.realtime import prefer_this_thread, settle, wait_until
from comvla_sim.netlink.shaper import Shaper
from comvla_sim.netlink.wires import Side

STOLEN_TICKS = 2
"""A period in which the host took so many ticks from this machine says nothing about the link."""

_FIRST_LEAD_S = 0.0015


def serve(
    lifeline: Connection,
    side: Side,
    mtu_bytes: int,
    link: LinkProfile,
    channel: Iterable[float],
) -> None:
    """Shapes one end of the cable, period after period, until the lifeline ends.

    A change takes Linux one to two milliseconds, so it is begun as much earlier as the last ones
    took. Period 0 begins when the keeper says, by ``time.monotonic``; at any later message it is
    told how late the changes were.

    Args:
        lifeline: to the process that keeps the link.
        side: the robot's end of the cable.
        mtu_bytes: of the cable.
        link: bandwidth, period and efficiency of the radio.
        channel: SNR in dB of each period.
    """
    lead_s = _FIRST_LEAD_S
    late_s: list[float] = []
    stolen: list[int] = []
    before = stolen_ticks()
    with Shaper(side, mtu_bytes=mtu_bytes, period_s=link.period_s) as shaper:
        capacities_bytes = (link.capacity_bits(snr_db) / 8.0 for snr_db in channel)
        shaper.set_capacity(next(capacities_bytes))
        settle()
        prefer_this_thread()
        announce(lifeline, "driver")
        try:
            start = float(lifeline.recv_bytes())
            for period, capacity_bytes in enumerate(capacities_bytes, start=1):
                boundary = start + period * link.period_s
                wait_until(boundary - lead_s)
                began = time.monotonic()
                shaper.set_capacity(capacity_bytes)
                took_s = time.monotonic() - began
                lead_s += 0.1 * (min(took_s, 5 * lead_s) - lead_s)
                late_s.append(began + took_s - boundary)
                now = stolen_ticks()
                if now - before >= STOLEN_TICKS:
                    stolen.append(period - 1)
                before = now
                if lifeline.poll():
                    lifeline.recv_bytes()
                    answer = {"late": summary_of(late_s), "stolen_periods": stolen}
                    lifeline.send_bytes(json.dumps(answer).encode())
        except EOFError:
            return
    raise LinkError("the channel ended; those of comvla_sim.channel go on for ever")


def stolen_ticks() -> int:
    """Time that a virtual machine's host has taken from its processors so far, in ticks of 10 ms."""
    try:
        line = Path("/proc/stat").read_text(encoding="ascii").partition("\n")[0]
        return int(line.split()[8])
    except (OSError, IndexError, ValueError):
        return 0


def summary_of(late_s: list[float]) -> dict[str, float]:
    """How late the changes of rate were, in seconds; negative is early."""
    if not late_s:
        return {"periods": 0, "median_s": math.nan, "p99_s": math.nan, "max_s": math.nan}
    ordered = sorted(late_s)
    return {
        "periods": len(ordered),
        "median_s": ordered[len(ordered) // 2],
        "p99_s": ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))],
        "max_s": ordered[-1],
    }
