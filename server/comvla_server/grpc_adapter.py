"""The service on a grpc.aio server: options, tolerant parsing, health, reflection."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from typing import Any

import grpc
from google.protobuf.message import DecodeError
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from comvla import codec
from comvla.v1 import policy_pb2
from comvla_server.service import PolicyService
from comvla_server.settings import ServerSettings
from comvla_server.statuses import STATUS

SERVICE_NAME = policy_pb2.DESCRIPTOR.services_by_name["PolicyService"].full_name

# The service refuses messages above max_request_bytes with words; gRPC itself refuses, before it
# allocates, those that are larger still.
_WORDS_UP_TO = 1.125


@dataclass(frozen=True)
class _Malformed:
    """Bytes that are no message of the contract."""

    size_bytes: int


def make_grpc_server(
    settings: ServerSettings, interceptors: Sequence[grpc.aio.ServerInterceptor] = ()
) -> grpc.aio.Server:
    """A grpc.aio server with this project's limits and keepalive; needs a running event loop."""
    return grpc.aio.server(
        interceptors=interceptors,
        options=server_options(settings),
        maximum_concurrent_rpcs=settings.max_concurrent_calls,
    )


def server_options(settings: ServerSettings) -> list[tuple[str, int]]:
    """gRPC channel arguments of the server.

    Clients ping every 10 s, with or without calls. gRPC's default is to end a connection that pings
    more often than every five minutes (GOAWAY, too_many_pings), hence ``min_ping_interval_s``.
    """
    return [
        *codec.GRPC_OPTIONS,
        # Two servers on one port would silently share its robots.
        ("grpc.so_reuseport", 0),
        ("grpc.max_receive_message_length", int(_WORDS_UP_TO * settings.max_request_bytes)),
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.min_ping_interval_without_data_ms", _ms(settings.min_ping_interval_s)),
        # The server's own pings find robots that vanished without a word, idle ones too.
        ("grpc.keepalive_time_ms", 30_000),
        ("grpc.keepalive_timeout_ms", 10_000),
        ("grpc.http2.max_pings_without_data", 0),
        # What strangers can hold on to: connections, handshakes, streams, headers, each bounded.
        ("grpc.max_allowed_incoming_connections", settings.max_connections),
        ("grpc.server_handshake_timeout_ms", _ms(settings.handshake_timeout_s)),
        ("grpc.max_concurrent_streams", settings.max_calls_per_connection),
        ("grpc.max_connection_idle_ms", _ms(settings.connection_idle_s)),
        ("grpc.max_connection_age_ms", _ms(settings.connection_age_s)),
        ("grpc.max_connection_age_grace_ms", _ms(max(settings.grace_s, 1.0))),
        # Between the two gRPC refuses some at random; here there is no between.
        ("grpc.max_metadata_size", settings.max_metadata_bytes),
        ("grpc.absolute_max_metadata_size", settings.max_metadata_bytes),
    ]


def _ms(seconds: float) -> int:
    return min(2**31 - 1, max(1, round(1000 * seconds)))


def add_policy_service(server: grpc.aio.Server, service: PolicyService) -> None:
    """Registers the service so that unparseable bytes are answered INVALID_ARGUMENT.

    gRPC would answer them with an internal error and a stack trace in the log.
    """

    async def infer(
        request: policy_pb2.InferRequest | _Malformed,
        context: grpc.aio.ServicerContext[Any, Any],
    ) -> policy_pb2.InferResponse:
        if isinstance(request, _Malformed):
            refusal = service.note_malformed(request.size_bytes)
            await context.abort(STATUS[refusal.reason], refusal.message)
        return await service.Infer(request, context)

    async def infer_progressive(
        messages: AsyncIterator[Any], context: grpc.aio.ServicerContext[Any, Any]
    ) -> policy_pb2.InferProgressiveResponse:
        return await service.InferProgressive(messages, context)

    async def get_model(
        request: policy_pb2.GetModelRequest | _Malformed,
        context: grpc.aio.ServicerContext[Any, Any],
    ) -> policy_pb2.GetModelResponse:
        # Nothing in the request matters for the answer, so a broken one gets it as well.
        if isinstance(request, _Malformed):
            request = policy_pb2.GetModelRequest()
        return await service.GetModel(request, context)

    handlers = {
        "Infer": grpc.unary_unary_rpc_method_handler(
            infer,
            request_deserializer=_parser(policy_pb2.InferRequest),
            response_serializer=policy_pb2.InferResponse.SerializeToString,
        ),
        "InferProgressive": grpc.stream_unary_rpc_method_handler(
            infer_progressive,
            request_deserializer=_parser(policy_pb2.InferProgressiveRequest),
            response_serializer=policy_pb2.InferProgressiveResponse.SerializeToString,
        ),
        "GetModel": grpc.unary_unary_rpc_method_handler(
            get_model,
            request_deserializer=_parser(policy_pb2.GetModelRequest),
            response_serializer=policy_pb2.GetModelResponse.SerializeToString,
        ),
    }
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE_NAME, handlers),))


def _parser(message: Any) -> Any:
    def parse(data: bytes) -> Any:
        try:
            return message.FromString(data)
        except DecodeError:
            return _Malformed(len(data))

    return parse


class HealthReporter:
    """``grpc.health.v1`` for the whole server and for the policy service."""

    def __init__(self) -> None:
        self._servicer = health.aio.HealthServicer()

    async def register(self, server: grpc.aio.Server) -> None:
        """Adds the health service, NOT_SERVING, and reflection over everything."""
        await self._set(health_pb2.HealthCheckResponse.NOT_SERVING)
        health_pb2_grpc.add_HealthServicer_to_server(self._servicer, server)
        names = (SERVICE_NAME, health.SERVICE_NAME, reflection.SERVICE_NAME)
        reflection.enable_server_reflection(names, server)

    async def serving(self) -> None:
        """From now on SERVING."""
        await self._set(health_pb2.HealthCheckResponse.SERVING)

    async def draining(self) -> None:
        """NOT_SERVING for good."""
        await self._servicer.enter_graceful_shutdown()

    async def _set(self, status: Any) -> None:
        for name in ("", SERVICE_NAME):
            await self._servicer.set(name, status)
