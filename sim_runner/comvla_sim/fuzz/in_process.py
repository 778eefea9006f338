"""Requests handed to the service itself, with everything behind it: validation, queue, model thread."""

from __future__ import annotations

import asyncio
import json
import logging
import math
import os
import random
import time
import tracemalloc
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import grpc
import numpy as np
from google.protobuf.message import DecodeError

from comvla import codec
from comvla.v1 import policy_pb2
from comvla_server.refusals import Refusal
from comvla_server.server import Server
from comvla_server.service import PolicyService
from comvla_server.statuses import STATUS
from comvla_sim.bench.processes import announce
from comvla_sim.fuzz.cases import Case
from comvla_sim.fuzz.mutations import (
    mutated_fields,
    mutated_message,
    mutated_pictures,
    payload,
)
from comvla_sim.fuzz.outcome import Tally
from comvla_sim.fuzz.streams import mutated_stream
from comvla_sim.fuzz.target import INFO, SETTINGS, engine, expected_actions, valid_request

_WORKERS = 32
_TELL_EVERY = 500
_AFTERWARDS = 20
_LONG_S = 30.0
_PATIENCE_S = (None, 5.0, 5.0, 5.0, 5.0, 0.001, 0.0, -1.0)

# A request may take a multiple of its own size (INT4 becomes float32, eight times as wide, and is
# looked at in float32 and float64), and some fixed sum for objects, words and log lines.
MOST_TIMES_ITS_SIZE, MOST_BESIDES_BYTES = 32, 256 * 1024


@dataclass(frozen=True)
class Share:
    """What one process does.

    Attributes:
        seed, first, last: of the run; numbers from ``first`` to before ``last``.
        index, of: every ``of``-th number, from the ``index``-th on.
        until_s: ``time.time()`` after which no case begins.
    """

    seed: int
    first: int
    last: int
    index: int
    of: int
    until_s: float

    def cases(self) -> list[Case]:
        """Those that are handed to the service directly."""
        numbers = range(self.first + self.index, self.last, self.of)
        return [case for case in (Case(self.seed, n) for n in numbers) if case.in_process]


def work(lifeline: Connection, share: Share) -> None:
    """Runs a share, tells how far it got, and announces the tally.

    The entry of a process of its own: what a crash would end.
    """
    logging.disable(logging.CRITICAL)  # a million refusals
    announce(lifeline, str(os.getpid()))

    cases, began_s = share.cases(), time.time()

    def tell(done: int, at: int) -> None:
        over = done / max(1, len(cases))
        if math.isfinite(share.until_s):
            over = max(over, (time.time() - began_s) / max(1e-9, share.until_s - began_s))
        announce(lifeline, json.dumps({"done": done, "at": at, "share": min(1.0, over)}))

    tally = asyncio.run(_run(cases, share.until_s, tell))
    announce(lifeline, json.dumps({"tally": tally.to_dict()}))


def run_one(case: Case) -> Tally:
    """A single case, in this process."""
    return asyncio.run(_run([case], math.inf, lambda done, at: None))


async def _run(cases: Sequence[Case], until_s: float, tell: Callable[[int, int], None]) -> Tally:
    server = Server(engine(), SETTINGS)
    await server.start()
    tally, done = Tally(), 0

    def over(case: Case) -> None:
        nonlocal done
        done += 1
        if done % _TELL_EVERY == 0:
            tell(done, case.number)

    try:
        assert server._service is not None
        bench = _Bench(server._service, tally)
        together = iter([case for case in cases if case.kind != "memory"])

        async def worker() -> None:
            for case in together:
                if time.time() > until_s:
                    return
                await bench.run(case)
                over(case)

        await asyncio.gather(*(worker() for _ in range(_WORKERS)))
        tracemalloc.start()
        for case in cases:
            if case.kind == "memory" and time.time() <= until_s:
                await bench.run_alone(case)
                over(case)
        tracemalloc.stop()
        for number in range(_AFTERWARDS):
            await bench.run_valid("afterwards", f"after-{number}", random.Random(number))
        tell(done, cases[-1].number if cases else 0)
    finally:
        await server.stop(0.5)
    return tally


class _Bench:
    """One service, and the tally of what it did."""

    def __init__(self, service: PolicyService, tally: Tally) -> None:
        self._service = service
        self._tally = tally

    async def run(self, case: Case) -> None:
        """One case; whatever happens is in the tally."""
        rng, kind = case.rng(), case.kind
        patience_s = rng.choice(_PATIENCE_S)
        match kind:
            case "fields" | "memory":
                data = mutated_fields(rng)
            case "bytes":
                data = mutated_message(rng)
            case "pictures":
                data = mutated_pictures(rng)
            case "streams":
                messages = mutated_stream(rng)
                closes = rng.random() < 0.9
                await self._judge(case, self._stream(messages, closes, patience_s))
                return
            case _:
                await self.run_valid(case, f"valid-{case.number}", rng)
                return
        await self._judge(case, self._infer(data, patience_s))

    async def run_alone(self, case: Case) -> None:
        """One case with nothing beside it, under a watch on what it allocates."""
        size = len(mutated_fields(_skipped(case)))
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        await self.run(case)
        _, peak = tracemalloc.get_traced_memory()
        if peak - before > MOST_TIMES_ITS_SIZE * size + MOST_BESIDES_BYTES:
            self._tally.fail(case, case.kind, f"{size} bytes allocated {peak - before} bytes")

    async def run_valid(self, case: object, session: str, rng: random.Random) -> None:
        """A request with nothing wrong, which has to be answered with the actions of its tokens."""
        content = payload(rng.choice((1, 3, 8, 32)), rng.choice(codec.QUANTIZATIONS))
        request = valid_request(session, 0, content)
        status, what = "OK", ""
        try:
            response = await self._service.infer(request, _LONG_S)
        except Exception as error:
            status, what = type(error).__name__, f"not answered: {error}"
        else:
            what = wrong_with(response, request)
        if isinstance(case, Case):
            self._tally.ended("valid", status)
        if what:
            self._tally.fail(case, "valid", what)

    async def _judge(self, case: Case, answering: Any) -> None:
        try:
            response = await answering
        except Refusal as refusal:
            self._tally.judge(case, case.kind, STATUS[refusal.reason], refusal.message)
        except Exception as error:
            self._tally.ended(case.kind, type(error).__name__)
            self._tally.fail(case, case.kind, f"raised {type(error).__name__}: {error}")
        else:
            self._tally.judge(case, case.kind, grpc.StatusCode.OK, "")
            what = wrong_with(response)
            if what:
                self._tally.fail(case, case.kind, what)

    async def _infer(self, data: bytes, patience_s: float | None) -> policy_pb2.InferResponse:
        try:
            request = policy_pb2.InferRequest.FromString(data)
        except DecodeError:
            raise self._service.note_malformed(len(data)) from None
        return await self._service.infer(request, patience_s)

    async def _stream(
        self, messages: list[bytes], closes: bool, patience_s: float | None
    ) -> policy_pb2.InferResponse:
        return await self._service.infer_progressive(_parsed(messages, closes), patience_s)


async def _parsed(messages: list[bytes], closes: bool) -> AsyncIterator[Any]:
    """As gRPC hands them on; a robot that does not close its side just stops."""
    for data in messages:
        try:
            yield policy_pb2.InferProgressiveRequest.FromString(data)
        except DecodeError:
            yield object()
        await asyncio.sleep(0)
    if not closes:
        await asyncio.sleep(60.0)


def wrong_with(
    response: policy_pb2.InferResponse, request: policy_pb2.InferRequest | None = None
) -> str:
    """What no answer may be; empty where nothing is wrong.

    Args:
        response: any answer.
        request: where it is known to be valid, and to bring tokens.
    """
    shape = (response.action_horizon, response.action_dim)
    if shape != (INFO.action_horizon, INFO.action_dim) or len(response.actions) != math.prod(shape):
        return f"answered {len(response.actions)} numbers as {shape}"
    if not np.isfinite(response.actions).all():
        return "answered actions that are not finite"
    if request is not None:
        expected = expected_actions(request).ravel()
        if not np.array_equal(np.asarray(response.actions, np.float32), expected):
            return "answered other actions than those of its tokens"
    return ""


def _skipped(case: Case) -> Any:
    """The case's own random numbers from where its request is made."""
    rng = case.rng()
    rng.choice(_PATIENCE_S)
    return rng
