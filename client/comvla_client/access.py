"""What a robot shows to be let in, and by what it knows its server: TLS and tokens."""

from __future__ import annotations

import ipaddress
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import grpc
import grpc.aio

from comvla.errors import ComVLAError
from comvla_client import channel
from comvla_client.tracing import trace_headers

_log = logging.getLogger(__name__)

Pem: TypeAlias = "str | os.PathLike[str] | bytes"
"""A PEM file by its path, read at every new connection, or PEM content as bytes."""

Token: TypeAlias = "str | os.PathLike[str] | Callable[[], str]"
"""A token as text, as the path (a :class:`pathlib.Path`) of a file that holds it, or as a function
that is asked at every call; the last two may change while the robot runs."""

Metadata: TypeAlias = "tuple[tuple[str, str], ...]"


class AccessError(ComVLAError, ValueError):
    """Certificates or tokens that cannot be used; raised before anything is sent."""


@dataclass(frozen=True)
class TlsOptions:
    """How the robot knows its server, and how the server knows the robot.

    Attributes:
        ca: authorities that may vouch for the server; those of the system where None.
        certificate: the robot's own certificate, where the server asks for one (mutual TLS).
        key: the private key of that certificate.
        server_name: name in the server's certificate where it differs from the host called.

    Raises:
        AccessError: a certificate without its key, or the other way round.
    """

    ca: Pem | None = None
    certificate: Pem | None = None
    key: Pem | None = None
    server_name: str | None = None

    def __post_init__(self) -> None:
        """Refuses half a pair."""
        if (self.certificate is None) != (self.key is None):
            raise AccessError(
                "expected the robot's certificate and its key, got one of them: give both for mutual "
                "TLS, or neither"
            )

    def with_server_name(self, name: str | None) -> TlsOptions:
        """These, for a server whose certificate bears a name; a name that was given stays."""
        return (
            self
            if name is None or self.server_name is not None
            else replace(self, server_name=name)
        )

    def credentials(self) -> grpc.ChannelCredentials:
        """Reads the files.

        Raises:
            AccessError: a file that cannot be read, or holds something else.
        """
        return grpc.ssl_channel_credentials(
            root_certificates=_pem(self.ca, "ca", b"CERTIFICATE"),
            private_key=_pem(self.key, "key", b"PRIVATE KEY"),
            certificate_chain=_pem(self.certificate, "certificate", b"CERTIFICATE"),
        )


class Access:
    """Makes channels to one server, and the headers of each call.

    Args:
        target: ``host:port``.
        tls: None sends everything in the clear.
        token: None sends none.
        insecure: lets a token cross a network in the clear, e.g. inside a tunnel.

    Raises:
        HandshakeError: the target is no address.
        AccessError: files or token that cannot be used, or a token that anybody could read on the way.
    """

    def __init__(
        self,
        target: str,
        tls: TlsOptions | None = None,
        token: Token | None = None,
        *,
        insecure: bool = False,
    ) -> None:
        self.target = channel.check_target(target)
        self._tls = tls
        self._token = token
        self._options: tuple[tuple[str, int | str], ...] = channel.CHANNEL_OPTIONS
        self._credentials: grpc.ChannelCredentials | None = None
        if tls is not None:
            if insecure:
                raise AccessError("insecure and tls contradict each other: give one of them up")
            if tls.server_name is not None:
                name = ("grpc.ssl_target_name_override", tls.server_name)
                self._options = (*channel.CHANNEL_OPTIONS, name)
            self._credentials = tls.credentials()
        elif token is not None and not insecure and not _is_loopback(self.target):
            raise AccessError(
                f"the token would cross the network to {target} in the clear, for anybody to read "
                "and use: give tls=TlsOptions(ca=…), or insecure=True inside a tunnel"
            )
        if isinstance(token, os.PathLike):
            _warn_if_exposed(Path(token))
        self._last_token = None if token is None else _read_token(token)

    def channel(self) -> grpc.Channel:
        """A new channel, with the certificates that the files hold now."""
        credentials = self._renewed()
        if credentials is None:
            return grpc.insecure_channel(self.target, options=self._options)
        return grpc.secure_channel(self.target, credentials, options=self._options)

    def aio_channel(self) -> grpc.aio.Channel:
        """The same for an event loop."""
        credentials = self._renewed()
        if credentials is None:
            return grpc.aio.insecure_channel(self.target, options=self._options)
        return grpc.aio.secure_channel(self.target, credentials, options=self._options)

    def metadata(self) -> Metadata:
        """Headers of the next call, with the token of now, and the trace that it belongs to."""
        if self._token is None:
            return trace_headers()
        if not isinstance(self._token, str):
            try:
                self._last_token = _read_token(self._token)
            except AccessError as error:
                # A file that is being replaced must not stop a robot that was let in before.
                _log.warning("the last token is used again: %s", error)
        return (("authorization", f"Bearer {self._last_token}"), *trace_headers())

    def _renewed(self) -> grpc.ChannelCredentials | None:
        if self._tls is not None:
            try:
                self._credentials = self._tls.credentials()
            except AccessError as error:
                _log.warning("the last certificates are used again: %s", error)
        return self._credentials


def check_unused(tls: TlsOptions | None, token: Token | None, insecure: bool) -> None:
    """Refuses options of a connection for a client that was given one of its own.

    Raises:
        AccessError: an option that would be ignored.
    """
    if tls is not None or token is not None or insecure:
        raise AccessError(
            "tls, token and insecure belong to an address, and a transport of your own was given: "
            "give them to that transport"
        )


def _pem(given: Pem | None, name: str, kind: bytes) -> bytes | None:
    if given is None:
        return None
    try:
        content = given if isinstance(given, bytes) else Path(given).read_bytes()
    except OSError as error:
        raise AccessError(
            f"cannot read {name} {os.fspath(given)!r}: {error.strerror or error}; correct the path"
        ) from error
    if b"-----BEGIN " not in content or kind + b"-----" not in content:
        raise AccessError(
            f"expected {name} in PEM form (-----BEGIN {kind.decode()}-----), got something else: is "
            "it the right file?"
        )
    return content


def _read_token(token: Token) -> str:
    if isinstance(token, os.PathLike):
        try:
            text = Path(token).read_text(encoding="ascii", errors="replace")
        except OSError as error:
            raise AccessError(
                f"cannot read the token in {token}: {error.strerror or error}; correct the path, or "
                "make a token on the server with `comvla-server token new`"
            ) from error
    else:
        text = token if isinstance(token, str) else token()
    text = text.strip()
    if not text or len(text) > 4096 or not all("!" <= character <= "~" for character in text):
        raise AccessError(
            f"expected a token of printable characters without spaces, got {len(text)} characters of "
            "something else; a file is given as a pathlib.Path, and holds the token alone"
        )
    return text


def _warn_if_exposed(path: Path) -> None:
    if os.name == "posix" and path.exists() and path.stat().st_mode & 0o007:
        _log.warning("%s can be read by every user of this machine: chmod 600 it", path)


def _is_loopback(target: str) -> bool:
    host = target.rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
