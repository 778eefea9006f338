"""Text from strangers, made safe for log lines and status messages."""

from __future__ import annotations

import itertools

# A gRPC status message travels percent-encoded in an HTTP/2 header block, of which peers accept
# 8 KiB. An emoji, say, is one character and twelve bytes there.
MAX_MESSAGE_CHARS = 1000
MAX_ENCODED_BYTES = 3000


def shown(text: str, limit: int = 64) -> str:
    """A quoted, printable ASCII form of any text, cut to about ``limit`` characters.

    Line breaks and escape sequences come out as escapes, so that no client can forge a log line.
    """
    if len(text) <= limit:
        return ascii(text)
    return f"{text[:limit]!a}… ({len(text)} characters)"


def one_line(
    message: str, limit: int = MAX_MESSAGE_CHARS, encoded_limit: int = MAX_ENCODED_BYTES
) -> str:
    """A message on one line, without control characters, cut where it gets too long.

    Args:
        message: any text.
        limit: most characters.
        encoded_limit: most bytes once gRPC has percent-encoded it.
    """
    # What the server says most, and under overload very often: nothing in it has to be changed.
    short = 3 * len(message) <= min(3 * limit, encoded_limit)
    if short and message.isascii() and message.isprintable():
        return message
    flat = "".join(c if c.isprintable() else " " for c in message[: 4 * limit])
    if len(flat) <= limit and sum(map(_encoded_bytes, flat)) <= encoded_limit:
        return flat
    room = encoded_limit - _encoded_bytes("…")
    spent = itertools.accumulate(map(_encoded_bytes, flat[: limit - 1]))
    kept = sum(1 for _ in itertools.takewhile(lambda size: size <= room, spent))
    return flat[:kept] + "…"


def _encoded_bytes(character: str) -> int:
    """Bytes of a character in a ``grpc-message`` header: printable ASCII but % as it is."""
    if " " <= character <= "~" and character != "%":
        return 1
    return 3 * len(character.encode("utf-8", "replace"))
