"""``comvla doctor``: what stands between this robot and its server, each finding with a remedy."""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import json
import socket
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from comvla import handshake
from comvla.codec import bits_per_value
from comvla.errors import ComVLAError
from comvla.model_info import ModelInfo
from comvla_client import channel
from comvla_client.budget import framed_token_budget, token_budget
from comvla_client.commands.arguments import (
    Subparsers,
    access_of,
    add_link,
    add_target,
    link_of,
    load_edge,
    tls_of,
)
from comvla_client.errors import TransportError
from comvla_client.health import check_health
from comvla_client.locked_out import locked_out
from comvla_client.transport import GrpcTransport

USEFUL_TOKENS = 20
"""Fewer than about this many of 512 tokens, and the paper's success collapses (Table I, K = 16)."""

_DESCRIPTION = """\
Looks at a server from here: is the port open, does a ComVLA server answer, is it healthy, how long
is the way there and back, and how many tokens does the link carry. Each finding has its remedy.
"""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        check: its name.
        ok: whether it is as it should be.
        found: what was measured or read.
        remedy: what to do about it; empty when all is well.
        values: the numbers behind ``found``, for ``--json``.
    """

    check: str
    ok: bool
    found: str
    remedy: str = ""
    values: dict[str, Any] = dataclasses.field(default_factory=dict)


def add_parser(subparsers: Subparsers) -> argparse.ArgumentParser:
    """Adds ``doctor`` to the commands."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "doctor",
        help="look at a server and the link to it",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_target(parser)
    parser.add_argument(
        "--calls", type=int, default=20, metavar="N", help="small calls to time (default: 20)"
    )
    parser.add_argument(
        "--edge", metavar="SOURCE", help="also compare this robot's half of a model"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    add_link(parser)
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Prints the findings as they come. 0 when all are well, else 1."""
    findings = []
    for finding in examine(arguments):
        findings.append(finding)
        if not arguments.json:
            print(f"{'ok  ' if finding.ok else 'FAIL'} {finding.check:<10} {finding.found}")
            if finding.remedy:
                print(f"     {'':<10} {finding.remedy}")
    healthy = all(finding.ok for finding in findings)
    if arguments.json:
        rows = [dataclasses.asdict(finding) for finding in findings]
        print(json.dumps({"target": arguments.target, "ok": healthy, "findings": rows}))
    return 0 if healthy else 1


def examine(arguments: argparse.Namespace) -> Iterator[Finding]:
    """Looks closer step by step; stops where nothing further can be told.

    Raises:
        LinkError: link arguments out of range.
        HandshakeError: the target is no address.
        AccessError: certificates or a token that cannot be used.
    """
    # A mistyped link or an unreadable file is an error of the command, not a finding.
    link_of(arguments)
    access_of(arguments)
    yield _torch()
    reach = _reach(channel.check_target(arguments.target), arguments.connect_timeout_s)
    yield reach
    if not reach.ok:
        return
    transport = GrpcTransport(
        arguments.target,
        tls_of(arguments),
        arguments.token_file,
        insecure=arguments.insecure,
    )
    try:
        try:
            response = transport.get_model(arguments.connect_timeout_s)
            model = handshake.from_response(response)
        except (TransportError, ComVLAError) as error:
            yield _no_handshake(arguments, error)
            return
        yield Finding(
            "handshake",
            True,
            f"{model.name} {model.fingerprint[:12]} on comvla-server {response.server_version}: "
            f"N {model.num_tokens}, D {model.token_dim}, chunks of {model.action_horizon}",
            values={"model": dataclasses.asdict(model), "server_version": response.server_version},
        )
        if arguments.edge is not None:
            yield _edge(arguments.edge, model)
        yield _health(arguments)
        yield _round_trips(transport, arguments, model)
        yield _link(arguments, model)
    finally:
        transport.close()


def _torch() -> Finding:
    if importlib.util.find_spec("torch") is not None:
        return Finding("torch", True, "installed, so an edge model can run here")
    return Finding(
        "torch", False, "not installed", "to run an edge model here: pip install 'comvla[edge]'"
    )


def _reach(target: str, timeout_s: float) -> Finding:
    host, _, port = target.rpartition(":")
    began = time.perf_counter()
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout_s).close()
    except OSError as error:
        return Finding(
            "reach",
            False,
            f"no TCP connection to {target} within {timeout_s:g} s: {error}",
            "start `comvla-server serve` there, listening on an address that this robot reaches "
            "(--host 0.0.0.0 with TLS opens it to the network); check the port, the route and the firewall",
        )
    elapsed_s = time.perf_counter() - began
    return Finding("reach", True, f"TCP connects in {1e3 * elapsed_s:.1f} ms")


def _no_handshake(arguments: argparse.Namespace, error: ComVLAError) -> Finding:
    if isinstance(error, TransportError) and locked_out(error) is not None:
        return Finding(
            "access",
            False,
            f"{error.code}: {error.message}",
            f"a server is there, but {locked_out(error)}",
        )
    if isinstance(error, TransportError):
        error = channel.no_server(arguments.target, error, arguments.connect_timeout_s)
    return Finding(
        "handshake",
        False,
        str(error),
        "the port is open, so give the gRPC address that comvla-server printed when it was ready, "
        "not the one of its admin surface; if it still loads its model, wait",
    )


def _edge(source: str, cloud: ModelInfo) -> Finding:
    difference = handshake.mismatch(load_edge(source).info, cloud)
    if difference is None:
        return Finding("edge", True, f"{source} is the other half of the server's model")
    return Finding("edge", False, difference, "start both sides with the same checkpoint")


def _health(arguments: argparse.Namespace) -> Finding:
    try:
        status = check_health(access_of(arguments), arguments.connect_timeout_s)
    except TransportError as error:
        return Finding(
            "health",
            False,
            f"no answer from grpc.health.v1 ({error})",
            "a proxy in between may not pass it on: allow the service grpc.health.v1.Health",
        )
    remedy = "" if status == "SERVING" else "the server is loading or stopping: wait, or restart it"
    return Finding("health", status == "SERVING", status, remedy)


def _round_trips(
    transport: GrpcTransport, arguments: argparse.Namespace, model: ModelInfo
) -> Finding:
    elapsed_s = []
    try:
        for _ in range(max(2, arguments.calls)):
            began = time.perf_counter()
            transport.get_model(arguments.connect_timeout_s)
            elapsed_s.append(time.perf_counter() - began)
    except TransportError as error:
        return Finding(
            "round trip",
            False,
            f"lost after {len(elapsed_s)} calls ({error})",
            "the link or the server is unsteady: look at the server's log and the radio",
        )
    median_s, worst_s = statistics.median(elapsed_s), max(elapsed_s)
    quick = worst_s <= model.control_period_s
    return Finding(
        "round trip",
        quick,
        f"{len(elapsed_s)} small calls: median {1e3 * median_s:.2f} ms, worst {1e3 * worst_s:.2f} ms",
        ""
        if quick
        else f"longer than one control period ({1e3 * model.control_period_s:.0f} ms): move the "
        "server closer, or let the robot execute longer chunks before it asks again",
        {"calls": len(elapsed_s), "median_s": median_s, "worst_s": worst_s},
    )


def _link(arguments: argparse.Namespace, model: ModelInfo) -> Finding:
    link, quantization = link_of(arguments), arguments.quantization
    bits_per_token = model.token_dim * bits_per_value(quantization)
    paper = token_budget(arguments.snr_db, link, bits_per_token)
    framed = framed_token_budget(
        arguments.snr_db,
        link,
        token_dim=model.token_dim,
        quantization=quantization,
        num_towers=len(model.tower_dims),
        proprio_dim=model.proprio_dim,
        model_fingerprint=model.fingerprint,
    )
    enough = framed >= min(USEFUL_TOKENS, model.num_tokens)
    return Finding(
        "link",
        enough,
        f"at {arguments.snr_db:g} dB {quantization} K* is {paper} by Eq. (4), {framed} with framing, "
        f"of {model.num_tokens} tokens",
        ""
        if enough
        else f"below about {USEFUL_TOKENS} tokens policies lose the task: raise bandwidth, power or "
        "period, or choose a coarser quantization",
        {"token_budget": paper, "framed_token_budget": framed},
    )
