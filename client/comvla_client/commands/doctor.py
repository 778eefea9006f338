"""``comvla doctor``: what stands between this robot and its server, each finding with a remedy."""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
from collections.abc import Iterator

from comvla.errors import LinkError
from comvla.number_arguments import whole
from comvla_client.access import Access
from comvla_client.commands.arguments import (
    Subparsers,
    access_of,
    add_link,
    add_target,
    link_of,
    load_edge,
    tls_of,
)
from comvla_client.diagnosis import goodput, reach, round_trips, server, silence, tokens
from comvla_client.diagnosis.finding import Allowance, Finding
from comvla_client.diagnosis.machine import machine
from comvla_client.transport import GrpcTransport

_DESCRIPTION = """\
Looks at a server from here: is the port open, does a ComVLA server answer, is it healthy and idle,
how long is the way, what does the uplink carry, what does silence cost, how many tokens is that, and
how is this machine set up. Each finding has its remedy.

  ok    as it should be
  note  could be better, and was not seen to do harm
  FAIL  stands in the robot's way
  skip  could not be looked at

The status is 0 without a FAIL, 1 with one, 2 where the examination could not be made.

It sends what robots send: small calls, uploads that the server reads and refuses (its log shows
them), and up to three real queries of one token.
"""

_MARKS = {"ok": "ok  ", "note": "note", "fail": "FAIL", "skip": "skip"}


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
        "--seconds",
        type=float,
        default=15.0,
        metavar="S",
        help="longest that the examination may take, loading --edge aside (default: %(default)s)",
    )
    parser.add_argument(
        "--calls",
        type=whole(1, 1_000_000),
        default=100,
        metavar="N",
        help="small calls to time (default: 100)",
    )
    parser.add_argument(
        "--edge", metavar="SOURCE", help="also compare this robot's half of a model"
    )
    parser.add_argument(
        "--tokens",
        type=whole(1, 65_535),
        metavar="K",
        help="tokens of the query whose time is estimated (default: K* of the link below)",
    )
    parser.add_argument(
        "--instruction",
        default="push the green drawer shut",
        metavar="WORDS",
        help="of the real queries; words that the server's model knows (default: %(default)r)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    add_link(parser)
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Prints the findings as they come, and a verdict. 0 without a fail, else 1."""
    findings = []
    for finding in examine(arguments):
        findings.append(finding)
        if not arguments.json:
            print(f"{_MARKS[finding.status]} {finding.check:<10} {finding.found}", flush=True)
            if finding.remedy:
                print(f"     {'':<10} -> {finding.remedy}", flush=True)
    failed = [finding.check for finding in findings if not finding.ok]
    verdict = f"{len(failed)} to mend: {', '.join(failed)}" if failed else "fine"
    if arguments.json:
        rows = [finding.to_dict() for finding in findings]
        print(
            json.dumps(
                {
                    "target": arguments.target,
                    "ok": not failed,
                    "verdict": verdict,
                    "findings": rows,
                }
            )
        )
    else:
        print(f"verdict: {verdict}")
    return 1 if failed else 0


def examine(arguments: argparse.Namespace) -> Iterator[Finding]:
    """Looks closer step by step; stops where nothing further can be told.

    Raises:
        LinkError: link arguments, or a time, out of range.
        HandshakeError: the target is no address.
        AccessError: certificates or a token that cannot be used.
    """
    # A mistyped link or an unreadable file is an error of the command, not a finding.
    link_of(arguments)
    access = access_of(arguments)
    if not (math.isfinite(arguments.seconds) and arguments.seconds > 0.0):
        raise LinkError(f"expected --seconds > 0, got {arguments.seconds}: how long it may take")
    target = access.target
    allowance = Allowance(arguments.seconds)
    yield _torch()
    reached, path = reach.reach(target, allowance.at_most_s(arguments.connect_timeout_s))
    yield reached
    if path is None:
        return
    transport = GrpcTransport(
        arguments.target,
        tls_of(arguments),
        arguments.token_file,
        insecure=arguments.insecure,
    )
    try:
        yield from _beyond(arguments, access, transport, path, allowance)
    finally:
        transport.close()


def _beyond(
    arguments: argparse.Namespace,
    access: Access,
    transport: GrpcTransport,
    path: reach.Path,
    allowance: Allowance,
) -> Iterator[Finding]:
    """All that needs an open port."""
    timeout_s = allowance.at_most_s(arguments.connect_timeout_s)
    shaken, response, model = server.shake_hands(transport, access.target, timeout_s)
    yield shaken
    if response is None or model is None:
        return
    if arguments.edge is not None:
        with allowance.paused():  # loading torch and weights may take longer than all the rest
            edge = load_edge(arguments.edge).info
        yield server.same_model(arguments.edge, edge, model)
    yield server.health(access, max(allowance.at_most_s(arguments.connect_timeout_s), 0.1))
    with silence.SilentConnection(access, max(allowance.at_most_s(1.0), 0.1)) as silent:
        timed, trips = round_trips.round_trips(
            transport, arguments.calls, model, allowance, timeout_s
        )
        yield timed
        if trips is None:
            return
        asked, answers = server.queries(
            transport, model, arguments.instruction, arguments.quantization, allowance
        )
        yield asked
        if answers is not None:
            yield server.load(answers)
            yield server.clock(answers)
        carried, seen = goodput.goodput(
            transport, trips.median_s, response.max_request_bytes, allowance
        )
        yield carried
        rested, idle_costs = silence.idle_restart(transport, trips.median_s, seen, allowance)
        yield rested
        link, quantization = link_of(arguments), arguments.quantization
        yield tokens.by_formula(arguments.snr_db, link, model, quantization)
        if seen is not None:
            yield tokens.by_goodput(seen, link, model, quantization, arguments.snr_db)
            server_s = 0.0 if answers is None else answers.server_s
            count = arguments.tokens or tokens.framed_budget(
                arguments.snr_db, link, model, quantization
            )
            yield tokens.expected_period(
                count,
                seen,
                trips.median_s,
                server_s,
                link,
                model,
                quantization,
            )
        yield from machine(path, idle_costs)
        yield silent.finding(allowance)


def _torch() -> Finding:
    if importlib.util.find_spec("torch") is not None:
        return Finding("torch", "ok", "installed, so an edge model can run here")
    return Finding(
        "torch", "fail", "not installed", "to run an edge model here: pip install 'comvla[edge]'"
    )
