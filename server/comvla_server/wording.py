"""Text from strangers, made safe for log lines and status messages."""

from __future__ import annotations

# A gRPC status message travels in an HTTP/2 header block, of which peers accept 8 KiB.
MAX_MESSAGE_CHARS = 1000


def shown(text: str, limit: int = 64) -> str:
    """A quoted, printable ASCII form of any text, cut to about ``limit`` characters.

    Line breaks and escape sequences come out as escapes, so that no client can forge a log line.
    """
    if len(text) <= limit:
        return ascii(text)
    return f"{text[:limit]!a}… ({len(text)} characters)"


def one_line(message: str, limit: int = MAX_MESSAGE_CHARS) -> str:
    """A message on one line, without control characters, cut to ``limit`` characters."""
    flat = "".join(c if c.isprintable() else " " for c in message[: 4 * limit])
    return flat if len(flat) <= limit else flat[: limit - 1] + "…"
