"""Connections of hostile frames, a batch at a time, and which of them ended the server."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import time
from collections.abc import Callable, Sequence

import grpc

from comvla import codec
from comvla.v1 import policy_pb2_grpc
from comvla_sim.fuzz.cases import Case
from comvla_sim.fuzz.frames import LAST_PING, mutated_connection
from comvla_sim.fuzz.in_process import wrong_with
from comvla_sim.fuzz.mutations import payload
from comvla_sim.fuzz.outcome import Tally
from comvla_sim.fuzz.supervised import SupervisedServer
from comvla_sim.fuzz.target import valid_request

KNOWN_END = "ended gRPC (known)"
"""How a connection ends that ends grpc.aio's loop by a path that is no UTF-8; see SECURITY.md."""

_KNOWN = UnicodeDecodeError.__name__
_BATCH = 24
_PATIENCE_S = 20.0
_COME_AGAIN_S = 0.1
_BYSTANDERS = itertools.count()
# A connection whose frames no longer fit together waits for bytes that never come; so long is waited
# for a last word of the server.
_LAST_WORD_S = 0.03


async def run(
    cases: Sequence[Case],
    server: SupervisedServer,
    tally: Tally,
    tell: Callable[[int], None],
    until_s: float = math.inf,
) -> None:
    """Opens a connection for every case.

    After each batch a valid request of somebody else has to be answered, and rightly. Where it is not
    because the server has ended, a new one is given the batch's connections one by one: so the one that
    ends it is found, and what comes after it meets a server that is well.

    Args:
        cases: in order.
        server: started again whenever it has ended.
        tally: what became of them.
        tell: called after each batch with how many are over.
        until_s: monotonic time after which no batch begins.
    """
    rest, done = iter(cases), 0
    while batch := list(itertools.islice(rest, _BATCH)):
        if time.monotonic() > until_s:
            return
        ends = await asyncio.gather(*(_connection(case, server.target) for case in batch))
        what = await _unwell(server.target)
        if not what:
            for how in ends:
                tally.ended("frames", how)
        else:
            await _search(batch, server, tally, what)
        done += len(batch)
        tell(done)


async def _search(batch: Sequence[Case], server: SupervisedServer, tally: Tally, what: str) -> None:
    """Repeats a batch one by one on a new server."""
    why, found = await server.end(), False
    server.restart()
    for case in batch:
        how = await _connection(case, server.target)
        unwell = await _unwell(server.target)
        if unwell:
            found, ended = True, await server.end()
            how = KNOWN_END if ended == _KNOWN else "ended the server"
            if ended != _KNOWN:
                tally.fail(case, "frames", f"ended the server: {ended or unwell}")
            server.restart()
        tally.ended("frames", how)
    if not found:
        what = (
            f"the server was unwell ({why or what}), and outlived the same connections one by one"
        )
        tally.fail(f"{batch[0]} to {batch[-1]}", "frames", what)


async def _unwell(target: str) -> str:
    """What is wrong with the answer to somebody else's valid request; empty where nothing is."""
    # Somebody new each time: a repeat would be answered from the record, whatever became of the model.
    request = valid_request(f"bystander-{next(_BYSTANDERS)}", 0, payload(8, "float32"))
    until_s = time.monotonic() + _PATIENCE_S
    async with grpc.aio.insecure_channel(target, options=list(codec.GRPC_OPTIONS)) as channel:
        stub = policy_pb2_grpc.PolicyServiceStub(channel)
        while True:
            try:
                response = await stub.Infer(request, timeout=_PATIENCE_S)
            except grpc.aio.AioRpcError as error:
                # A crowded server may ask anybody to come again.
                crowded = error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
                if crowded and time.monotonic() < until_s:
                    await asyncio.sleep(_COME_AGAIN_S)
                    continue
                return (
                    f"somebody else's request was answered {error.code().name}: {error.details()}"
                )
            return wrong_with(response, request)


async def _connection(case: Case, target: str) -> str:
    """Sends a connection's bytes and tells how it ended: echoed, closed, silent, or refused."""
    host, _, port = target.rpartition(":")
    try:
        reader, writer = await asyncio.open_connection(host.strip("[]"), int(port))
    except OSError:
        return "refused"
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
