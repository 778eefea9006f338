"""The asyncio twin of :mod:`comvla_client.fleet`."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Any, TypeAlias

from comvla.v1.policy_pb2 import GetModelResponse, InferRequest, InferResponse
from comvla_client import channel
from comvla_client.access import TlsOptions, Token
from comvla_client.errors import ClientClosedError, TransportError
from comvla_client.health import check_health_aio
from comvla_client.look_up import LookUps
from comvla_client.revival import PATIENCE_S
from comvla_client.roster import (
    LOOK_UP_DOWN_EVERY_S,
    LOOK_UP_EVERY_S,
    LOOK_UP_NOBODY_EVERY_S,
    PROBE_EVERY_S,
    PROBE_TIMEOUT_S,
    Member,
    Roster,
)
from comvla_client.search import Search
from comvla_client.streaming import PayloadStream
from comvla_client.targets import Address, Addresses
from comvla_client.transport_aio import GrpcAioTransport

Work: TypeAlias = Callable[[GrpcAioTransport, float], Awaitable[Any]]
"""Makes a call over a transport within so many seconds."""

_Member: TypeAlias = "Member[GrpcAioTransport]"


class FleetAioTransport:
    """:class:`comvla_client.fleet.FleetTransport` on the running event loop.

    Args:
        target: ``host:port`` or ``dns:///name:port``, once or more with commas between.
        tls, token, insecure, model: as for one server.

    Raises:
        HandshakeError: a part of the target is no address.
        AccessError: certificates or a token that cannot be used; of servers that a name stands for,
            from the first call that knows them.
    """

    def __init__(
        self,
        target: str,
        tls: TlsOptions | None = None,
        token: Token | None = None,
        *,
        insecure: bool = False,
        model: str = "",
    ) -> None:
        self.target = target
        addresses = Addresses(target)
        self._names = LookUps(addresses)
        self._closed = asyncio.Event()
        self._tasks: set[asyncio.Future[Any]] = set()
        self._prober: asyncio.Task[None] | None = None

        def make(address: Address) -> GrpcAioTransport:
            named = None if tls is None else tls.with_server_name(address.server_name)
            return GrpcAioTransport(
                address.target, named, token, insecure=insecure, model=model, patient=False
            )

        self._roster: Roster[GrpcAioTransport] = Roster(make)
        self._roster.update(addresses.fixed)

    async def get_model(self, timeout_s: float) -> GetModelResponse:
        """The description that the first server gives which is there.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
            ClientClosedError: the transport is closed.
        """
        answer: GetModelResponse = await self._call(
            lambda one, left_s: one.get_model(left_s), timeout_s
        )
        return answer

    async def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        """Actions for one observation, from whoever answers first.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
            ClientClosedError: the transport is closed, before or during the call.
        """
        answer: InferResponse = await self._call(
            lambda one, left_s: one.infer(request, left_s), timeout_s
        )
        return answer

    async def infer_progressive(self, stream: PayloadStream, timeout_s: float) -> InferResponse:
        """Actions for as much of one observation as arrives within the stream's window.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
            ClientClosedError: the transport is closed, before or during the call.
        """
        answer: InferResponse = await self._call(
            lambda one, left_s: one.infer_progressive(stream, left_s), timeout_s
        )
        return answer

    async def close(self) -> None:
        """Ends calls under way with ClientClosedError. Closing twice does no harm."""
        self._closed.set()
        for member in self._roster.members:
            await member.transport.close()
        if self._prober is not None:
            self._prober.cancel()

    async def _call(self, work: Work, timeout_s: float) -> Any:
        search = Search(self._roster, self.target, timeout_s)
        self._check_open()
        await self._look_up(LOOK_UP_EVERY_S)
        while True:
            self._check_open()
            member = search.next()
            if member is None:
                await asyncio.sleep(search.pause_s())
                await self._look_up(LOOK_UP_NOBODY_EVERY_S)
                continue
            try:
                return await self._ask(member, work, search.remaining_s(), search.tried)
            except TransportError as error:
                search.failed(member, error)

    async def _ask(
        self, member: _Member, work: Work, timeout_s: float, tried: list[_Member]
    ) -> Any:
        """One server's answer, or another's where it is silent."""
        deadline = time.monotonic() + timeout_s
        calls = {self._send(member, work, timeout_s): member}
        try:
            await asyncio.wait(calls, timeout=min(timeout_s, member.patience_s))
            (first,) = calls
            if not first.done():
                other = await self._somebody_else(member, first, deadline, tried)
                if other is not None and (left_s := deadline - time.monotonic()) > 0.0:
                    self._roster.leave(member)
                    self._look_after()
                    calls[self._send(other, work, left_s)] = other
            return await self._first_answer(calls, deadline, timeout_s)
        finally:
            for call in calls:
                call.cancel()

    async def _first_answer(
        self, calls: dict[asyncio.Future[Any], _Member], deadline: float, timeout_s: float
    ) -> Any:
        pending, failure = set(calls), channel.unanswered(timeout_s)
        while pending:
            left_s = max(0.0, deadline - time.monotonic())
            done, pending = await asyncio.wait(
                pending, timeout=left_s, return_when=asyncio.FIRST_COMPLETED
            )
            if not done:
                break
            for call in done:
                try:
                    return call.result()
                except TransportError as error:
                    self._roster.failed(calls[call], error)
                    if calls[call].down:
                        self._look_after()
                    failure = error
        self._check_open()
        raise failure

    async def _somebody_else(
        self,
        silent: _Member,
        call: asyncio.Future[Any],
        deadline: float,
        tried: list[_Member],
    ) -> _Member | None:
        """Who says that it is well while a server that owes an answer does not; None where that one does."""
        others = self._roster.others(silent, tried)
        if not others:
            return None
        probes = {asyncio.ensure_future(_is_well(m)): m for m in (silent, *others)}
        pending: set[asyncio.Future[Any]] = {call, *probes}
        choice, ends = None, min(deadline, time.monotonic() + PROBE_TIMEOUT_S)
        grace = time.monotonic() + PATIENCE_S
        try:
            while True:
                left_s = (ends if choice is None else min(ends, grace)) - time.monotonic()
                if left_s <= 0.0 or not pending:
                    return choice
                done, pending = await asyncio.wait(
                    pending, timeout=left_s, return_when=asyncio.FIRST_COMPLETED
                )
                well = [probes[one] for one in done if one is not call and one.result()]
                if call in done or silent in well:
                    return None
                choice = choice or next(iter(well), None)
        finally:
            for probe in probes:
                probe.cancel()

    def _send(self, member: _Member, work: Work, timeout_s: float) -> asyncio.Future[Any]:
        async def call() -> Any:
            began = time.monotonic()
            self._roster.begin(member)
            try:
                answer = await work(member.transport, timeout_s)
            except ClientClosedError as error:
                self._check_open()
                raise TransportError("UNAVAILABLE", "the server's name means it no more") from error
            finally:
                self._roster.end(member)
            self._roster.answered(member, time.monotonic() - began)
            return answer

        task = asyncio.ensure_future(call())
        self._tasks.add(task)
        task.add_done_callback(self._forget)
        return task

    def _forget(self, task: asyncio.Future[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled():
            task.exception()  # retrieved, even where another answer was quicker

    async def _look_up(self, every_s: float) -> None:
        """Takes over what was found meanwhile, and has names looked up again after so many seconds."""
        for gone in self._roster.update(self._names.news(every_s)):
            await gone.transport.close()

    def _look_after(self) -> None:
        """Asks servers that are down whether they are well again, in a task, until all are."""
        if not self._closed.is_set() and (self._prober is None or self._prober.done()):
            self._prober = asyncio.ensure_future(self._probe())

    async def _probe(self) -> None:
        probes: set[asyncio.Task[None]] = set()
        try:
            while True:
                await self._look_up(LOOK_UP_DOWN_EVERY_S)
                for member in self._roster.to_probe():
                    probe = asyncio.ensure_future(self._ask_after(member))
                    probes.add(probe)
                    probe.add_done_callback(probes.discard)
                    probe.add_done_callback(self._forget)
                if not self._roster.down:
                    return
                await asyncio.sleep(PROBE_EVERY_S)
        finally:
            for probe in list(probes):
                probe.cancel()

    async def _ask_after(self, member: _Member) -> None:
        well = False
        try:
            well = await _is_well(member) and not member.calls  # which a new connection would end
            if well:
                await member.transport.renew()  # the old connection may still be a silent one
        finally:
            self._roster.probed(member, well)

    def _check_open(self) -> None:
        if self._closed.is_set():
            raise self._closed_error()

    def _closed_error(self) -> ClientClosedError:
        return ClientClosedError(f"the connection to {self.target} was closed: make a new client")


async def _is_well(member: _Member) -> bool:
    """Whether the server answers over a new connection, and says that it serves."""
    try:
        return await check_health_aio(member.transport.access, PROBE_TIMEOUT_S) == "SERVING"
    except TransportError as error:
        return error.code == "UNIMPLEMENTED"  # it is there, and has no health service
