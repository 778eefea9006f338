"""A bound on the bytes of requests that a server holds at once."""

from __future__ import annotations

from types import TracebackType

from comvla_server.refusals import Reason, Refusal


class BytesInFlight:
    """Counts what open calls hold: messages as they came, and tokens decoded from them.

    The number of calls alone bounds little where one may hold thousands of times what another does.

    Args:
        limit: most bytes that all calls together may hold.

    Attributes:
        held: bytes that they hold now.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.held = 0

    def lease(self) -> Lease:
        """The share of one call, a context manager."""
        return Lease(self)


class Lease:
    """What one call holds; all of it is given back when the call ends."""

    def __init__(self, owner: BytesInFlight) -> None:
        self._owner = owner
        self._bytes = 0

    def take(self, size_bytes: int) -> None:
        """Holds so many bytes more.

        Raises:
            Refusal: all calls together would hold too much; this one should let go.
        """
        owner = self._owner
        if owner.held + size_bytes > owner.limit:
            raise Refusal(
                Reason.OVERLOAD,
                f"requests in flight hold {owner.held} of {owner.limit} bytes, {size_bytes} more do "
                "not fit: send fewer tokens, ask less often, or raise --max-bytes-in-flight",
            )
        owner.held += size_bytes
        self._bytes += size_bytes

    def __enter__(self) -> Lease:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._owner.held -= self._bytes
        self._bytes = 0
