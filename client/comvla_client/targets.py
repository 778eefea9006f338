"""Addresses of several servers that answer alike: a list, or a name that stands for all of them."""

from __future__ import annotations

import socket
from contextlib import suppress
from dataclasses import dataclass

from comvla.errors import HandshakeError
from comvla_client import channel

DNS = "dns:///"
"""What a target begins with whose name stands for several servers."""

_MOST = 64


@dataclass(frozen=True)
class Address:
    """One server.

    Attributes:
        target: ``host:port``.
        server_name: name that its certificate is for; None where that is the host.
    """

    target: str
    server_name: str | None = None


def is_fleet(target: str) -> bool:
    """Whether a target stands for several servers: ``a:1,b:2`` or ``dns:///name:port``."""
    return "," in target or target.startswith(DNS)


class Addresses:
    """The servers that a target names. A name that a look-up fails for keeps those that it had.

    Args:
        target: ``host:port`` or ``dns:///name:port``, once or more with commas between.

    Raises:
        HandshakeError: a part of it is neither, or there are more than 64.
    """

    def __init__(self, target: str) -> None:
        parts = [part.strip() for part in target.split(",")]
        if len(parts) > _MOST:
            raise HandshakeError(
                f"expected at most {_MOST} targets, got {len(parts)}: put a load balancer in between"
            )
        for part in parts:
            channel.check_target(part.removeprefix(DNS))
        self._fixed = [Address(part) for part in parts if not part.startswith(DNS)]
        self._named = [part.removeprefix(DNS) for part in parts if part.startswith(DNS)]
        self._known: dict[str, list[Address]] = {}

    @property
    def change(self) -> bool:
        """Whether a name is among them, whose servers come and go."""
        return bool(self._named)

    @property
    def fixed(self) -> list[Address]:
        """The servers among them that no name stands for, each once."""
        return list(dict.fromkeys(self._fixed))

    def look_up(self) -> list[Address]:
        """All servers that there are now, each once. A name that nobody ever knew stands for none.

        Asks the system's resolver, which may take many seconds.
        """
        found = list(self._fixed)
        for name in self._named:
            # A look-up that fails says nothing of the servers.
            with suppress(OSError, UnicodeError):
                self._known[name] = _resolved(name)
            found += self._known.get(name, [])
        return list(dict.fromkeys(found))[:_MOST]


def _resolved(name: str) -> list[Address]:
    host, _, port = name.rpartition(":")
    host = host.strip("[]")
    found = []
    for family, _, _, _, place in socket.getaddrinfo(host, int(port), type=socket.SOCK_STREAM):
        ip = f"[{place[0]}]" if family == socket.AF_INET6 else place[0]
        found.append(Address(f"{ip}:{port}", host))
    return found
