"""Who calls."""

from __future__ import annotations

import re
from contextvars import ContextVar
from dataclasses import dataclass, field

MAY_SWAP = "may_swap"
"""Right of an operator: to replace a model that serves."""

RIGHTS = (MAY_SWAP,)

IDENTITY_PATTERN = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:@/+-]{0,99}")


@dataclass(frozen=True)
class Limits:
    """What one identity may do; None leaves it to the server's settings.

    Attributes:
        requests_per_s: calls per second.
        bytes_per_s: bytes of requests per second.
        max_request_bytes: largest request.
    """

    requests_per_s: float | None = None
    bytes_per_s: float | None = None
    max_request_bytes: int | None = None


@dataclass(frozen=True)
class Identity:
    """A robot, or an operator, by name.

    Attributes:
        name: empty where the server asks nobody who they are.
        limits: its own.
        rights: what an operator may do beside looking, :data:`MAY_SWAP`.
    """

    name: str
    limits: Limits = field(default_factory=Limits)
    rights: frozenset[str] = frozenset()


ANYBODY = Identity("")

# Every call runs in a task, and so in a context, of its own.
_CALLER: ContextVar[Identity] = ContextVar("comvla_caller", default=ANYBODY)


def caller() -> Identity:
    """Who made the call that runs here; :data:`ANYBODY` where nobody was asked."""
    return _CALLER.get()


def set_caller(identity: Identity) -> None:
    """From here on this task works for that identity."""
    _CALLER.set(identity)
