"""Hot swap under load: robots ask as fast as they are answered while the model is replaced again and again.

The server swaps between a checkpoint and a copy of it whose action head was changed a little, so that
the answers tell which of both gave them, and robots with the edge half of the first fit both. What
counts is the number of calls that failed: none may.
"""

from __future__ import annotations

import json
import tempfile
import time
import urllib.request
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from comvla_sim.bench import environment
from comvla_sim.bench.steady_load import Answered, call_figures, under_load
from comvla_sim.demo.server_process import ServerProcess

OnSwap = Callable[[int, int], None]

_TIMEOUT_S = 60.0
_CHANGE = 0.01


@dataclass(frozen=True)
class SwapParameters:
    """The load and the swaps.

    Attributes:
        swaps: of the model under load.
        clients: robots that ask one query after another.
        between_s: seconds of load before each swap and after the last.
        token_budget: K of every query.
        deadline_s: of a query; one that is answered later has failed.
        model: ``"mini"`` or a whole checkpoint of this project's own.
        seed: of the tokens.
    """

    swaps: int = 6
    clients: int = 4
    between_s: float = 2.0
    token_budget: int = 32
    deadline_s: float = 1.0
    model: str = "mini"
    seed: int = 0


def run(parameters: SwapParameters, on_swap: OnSwap = lambda done, total: None) -> dict[str, Any]:
    """Swaps under load.

    Args:
        parameters: what to run.
        on_swap: told of progress.

    Returns:
        An object with ``environment``, ``parameters``, ``rows`` and figures, JSON-able.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="comvla-swap-")))
        changed = changed_copy(parameters.model, folder / "changed")
        token, tokens = operator_token(folder)
        server = stack.enter_context(
            ServerProcess(parameters.model, options=["--admin-tokens-file", str(tokens)])
        )
        load = stack.enter_context(
            under_load(
                server.target,
                clients=parameters.clients,
                token_budget=parameters.token_budget,
                deadline_s=parameters.deadline_s,
                seed=parameters.seed,
            )
        )
        memory, reports, spans = [resident_bytes(server.pid)], [], []
        for number in range(parameters.swaps):
            time.sleep(parameters.between_s)
            source = parameters.model if number % 2 else str(changed)
            began = time.monotonic()
            reports.append(order_swap(server.admin_url, token, source))
            spans.append((began, time.monotonic()))
            memory.append(resident_bytes(server.pid))
            on_swap(number + 1, parameters.swaps)
        time.sleep(parameters.between_s)
        calls, distinct = load.stop(), load.distinct_answers
    return _result(parameters, calls, distinct, reports, spans, memory)


def changed_copy(source: str, folder: Path) -> Path:
    """A copy of a whole checkpoint with other weights in its action head, and the same edge half."""
    import torch

    from comvla_vla import load_cloud, load_edge, save_policy
    from comvla_vla.checkpoints import locate, open_checkpoint

    edge, cloud = load_edge(source), load_cloud(source)
    with torch.no_grad():
        for weights in cloud.net.action_head.parameters():
            weights.add_(
                _CHANGE * torch.randn(weights.shape, generator=torch.Generator().manual_seed(0))
            )
    statistics = dict(open_checkpoint(locate(source), "any").statistics)
    save_policy(folder, edge.net, cloud.net, edge.prompt.tokenizer, statistics)
    return folder


def operator_token(folder: Path) -> tuple[str, Path]:
    """A token that may swap, and the file that a server knows it by."""
    from comvla_server.identity import MAY_SWAP, Identity
    from comvla_server.tokens import TokenLine, new_token

    token, path = new_token(), folder / "admin-tokens"
    path.touch(mode=0o600)
    operator = Identity("bench", rights=frozenset([MAY_SWAP]))
    path.write_text(f"{TokenLine.of(operator, token)}\n")
    return token, path


def order_swap(admin_url: str, token: str, source: str) -> dict[str, Any]:
    """Has a server replace its model; what it says when it is done."""
    request = urllib.request.Request(
        f"{admin_url}/v1/models/swap",
        data=json.dumps({"source": source}).encode(),
        headers={"Authorization": f"Bearer {token}", "Content-Type": "application/json"},
    )
    with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
        report: dict[str, Any] = json.load(answer)
        return report


def resident_bytes(pid: int) -> int | None:
    """Memory of a process; None where the system does not tell (not Linux)."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return None
    return next((int(x.split()[1]) * 1024 for x in lines if x.startswith("VmRSS:")), None)


def _result(
    parameters: SwapParameters,
    calls: list[Answered],
    distinct: int,
    reports: list[dict[str, Any]],
    spans: list[tuple[float, float]],
    memory: list[int | None],
) -> dict[str, Any]:
    def during(call: Answered) -> bool:
        return any(call.began < end and call.began + call.took_s > begin for begin, end in spans)

    failed = [call.failure for call in calls if call.failure]
    rows = []
    for name, chosen in (
        ("between swaps", [call for call in calls if not during(call)]),
        ("during swaps", [call for call in calls if during(call)]),
    ):
        if not chosen:
            continue
        rows.append({"name": name, **call_figures(chosen)})
    return {
        "bench": "swap",
        "environment": environment.describe(),
        "parameters": asdict(parameters),
        "rows": rows,
        "calls": len(calls),
        "failed": len(failed),
        "failures": sorted(set(failed))[:10],
        "distinct_answers": distinct,
        "swaps": reports,
        "freed": sum(report["freed"] for report in reports),
        "resident_bytes": memory,
    }
