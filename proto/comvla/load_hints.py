"""What a server that turns a call away says beside the status, in the call's trailing metadata.

An answer carries its hints in ``LoadHint``; a status has no message, so the same wishes go as text.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil
from typing import Any

RETRY_AFTER_MS = "grpc-retry-pushback-ms"
"""When to try again, whole milliseconds; gRPC's own name for it."""

SUGGESTED_TOKENS = "comvla-suggested-tokens"
"""As ``LoadHint.suggested_tokens``."""

_MOST = 86_400_000  # a day of milliseconds; whatever is more is no hint


@dataclass(frozen=True)
class LoadHints:
    """Hints of a refusal.

    Attributes:
        retry_after_s: when to try again, seconds; None where the server did not say.
        suggested_tokens: tokens per request that the server would like, 0 for no wish.
    """

    retry_after_s: float | None = None
    suggested_tokens: int = 0

    def to_metadata(self) -> tuple[tuple[str, str], ...]:
        """As trailing metadata; hints that are not there take no bytes."""
        found = []
        if self.retry_after_s is not None:
            pause_ms = min(_MOST, max(1, ceil(1000 * self.retry_after_s)))
            found.append((RETRY_AFTER_MS, str(pause_ms)))
        if self.suggested_tokens > 0:
            found.append((SUGGESTED_TOKENS, str(self.suggested_tokens)))
        return tuple(found)

    @classmethod
    def from_metadata(cls, metadata: Iterable[Any] | None) -> LoadHints:
        """Reads what a server sent, pairs of key and value; what is no hint counts as none."""
        found = {key: _whole(value) for key, value in metadata or ()}
        pause_ms = found.get(RETRY_AFTER_MS)
        return cls(
            None if pause_ms is None else pause_ms / 1000.0, found.get(SUGGESTED_TOKENS) or 0
        )


def _whole(value: str | bytes) -> int | None:
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else value
    if not (text.isascii() and text.isdecimal() and len(text) <= 9):
        return None  # gRPC's "-1" means never, and a robot does not wait for that
    number = int(text)
    return number if number <= _MOST else None
