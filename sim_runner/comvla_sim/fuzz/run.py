"""A whole run: processes, phases, and the verdict."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import time
import urllib.request
from collections.abc import Callable
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, cast

import grpc

from comvla.errors import ComVLAError
from comvla.v1 import policy_pb2_grpc
from comvla_sim.bench import environment
from comvla_sim.bench.processes import ProcessError, connected
from comvla_sim.fuzz import connections, over_socket
from comvla_sim.fuzz.cases import DESCRIPTIONS, Case
from comvla_sim.fuzz.in_process import Share, run_one, work, wrong_with
from comvla_sim.fuzz.mutations import payload
from comvla_sim.fuzz.outcome import Tally
from comvla_sim.fuzz.supervised import SupervisedServer
from comvla_sim.fuzz.target import valid_request
from comvla_sim.fuzz.watch import Watch

# Of a limited time, the part of the cases in process.
_IN_PROCESS_SHARE = 0.55
# Of what is left, the part of the calls; the rest is for connections of frames.
_CALLS_SHARE = 0.65
_SETTLES_WITHIN_S = 15.0

OnProgress = Callable[[int, int], None]


class FuzzError(ComVLAError, ValueError):
    """A run that makes no sense."""


@dataclass(frozen=True)
class FuzzParameters:
    """What to run.

    Attributes:
        requests: how many cases.
        seed: of all of them.
        seconds: after which no case begins; None for no limit.
        processes: that work in process at the same time.
        only: a single case instead of all.
    """

    requests: int = 10_000
    seed: int = 0
    seconds: float | None = None
    processes: int = min(2, os.cpu_count() or 1)
    only: int | None = None


def run(
    parameters: FuzzParameters, on_progress: OnProgress = lambda done, total: None
) -> dict[str, Any]:
    """Runs all cases, or one, and says what happened.

    Returns:
        JSON: counts by kind and status, failures, memory and descriptors, and ``passed``.
    """
    began_s = time.monotonic()
    tally, watches = Tally(), []
    if parameters.only is not None:
        _run_only(Case(parameters.seed, parameters.only), tally)
    else:
        progress = _Progress(parameters.requests, on_progress)
        watches += _in_process(parameters, tally, progress)
        try:
            watches += _over_socket(parameters, tally, progress)
        except ProcessError as error:  # what was counted before stays
            tally.fail("over sockets", "server", f"did not start: {error}")
    memory = [watch.verdict() for watch in watches]
    counts = tally.to_dict()
    return {
        "bench": "fuzz",
        "environment": environment.describe(),
        "parameters": asdict(parameters),
        "requests": sum(tally.kinds.values()),
        "wall_s": round(time.monotonic() - began_s, 1),
        "rows": [
            {"name": kind, "requests": tally.kinds[kind], "ended": _ends(counts, kind)}
            for kind in DESCRIPTIONS
            if tally.kinds[kind]
        ],
        **counts,
        "known_ends": counts["statuses"].get("frames", {}).get(connections.KNOWN_END, 0),
        "grpcio": grpc.__version__,
        "memory": memory,
        "passed": bool(tally.kinds)
        and not tally.failed
        and not any(item["grew"] for item in memory),
    }


def _ends(counts: dict[str, Any], kind: str) -> str:
    ends = sorted(counts["statuses"][kind].items(), key=lambda item: -item[1])
    return ", ".join(f"{name} {count}" for name, count in ends)


class _Progress:
    """Joins what several processes have done."""

    def __init__(self, total: int, on_progress: OnProgress) -> None:
        self._total = total
        self._on_progress = on_progress
        self._done: dict[object, int] = {}

    def note(self, who: object, done: int) -> None:
        """So many are over there."""
        self._done[who] = done
        self._on_progress(sum(self._done.values()), self._total)


def _run_only(case: Case, tally: Tally) -> None:
    if case.in_process:
        tally.add(run_one(case).to_dict())
        return
    kind = connections if case.kind == "frames" else over_socket
    with SupervisedServer() as server:
        asyncio.run(kind.run([case], server, tally, lambda done: None))
        _require_well(server, tally)


def _in_process(parameters: FuzzParameters, tally: Tally, progress: _Progress) -> list[Watch]:
    until_s = math.inf
    if parameters.seconds is not None:
        until_s = time.time() + _IN_PROCESS_SHARE * parameters.seconds
    watches = []
    with contextlib.ExitStack() as stack:
        running: dict[Connection, tuple[Share, Watch]] = {}
        for index in range(parameters.processes):
            share = Share(
                parameters.seed, 0, parameters.requests, index, parameters.processes, until_s
            )
            lifeline, pid = stack.enter_context(connected(work, share))
            watch = Watch(f"in process {index + 1}", int(pid))
            watches.append(watch)
            running[lifeline] = share, watch
        at = dict.fromkeys(running, 0)
        while running:
            for ready in wait(list(running)):
                lifeline = cast(Connection, ready)
                share, watch = running[lifeline]
                try:
                    said = json.loads(lifeline.recv_bytes())
                except (EOFError, OSError):
                    del running[lifeline]
                    tally.fail(
                        f"{share.seed}:{at[lifeline]} or soon after",
                        "in process",
                        "the process crashed: its last words are above",
                    )
                    continue
                if "tally" in said:
                    tally.add(said["tally"])
                    del running[lifeline]
                else:
                    at[lifeline] = said["at"]
                    progress.note(share.index, said["done"])
                    watch.look(said["share"])
    return watches


def _over_socket(parameters: FuzzParameters, tally: Tally, progress: _Progress) -> list[Watch]:
    """Calls to one server, then frames to it, which may end it: another takes its place."""
    cases = [
        case
        for case in (Case(parameters.seed, n) for n in range(parameters.requests))
        if not case.in_process
    ]
    calls = [case for case in cases if case.kind != "frames"]
    frames = [case for case in cases if case.kind == "frames"]
    began_s = time.monotonic()
    left_s = math.inf
    if parameters.seconds is not None:
        left_s = (1 - _IN_PROCESS_SHARE) * parameters.seconds
    before = 0

    with SupervisedServer() as server:

        def tell(done: int) -> None:
            progress.note("socket", before + done)
            share = (before + done) / max(1, len(cases))
            server.look(min(1.0, max(share, (time.monotonic() - began_s) / left_s)))

        asyncio.run(over_socket.run(calls, server, tally, tell, began_s + _CALLS_SHARE * left_s))
        _require_well(server, tally)
        if server.ended() is not None:
            server.restart()
        before = len(calls)
        asyncio.run(connections.run(frames, server, tally, tell, began_s + left_s))
        _settle(server.watches[-1])
        _require_well(server, tally)
    return server.watches


def _require_well(server: SupervisedServer, tally: Tally) -> None:
    what = _unwell(server.target, server.admin_url)
    if what:
        tally.fail("afterwards", "server", what)


def _unwell(target: str, admin_url: str) -> str:
    """What is wrong with a server; empty where it answers a valid request, and blames itself for nothing."""
    request = valid_request("afterwards", 0, payload(8, "float32"))
    try:
        with grpc.insecure_channel(target) as channel:
            response = policy_pb2_grpc.PolicyServiceStub(channel).Infer(request, timeout=30.0)
        with urllib.request.urlopen(f"{admin_url}/metrics", timeout=30.0) as page:
            metrics = page.read().decode()
    except (grpc.RpcError, OSError) as error:
        return f"does not answer any more: {error}"
    for line in (
        "comvla_model_errors_total 0.0",
        'comvla_requests_dropped_total{reason="model"} 0.0',
    ):
        if line not in metrics:
            return f"expected {line} in its metrics"
    return wrong_with(response, request)


def _settle(watch: Watch) -> None:
    """Lets connections that were cut off go, and takes the last sample."""
    until_s = time.monotonic() + _SETTLES_WITHIN_S
    watch.look(1.0)
    while watch.verdict()["grew"] and time.monotonic() < until_s:
        time.sleep(0.2)
        watch.look(1.0)
