"""Arguments that several commands share."""

from __future__ import annotations

import argparse
from typing import TypeAlias

from comvla import codec
from comvla.errors import DependencyError
from comvla_client.budget import PAPER_LINK, LinkProfile
from comvla_client.edge import EdgeModel

Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def add_target(parser: argparse.ArgumentParser) -> None:
    """The server's address, and how long to wait for it."""
    parser.add_argument("target", metavar="HOST:PORT", help="gRPC address of the server")
    parser.add_argument(
        "--connect-timeout-s",
        type=float,
        default=5.0,
        metavar="S",
        help="seconds to wait for the server (default: %(default)s)",
    )


def add_link(parser: argparse.ArgumentParser) -> None:
    """The radio link that sizes payloads."""
    group = parser.add_argument_group("link", "K* = floor(eta W T log2(1 + SNR) / (D B))")
    group.add_argument(
        "--snr-db",
        type=float,
        default=10.0,
        metavar="DB",
        help="reported SNR in dB, -inf for no link (default: %(default)s)",
    )
    for name, metavar, words in (
        ("bandwidth_hz", "HZ", "bandwidth W in hertz"),
        ("period_s", "S", "control period T in seconds"),
        ("efficiency", "ETA", "share of the Shannon capacity that becomes tokens, eta in (0, 1]"),
        ("reserve_s", "S", "part of the period kept for round trip and computing, in seconds"),
    ):
        group.add_argument(
            "--" + name.replace("_", "-"),
            type=float,
            default=getattr(PAPER_LINK, name),
            metavar=metavar,
            help=f"{words} (default: %(default)s)",
        )
    group.add_argument(
        "--quantization",
        choices=codec.QUANTIZATIONS,
        default="int8",
        help="coding of token values (default: %(default)s)",
    )


def link_of(arguments: argparse.Namespace) -> LinkProfile:
    """The link that the arguments describe.

    Raises:
        LinkError: a value out of range.
    """
    return LinkProfile(
        arguments.bandwidth_hz, arguments.period_s, arguments.efficiency, arguments.reserve_s
    )


def load_edge(source: str) -> EdgeModel:
    """The robot's half of a checkpoint.

    Raises:
        DependencyError: torch is not installed.
        CheckpointError: no checkpoint there.
    """
    try:
        import comvla_vla
    except ImportError as error:
        raise DependencyError(
            f"the edge model needs torch, safetensors and tokenizers, and {error.name!r} is "
            "missing: pip install 'comvla[edge]'"
        ) from error
    return comvla_vla.load_edge(source)
