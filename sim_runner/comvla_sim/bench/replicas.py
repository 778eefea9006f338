"""What more replicas buy, what Ray's proxy costs, and whether a step is lost when one of them dies.

The same load on one server and on two whose robots take turns, and on one and two of Ray's replicas;
then two, of which one is killed in the middle. Each robot asks one query after another, so throughput
is what the servers give. Latency is that of one robot alone.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from comvla_sim.bench import environment
from comvla_sim.bench.steady_load import call_figures, under_load
from comvla_sim.demo.server_process import ServerProcess, ServerProcessError

OnCase = Callable[[int, int], None]

_NO_RAY = "Ray Serve is not installed: pip install 'comvla[ray]'"


@dataclass(frozen=True)
class ReplicaParameters:
    """The load.

    Attributes:
        seconds: of load in each case.
        clients: robots that ask one query after another.
        token_budget: K of every query.
        deadline_s: of a query.
        model: ``"mini"`` or a checkpoint.
        only: ``plain``, ``ray``, or both where None.
        seed: of the tokens.
    """

    seconds: float = 5.0
    clients: int = 4
    token_budget: int = 32
    deadline_s: float = 5.0
    model: str = "mini"
    only: str | None = None
    seed: int = 0


def run(
    parameters: ReplicaParameters, on_case: OnCase = lambda done, total: None
) -> dict[str, Any]:
    """Measures every case in a row.

    Args:
        parameters: what to run.
        on_case: told of progress.

    Returns:
        An object with ``environment``, ``parameters``, ``rows`` and figures, JSON-able.
    """
    left_out, kinds = [], ["plain", "ray"] if parameters.only is None else [parameters.only]
    if "ray" in kinds and not importlib.util.find_spec("ray"):
        kinds.remove("ray")
        left_out.append(_NO_RAY)
    rows: list[dict[str, Any]] = []
    result: dict[str, Any] = {
        "bench": "replicas",
        "environment": environment.describe(),
        "parameters": asdict(parameters),
        "rows": rows,
        "left_out": left_out,
    }
    total = 4 * len(kinds)
    alone: dict[str, float] = {}
    for kind in kinds:
        serving = _plain if kind == "plain" else _ray
        found = []
        with serving(parameters.model, 1) as (target, _):
            found.append(_case(parameters, f"{kind}, one, one robot", target, clients=1))
            alone[kind] = found[0]["median_s"]
            on_case(len(rows) + 1, total)
            found.append(_case(parameters, f"{kind}, one", target))
            on_case(len(rows) + 2, total)
        with serving(parameters.model, 2) as (target, kill):
            found.append(_case(parameters, f"{kind}, two", target))
            on_case(len(rows) + 3, total)
            found.append(_case(parameters, f"{kind}, two, one killed", target, kill=kill))
            on_case(len(rows) + 4, total)
        rows += found
        result[kind] = {
            "throughput_ratio": found[2]["requests_per_s"] / found[1]["requests_per_s"],
            "lost_steps": found[3]["failed"],
            "failures": found[3].pop("failures"),
        }
        for row in found:
            row.pop("failures", None)
    if len(alone) == 2:
        result["ray_added_s"] = alone["ray"] - alone["plain"]
    return result


def _case(
    parameters: ReplicaParameters,
    name: str,
    target: str,
    *,
    clients: int | None = None,
    kill: Callable[[], None] | None = None,
) -> dict[str, Any]:
    with under_load(
        target,
        clients=clients or parameters.clients,
        token_budget=parameters.token_budget,
        deadline_s=parameters.deadline_s,
        seed=parameters.seed,
    ) as load:
        began = time.monotonic()
        time.sleep(parameters.seconds / 2)
        if kill is not None:
            kill()
        time.sleep(parameters.seconds / 2)
        took_s = time.monotonic() - began
        calls = load.stop()
    answered = sum(not call.failure for call in calls)
    return {
        "name": name,
        "requests_per_s": answered / took_s,
        **call_figures(calls),
        "failures": sorted({call.failure for call in calls if call.failure})[:5],
    }


@contextmanager
def _plain(model: str, count: int) -> Iterator[tuple[str, Callable[[], None]]]:
    """Servers of their own, which robots take turns with."""
    with ExitStack() as stack:
        servers = [stack.enter_context(ServerProcess(model)) for _ in range(count)]
        yield ",".join(server.target for server in servers), servers[-1].kill


@contextmanager
def _ray(model: str, count: int) -> Iterator[tuple[str, Callable[[], None]]]:
    """The command that starts Ray's replicas, in a session of its own."""
    import socket

    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "comvla_server", "ray", "--insecure", "--model", model]
    command += ["--replicas", str(count), "--port", str(port), "--threads", "1"]
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("comvla-server ready "):
                break
        else:
            raise ServerProcessError("Ray's replicas were not ready; their own words are above")
        yield f"127.0.0.1:{port}", lambda: _kill_replica(process.pid)
    finally:
        process.terminate()
        try:
            process.wait(60.0)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


def _kill_replica(root: int) -> None:
    """Kills one replica's process among the descendants of Ray's starter, without a word."""
    for pid in _descendants(root):
        with contextlib.suppress(OSError):
            with open(f"/proc/{pid}/cmdline", "rb") as file:
                words = file.read().replace(b"\0", b" ")
            if b"ServeReplica:comvla" in words:
                os.kill(pid, signal.SIGKILL)
                return
    raise ServerProcessError("none of Ray's replicas was found among the processes")


def _descendants(root: int) -> list[int]:
    parents: dict[int, int] = {}
    for name in os.listdir("/proc"):
        if name.isdigit():
            with (
                contextlib.suppress(OSError, ValueError, IndexError),
                open(f"/proc/{name}/stat") as file,
            ):
                parents[int(name)] = int(file.read().rpartition(")")[2].split()[1])
    found, added = set[int](), {root}
    while added:
        found |= added
        added = {pid for pid, above in parents.items() if above in found} - found
    return sorted(found - {root})
