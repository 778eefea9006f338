"""The robot's side of a link: the real client, asking at the beginning of control periods."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from comvla_client import ComVLAClient, SnrReading
from comvla_client.budget import LinkProfile
from comvla_client.edge import EdgeModel
from comvla_sim.bench.processes import announce
from comvla_sim.netlink.cloud import SYNTHETIC
from comvla_sim.netlink.namespaces import enter
from comvla_sim.netlink.realtime import EMULATED, prefer_this_thread, settle, wait_until
from comvla_sim.netlink.synthetic import INSTRUCTION, SyntheticEdge, observation

MINI_INSTRUCTION = "push the green button"
LARGEST_RESERVE = 0.8
"""Of a period. More than that for computing leaves no time to send."""

SLACK_S = 0.006
"""The client winds a step up 2 ms before its deadline; the rest is for what is late on a machine."""

_SKIPPED = {
    "session": "",
    "step": None,
    "token_budget": 0,
    "tokens": 0,
    "tokens_used": 0,
    "payload_bytes": 0,
    "framed_bytes": 0,
    "source": "skipped",
    "reason": "skipped",
    "call_s": 0.0,
    "answered_after_s": None,
}
_CALIBRATING_QUERIES = 40
_CALIBRATING_SNR_DB = 60.0
_PROGRESS_EVERY_S = 0.5


@dataclass(frozen=True)
class RobotSettings:
    """What the robot does.

    Attributes:
        model: :data:`comvla_sim.netlink.cloud.SYNTHETIC`, or what ``comvla_vla.load_edge`` takes.
        link: what the client is told of the link.
        sending: policy of sending, by name.
        budget: how the client counts: ``paper`` or ``framed``.
        quantization: how values are coded.
        every: periods from one query to the next.
        csi_delay: age of the reported SNR in periods.
        reserve_s: kept of the period for what is not sending; None measures it first.
        typical_tokens: K of the queries that measure the reserve.
        realtime: whether the robot runs before ordinary processes, on a machine that is shared.
    """

    model: str
    link: LinkProfile
    sending: str
    budget: str
    quantization: str = "int8"
    every: int = 1
    csi_delay: int = 0
    reserve_s: float | None = None
    typical_tokens: int = 32
    realtime: bool = False


def serve(
    lifeline: Connection,
    namespace: str,
    target: str,
    settings: RobotSettings,
    channel: Iterable[float],
    queries: int,
) -> None:
    """Drives the robot; announces what was measured, then asks from the moment that it is told.

    While it asks it sends the number of queries done now and then, and all records at the end.
    """
    enter(namespace)
    if settings.realtime:
        prefer_this_thread(EMULATED)
    edge: EdgeModel
    if settings.model == SYNTHETIC:
        edge, instruction = SyntheticEdge(), INSTRUCTION
    else:
        import torch

        import comvla_vla

        torch.set_num_threads(1)
        edge, instruction = comvla_vla.load_edge(settings.model), MINI_INSTRUCTION
    obs = observation(edge.info)
    overhead_s = _overhead_s(target, edge, settings, obs, instruction)
    reserve_s = settings.reserve_s
    if reserve_s is None:
        needed_s = float(np.quantile(overhead_s, 0.95)) + SLACK_S
        reserve_s = min(needed_s, LARGEST_RESERVE * settings.link.period_s)
    link = replace(settings.link, reserve_s=reserve_s)
    with ComVLAClient(
        target,
        edge=edge,
        link=link,
        quantization=settings.quantization,
        budget=settings.budget,  # type: ignore[arg-type]
        sending=settings.sending,
        deadline_s=link.period_s,
        execute=1,
    ) as client:
        client.step(obs, instruction, _CALIBRATING_SNR_DB)  # a connection in use
        client.reset()
        settle()
        announce(
            lifeline,
            json.dumps(
                {
                    "reserve_s": reserve_s,
                    "overhead_median_s": float(np.median(overhead_s)),
                    "overhead_p95_s": float(np.quantile(overhead_s, 0.95)),
                }
            ),
        )
        try:
            start = float(lifeline.recv_bytes())
        except EOFError:
            return
        records = []
        told = time.monotonic()
        for record in _walk(client, obs, instruction, settings, channel, start, queries):
            records.append(record)
            if time.monotonic() - told > _PROGRESS_EVERY_S:
                told = time.monotonic()
                lifeline.send_bytes(json.dumps({"done": len(records)}).encode())
            if lifeline.poll():  # nothing is ever sent: the run was broken off
                return
        lifeline.send_bytes(json.dumps({"records": records}).encode())


def _overhead_s(
    target: str, edge: EdgeModel, settings: RobotSettings, obs: Any, instruction: str
) -> list[float]:
    """Seconds of steps over a link that is not shaped yet: all that is not sending."""
    with ComVLAClient(
        target,
        edge=edge,
        budget=settings.typical_tokens,
        quantization=settings.quantization,
        snr=_CALIBRATING_SNR_DB,
        deadline_s=10.0,
    ) as client:
        took_s = []
        for _ in range(_CALIBRATING_QUERIES):
            took_s.append(client.step(obs, instruction).report.timings_s["total"])
            time.sleep(0.02)
    return took_s[_CALIBRATING_QUERIES // 4 :]


def _walk(
    client: ComVLAClient,
    obs: Any,
    instruction: str,
    settings: RobotSettings,
    channel: Iterable[float],
    start: float,
    queries: int,
) -> Iterator[dict[str, Any]]:
    period_s, every, delay = settings.link.period_s, settings.every, settings.csi_delay
    values = list(islice(channel, queries * every + 1))
    for query in range(queries):
        period = query * every
        boundary = start + period * period_s
        late_s = wait_until(boundary)
        if late_s > period_s:  # a robot that was held up skips, it does not run after the clock
            yield {**_SKIPPED, "period": period, "boundary": boundary, "late_s": late_s}
            continue
        # Before the first report is old enough, the robot knows the first value.
        reported = SnrReading(values[max(0, period - delay)], delay * period_s)
        chunk = client.step(obs, instruction, reported)
        ended = time.monotonic()
        report = chunk.report
        yield {
            "period": period,
            "boundary": boundary,
            "late_s": late_s,
            "snr_db": values[period] if math.isfinite(values[period]) else None,
            "reported_snr_db": reported.snr_db if math.isfinite(reported.snr_db) else None,
            "session": report.session,
            "step": report.step,
            "token_budget": report.token_budget,
            "tokens": report.tokens,
            "tokens_used": report.tokens_used,
            "payload_bytes": report.payload_bytes,
            "framed_bytes": report.framed_bytes,
            "source": chunk.source,
            "reason": report.fallback_reason,
            "call_s": report.timings_s["call"],
            "answered_after_s": ended - boundary if chunk.source == "cloud" else None,
        }
