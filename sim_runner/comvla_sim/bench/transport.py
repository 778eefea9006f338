"""One round trip of a step: 68 KiB of tokens up, one KiB of actions down, on loopback.

Contenders: raw TCP, which is the limit; gRPC that carries bytes and does nothing else; msgpack over a
websocket, which most policy servers speak; and this project's whole call, with the real server's
validation, codec, queue and batcher around a model that answers at once.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from comvla import codec
from comvla.model_info import PROTOCOL_VERSION
from comvla.v1 import policy_pb2
from comvla_client.transport import GrpcTransport
from comvla_sim.bench import environment, grpc_bytes, policy_server, raw_tcp, websocket_msgpack
from comvla_sim.bench.policy_server import NO_MODEL
from comvla_sim.bench.processes import serving
from comvla_sim.bench.timing import measure

_TIMEOUT_S = 30.0
_CHUNK_BYTES = NO_MODEL.action_horizon * NO_MODEL.action_dim * 4


@dataclass(frozen=True)
class TransportParameters:
    """Size and number of the round trips.

    Attributes:
        token_budget: K; 32 INT8 tokens of D = 2176 are 68 KiB.
        repetitions: timed calls of each contender.
        warm_up: calls before them.
    """

    token_budget: int = 32
    repetitions: int = 2000
    warm_up: int = 200


def run(parameters: TransportParameters) -> dict[str, Any]:
    """Measures all contenders in turns, each against its own server process.

    Returns:
        An object with ``environment``, ``parameters`` and ``rows``, JSON-able.
    """
    rng = np.random.default_rng(0)
    tokens = rng.standard_normal((parameters.token_budget, NO_MODEL.token_dim), np.float32)
    positions = rng.permutation(NO_MODEL.num_tokens)[: parameters.token_budget]
    payload = codec.encode(tokens, positions, "int8", tower_dims=NO_MODEL.tower_dims)
    with ExitStack() as stack:
        calls: dict[str, Callable[[], object]] = {
            "raw TCP": stack.enter_context(_tcp(payload)),
            "gRPC, bytes only": stack.enter_context(_grpc_bytes(payload)),
        }
        calls.update(stack.enter_context(_websockets(payload)))
        calls["ComVLA Infer"] = stack.enter_context(_comvla(payload))
        timings = measure(calls, repetitions=parameters.repetitions, warm_up=parameters.warm_up)
    limit = timings["raw TCP"]
    websocket = timings["websocket + msgpack"]
    return {
        "bench": "transport",
        "environment": environment.describe(),
        "parameters": {
            **asdict(parameters),
            "payload_bytes": codec.payload_bytes(
                parameters.token_budget, NO_MODEL.token_dim, "int8"
            ),
            "encoded_bytes": len(payload),
            "response_bytes": _CHUNK_BYTES,
        },
        "rows": [
            {
                "name": name,
                **asdict(timing),
                "ratio_to_tcp": timing.median_s / limit.median_s,
                "p99_ratio_to_tcp": timing.p99_s / limit.p99_s,
                "ratio_to_websocket": timing.median_s / websocket.median_s,
            }
            for name, timing in timings.items()
        ],
    }


@contextmanager
def _tcp(payload: bytes) -> Iterator[Callable[[], object]]:
    with (
        serving(raw_tcp.serve, _CHUNK_BYTES) as port,
        closing(raw_tcp.TcpCaller(int(port), payload, _CHUNK_BYTES)) as caller,
    ):
        yield caller.call


@contextmanager
def _grpc_bytes(payload: bytes) -> Iterator[Callable[[], object]]:
    with (
        serving(grpc_bytes.serve, _CHUNK_BYTES) as target,
        closing(grpc_bytes.BytesCaller(target, payload)) as caller,
    ):
        yield caller.call


@contextmanager
def _websockets(payload: bytes) -> Iterator[dict[str, Callable[[], object]]]:
    observation = {
        "tokens": np.frombuffer(payload, np.uint8),
        "state": np.zeros(NO_MODEL.proprio_dim, np.float32),
        "prompt": "put the bowl on the plate",
    }
    shape = (NO_MODEL.action_horizon, NO_MODEL.action_dim)
    with (
        serving(websocket_msgpack.serve, *shape) as port,
        closing(websocket_msgpack.WebsocketCaller(int(port), observation)) as caller,
    ):
        calls: dict[str, Callable[[], object]] = {"websocket + msgpack": caller.call}
        if openpi := websocket_msgpack.openpi_caller(int(port), observation):
            calls["openpi-client"] = openpi
        yield calls


@contextmanager
def _comvla(payload: bytes) -> Iterator[Callable[[], object]]:
    steps = itertools.count()
    with serving(policy_server.serve, "none", 8, 0) as addresses:
        target = addresses.split()[0]
        with closing(GrpcTransport(target)) as transport:

            def call() -> policy_pb2.InferResponse:
                request = policy_pb2.InferRequest(
                    session_id="bench",
                    step=next(steps),
                    instruction="put the bowl on the plate",
                    proprio=[0.0] * NO_MODEL.proprio_dim,
                    payload=payload,
                    model_fingerprint=NO_MODEL.fingerprint,
                    protocol_version=PROTOCOL_VERSION,
                )
                return transport.infer(request, _TIMEOUT_S)

            yield call
