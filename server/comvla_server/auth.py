"""Who calls, told by a token or by the certificate of the connection."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Protocol

from comvla_server.identity import ANYBODY, IDENTITY_PATTERN, Identity
from comvla_server.refusals import Reason, Refusal
from comvla_server.tokens import TokenFile

HEADER = "authorization"

_NAME = "x509_common_name"


class Call(Protocol):
    """What is known of a call before its request; gRPC's context is one."""

    def invocation_metadata(self) -> Iterable[tuple[str, str | bytes]] | None:
        """Its headers."""
        ...

    def auth_context(self) -> Mapping[str, Iterable[bytes]]:
        """What the handshake told of its connection."""
        ...


class Authenticator:
    """Finds out who calls.

    Where there is a tokens file, every call needs a token of it, whatever certificate its connection
    has. Without one, the identity is the common name of the certificate, which the TLS handshake has
    checked. Without either, everybody is :data:`comvla_server.identity.ANYBODY`.

    Args:
        tokens: known tokens, None where none are asked for.
        certificates: whether connections show certificates.
    """

    def __init__(self, tokens: TokenFile | None = None, certificates: bool = False) -> None:
        self._tokens = tokens
        self._certificates = certificates

    def identify(self, call: Call) -> Identity:
        """Whose call this is.

        Raises:
            Refusal: nobody's.
        """
        if self._tokens is not None:
            return self._by_token(self._tokens, call.invocation_metadata() or ())
        return _by_certificate(call.auth_context()) if self._certificates else ANYBODY

    def _by_token(self, tokens: TokenFile, metadata: Iterable[tuple[str, str | bytes]]) -> Identity:
        given = [value for name, value in metadata if name == HEADER]
        if not given:
            raise Refusal(
                Reason.NO_IDENTITY,
                "expected a token (authorization: Bearer …), got none: make one on the server with "
                "`comvla-server token new`, and give it to the robot with --token-file or token=",
            )
        token = bearer_token(given[0]) if len(given) == 1 else None
        identity = None if token is None else tokens.find(token)
        if identity is None:
            raise Refusal(
                Reason.NO_IDENTITY,
                "expected a token that this server knows, got another: it may have been revoked or "
                "belong to another server; make one with `comvla-server token new`",
            )
        return identity


def bearer_token(value: str | bytes) -> str | None:
    """The token of an authorization header, None where it holds none."""
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    scheme, _, token = value.strip().partition(" ")
    token = token.strip()
    return token if scheme.lower() == "bearer" and token else None


def _by_certificate(peer: Mapping[str, Iterable[bytes]]) -> Identity:
    names = [name.decode("utf-8", "replace") for name in peer.get(_NAME, ())]
    if len(names) != 1 or not IDENTITY_PATTERN.fullmatch(names[0]):
        raise Refusal(
            Reason.NO_IDENTITY,
            "expected a client certificate with one common name of up to 100 letters, digits or "
            "._:@/+-, got another: it is the robot's identity; issue one, or use tokens",
        )
    return Identity(names[0])
