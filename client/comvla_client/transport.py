"""How a request reaches the server: over gRPC, the default form of the protocol that clients use."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

import grpc

from comvla.model_info import PROTOCOL_VERSION
from comvla.v1 import policy_pb2_grpc
from comvla.v1.policy_pb2 import GetModelRequest, GetModelResponse, InferRequest, InferResponse
from comvla_client import channel
from comvla_client.access import Access, Metadata, TlsOptions, Token
from comvla_client.errors import ClientClosedError, TransportError
from comvla_client.revival import Revival, discard
from comvla_client.streaming import PayloadStream, paced
from comvla_client.transport_protocol import ProgressiveTransport, Transport
from comvla_client.warm_up import WarmUp

__all__ = ["GrpcTransport", "ProgressiveTransport", "Transport", "TransportError"]

Start = Callable[[Any, float, Metadata], Any]
"""Begins a call: a stub, seconds, and what proves who calls."""

_FILLER_TIMEOUT_S = 1.0
_CLOSE_WITHIN_S = 0.2


class GrpcTransport:
    """Calls over gRPC. Every call has a deadline that a clock on this machine enforces as well.

    UNAVAILABLE is tried again within the deadline (:class:`comvla_client.channel.Attempts`), each
    time over a new connection, so the first call after a server's return finds it. A connection
    that went silent is replaced as soon as another one works (:mod:`comvla_client.revival`).

    Args:
        target: ``host:port``.
        tls: encrypts; None sends in the clear.
        token: says who calls.
        insecure: lets the token cross a network in the clear.
        model: name of the model to ask for, where the server has several; empty for its default.
        patient: try UNAVAILABLE again; else it is told at once, for somebody who knows another server.
        warm_up: send filler ahead of a query that follows a silence (:mod:`comvla_client.warm_up`).

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
        warm_up: bool = False,
    ) -> None:
        self.target = target
        self._warm_up = WarmUp(self._send_filler) if warm_up else None
        self._access = Access(target, tls, token, insecure=insecure)
        self._model, self._patient = model, patient
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._calls = 0
        self._revival = Revival(self._new_channel, self._access.metadata)
        self._channel = self._new_channel()

    def get_model(self, timeout_s: float) -> GetModelResponse:
        """The server's description of its model; waits for one that is still starting.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
            ClientClosedError: the transport is closed.
        """
        request = GetModelRequest(protocol_version=PROTOCOL_VERSION, model=self._model)
        answer: GetModelResponse = self._call(_unary("GetModel", request), timeout_s)
        return answer

    def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        """Actions for one observation.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
            ClientClosedError: the transport is closed, before or during the call.
        """
        with self._warmed(request.ByteSize()):
            answer: InferResponse = self._call(_unary("Infer", request), timeout_s)
        return answer

    def infer_progressive(self, stream: PayloadStream, timeout_s: float) -> InferResponse:
        """Actions for as much of one observation as arrives within the stream's window.

        gRPC takes one piece at a time and only when the one before was written. When the window
        ends no further piece is handed out, when the time is over the call is cancelled, and what
        gRPC still held is dropped.

        Raises:
            TransportError: no usable answer within ``timeout_s`` seconds.
            ClientClosedError: the transport is closed, before or during the call.
        """
        # Each attempt counts its own pieces and is stopped at the end only: to half-close an earlier
        # one would tell the server to answer what little it has, and that answer might win.
        attempts: list[tuple[PayloadStream, threading.Event]] = []

        def start(stub: Any, remaining_s: float, metadata: Metadata) -> Any:
            attempt, stopped = replace(stream), threading.Event()
            attempts.append((attempt, stopped))
            messages = paced(attempt, min(stream.window_s, remaining_s), stopped)
            return stub.InferProgressive.future(messages, timeout=remaining_s, metadata=metadata)

        try:
            with self._warmed(stream.head.ByteSize() + len(stream.payload)):
                answer: InferResponse = self._call(start, timeout_s).response
        finally:
            for attempt, stopped in attempts:
                stopped.set()  # the thread that feeds gRPC may be waiting for its next piece
                stream.taken = max(stream.taken, attempt.taken)
        return answer

    def close(self) -> None:
        """Ends calls under way with ClientClosedError. Closing twice does no harm."""
        self._closed.set()
        if self._warm_up is not None:
            self._warm_up.close()
        self._revival.wake()
        with self._lock:
            closing = discard([self._channel])
            idle = self._calls == 0
        if idle:  # else the call under way does it when it ends
            self._revival.reset()
        closing.join(_CLOSE_WITHIN_S)

    @property
    def access(self) -> Access:
        """How the server is reached."""
        return self._access

    @property
    def filler_bytes(self) -> int:
        """Bytes of filler sent so far, with their frames; 0 without ``warm_up``."""
        return 0 if self._warm_up is None else self._warm_up.sent_bytes

    def _call(self, start: Start, timeout_s: float) -> Any:
        with self._lock:
            self._calls += 1
        try:
            return self._attempts(start, timeout_s)
        finally:
            with self._lock:
                self._calls -= 1
                idle = self._calls == 0
            if idle and self._closed.is_set():
                self._revival.reset()

    def _attempts(self, start: Start, timeout_s: float) -> Any:
        attempts = channel.Attempts(timeout_s)
        while True:
            try:
                answer = self._attempt(start, attempts.remaining_s())
            except TransportError as error:
                if not self._patient:
                    if error.code == "UNAVAILABLE":
                        self._renew()
                    raise
                if self._closed.wait(attempts.pause_s(error)):
                    raise self._closed_error() from error
                self._renew()
            else:
                return answer

    def _attempt(self, start: Start, timeout_s: float) -> Any:
        began = time.monotonic()
        try:
            answer = self._answer(start, began + timeout_s)
        except grpc.FutureTimeoutError:
            self._check_open()
            self._revival.suspect()
            raise channel.unanswered(timeout_s) from None
        except (grpc.RpcError, grpc.FutureCancelledError, ValueError) as error:
            # gRPC raises ValueError for a call on a channel that was closed meanwhile.
            if self._closed.is_set() or not isinstance(error, grpc.RpcError):
                raise self._closed_error() from error
            failure = channel.transport_error(error)
            if channel.is_silence(failure):
                self._revival.suspect()
            raise failure from error
        self._revival.heard(time.monotonic() - began)
        return answer

    def _answer(self, start: Start, deadline: float) -> Any:
        """The answer to a call, over this connection or, where it is silent, over another."""
        self._check_open()
        call = None
        if not self._revival.suspected:
            left_s = deadline - time.monotonic()
            call = start(self._stub(self._channel), left_s, self._access.metadata())
            try:
                return call.result(timeout=min(left_s, self._revival.pace.patience_s))
            except grpc.FutureTimeoutError:
                self._revival.suspect()
        return self._first_answer(call, start, deadline)

    def _first_answer(self, call: Any, start: Start, deadline: float) -> Any:
        """Waits for a call over a connection that may be dead, and makes it over another if it is.

        Args:
            call: under way; None where the connection was suspected before.
            start: makes the call.
            deadline: on ``time.monotonic``; gRPC's own timer may fire late, this one does not.

        Raises:
            grpc.FutureTimeoutError: the time is over.
        """
        current, spare, won = self._channel, None, None
        enough_s = self._revival.pace.enough_s(deadline - time.monotonic())
        calls: dict[grpc.Channel, Any] = {} if call is None else {current: call}
        self._revival.watch(current, calls.values())
        try:
            while (left_s := deadline - time.monotonic()) > 0.0:
                self._check_open()
                done = [over for over, call in calls.items() if call.done()]
                answered = [over for over in done if _succeeded(calls[over])]
                if answered or (done and len(done) == len(calls)):
                    won = (answered or done)[0]
                    return calls[won].result()
                over = None
                if spare is None and left_s >= enough_s:
                    over = spare = self._revival.take_spare()
                # A dead connection is given nothing more: it would be in the way after its revival.
                if over is None and not calls and not self._revival.given_up:
                    over = current
                if over is not None:
                    calls[over] = start(self._stub(over), left_s, self._access.metadata())
                    calls[over].add_done_callback(lambda _: self._revival.wake())
                self._revival.wait(left_s, settled=spare is not None)
            raise grpc.FutureTimeoutError()
        finally:
            if spare is not None and won is current:
                discard([spare])
            elif spare is not None:
                self._replace(spare)
            for other in calls.values():
                other.cancel()

    def _renew(self) -> None:
        if not self._closed.is_set():
            self._replace(self._new_channel())

    def _replace(self, fresh: grpc.Channel) -> None:
        with self._lock:
            stale, self._channel = self._channel, fresh
        if self._closed.is_set():  # closed meanwhile, perhaps before the exchange
            discard([fresh])
        discard([stale])
        self._revival.reset()

    @staticmethod
    def _stub(connection: grpc.Channel) -> policy_pb2_grpc.PolicyServiceStub:
        return policy_pb2_grpc.PolicyServiceStub(connection)

    def _check_open(self) -> None:
        if self._closed.is_set():
            raise self._closed_error()

    def _warmed(self, request_bytes: int) -> AbstractContextManager[None]:
        return nullcontext() if self._warm_up is None else self._warm_up.around(request_bytes)

    def _send_filler(self, message: bytes) -> None:
        with self._lock:
            if self._closed.is_set():
                return
            send: grpc.UnaryUnaryMultiCallable[bytes, bytes]
            send = self._channel.unary_unary("/comvla.v1.PolicyService/GetModel")
        send(message, timeout=_FILLER_TIMEOUT_S, metadata=self._access.metadata())

    def _new_channel(self) -> grpc.Channel:
        return self._access.channel()

    def _closed_error(self) -> ClientClosedError:
        return ClientClosedError(f"the connection to {self.target} was closed: make a new client")


def _unary(method: str, request: Any) -> Start:
    return lambda stub, timeout_s, metadata: getattr(stub, method).future(
        request, timeout=timeout_s, metadata=metadata
    )


def _succeeded(call: Any) -> bool:
    """Whether a call that is over was answered."""
    return not call.cancelled() and call.exception() is None
