"""Errors that only a client can have; those of the contract live in :mod:`comvla.errors`."""

from comvla.errors import ComVLAError
from comvla.load_hints import LoadHints


class ClientClosedError(ComVLAError, RuntimeError):
    """The client or its transport was closed, perhaps by another thread while a step was under way."""


class SnrSourceError(ComVLAError):
    """A device or a bus that gives no SNR; the message says what to use instead."""


class TransportError(ComVLAError):
    """A call got no usable answer. A step turns it into a fallback or, if nobody can wait it out, raises.

    Attributes:
        code: name of the gRPC status, e.g. ``"UNAVAILABLE"``.
        message: what the server or the channel said.
        hints: what a busy server wishes.
    """

    def __init__(self, code: str, message: str, hints: LoadHints | None = None) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message
        self.hints = hints or LoadHints()
