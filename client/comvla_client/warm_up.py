"""Keeps a connection fast through the silence between two queries, without root, at a cost in bytes.

After a silence Linux lets a connection send only its first 10 packets until answers come back
(RFC 2861, see :mod:`comvla_client.tcp_tuning`). A robot knows when it will ask next, so a little
before it sends as much filler as its last request had. The filler pays the slow start, and the
query finds the window open.
"""

from __future__ import annotations

import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from comvla import codec

SHORTEST_SILENCE_S = 0.2
"""Linux forgets nothing in a silence shorter than this, its least retransmission timeout."""

_KEPT_INTERVALS = 5
_FILLER_TAG = b"\x7a"  # field 15, bytes: none that GetModelRequest has, so a server skips it
_ROUND_TRIPS_AHEAD = 4.0
_LEAST_LEAD_S = 0.05
_LONGEST_LEAD_S = 0.19


def filler(nbytes: int) -> bytes:
    """A serialised ``GetModelRequest`` of about ``nbytes`` that says nothing."""
    length, varint = max(0, nbytes), bytearray()
    while length >= 0x80:
        varint.append(0x80 | length & 0x7F)
        length >>= 7
    varint.append(length)
    return _FILLER_TAG + bytes(varint) + bytes(max(0, nbytes))


class WarmUp:
    """Decides when to send filler, and sends it from a thread of its own.

    Args:
        send: sends bytes and waits for the answer to them; what it raises is taken as "no link".
        clock: seconds, monotonic.

    Attributes:
        sent_bytes: filler sent so far, with its frames, for the account.
    """

    def __init__(
        self, send: Callable[[bytes], object], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._send = send
        self._clock = clock
        self._intervals_s: deque[float] = deque(maxlen=_KEPT_INTERVALS)
        self._began: float | None = None
        self._request_bytes = 0
        self._round_trip_s = 0.05
        self._due: float | None = None
        self._closed = False
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self.sent_bytes = 0

    @contextmanager
    def around(self, request_bytes: int) -> Iterator[None]:
        """Around a query: when it began and how long it took tell when the next filler is due.

        Args:
            request_bytes: what the query sends; the filler will be as long.
        """
        self.query_begins(request_bytes)
        began, took_s = self._clock(), None
        try:
            yield
            took_s = self._clock() - began
        finally:
            self.query_ends(took_s)

    def query_begins(self, request_bytes: int) -> None:
        """Told when a query of so many bytes sets out."""
        with self._changed:
            now = self._clock()
            if self._began is not None:
                self._intervals_s.append(now - self._began)
            self._began, self._request_bytes, self._due = now, request_bytes, None

    def query_ends(self, took_s: float | None) -> None:
        """Told when a query was answered, after so many seconds; None where it was not."""
        with self._changed:
            due = self.next_filler_at(took_s)
            if due is None or self._closed:
                return
            self._due = due
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._run, name="comvla-warm-up", daemon=True
                )
                self._thread.start()
            self._changed.notify()

    def next_filler_at(self, took_s: float | None) -> float | None:
        """When filler is due before the next query; None where none is needed or nothing is known.

        Args:
            took_s: seconds of the last call; its round trip is in it.
        """
        if took_s is None or self._began is None or not self._intervals_s:
            return None
        interval_s = statistics.median(self._intervals_s)
        if interval_s - took_s < SHORTEST_SILENCE_S:
            return None
        lead_s = min(max(_ROUND_TRIPS_AHEAD * took_s, _LEAST_LEAD_S), _LONGEST_LEAD_S)
        return self._began + interval_s - lead_s

    def close(self) -> None:
        """Sends no more. Harmless when repeated."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._closed and (self._due is None or self._due > self._clock()):
                    wait_s = None if self._due is None else self._due - self._clock()
                    self._changed.wait(wait_s)
                if self._closed:
                    return
                self._due = None
                message = filler(self._request_bytes)
                self.sent_bytes += codec.wire_bytes(len(message)) + codec.CALL_HEADERS_BYTES
            try:
                self._send(message)
            except Exception:  # whatever is wrong with the link, the next query will tell
                continue
