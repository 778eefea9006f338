"""What most policy servers speak: msgpack with arrays as bytes, over a websocket.

The pattern of openpi-client (a message of metadata on connect, then one observation and one answer at
a time, without compression). Its server half is not on the package index, and its client asks for an
older NumPy; where the client is installed all the same, it is measured against this server too.
"""

from __future__ import annotations

import asyncio
import importlib.util
import logging
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray
from websockets.asyncio.server import ServerConnection
from websockets.asyncio.server import serve as serve_websocket
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from comvla_sim.bench.processes import announce, wait_for_end


def pack(message: Any) -> bytes:
    """msgpack, with arrays as a map of bytes, dtype and shape."""
    packed: bytes = msgpack.packb(message, default=_array_to_map)
    return packed


def unpack(data: bytes | str) -> Any:
    """The message of :func:`pack`."""
    return msgpack.unpackb(data, object_hook=_array_from_map)


def _array_to_map(value: object) -> object:
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    raise TypeError(f"expected numbers, text, bytes or arrays, got {type(value).__name__}")


def _array_from_map(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" not in value:
        return value
    array: NDArray[Any] = np.frombuffer(value[b"data"], np.dtype(value[b"dtype"]))
    return array.reshape(value[b"shape"])


def serve(lifeline: Connection, horizon: int, action_dim: int) -> None:
    """Answers every observation with a chunk of zeros (horizon, action_dim)."""
    logging.getLogger("websockets").setLevel(logging.ERROR)
    asyncio.run(_serve(lifeline, np.zeros((horizon, action_dim), np.float32)))


async def _serve(lifeline: Connection, actions: NDArray[np.float32]) -> None:
    async def answer(connection: ServerConnection) -> None:
        await connection.send(pack({"policy": "none"}))
        try:
            while True:
                unpack(await connection.recv())
                await connection.send(pack({"actions": actions}))
        except ConnectionClosed:
            return

    async with serve_websocket(answer, "127.0.0.1", 0, compression=None, max_size=None) as server:
        port = next(iter(server.sockets)).getsockname()[1]
        announce(lifeline, str(port))
        await asyncio.get_running_loop().run_in_executor(None, wait_for_end, lifeline)


class WebsocketCaller:
    """One robot's connection."""

    def __init__(self, port: int, observation: dict[str, Any]) -> None:
        self._observation = observation
        self._ending = ExitStack()
        self._connection = self._ending.enter_context(
            connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None)
        )
        self._connection.recv()  # metadata

    def call(self) -> NDArray[np.float32]:
        """Sends the observation and returns the actions."""
        self._connection.send(pack(self._observation))
        actions: NDArray[np.float32] = unpack(self._connection.recv())["actions"]
        return actions

    def close(self) -> None:
        """Ends the connection."""
        self._ending.close()


def openpi_caller(port: int, observation: dict[str, Any]) -> Callable[[], object] | None:
    """The same call through openpi-client, or None where it is not installed."""
    if importlib.util.find_spec("openpi_client") is None:
        return None
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    policy = WebsocketClientPolicy("127.0.0.1", port)
    return lambda: policy.infer(observation)["actions"]
