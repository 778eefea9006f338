"""The asyncio twin of :mod:`comvla_client.revival`, which says what is done and why."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterable
from typing import Any

import grpc
import grpc.aio

from comvla.model_info import PROTOCOL_VERSION
from comvla.v1 import policy_pb2_grpc
from comvla.v1.policy_pb2 import GetModelRequest
from comvla_client.access import Metadata
from comvla_client.revival import EVERY_S, MOST_SPARES, PATIENCE_S, Pace, answered

_LEAST_AGE_S = 0.005
_PING_TIMEOUT_S = 30.0

Call = Callable[[grpc.aio.Channel, float], Awaitable[Any]]
"""Makes a call over a connection, within seconds."""


class AsyncRevival:
    """Makes calls over a connection that may be dead, and over another one if it is.

    Args:
        open_channel: opens a new connection to the same server.
        metadata: what proves who calls.

    Attributes:
        suspected: a call takes long or went unanswered, and nothing was heard since.
        pace: what calls usually take.
    """

    def __init__(
        self, open_channel: Callable[[], grpc.aio.Channel], metadata: Callable[[], Metadata]
    ) -> None:
        self._open_channel = open_channel
        self._metadata = metadata
        self._ping: asyncio.Task[Any] | None = None
        self._pinged = 0.0
        self._spares: list[tuple[float, grpc.aio.Channel, asyncio.Task[Any]]] = []
        self._closing: set[asyncio.Task[None]] = set()
        self.suspected = False
        self.pace = Pace()

    async def answer(
        self,
        call: Call,
        current: grpc.aio.Channel,
        timeout_s: float,
        replace: Callable[[grpc.aio.Channel], None],
    ) -> Any:
        """The answer to a call.

        Args:
            call: makes it.
            current: the connection in use.
            timeout_s: longest to wait, in seconds.
            replace: told where another connection is to be used from now on.

        Raises:
            asyncio.TimeoutError: no answer in time.
            grpc.RpcError: what the call ended with.
        """
        deadline = time.monotonic() + timeout_s
        calls: dict[grpc.aio.Channel, asyncio.Task[Any]] = {}
        spare: grpc.aio.Channel | None = None
        won: grpc.aio.Channel | None = None
        try:
            if not self.suspected:
                calls[current] = _task(call(current, timeout_s))
                await asyncio.wait(calls.values(), timeout=min(timeout_s, self.pace.patience_s))
                if calls[current].done():
                    return calls[current].result()
                self.suspected = True
            enough_s = self.pace.enough_s(deadline - time.monotonic())
            self._watch(current)
            while (left_s := deadline - time.monotonic()) > 0.0:
                done = [over for over, task in calls.items() if task.done()]
                good = [over for over in done if answered(calls[over])]
                if good or (done and len(done) == len(calls)):
                    won = (good or done)[0]
                    return calls[won].result()
                over = None
                if spare is None and left_s >= enough_s:
                    over = spare = self._take_spare()
                if over is None and not calls and not self._given_up:
                    over = current
                if over is not None:
                    calls[over] = _task(call(over, left_s))
                await self._wait(left_s, calls.values(), settled=spare is not None)
            raise asyncio.TimeoutError
        finally:
            for task in calls.values():
                task.cancel()
            if spare is not None and won is current:
                self._discard([spare])
            elif spare is not None:
                replace(spare)

    def heard(self, took_s: float) -> None:
        """A call was answered, after so many seconds."""
        self.pace.heard(took_s)
        if self.suspected:
            self.reset()

    def reset(self) -> None:
        """Something was heard, or there is another connection: all is well."""
        self.suspected = False
        if self._ping is not None:
            self._ping.cancel()
            self._ping = None
        dropped, self._spares = self._spares, []
        for _, _, ping in dropped:
            ping.cancel()
        self._discard([channel for _, channel, _ in dropped])

    def discard(self, channel: grpc.aio.Channel) -> None:
        """Closes a connection without waiting for it."""
        self._discard([channel])

    def _watch(self, current: grpc.aio.Channel) -> None:
        if self._ping is not None and self._ping.done():
            self._ping = None
        if self._ping is None:
            self._pinged = time.monotonic()
            self._ping = self._ping_over(current)
        elif self._overdue_s >= 0.0:
            self._open_spare(_LEAST_AGE_S)

    async def _wait(
        self, left_s: float, calls: Iterable[asyncio.Task[Any]], *, settled: bool
    ) -> None:
        ready = any(answered(ping) for _, _, ping in self._spares)
        if not (settled or ready or self._lives) and self._overdue_s >= 0.0:
            self._open_spare(EVERY_S)
            left_s = min(left_s, max(_LEAST_AGE_S, EVERY_S - self._youngest_s))
        elif not (settled or ready or self._lives):
            left_s = min(left_s, -self._overdue_s)
        pings = [ping for _, _, ping in self._spares] + ([self._ping] if self._ping else [])
        pending = [task for task in (*calls, *pings) if not task.done()]
        if pending:
            await asyncio.wait(pending, timeout=left_s, return_when=asyncio.FIRST_COMPLETED)
        else:
            await asyncio.sleep(left_s)

    def _take_spare(self) -> grpc.aio.Channel | None:
        for spare in () if self._lives else self._spares:
            if answered(spare[2]):
                self._spares.remove(spare)
                return spare[1]
        return None

    def _open_spare(self, least_age_s: float) -> None:
        if self._youngest_s < least_age_s:
            return
        channel = self._open_channel()
        ping = self._ping_over(channel, wait_for_ready=True)
        self._spares.append((time.monotonic(), channel, ping))
        while len(self._spares) > MOST_SPARES:
            _, oldest_but_one, ping = self._spares.pop(1)
            ping.cancel()
            self._discard([oldest_but_one])

    def _ping_over(
        self, channel: grpc.aio.Channel, *, wait_for_ready: bool = False
    ) -> asyncio.Task[Any]:
        return _task(
            policy_pb2_grpc.PolicyServiceStub(channel).GetModel(
                GetModelRequest(protocol_version=PROTOCOL_VERSION),
                timeout=_PING_TIMEOUT_S,
                metadata=self._metadata(),
                wait_for_ready=wait_for_ready,
            )
        )

    def _discard(self, channels: Iterable[grpc.aio.Channel]) -> None:
        for channel in channels:
            closing = asyncio.ensure_future(channel.close())
            self._closing.add(closing)
            closing.add_done_callback(self._closing.discard)

    @property
    def _lives(self) -> bool:
        return self._ping is not None and answered(self._ping)

    @property
    def _given_up(self) -> bool:
        return not self._lives and self._overdue_s >= 0.0

    @property
    def _overdue_s(self) -> float:
        return time.monotonic() - self._pinged - PATIENCE_S

    @property
    def _youngest_s(self) -> float:
        return time.monotonic() - self._spares[-1][0] if self._spares else float("inf")


def _task(call: Awaitable[Any]) -> asyncio.Task[Any]:
    async def made() -> Any:
        return await call

    task = asyncio.ensure_future(made())
    task.add_done_callback(_retrieve)
    return task


def _retrieve(task: asyncio.Task[Any]) -> None:
    if not task.cancelled():
        task.exception()  # else asyncio complains of an error that nobody asked for
