"""Requests over real connections, through gRPC."""

from __future__ import annotations

import asyncio
import math
import random
import time
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Any

import grpc

from comvla import codec
from comvla.v1 import policy_pb2
from comvla_sim.fuzz.cases import Case
from comvla_sim.fuzz.in_process import wrong_with
from comvla_sim.fuzz.mutations import mutated_fields, mutated_message, mutated_pictures
from comvla_sim.fuzz.outcome import Tally
from comvla_sim.fuzz.streams import mutated_stream
from comvla_sim.fuzz.supervised import SupervisedServer

_CALLS = 48
_PATIENCE_S = 20.0

# gRPC's own asyncio client says so, with INTERNAL, where the server answered while it was still writing a stream,
# and hides the answer (github.com/grpc/grpc/issues/36066): the same stream is sent again.
_HIDDEN = "Internal error from Core"
_ATTEMPTS = 20

_SERVICE = "/comvla.v1.PolicyService"


async def run(
    cases: Sequence[Case],
    server: SupervisedServer,
    tally: Tally,
    tell: Callable[[int], None],
    until_s: float = math.inf,
) -> None:
    """Sends every case; none more once the server has ended, which is one failure and not thousands.

    Args:
        cases: in order.
        server: there until the end.
        tally: what became of them.
        tell: called now and then with how many are over.
        until_s: monotonic time after which no case begins.
    """
    rest = iter(cases)
    done = 0

    async with grpc.aio.insecure_channel(
        server.target, options=list(codec.GRPC_OPTIONS)
    ) as channel:
        caller = _Caller(channel, tally)

        async def call() -> None:
            nonlocal done
            for case in rest:
                if time.monotonic() > until_s or server.ended() is not None:
                    return
                await caller.run(case)
                done += 1
                if done % 200 == 0:
                    tell(done)

        await asyncio.gather(*(call() for _ in range(_CALLS)))
    why = server.ended()
    if why is not None:
        tally.fail("during the calls", "server", f"it ended: {why}")
    tell(done)


class _Caller:
    """Sends bytes as messages, whatever they are."""

    def __init__(self, channel: grpc.aio.Channel, tally: Tally) -> None:
        self._infer: Any = channel.unary_unary(f"{_SERVICE}/Infer")
        self._stream: Any = channel.stream_unary(f"{_SERVICE}/InferProgressive")
        self._tally = tally

    async def run(self, case: Case) -> None:
        """One call; whatever happens is in the tally."""
        rng, kind = case.rng(), case.kind
        messages = _messages(kind, rng)
        for attempt in range(_ATTEMPTS):
            try:
                if kind == "socket streams":
                    answer = await self._stream(_each(messages), timeout=_PATIENCE_S)
                else:
                    answer = await self._infer(messages[0], timeout=_PATIENCE_S)
                break
            except grpc.aio.AioRpcError as error:
                if error.details() != _HIDDEN or attempt == _ATTEMPTS - 1:
                    self._tally.judge(case, kind, error.code(), error.details() or "")
                    return
        self._tally.judge(case, kind, grpc.StatusCode.OK, "")
        response = (
            policy_pb2.InferProgressiveResponse.FromString(answer).response
            if kind == "socket streams"
            else policy_pb2.InferResponse.FromString(answer)
        )
        what = wrong_with(response)
        if what:
            self._tally.fail(case, kind, what)


def _messages(kind: str, rng: random.Random) -> list[bytes]:
    """What a call sends: one message, or those of a stream."""
    match kind:
        case "socket fields":
            return [mutated_fields(rng)]
        case "socket bytes":
            return [mutated_message(rng)]
        case "socket pictures":
            return [mutated_pictures(rng)]
        case _:
            return mutated_stream(rng)


async def _each(messages: list[bytes]) -> AsyncIterator[bytes]:
    for message in messages:
        yield message
