"""The admin surface behind a token of its own."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Awaitable, Callable, Iterable
from typing import Any
from urllib.parse import urlsplit

from comvla_server.auth import bearer_token
from comvla_server.identity import MAY_SWAP, Identity
from comvla_server.ports import is_loopback
from comvla_server.tokens import TokenFile

ADMITTED = "comvla_admitted"
"""Key of the ASGI scope: a function that says whether the caller would be let in now as well. Who answers
at length asks it now and then, so that a token that was taken away ends with what it opened."""

# Probes carry no token, and learn no more than up or down.
_OPEN = frozenset({"/healthz", "/readyz"})

_REFUSED = b"expected a token of the admin tokens file: `comvla-server token new` makes one\n"

_MISDIRECTED = (
    b"expected localhost or the address of --admin-host as Host; give --admin-tokens-file\n"
)

__all__ = ["MAY_SWAP", "AdminAuth", "Asgi", "HostCheck", "rights_of"]

_OPERATOR = "comvla.operator"

Asgi = Callable[[Any, Any, Any], Awaitable[None]]


class AdminAuth:
    """ASGI middleware that lets nobody past without a token, except to the probes.

    Programs send ``Authorization: Bearer TOKEN``. Browsers ask for a name and a password: the name
    is any, the password is the token.

    Args:
        app: what is behind it.
        tokens: known tokens.
        open_paths: may be read without one, besides the probes.
    """

    def __init__(self, app: Asgi, tokens: TokenFile, open_paths: Iterable[str] = ()) -> None:
        self._app = app
        self._tokens = tokens
        self._open = _OPEN.union(open_paths)

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Passes on, or answers 401."""
        operator = None if scope["type"] == "lifespan" else self._operator(scope)
        if operator is not None:
            scope[_OPERATOR] = operator
        if scope["type"] == "lifespan" or scope.get("path") in self._open or operator is not None:
            scope[ADMITTED] = lambda: self._operator(scope) is not None
            await self._app(scope, receive, send)
            return
        headers = [
            (b"content-type", b"text/plain"),
            (b"content-length", str(len(_REFUSED)).encode()),
            (b"www-authenticate", b'Basic realm="comvla", charset="UTF-8"'),
            (b"cache-control", b"no-store"),
        ]
        await send({"type": "http.response.start", "status": 401, "headers": headers})
        await send({"type": "http.response.body", "body": _REFUSED})

    def _operator(self, scope: Any) -> Identity | None:
        given = [value for name, value in scope["headers"] if name == b"authorization"]
        token = _token(given[0]) if len(given) == 1 else None
        return None if token is None else self._tokens.find(token)


class HostCheck:
    """ASGI middleware for an address of this machine without tokens: answers requests to it only.

    A page of the internet can have its own name lead to 127.0.0.1 and then read what is there; its
    requests still carry its name.

    Args:
        app: what is behind it.
        host: where it listens, the one name besides those of the loopback.
    """

    def __init__(self, app: Asgi, host: str) -> None:
        self._app = app
        self._host = host.lower()

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Passes on, or answers 421."""
        if scope["type"] == "lifespan" or self._meant(scope):
            await self._app(scope, receive, send)
            return
        headers = [
            (b"content-type", b"text/plain"),
            (b"content-length", str(len(_MISDIRECTED)).encode()),
        ]
        await send({"type": "http.response.start", "status": 421, "headers": headers})
        await send({"type": "http.response.body", "body": _MISDIRECTED})

    def _meant(self, scope: Any) -> bool:
        given = [value for name, value in scope["headers"] if name == b"host"]
        if len(given) != 1:
            return False
        try:
            host = urlsplit(f"//{given[0].decode('ascii')}").hostname
        except ValueError:
            return False
        return host is not None and (host == self._host or is_loopback(host))


def rights_of(scope: Any) -> frozenset[str]:
    """What whoever sends a request may do; nothing where nobody was asked who they are."""
    operator = scope.get(_OPERATOR)
    return operator.rights if isinstance(operator, Identity) else frozenset()


def _token(value: bytes) -> str | None:
    scheme, _, rest = value.strip().partition(b" ")
    if scheme.lower() != b"basic":
        return bearer_token(value)
    try:
        _, _, password = base64.b64decode(rest.strip(), validate=True).partition(b":")
    except binascii.Error:
        return None
    return password.decode("latin-1") or None
