"""Finds a connection that works when the one in use has gone silent.

When a radio comes back, TCP does not notice: it waits out a pause that has doubled with every loss,
from 0.2 s up to seconds. A new connection asks at once. But a silent connection may also be alive
and only late, and to drop that one would cost round trips. So, once a call takes much longer than
the last ones did, or went unanswered:

* a ping is sent over the old connection, and the next call as ever;
* when the ping is not answered in time, the old connection is given nothing more, and new ones are
  opened beside it, a fresh one every :data:`EVERY_S`: one whose first packet is lost waits a second;
* whichever answers first is used: an old connection that is alive needs one round trip, a new one
  three. A call that was under way is then made over the new one, too, if there is time; the server
  answers both alike.

All of this costs some 100 bytes for the ping and 60 for each attempt that is lost.
"""

from __future__ import annotations

import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import grpc

from comvla.model_info import PROTOCOL_VERSION
from comvla.v1 import policy_pb2_grpc
from comvla.v1.policy_pb2 import GetModelRequest
from comvla_client.access import Metadata

PATIENCE_S = 0.05
"""How long a ping may take before others are tried beside its connection, in seconds; and the
shortest time after which a call is found to take long."""

USUAL_TIMES = 3.0
"""A call takes long when it takes so many times the median of the last ones."""

EVERY_S = 0.04
"""Pause between attempts within one long call, in seconds; a new call tries anew at once."""

MOST_SPARES = 8
"""Attempts under way at most. The oldest stays: on a long link an attempt needs time to succeed."""

_LEAST_AGE_S = 0.005
_REMEMBERED = 9
_WORTH_STARTING = 0.7
_PING_TIMEOUT_S = 30.0
_NO_ANSWER = (
    grpc.StatusCode.UNAVAILABLE,
    grpc.StatusCode.DEADLINE_EXCEEDED,
    grpc.StatusCode.CANCELLED,
)


class Pace:
    """What calls usually take, by which one is found to take long."""

    def __init__(self) -> None:
        self._took_s: deque[float] = deque(maxlen=_REMEMBERED)

    def heard(self, took_s: float) -> None:
        """A call was answered, after so many seconds."""
        self._took_s.append(took_s)

    @property
    def usual_s(self) -> float:
        """What the last calls took, their median, in seconds; 0 before the first."""
        return statistics.median(self._took_s) if self._took_s else 0.0

    @property
    def patience_s(self) -> float:
        """How long a call may take before something seems to be wrong, in seconds."""
        return max(PATIENCE_S, USUAL_TIMES * self.usual_s)

    def enough_s(self, left_s: float) -> float:
        """How much time a call over another connection needs to be worth starting, in seconds.

        With less it would not be answered, and be in the way of the next one.

        Args:
            left_s: what a call has that begins now.
        """
        return min(self.usual_s, _WORTH_STARTING * left_s)


class Revival:
    """Watches over one connection. Its methods are called from the thread that makes the calls.

    Args:
        open_channel: opens a new connection to the same server.
        metadata: what proves who calls.

    Attributes:
        suspected: a call takes long or went unanswered, and nothing was heard since.
        pace: what calls usually take.
    """

    def __init__(
        self, open_channel: Callable[[], grpc.Channel], metadata: Callable[[], Metadata]
    ) -> None:
        self._open_channel = open_channel
        self._metadata = metadata
        self._spares: list[_Spare] = []
        self._ping: Any = None
        self._pinged = 0.0
        self._changed = threading.Event()
        self.pace = Pace()
        self.suspected = False

    def suspect(self) -> None:
        """A call takes long, or went unanswered."""
        self.suspected = True

    def heard(self, took_s: float) -> None:
        """A call was answered, after so many seconds."""
        self.pace.heard(took_s)
        if self.suspected:
            self.reset()

    def reset(self) -> None:
        """Something was heard, or there is another connection: all is well."""
        self.suspected = False
        self._forget_ping()
        self._drop_spares()

    def watch(self, current: grpc.Channel, calls: Iterable[Any]) -> None:
        """A call sets out over a suspected connection, or some are under way over it."""
        self._changed.clear()
        for call in calls:
            call.add_done_callback(lambda _: self.wake())
        if self._ping is not None and self._ping.done():
            self._forget_ping()
        if self._ping is None:
            self._send_ping(current)
        elif self._overdue_s() >= 0.0:
            self._open_spare(_LEAST_AGE_S)

    @property
    def given_up(self) -> bool:
        """Whether the connection in use has not answered its ping in time."""
        return not self._old_one_lives() and self._overdue_s() >= 0.0

    def wake(self) -> None:
        """Ends :meth:`wait`; may be called from any thread."""
        self._changed.set()

    def wait(self, longest_s: float, *, settled: bool = False) -> None:
        """Waits until something has changed or there is something to do.

        Args:
            longest_s: seconds.
            settled: another connection is in use or ready, so no more are opened.
        """
        if settled or any(spare.ready for spare in self._spares):
            self._changed.wait(longest_s)
        elif self._old_one_lives():
            self._drop_spares()
            self._changed.wait(longest_s)
        elif self._overdue_s() < 0.0:
            self._changed.wait(min(longest_s, -self._overdue_s()))
        else:
            self._open_spare(EVERY_S)
            age_s = time.monotonic() - self._spares[-1].born
            self._changed.wait(min(longest_s, max(_LEAST_AGE_S, EVERY_S - age_s)))
        self._changed.clear()

    def take_spare(self) -> grpc.Channel | None:
        """A connection that works, where the suspected one does not; it is the caller's now."""
        if self._old_one_lives():
            return None
        for spare in self._spares:
            if spare.ready:
                self._spares.remove(spare)
                return spare.channel
        return None

    def _old_one_lives(self) -> bool:
        return self._ping is not None and answered(self._ping)

    def _overdue_s(self) -> float:
        return time.monotonic() - self._pinged - PATIENCE_S

    def _send_ping(self, current: grpc.Channel) -> None:
        self._pinged = time.monotonic()
        try:
            self._ping = self._ping_over(current)
            self._ping.add_done_callback(lambda _: self.wake())
        except ValueError:  # closed meanwhile; the call that follows will say so
            self._ping = None

    def _ping_over(self, channel: grpc.Channel, *, wait_for_ready: bool = False) -> Any:
        return policy_pb2_grpc.PolicyServiceStub(channel).GetModel.future(
            GetModelRequest(protocol_version=PROTOCOL_VERSION),
            timeout=_PING_TIMEOUT_S,
            metadata=self._metadata(),
            wait_for_ready=wait_for_ready,
        )

    def _forget_ping(self) -> None:
        ping, self._ping = self._ping, None
        if ping is not None:
            ping.cancel()

    def _open_spare(self, least_age_s: float) -> None:
        if self._spares and time.monotonic() - self._spares[-1].born < least_age_s:
            return
        channel = self._open_channel()
        ping = self._ping_over(channel, wait_for_ready=True)
        self._spares.append(_Spare(channel, ping, self.wake))
        while len(self._spares) > MOST_SPARES:
            discard([self._spares.pop(1).channel])

    def _drop_spares(self) -> None:
        dropped = []
        while True:
            try:  # two threads may do this at once when a client is closed
                dropped.append(self._spares.pop().channel)
            except IndexError:
                break
        discard(dropped)


class _Spare:
    """A connection that is being opened; it is ready when the server has answered over it."""

    def __init__(self, channel: grpc.Channel, ping: Any, wake: Callable[[], None]) -> None:
        self.channel = channel
        self.born = time.monotonic()
        self._ping = ping
        ping.add_done_callback(lambda _: wake())

    @property
    def ready(self) -> bool:
        """Whether the server has answered."""
        return answered(self._ping)


def answered(ping: Any) -> bool:
    """Whether a server said anything at all to a ping."""
    if not ping.done() or ping.cancelled():
        return False
    error = ping.exception()
    return not (isinstance(error, grpc.RpcError) and error.code() in _NO_ANSWER)


def discard(channels: Sequence[grpc.Channel]) -> threading.Thread:
    """Closes connections without waiting for it.

    gRPC's own ``close`` waits until the system has given up what a dead connection still had to
    send, for 5 seconds and more.

    Returns:
        Who closes them.
    """

    def close() -> None:
        for channel in channels:
            channel.close()

    thread = threading.Thread(target=close, name="comvla-discard", daemon=True)
    if channels:
        thread.start()
    return thread
