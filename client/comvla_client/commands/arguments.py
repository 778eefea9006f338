"""Arguments that several commands share."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TypeAlias

from comvla import codec
from comvla.errors import DependencyError
from comvla.number_arguments import SECONDS, SNR_DB
from comvla_client.access import Access, TlsOptions
from comvla_client.budget import PAPER_LINK, LinkProfile
from comvla_client.edge import EdgeModel

Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def add_target(parser: argparse.ArgumentParser) -> None:
    """The server's address, and how long to wait for it."""
    parser.add_argument("target", metavar="HOST:PORT", help="gRPC address of the server")
    parser.add_argument(
        "--connect-timeout-s",
        type=SECONDS,
        default=5.0,
        metavar="S",
        help="seconds to wait for the server (default: %(default)s)",
    )
    group = parser.add_argument_group("encryption and identity")
    group.add_argument("--tls", action="store_true", help="use TLS with the system's authorities")
    group.add_argument(
        "--tls-ca", metavar="FILE", help="authorities that may vouch for the server, PEM; uses TLS"
    )
    group.add_argument(
        "--tls-certificate", metavar="FILE", help="this robot's certificate, PEM, for mutual TLS"
    )
    group.add_argument("--tls-key", metavar="FILE", help="its private key, PEM")
    group.add_argument(
        "--tls-server-name", metavar="NAME", help="name in the server's certificate, if another"
    )
    group.add_argument(
        "--token-file", type=Path, metavar="FILE", help="file that holds this robot's token"
    )
    group.add_argument(
        "--insecure",
        action="store_true",
        help="send the token in the clear, where only this robot and the server can listen",
    )


def tls_of(arguments: argparse.Namespace) -> TlsOptions | None:
    """The TLS options that the arguments describe, None for none.

    Raises:
        AccessError: half a pair.
    """
    given = {
        "ca": arguments.tls_ca,
        "certificate": arguments.tls_certificate,
        "key": arguments.tls_key,
        "server_name": arguments.tls_server_name,
    }
    if arguments.tls or any(value is not None for value in given.values()):
        return TlsOptions(**given)
    return None


def access_of(arguments: argparse.Namespace) -> Access:
    """How the arguments say to reach the server.

    Raises:
        HandshakeError: the target is no address.
        AccessError: certificates or a token that cannot be used.
    """
    return Access(
        arguments.target, tls_of(arguments), arguments.token_file, insecure=arguments.insecure
    )


def add_link(parser: argparse.ArgumentParser) -> None:
    """The radio link that sizes payloads."""
    group = parser.add_argument_group("link", "K* = floor(eta W T log2(1 + SNR) / (D B))")
    group.add_argument(
        "--snr-db",
        type=SNR_DB,
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
