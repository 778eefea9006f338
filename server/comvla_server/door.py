"""Every call of every service on the gRPC port comes through here, whatever it is.

An interceptor, so that a service that is added later is behind it as well. It reads requests itself:
who calls is known before a byte of the request is read, and a request has to arrive in time.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import grpc
from grpc_health.v1 import health

from comvla_server.auth import Authenticator
from comvla_server.identity import ANYBODY, Identity, set_caller
from comvla_server.log_throttle import LogThrottle
from comvla_server.metrics import Metrics
from comvla_server.rate_limits import RateLimits
from comvla_server.refusals import Reason, Refusal
from comvla_server.settings import ServerSettings
from comvla_server.statuses import STATUS, hints
from comvla_server.wording import shown

_log = logging.getLogger(__name__)

if sys.version_info >= (3, 11):

    async def _within(message: Awaitable[bytes], timeout_s: float) -> bytes:
        async with asyncio.timeout(timeout_s):  # unlike wait_for, without a task of its own
            return await message
else:

    async def _within(message: Awaitable[bytes], timeout_s: float) -> bytes:
        return await asyncio.wait_for(message, timeout_s)


_MOST_METHODS = 256
_TRANSIT_S = 0.05  # a robot's own deadline is over earlier than it seems here

_Context = Any  # grpc.aio.ServicerContext
_HEALTH = f"/{health.SERVICE_NAME}/"
_INFER = "/comvla.v1.PolicyService/Infer"  # and InferProgressive

# Of the calls that may be open, the share left to health checks, which need no token: strangers who
# watch the server's health must not keep robots out.
_HEALTH_SHARE = 8


class Door(grpc.aio.ServerInterceptor):
    """Identifies callers, keeps them to their limits, and waits for requests only so long.

    Health checks are open to all, few at a time; everything else needs an identity where the server
    asks for one.

    Args:
        authenticator: tells who calls.
        limits: what each may send.
        settings: how long to wait for a request, and how many calls may be open.
        metrics: where refusals are counted.

    Attributes:
        glance: asked before a call for actions is looked at, with the seconds that it has: a refusal where it would
            be read in vain.
        on_lost: told of each call with a single request that ended while it was read: whose it was, and the seconds
            that it had.
    """

    def __init__(
        self,
        authenticator: Authenticator,
        limits: RateLimits,
        settings: ServerSettings,
        metrics: Metrics,
    ) -> None:
        self._authenticator = authenticator
        self._limits = limits
        self._timeout_s = settings.request_timeout_s
        self._most_health_calls = max(1, settings.max_concurrent_calls // _HEALTH_SHARE)
        self._health_calls = 0
        self._metrics = metrics
        self._throttle = LogThrottle(time.monotonic)
        self._guards: dict[str, tuple[Any, Any]] = {}
        self.on_lost: Callable[[str, float | None], None] = lambda who, time_remaining_s: None
        self.glance: Callable[[float | None], Refusal | None] = lambda time_remaining_s: None

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Any]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Any:
        """The method's handler with the door in front; None where there is no such method."""
        handler = await continuation(handler_call_details)
        if handler is None:
            return None
        # The same for all calls of a method, unless somebody makes handlers anew for each.
        method = handler_call_details.method
        behind, guarded = self._guards.get(method, (None, None))
        if behind is not handler:
            guarded = self._guarded(handler, method)
            if len(self._guards) < _MOST_METHODS:
                self._guards[method] = handler, guarded
        return guarded

    def _guarded(self, handler: Any, method: str) -> Any:
        # On the wire a unary request is a stream of one message. Taken as a stream, the call reaches
        # this code before its request does.
        if handler.response_streaming:
            inner = handler.stream_stream or handler.unary_stream
            make, guard = grpc.stream_stream_rpc_method_handler, self._streaming(inner)
        else:
            inner = handler.stream_unary or handler.unary_unary
            make, guard = grpc.stream_unary_rpc_method_handler, self._single(inner)
        entry = _Entry(self, method, handler.request_streaming, handler.request_deserializer)
        return make(guard(entry), response_serializer=handler.response_serializer)

    def _single(self, inner: Any) -> Callable[[_Entry], Any]:
        def guard(entry: _Entry) -> Any:
            async def respond(requests: AsyncIterator[bytes], context: _Context) -> Any:
                request = await entry.admit(requests, context)
                try:
                    return await inner(request, context)
                except Refusal as refusal:
                    await entry.refuse(refusal, context)
                except NotImplementedError:  # gRPC would log a stack trace for each such call
                    await context.abort(grpc.StatusCode.UNIMPLEMENTED, "no such method here")

            return respond

        return guard

    def _streaming(self, inner: Any) -> Callable[[_Entry], Any]:
        if not inspect.isasyncgenfunction(inner):  # it writes its responses itself
            return self._single(inner)

        def guard(entry: _Entry) -> Any:
            async def respond(requests: AsyncIterator[bytes], context: _Context) -> Any:
                request = await entry.admit(requests, context)
                try:
                    async for response in inner(request, context):
                        yield response
                except Refusal as refusal:
                    await entry.refuse(refusal, context)

            return respond

        return guard

    def begin(self, method: str, context: _Context) -> Identity:
        """Lets a call in until its task ends.

        Raises:
            Refusal: nobody's call, or one too many.
        """
        if method.startswith(_HEALTH):
            identity, ended = ANYBODY, self._begin_health_call()
        else:
            identity = self._authenticator.identify(context)
            ended = self._limits.begin(identity)
        task = asyncio.current_task()
        assert task is not None, "gRPC runs every call in a task"
        task.add_done_callback(lambda _: ended())
        set_caller(identity)
        return identity

    async def read(self, requests: AsyncIterator[bytes], identity: Identity) -> bytes | None:
        """The next message of a call, None at the end.

        Raises:
            Refusal: it takes too long, or is more than the identity may send.
        """
        try:
            message = await _within(anext(requests), self._timeout_s)
        except StopAsyncIteration:
            return None
        except asyncio.TimeoutError:
            raise Refusal(
                Reason.SLOW,
                f"expected the whole request within {self._timeout_s:g} s, it did not arrive: send "
                "fewer tokens, or raise --request-timeout-s",
            ) from None
        self._limits.charge(identity, len(message))
        return message

    def note(self, refusal: Refusal, method: str, peer: str) -> None:
        """Counts and logs a call that was turned away."""
        reason = refusal.reason.value
        self._metrics.calls_refused.labels(reason).inc()
        suppressed = self._throttle.allow(reason)
        if suppressed is not None:
            _log.info(
                "turned away: %s",
                refusal.message,
                extra={
                    "reason": reason,
                    "method": method,
                    "peer": shown(peer),
                    "suppressed": suppressed,
                },
            )

    def _begin_health_call(self) -> Callable[[], None]:
        if self._health_calls >= self._most_health_calls:
            raise Refusal(
                Reason.RATE,
                f"{self._health_calls} health checks are open, expected at most "
                f"{self._most_health_calls}: retry when one has ended, or raise "
                "--max-concurrent-calls",
            )
        self._health_calls += 1

        def ended() -> None:
            self._health_calls -= 1

        return ended


class _Entry:
    """The way of one method's calls through the door."""

    def __init__(self, door: Door, method: str, streams: bool, parse: Any) -> None:
        self._door = door
        self._method = method
        self._for_actions = method.startswith(_INFER)
        self._streams = streams
        self._parse = parse or (lambda message: message)

    async def admit(self, requests: AsyncIterator[bytes], context: _Context) -> Any:
        """The request, or the stream of them, of a call that may come in."""
        if self._for_actions:
            refusal = self._door.glance(context.time_remaining())
            if refusal is not None:
                await self.refuse(refusal, context)
        try:
            identity = self._door.begin(self._method, context)
            messages = aiter(requests)
            if self._streams:
                return self._stream(messages, identity)
            time_remaining_s = context.time_remaining()
            try:
                message = await self._door.read(messages, identity)
            except asyncio.CancelledError:
                # Of a stream the service itself tells, which also ends reading where a window ends.
                self._door.on_lost(identity.name or context.peer(), time_remaining_s)
                raise
        except Refusal as refusal:
            await self.refuse(refusal, context)
        if message is None and _given_up(context):
            await context.abort(
                grpc.StatusCode.DEADLINE_EXCEEDED,
                "expected the request before its deadline, it had not come: allow more time",
            )
        if message is None:
            await context.abort(
                grpc.StatusCode.INVALID_ARGUMENT, "expected one request, got none: send a message"
            )
        return self._parse(message)

    async def _stream(self, messages: AsyncIterator[bytes], identity: Identity) -> Any:
        while (message := await self._door.read(messages, identity)) is not None:
            yield self._parse(message)

    async def refuse(self, refusal: Refusal, context: _Context) -> Any:
        """Ends a call that may not go on."""
        self._door.note(refusal, self._method, context.peer())
        await context.abort(STATUS[refusal.reason], refusal.message, hints(refusal))


def _given_up(context: _Context) -> bool:
    """Whether a call has ended for its caller; gRPC shows that as the end of its messages."""
    remaining_s = context.time_remaining()
    return context.cancelled() or (remaining_s is not None and remaining_s < _TRANSIT_S)
