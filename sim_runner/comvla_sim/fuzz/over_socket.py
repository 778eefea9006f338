"""Requests over real connections: through gRPC, and as HTTP/2 frames that no client would write."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Any

import grpc

from comvla import codec
from comvla.v1 import policy_pb2
from comvla_sim.fuzz.cases import Case
from comvla_sim.fuzz.frames import LAST_PING, mutated_connection
from comvla_sim.fuzz.in_process import wrong_with
from comvla_sim.fuzz.mutations import mutated_fields, mutated_message, mutated_pictures
from comvla_sim.fuzz.outcome import Tally
from comvla_sim.fuzz.streams import mutated_stream

_CALLS, _CONNECTIONS = 48, 12
_PATIENCE_S = 20.0
# A connection whose frames no longer fit together waits for bytes that never come; so long is waited
# for a last word of the server.
_LAST_WORD_S = 0.03

_SERVICE = "/comvla.v1.PolicyService"


async def run(
    cases: Sequence[Case],
    target: str,
    tally: Tally,
    tell: Callable[[int], None],
    until_s: float = math.inf,
) -> None:
    """Sends every case that goes over a socket.

    Args:
        cases: in order.
        target: ``host:port``.
        tally: what became of them.
        tell: called now and then with how many are over.
        until_s: monotonic time after which no case begins.
    """
    calls = iter([case for case in cases if case.kind.startswith("socket")])
    connections = iter([case for case in cases if case.kind == "frames"])
    done = 0

    def over() -> None:
        nonlocal done
        done += 1
        if done % 200 == 0:
            tell(done)

    async with grpc.aio.insecure_channel(target, options=list(codec.GRPC_OPTIONS)) as channel:
        caller = _Caller(channel, tally)

        async def call() -> None:
            for case in calls:
                if time.monotonic() > until_s:
                    return
                await caller.run(case)
                over()

        async def connect() -> None:
            for case in connections:
                if time.monotonic() > until_s:
                    return
                tally.ended("frames", await _connection(case, target))
                over()

        await asyncio.gather(
            *(call() for _ in range(_CALLS)), *(connect() for _ in range(_CONNECTIONS))
        )
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
        try:
            match kind:
                case "socket fields":
                    answer = await self._infer(mutated_fields(rng), timeout=_PATIENCE_S)
                case "socket bytes":
                    answer = await self._infer(mutated_message(rng), timeout=_PATIENCE_S)
                case "socket pictures":
                    answer = await self._infer(mutated_pictures(rng), timeout=_PATIENCE_S)
                case _:
                    messages = _each(mutated_stream(rng))
                    answer = await self._stream(messages, timeout=_PATIENCE_S)
        except grpc.aio.AioRpcError as error:
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


async def _each(messages: list[bytes]) -> AsyncIterator[bytes]:
    for message in messages:
        yield message


async def _connection(case: Case, target: str) -> str:
    """Sends a connection's bytes and tells how it ended: echoed, closed, or silent."""
    host, _, port = target.rpartition(":")
    reader, writer = await asyncio.open_connection(host.strip("[]"), int(port))
    came = bytearray()
    try:
        writer.write(mutated_connection(case.rng()))
        while LAST_PING not in came:
            part = await asyncio.wait_for(reader.read(65_536), _LAST_WORD_S)
            if not part:
                return "closed"
            came += part
        return "echoed"
    except asyncio.TimeoutError:
        return "silent"
    except OSError:
        return "closed"
    finally:
        writer.transport.abort()
        with contextlib.suppress(OSError):
            await writer.wait_closed()
