"""The asyncio twin of :mod:`comvla_client.transport`."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any, Protocol

import grpc
import grpc.aio

from comvla.model_info import PROTOCOL_VERSION
from comvla.v1 import policy_pb2_grpc
from comvla.v1.policy_pb2 import GetModelRequest, GetModelResponse, InferRequest, InferResponse
from comvla_client import channel
from comvla_client.access import Access, Metadata, TlsOptions, Token
from comvla_client.errors import ClientClosedError, TransportError
from comvla_client.revival_aio import AsyncRevival
from comvla_client.streaming import PayloadStream, paced_async

Start = Callable[[Any, float, Metadata], Any]
"""Begins a call: a stub, seconds, and what proves who calls."""


class AsyncTransport(Protocol):
    """:class:`comvla_client.transport_protocol.Transport` with awaitable calls."""

    async def get_model(self, timeout_s: float) -> GetModelResponse:
        """The server's description of its model, or TransportError."""
        ...

    async def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        """Actions for one observation, or TransportError."""
        ...

    async def close(self) -> None:
        """Ends calls under way and frees the connection."""
        ...


class AsyncProgressiveTransport(AsyncTransport, Protocol):
    """:class:`comvla_client.transport_protocol.ProgressiveTransport` with awaitable calls."""

    async def infer_progressive(self, stream: PayloadStream, timeout_s: float) -> InferResponse:
        """Actions for as much of one observation as arrives in time, or TransportError."""
        ...


class GrpcAioTransport:
    """:class:`comvla_client.transport.GrpcTransport` on the running event loop.

    A connection that went silent is replaced in the same way; filler is not sent.

    Args:
        target: ``host:port``.
        tls: encrypts; None sends in the clear.
        token: says who calls.
        insecure: lets the token cross a network in the clear.
        model: name of the model to ask for, where the server has several; empty for its default.
        patient: try UNAVAILABLE again; else it is told at once, for somebody who knows another server.

    Raises:
        HandshakeError: the target is no such address.
        AccessError: certificates or a token that cannot be used.
    """

    def __init__(
        self,
        target: str,
        tls: TlsOptions | None = None,
        token: Token | None = None,
        *,
        insecure: bool = False,
        model: str = "",
        patient: bool = True,
    ) -> None:
        self.target = target
        self._access = Access(target, tls, token, insecure=insecure)
        self._model, self._patient = model, patient
        self._closed = asyncio.Event()
        self._revival = AsyncRevival(self._access.aio_channel, self._access.metadata)
        self._channel: grpc.aio.Channel | None = None

    @property
    def access(self) -> Access:
        """How the server is reached."""
        return self._access

    async def get_model(self, timeout_s: float) -> GetModelResponse:
        """The server's description of its model; waits for one that is still starting.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
            ClientClosedError: the transport is closed.
        """
        request = GetModelRequest(protocol_version=PROTOCOL_VERSION, model=self._model)
        answer: GetModelResponse = await self._call(_unary("GetModel", request), timeout_s)
        return answer

    async def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        """Actions for one observation.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
            ClientClosedError: the transport is closed, before or during the call.
        """
        answer: InferResponse = await self._call(_unary("Infer", request), timeout_s)
        return answer

    async def infer_progressive(self, stream: PayloadStream, timeout_s: float) -> InferResponse:
        """Actions for as much of one observation as arrives within the stream's window.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
            ClientClosedError: the transport is closed, before or during the call.
        """

        def start(stub: Any, remaining_s: float, metadata: Metadata) -> Any:
            messages = paced_async(stream, min(stream.window_s, remaining_s))
            return stub.InferProgressive(messages, timeout=remaining_s, metadata=metadata)

        answer: InferResponse = (await self._call(start, timeout_s)).response
        return answer

    async def renew(self) -> None:
        """Makes the next call over a new connection; ends those under way."""
        if not self._closed.is_set():
            self._replace(self._access.aio_channel())

    async def close(self) -> None:
        """Ends calls under way with ClientClosedError. Closing twice does no harm."""
        self._closed.set()
        self._revival.reset()
        stale, self._channel = self._channel, None
        if stale is not None:
            await stale.close()

    async def _call(self, start: Start, timeout_s: float) -> Any:
        attempts = channel.Attempts(timeout_s)
        while True:
            try:
                return await self._attempt(start, attempts.remaining_s())
            except TransportError as error:
                if not self._patient:
                    if error.code == "UNAVAILABLE":
                        await self.renew()
                    raise
                await asyncio.sleep(attempts.pause_s(error))
                if not self._closed.is_set():
                    self._replace(self._access.aio_channel())

    async def _attempt(self, start: Start, timeout_s: float) -> Any:
        self._check_open()
        if self._channel is None:
            # Made here and not before, because a channel belongs to the loop that runs.
            self._channel = self._access.aio_channel()
        began = time.monotonic()

        def call(over: grpc.aio.Channel, left_s: float) -> Any:
            stub = policy_pb2_grpc.PolicyServiceStub(over)
            return start(stub, left_s, self._access.metadata())

        try:
            # gRPC's own timer may fire late; this wait does not.
            answer = await self._revival.answer(call, self._channel, timeout_s, self._replace)
        except asyncio.TimeoutError:
            self._check_open()
            self._revival.suspected = True
            raise channel.unanswered(timeout_s) from None
        except (grpc.RpcError, grpc.aio.UsageError) as error:
            if self._closed.is_set() or not isinstance(error, grpc.RpcError):
                raise self._closed_error() from error
            failure = channel.transport_error(error)
            if channel.is_silence(failure):
                self._revival.suspected = True
            raise failure from error
        except asyncio.CancelledError as error:
            # Closing the channel cancels its calls; a cancelled task is another matter.
            if self._closed.is_set():
                raise self._closed_error() from error
            raise
        self._revival.heard(time.monotonic() - began)
        return answer

    def _replace(self, fresh: grpc.aio.Channel) -> None:
        stale, self._channel = self._channel, fresh
        if stale is not None:
            self._revival.discard(stale)
        self._revival.reset()

    def _check_open(self) -> None:
        if self._closed.is_set():
            raise self._closed_error()

    def _closed_error(self) -> ClientClosedError:
        return ClientClosedError(f"the connection to {self.target} was closed: make a new client")


def _unary(method: str, request: Any) -> Start:
    return lambda stub, timeout_s, metadata: getattr(stub, method)(
        request, timeout=timeout_s, metadata=metadata
    )
