"""gRPC that carries bytes and does nothing else: what the transport itself costs, without a contract."""

from __future__ import annotations

import asyncio
from multiprocessing.connection import Connection

import grpc

from comvla_sim.bench.processes import announce, wait_for_end

_SERVICE = "bench.Bytes"
_METHOD = "Exchange"
_TIMEOUT_S = 30.0


def serve(lifeline: Connection, response_bytes: int) -> None:
    """Answers every message with ``response_bytes`` bytes, on asyncio like the real server."""
    asyncio.run(_serve(lifeline, bytes(response_bytes)))


async def _serve(lifeline: Connection, response: bytes) -> None:
    async def exchange(request: bytes, context: object) -> bytes:
        return response

    server = grpc.aio.server()
    handlers: dict[str, grpc.RpcMethodHandler[bytes, bytes]] = {
        _METHOD: grpc.unary_unary_rpc_method_handler(exchange)
    }
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(_SERVICE, handlers),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    announce(lifeline, f"127.0.0.1:{port}")
    await asyncio.get_running_loop().run_in_executor(None, wait_for_end, lifeline)
    await server.stop(grace=None)


class BytesCaller:
    """One robot's connection."""

    def __init__(self, target: str, payload: bytes) -> None:
        self._payload = payload
        self._channel = grpc.insecure_channel(target)
        self._exchange: grpc.UnaryUnaryMultiCallable[bytes, bytes] = self._channel.unary_unary(
            f"/{_SERVICE}/{_METHOD}"
        )

    def call(self) -> int:
        """Sends the payload and returns the size of the answer in bytes."""
        return len(self._exchange(self._payload, timeout=_TIMEOUT_S))

    def close(self) -> None:
        """Ends the connection."""
        self._channel.close()
