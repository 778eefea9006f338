"""What a silence costs the next query, with each remedy and without any.

A chunked policy asks, executes, and asks again: between queries its connection is silent. Every
case here is a link of its own, with a warm connection, on which single queries follow silences.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from comvla import codec
from comvla.model_info import PROTOCOL_VERSION
from comvla.v1.policy_pb2 import InferRequest
from comvla_sim.bench import environment
from comvla_sim.bench.processes import announce, connected
from comvla_sim.netlink.capture import capturing
from comvla_sim.netlink.cloud import SYNTHETIC, cloud_server
from comvla_sim.netlink.link import LinkSettings, NamespaceLink
from comvla_sim.netlink.namespaces import enter
from comvla_sim.netlink.shaper import BURST_SHARE
from comvla_sim.netlink.synthetic import INSTRUCTION, OFT_SIZES

ALLOWED_ROUND_TRIPS = 1.15
_TIMEOUT_S = 30.0
_WARM_QUERIES = 30


@dataclass(frozen=True)
class Case:
    """A remedy.

    Attributes:
        name: for the table.
        needs_root: whether a robot's owner needs root for it.
        congestion_control: of the robot.
        initcwnd: of the robot's route.
        sysctls: of the robot.
        warm_up: whether the client sends filler ahead of each query.
        silence: False is the reference: queries back to back.
    """

    name: str
    needs_root: bool
    congestion_control: str = "cubic"
    initcwnd: int | None = None
    sysctls: dict[str, str | int] = field(default_factory=dict)
    warm_up: bool = False
    silence: bool = True


CASES: tuple[Case, ...] = (
    Case("back to back", False, silence=False),
    Case("no remedy, cubic", False),
    Case("no remedy, reno", False, congestion_control="reno"),
    Case("client's warm_up", False, warm_up=True),
    Case("slow_start_after_idle=0", True, sysctls={"tcp_slow_start_after_idle": 0}),
    Case("route with initcwnd 64", True, initcwnd=64),
    Case("bbr", True, congestion_control="bbr"),
)


@dataclass(frozen=True)
class IdleParameters:
    """The link and the queries.

    Attributes:
        token_budget: K; 32 INT8 tokens of the paper's width are 68 KiB.
        repetitions: timed queries of each case.
        silence_s: before each.
        delay_ms: one-way delay, milliseconds.
        mbit_per_s: rate of the link: the paper's at 10 dB.
    """

    token_budget: int = 32
    repetitions: int = 20
    silence_s: float = 1.2
    delay_ms: float = 20.0
    mbit_per_s: float = 26.3


def run(
    parameters: IdleParameters,
    cases: Sequence[Case] = CASES,
    on_case: Callable[[str], None] = lambda name: None,
) -> dict[str, Any]:
    """Measures every case.

    Returns:
        ``environment``, ``parameters``, what a query may take, and ``rows``, JSON-able.

    Raises:
        LinkError: without root.
    """
    rows = []
    for case in cases:
        on_case(case.name)
        rows.append(_measure(parameters, case))
    round_trip_s = 2e-3 * parameters.delay_ms
    serialisation_s = _serialisation_s(parameters)
    return {
        "bench": "idle",
        "environment": environment.describe(),
        "parameters": asdict(parameters),
        "round_trip_s": round_trip_s,
        "serialisation_s": serialisation_s,
        "allowed_s": ALLOWED_ROUND_TRIPS * round_trip_s + serialisation_s,
        "rows": [
            {**row, "round_trips": (row["median_s"] - serialisation_s) / round_trip_s}
            for row in rows
        ],
    }


def _measure(parameters: IdleParameters, case: Case) -> dict[str, Any]:
    settings = LinkSettings(
        delay_s=parameters.delay_ms / 1e3,
        congestion_control=case.congestion_control,
        initcwnd=case.initcwnd,
        sysctls=case.sysctls,
    )
    silence_s = parameters.silence_s if case.silence else 0.0
    with (
        NamespaceLink(settings) as link,
        cloud_server(link.cloud, SYNTHETIC) as target,
        capturing(link.robot_end) as capture,
        connected(_serve_robot, link.robot, target, parameters.token_budget, case.warm_up) as (
            robot,
            _,
        ),
    ):
        link.shape(parameters.mbit_per_s * 1e6 / 8)
        _ask(robot, _WARM_QUERIES, 0.0)
        if case.warm_up:
            _ask(robot, 3, silence_s)  # it learns the rhythm
        before, _ = capture.counts()
        answer = _ask(robot, parameters.repetitions, silence_s)
        time.sleep(0.1)
        after, _ = capture.counts()
    durations_s = answer["durations_s"]
    return {
        "name": case.name,
        "needs_root": case.needs_root,
        "repetitions": len(durations_s),
        "median_s": statistics.median(durations_s),
        "p90_s": float(np.quantile(durations_s, 0.9)),
        "worst_s": max(durations_s),
        "bytes_per_query": (after.bytes - before.bytes) / len(durations_s),
        "durations_s": durations_s,
    }


def _serialisation_s(parameters: IdleParameters) -> float:
    """Time that the link needs for a query's bytes, less what the bucket holds after a silence."""
    nbytes = codec.request_wire_bytes(
        parameters.token_budget,
        OFT_SIZES.token_dim,
        "int8",
        num_towers=len(OFT_SIZES.tower_dims),
        session_id="robot.00000000.0",
        step=100,
        instruction=INSTRUCTION,
        proprio_dim=OFT_SIZES.proprio_dim,
        model_fingerprint=OFT_SIZES.fingerprint,
        tcp_ip=True,
    )
    rate = parameters.mbit_per_s * 1e6 / 8
    return nbytes / rate - BURST_SHARE * LinkSettings().profile.period_s


def _ask(robot: Connection, queries: int, silence_s: float) -> dict[str, Any]:
    robot.send_bytes(json.dumps([queries, silence_s]).encode())
    answer: dict[str, Any] = json.loads(robot.recv_bytes())
    return answer


def _serve_robot(
    lifeline: Connection, namespace: str, target: str, token_budget: int, warm_up: bool
) -> None:
    enter(namespace)
    from comvla_client.transport import GrpcTransport

    rng = np.random.default_rng(0)
    tokens = rng.standard_normal((token_budget, OFT_SIZES.token_dim), np.float32)
    positions = rng.permutation(OFT_SIZES.num_tokens)[:token_budget]
    payload = codec.encode(tokens, positions, "int8", tower_dims=OFT_SIZES.tower_dims)
    step = 0
    with contextlib.closing(GrpcTransport(target, warm_up=warm_up)) as transport:
        announce(lifeline, "robot")
        for queries, silence_s in _questions(lifeline):
            durations_s = []
            for _ in range(queries):
                time.sleep(silence_s)
                request = InferRequest(
                    session_id="robot.00000000.0",
                    step=step,
                    instruction=INSTRUCTION,
                    proprio=[0.5] * OFT_SIZES.proprio_dim,
                    payload=payload,
                    model_fingerprint=OFT_SIZES.fingerprint,
                    protocol_version=PROTOCOL_VERSION,
                    snr_db=10.0,
                    snr_age_s=0.01,
                )
                began = time.perf_counter()
                transport.infer(request, _TIMEOUT_S)
                durations_s.append(time.perf_counter() - began)
                step += 1
            lifeline.send_bytes(json.dumps({"durations_s": durations_s}).encode())


def _questions(lifeline: Connection) -> Iterator[tuple[int, float]]:
    while True:
        try:
            queries, silence_s = json.loads(lifeline.recv_bytes())
        except EOFError:
            return
        yield int(queries), float(silence_s)
