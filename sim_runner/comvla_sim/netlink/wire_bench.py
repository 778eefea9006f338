"""Accounted bytes against captured ones: every K, every quantization, at the IP layer.

A query's bytes on the wire are all IP packets that leave the robot from its beginning until the next
query's: request, HTTP/2 control frames, and the acknowledgement of the answer. Packets that are sent
again because one was lost or late are shown apart.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from comvla import codec
from comvla.model_info import PROTOCOL_VERSION
from comvla.v1.policy_pb2 import InferRequest
from comvla_sim.bench import environment
from comvla_sim.bench.processes import announce, connected
from comvla_sim.netlink.capture import Capture, capturing
from comvla_sim.netlink.cloud import SYNTHETIC, cloud_server
from comvla_sim.netlink.link import LinkSettings, NamespaceLink
from comvla_sim.netlink.namespaces import enter
from comvla_sim.netlink.synthetic import INSTRUCTION, OFT_SIZES

SESSION = "robot.00000000.0"
_TIMEOUT_S = 30.0
# Longer than Linux keeps back an acknowledgement (40 ms): what a query caused has then passed.
_QUIET_S = 0.06


@dataclass(frozen=True)
class WireParameters:
    """What is sent, and over which link.

    Attributes:
        token_budgets: K of each query.
        quantizations: how values are coded.
        delay_ms: one-way delay, milliseconds.
        mbit_per_s: rate of the link; 0 for as fast as the machine.
        mtu_bytes: largest IP packet.
    """

    token_budgets: Sequence[int] = range(1, 513)
    quantizations: Sequence[str] = codec.QUANTIZATIONS
    delay_ms: float = 0.0
    mbit_per_s: float = 0.0
    mtu_bytes: int = 1500


def run(
    parameters: WireParameters, on_query: Callable[[int, int], None] = lambda done, total: None
) -> dict[str, Any]:
    """Sends one query for each K and quantization and compares.

    Args:
        parameters: what to send.
        on_query: told of progress: queries done, and of how many.

    Returns:
        ``environment``, ``parameters``, ``rows`` (one for each quantization: worst cases) and
        ``queries`` (one for each query), JSON-able.

    Raises:
        LinkError: without root.
    """
    settings = LinkSettings(delay_s=parameters.delay_ms / 1e3, mtu_bytes=parameters.mtu_bytes)
    total = len(parameters.quantizations) * len(parameters.token_budgets)
    queries: list[dict[str, Any]] = []
    with (
        NamespaceLink(settings) as link,
        cloud_server(link.cloud, SYNTHETIC) as target,
        capturing(link.robot_end) as capture,
        connected(_serve_robot, link.robot, target) as (robot, _),
    ):
        if parameters.mbit_per_s:
            link.shape(parameters.mbit_per_s * 1e6 / 8)
        _ask(robot, 1, "int8")  # a connection in use: the first call also names itself
        time.sleep(_QUIET_S)
        for quantization in parameters.quantizations:
            for k in parameters.token_budgets:
                queries.append(_compare(capture, robot, k, quantization, parameters.mtu_bytes))
                on_query(len(queries), total)
        lost = capture.result().lost
    return {
        "bench": "wire",
        "environment": environment.describe(),
        "parameters": {
            **asdict(parameters),
            "token_budgets": list(parameters.token_budgets),
            "quantizations": list(parameters.quantizations),
        },
        "packets_missed_by_capture": lost,
        "rows": [_worst(name, queries) for name in parameters.quantizations],
        "queries": queries,
    }


def accounted_bytes(k: int, quantization: str, *, step: int, mtu_bytes: int = 1500) -> int:
    """What the accounting says of one of these queries."""
    return codec.request_wire_bytes(
        k,
        OFT_SIZES.token_dim,
        quantization,
        num_towers=len(OFT_SIZES.tower_dims),
        session_id=SESSION,
        step=step,
        instruction=INSTRUCTION,
        proprio_dim=OFT_SIZES.proprio_dim,
        model_fingerprint=OFT_SIZES.fingerprint,
        tcp_ip=True,
        mtu_bytes=mtu_bytes,
    )


def _compare(
    capture: Capture, robot: Connection, k: int, quantization: str, mtu_bytes: int
) -> dict[str, Any]:
    before, _ = capture.counts()
    step = _ask(robot, k, quantization)
    time.sleep(_QUIET_S)
    after, _ = capture.counts()
    repeated = after.repeated_bytes - before.repeated_bytes
    captured = after.bytes - before.bytes - repeated
    accounted = accounted_bytes(k, quantization, step=step, mtu_bytes=mtu_bytes)
    return {
        "k": k,
        "quantization": quantization,
        "accounted_bytes": accounted,
        "captured_bytes": captured,
        "packets": after.packets - before.packets,
        "acknowledgement_bytes": after.empty_bytes - before.empty_bytes,
        "repeated_bytes": repeated,
        "over": accounted / captured - 1.0,
    }


def _worst(quantization: str, queries: list[dict[str, Any]]) -> dict[str, Any]:
    own = [query for query in queries if query["quantization"] == quantization]
    return {
        "name": quantization,
        "queries": len(own),
        "under": sum(query["over"] < 0 for query in own),
        "least_over_percent": 100 * min(query["over"] for query in own),
        "most_over_percent": 100 * max(query["over"] for query in own),
        "repeated_bytes": sum(query["repeated_bytes"] for query in own),
        "captured_bytes": sum(query["captured_bytes"] for query in own),
        "accounted_bytes": sum(query["accounted_bytes"] for query in own),
    }


def _ask(robot: Connection, k: int, quantization: str) -> int:
    robot.send_bytes(json.dumps([k, quantization]).encode())
    return int(robot.recv_bytes())


def _serve_robot(lifeline: Connection, namespace: str, target: str) -> None:
    enter(namespace)
    from comvla_client.transport import GrpcTransport

    rng = np.random.default_rng(0)
    tokens = rng.standard_normal((OFT_SIZES.num_tokens, OFT_SIZES.token_dim), np.float32)
    positions = rng.permutation(OFT_SIZES.num_tokens)
    with contextlib.closing(GrpcTransport(target)) as transport:
        announce(lifeline, "robot")
        for step, (k, quantization) in enumerate(_questions(lifeline)):
            request = InferRequest(
                session_id=SESSION,
                step=step,
                instruction=INSTRUCTION,
                proprio=[0.5] * OFT_SIZES.proprio_dim,
                payload=codec.encode(
                    tokens[:k], positions[:k], quantization, tower_dims=OFT_SIZES.tower_dims
                ),
                model_fingerprint=OFT_SIZES.fingerprint,
                protocol_version=PROTOCOL_VERSION,
                snr_db=10.0,
                snr_age_s=0.01,
            )
            # A client's deadline is what is left of a step's: never twice the same.
            transport.infer(request, _TIMEOUT_S - 1e-3 * (step % 997))
            lifeline.send_bytes(str(step).encode())


def _questions(lifeline: Connection) -> Iterator[tuple[int, str]]:
    while True:
        try:
            k, quantization = json.loads(lifeline.recv_bytes())
        except EOFError:
            return
        yield int(k), str(quantization)
