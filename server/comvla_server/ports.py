"""Taking ports, all or none."""

from __future__ import annotations

import contextlib
import ipaddress
import socket

import grpc

from comvla.errors import ComVLAError


class BindError(ComVLAError, OSError):
    """An address that cannot be listened on; the message names it and the remedy."""


def listen(host: str, port: int, option: str) -> socket.socket:
    """A listening TCP socket.

    Args:
        host: address or name of this machine.
        port: 0 takes a free one.
        option: command-line option to name in the error.

    Raises:
        BindError: the port is taken, or the host is no address of this machine.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        return socket.create_server(address[:2], family=family, backlog=128)
    except OSError as error:
        raise _refused(host, port, option, error.strerror or str(error)) from error


def add_grpc_port(
    server: grpc.aio.Server,
    host: str,
    port: int,
    credentials: grpc.ServerCredentials | None = None,
) -> int:
    """Makes a gRPC server listen, and returns the port that it got.

    Args:
        server: not started yet.
        host: address or name of this machine.
        port: 0 takes a free one.
        credentials: for TLS; in the clear where None.

    Raises:
        BindError: the port is taken, or the host is no address of this machine.
    """
    # gRPC reports a taken port in many lines on stderr; a probe says it in one.
    listen(host, port, "--port").close()
    try:
        if credentials is None:
            bound = server.add_insecure_port(authority(host, port))
        else:
            bound = server.add_secure_port(authority(host, port), credentials)
    except RuntimeError as error:
        raise _refused(host, port, "--port", "gRPC could not take it") from error
    if not bound:
        raise _refused(host, port, "--port", "gRPC could not take it")
    return bound


def authority(host: str, port: int) -> str:
    """``host:port``, IPv6 in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches the address. A name other than localhost may lead anywhere."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def _refused(host: str, port: int, option: str, cause: str) -> BindError:
    return BindError(
        f"cannot listen on {authority(host, port)}: {cause}; stop the other program, "
        f"choose another {option} (0 takes a free one), or check --host"
    )
