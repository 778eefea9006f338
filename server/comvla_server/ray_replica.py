"""The service as one replica of a Ray Serve deployment: Ray's gRPC proxy brings the calls.

A request stands alone, so any replica answers any step. What a replica remembers of a session is only
there to answer a repeat from the record; on another replica, or after the loss of one, the repeat is
computed again.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from functools import partial
from typing import Any

from comvla.v1 import policy_pb2
from comvla_server import logs
from comvla_server.auth import Authenticator
from comvla_server.bring_up import bring_up
from comvla_server.identity import set_caller
from comvla_server.lifecycle import Lifecycle, Phase
from comvla_server.metrics import Metrics
from comvla_server.model_loading import load_engine
from comvla_server.process import settle, take_turns
from comvla_server.refusals import Refusal
from comvla_server.runtimes import Runtimes
from comvla_server.secret_files import Watcher
from comvla_server.service import PolicyService
from comvla_server.settings import ServerSettings
from comvla_server.statuses import STATUS
from comvla_server.tokens import TokenFile
from comvla_server.tracing import Tracing

_SERVING = b"\x08\x01"  # grpc.health.v1: field 1, SERVING


class Replica:
    """One replica. Its methods are those of the contract, by their names.

    Args:
        settings: as of a server of its own; ports and TLS are Ray's affair.
    """

    def __init__(self, settings: ServerSettings) -> None:
        logs.configure(settings.log_format, settings.log_level)
        logging.getLogger("ray").setLevel(logging.WARNING)
        self._settings = settings
        self._lifecycle = Lifecycle()
        self._metrics = Metrics()
        self._service = PolicyService(
            self._lifecycle, self._metrics, settings, tracing=Tracing.of(settings)
        )
        tokens = settings.tokens_file
        self._tokens = None if tokens is None else TokenFile(tokens, "tokens_file")
        self._authenticator = Authenticator(self._tokens)
        self._ready: asyncio.Task[None] | None = None
        self._watching: asyncio.Task[None] | None = None

    async def check_health(self) -> None:
        """Asked by Ray again and again; a replica counts from the first answer on."""
        await self._bring_up()
        alive = all(runtime.batcher.alive for runtime in self._service.models)
        if not alive:
            raise RuntimeError("the dispatcher has died")

    async def GetModel(
        self, request: policy_pb2.GetModelRequest, grpc_context: Any
    ) -> policy_pb2.GetModelResponse:
        """As the service does."""
        answer: policy_pb2.GetModelResponse
        answer = await self._answer(self._service.GetModel, request, grpc_context)
        return answer

    async def Infer(
        self, request: policy_pb2.InferRequest, grpc_context: Any
    ) -> policy_pb2.InferResponse:
        """As the service does."""
        answer: policy_pb2.InferResponse
        answer = await self._answer(self._service.Infer, request, grpc_context)
        return answer

    async def InferProgressive(
        self, request_stream: AsyncIterator[Any], grpc_context: Any
    ) -> policy_pb2.InferProgressiveResponse:
        """As the service does."""
        answer: policy_pb2.InferProgressiveResponse
        answer = await self._answer(self._service.InferProgressive, request_stream, grpc_context)
        return answer

    async def Check(self, request: Any, grpc_context: Any) -> Any:
        """``grpc.health.v1``: a replica that answers at all serves."""
        from grpc_health.v1 import health_pb2

        return health_pb2.HealthCheckResponse.FromString(_SERVING)

    async def _answer(self, method: Any, request: Any, grpc_context: Any) -> Any:
        await self._bring_up()
        try:
            set_caller(self._authenticator.identify(grpc_context))
        except Refusal as refusal:
            await _Context(grpc_context).abort(STATUS[refusal.reason], refusal.message)
        return await method(request, _Context(grpc_context))

    async def _bring_up(self) -> None:
        if self._ready is None:
            self._ready = asyncio.ensure_future(self._load())
        await asyncio.shield(self._ready)

    async def _load(self) -> None:
        settings = self._settings
        take_turns()
        if self._tokens is not None:
            watcher = Watcher({"tokens": self._tokens}, settings.reload_interval_s, lambda _: None)
            self._watching = asyncio.ensure_future(watcher.run())
        loads = {n: partial(load_engine, settings, s) for n, s in settings.models.items()}
        await bring_up(
            loads,
            self._service.models,
            Runtimes(settings, self._metrics),
            lifecycle=self._lifecycle,
            metrics=self._metrics,
            settings=settings,
        )
        settle()
        self._lifecycle.enter(Phase.SERVING)


class _Context:
    """What the service needs of a call's context, over Ray's."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def time_remaining(self) -> float | None:
        """Nobody tells: Ray's proxy keeps the robot's deadline to itself."""
        return None

    def invocation_metadata(self) -> Any:
        """Headers of the call."""
        return self._context.invocation_metadata()

    async def abort(self, code: Any, message: str, trailing: Any = ()) -> None:
        """Ends the call with a status, which Ray takes from its context when something is raised."""
        self._context.set_code(code)
        self._context.set_details(message)
        self._context.set_trailing_metadata(list(trailing))
        raise CallEndedError(message)


class CallEndedError(Exception):
    """A call that ends with a status of its own; raised to make Ray look at it."""
