"""Who answers, in which health, how busy, and by which clock."""

from __future__ import annotations

import dataclasses
import statistics
from dataclasses import dataclass

from comvla import handshake
from comvla.errors import ComVLAError
from comvla.model_info import ModelInfo
from comvla.v1.policy_pb2 import GetModelResponse, InferResponse
from comvla_client import channel
from comvla_client.access import Access
from comvla_client.diagnosis.finding import Allowance, Finding, out_of_time
from comvla_client.diagnosis.probes import query, query_request
from comvla_client.errors import TransportError
from comvla_client.health import check_health
from comvla_client.locked_out import locked_out
from comvla_client.transport_protocol import Transport

QUERIES = 3
BUSY = 0.9
"""Share of time that inference is busy above which queues grow."""

CLOCK_TOLERANCE_S = 1e-3


def shake_hands(
    transport: Transport, target: str, timeout_s: float
) -> tuple[Finding, GetModelResponse | None, ModelInfo | None]:
    """Asks for the model.

    Returns:
        The finding, and the answer where a ComVLA server gave one.
    """
    try:
        response = transport.get_model(timeout_s)
        model = handshake.from_response(response)
    except (TransportError, ComVLAError) as error:
        return _no_handshake(target, error, timeout_s), None, None
    found = (
        f"{model.name} {model.fingerprint[:12]} on comvla-server {response.server_version}: "
        f"N {model.num_tokens}, D {model.token_dim}, chunks of {model.action_horizon}"
    )
    options = handshake.run_options(response)
    if options:
        found += f", run with {' '.join(options)}"
    values = {
        "model": dataclasses.asdict(model),
        "server_version": response.server_version,
        "run_options": options,
    }
    return Finding("handshake", "ok", found, values=values), response, model


def _no_handshake(target: str, error: ComVLAError, timeout_s: float) -> Finding:
    if isinstance(error, TransportError):
        why = locked_out(error)
        if why is not None:
            found = f"{error.code}: {error.message}"
            return Finding("access", "fail", found, f"a server is there, but {why}")
        error = channel.no_server(target, error, timeout_s)
    return Finding(
        "handshake",
        "fail",
        str(error),
        "the port is open, so give the gRPC address that comvla-server printed when it was ready, "
        "not the one of its admin surface; if it still loads its model, wait",
    )


def same_model(source: str, edge: ModelInfo, cloud: ModelInfo) -> Finding:
    """Whether the robot's half belongs to the server's model."""
    difference = handshake.mismatch(edge, cloud)
    if difference is None:
        return Finding("edge", "ok", f"{source} is the other half of the server's model")
    return Finding("edge", "fail", difference, "start both sides with the same checkpoint")


def health(access: Access, timeout_s: float) -> Finding:
    """What grpc.health.v1 says."""
    try:
        status = check_health(access, timeout_s)
    except TransportError as error:
        return Finding(
            "health",
            "fail",
            f"no answer from grpc.health.v1 ({error})",
            "a proxy in between may not pass it on: allow the service grpc.health.v1.Health",
        )
    if status == "SERVING":
        return Finding("health", "ok", status)
    remedy = "the server is loading or stopping: wait, or restart it"
    return Finding("health", "fail", status, remedy)


@dataclass(frozen=True)
class Queries:
    """A few real queries.

    Attributes:
        last: the last answer.
        call_s: median seconds that the robot waited.
        server_s: median seconds that the server says it took.
        slowest_claim_s: by how much the server's seconds exceeded the robot's at most; negative
            where they never did, as it should be.
    """

    last: InferResponse
    call_s: float
    server_s: float
    slowest_claim_s: float


def queries(
    transport: Transport,
    model: ModelInfo,
    instruction: str,
    quantization: str,
    allowance: Allowance,
) -> tuple[Finding, Queries | None]:
    """Sends up to three real queries of one token each; they take their turn among the robots'.

    Args:
        transport: to the server.
        model: that it runs.
        instruction: words that this model knows.
        quantization: of the token.
        allowance: a third of what is left of it may be spent on each.

    Returns:
        The finding, and the numbers where there are any.
    """
    if allowance.left_s() <= 0.0:
        return out_of_time("query", allowance), None
    answers: list[InferResponse] = []
    took_s: list[float] = []
    request = query_request(model, instruction, quantization)
    try:
        for step in range(QUERIES):
            request.step = step
            answer, elapsed_s = query(transport, request, max(allowance.left_s() / 3, 0.1))
            answers.append(answer)
            took_s.append(elapsed_s)
            if allowance.left_s() < 3 * elapsed_s:
                break
    except TransportError as error:
        if not answers:
            return _no_answer(error), None
    server_s = [answer.timings.total_s for answer in answers]
    claims = [server - call for server, call in zip(server_s, took_s, strict=True)]
    seen = Queries(answers[-1], statistics.median(took_s), statistics.median(server_s), max(claims))
    values = {"queries": len(answers), "call_s": seen.call_s, "server_s": seen.server_s}
    found = (
        f"{len(answers)} of one token: {1e3 * seen.call_s:.1f} ms, of which the server's "
        f"{1e3 * seen.server_s:.1f} ms"
    )
    return Finding("query", "ok", found, values=values), seen


def _no_answer(error: TransportError) -> Finding:
    if error.code == "INVALID_ARGUMENT":
        return Finding(
            "query",
            "skip",
            f"the server did not accept it: {error.message}",
            "give words that its model knows: --instruction 'push the drawer shut'",
        )
    return Finding(
        "query",
        "fail",
        f"no answer to a query of one token ({error})",
        "the server answers small calls and no queries: look at its log and its load",
    )


def load(seen: Queries) -> Finding:
    """How busy the server says it is."""
    hint = seen.last.load
    values = {"queue_depth": hint.queue_depth, "utilization": hint.utilization}
    found = f"busy {100 * hint.utilization:.0f} % of the time, {hint.queue_depth} requests waiting"
    if hint.suggested_tokens:
        values["suggested_tokens"] = hint.suggested_tokens
        found += f", it would like {hint.suggested_tokens} tokens a request"
    if hint.utilization <= BUSY:
        return Finding("load", "ok", found, values=values)
    return Finding(
        "load",
        "fail",
        found,
        "queries will wait or be refused: fewer robots, longer chunks, or one more server",
        values,
    )


def clock(seen: Queries) -> Finding:
    """Whether the server's seconds are as long as this robot's.

    Nothing in ComVLA compares wall clocks: the contract carries durations, each from one machine's
    monotonic clock. Their offset is therefore neither needed nor known.
    """
    way_s = seen.call_s - seen.server_s
    values = {"on_the_way_s": way_s, "offset_s": None}
    if seen.slowest_claim_s <= CLOCK_TOLERANCE_S:
        return Finding(
            "clock",
            "ok",
            f"the server's share fits into the call, {1e3 * way_s:.1f} ms are the way; wall clocks "
            "may differ, only durations are exchanged",
            values=values,
        )
    return Finding(
        "clock",
        "fail",
        f"the server claims {1e3 * seen.slowest_claim_s:.1f} ms more than the whole call took here",
        "one of the two monotonic clocks runs wrong, as on virtual machines that are paused: "
        "timings in reports cannot be trusted until it is found",
        values,
    )
