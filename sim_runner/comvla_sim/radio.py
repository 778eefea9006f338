"""Bytes in a queue before a radio, in simulated time: what crosses in which control period."""

from __future__ import annotations

from collections.abc import Iterable

from comvla.errors import LinkError
from comvla_client import LinkProfile
from comvla_sim.link_records import PeriodRecord


class Radio:
    """A first-in, first-out queue that each control period drains by its capacity.

    Whole bytes cross, and capacity that nothing waits for is gone. At most one call is under way;
    what it leaves behind when it is given up comes before the next one.

    Args:
        channel: SNR in dB of each control period.
        link: bandwidth, period, efficiency and reserve.
        buffer_bytes: what of a given-up call cannot be taken back any more.

    Attributes:
        periods: one record for each control period, the current one last.
        backlog_bytes: bytes of given-up calls that have to cross before anything newer.
        airtime_s: time on the air of the call under way, or of the last one, in seconds.

    Raises:
        LinkError: the channel ends.
    """

    def __init__(self, channel: Iterable[float], link: LinkProfile, buffer_bytes: int) -> None:
        self._values = iter(channel)
        self._link = link
        self._buffer_bytes = buffer_bytes
        self._waiting_bytes = 0  # of the call under way
        self.backlog_bytes = 0
        self.airtime_s = 0.0
        self.periods: list[PeriodRecord] = []
        self.advance()

    @property
    def current(self) -> PeriodRecord:
        """The current control period."""
        return self.periods[-1]

    def advance(self) -> None:
        """The next control period begins.

        Raises:
            LinkError: the channel has no value for it.
        """
        value = next(self._values, None)
        if value is None:
            raise LinkError(
                f"the channel ends before period {len(self.periods)}: use one without end "
                "(all of comvla_sim.channel are), or a longer trace"
            )
        if self.periods:
            self.current.backlog_bytes = self.backlog_bytes + self._waiting_bytes
            self.current.late += self._waiting_bytes > 0
        capacity_bits = self._link.capacity_bits(value)
        self.periods.append(PeriodRecord(len(self.periods), float(value), capacity_bits))
        self._drain()

    def carry(self, offered_bytes: int, periods: int) -> int:
        """Sends, and lets up to ``periods`` - 1 control periods pass while there is more to send.

        The last period counts up to its reserve only. In an earlier one bytes cross until its end;
        an answer to what was complete after the reserve began takes one more period.

        Returns:
            How many bytes crossed. The rest waits until :meth:`give_up`.
        """
        self.current.offered_bytes += offered_bytes
        self._waiting_bytes = offered_bytes
        self.airtime_s = 0.0
        for left in reversed(range(periods)):
            self._send(in_time=left == 0)
            if not self._waiting_bytes:
                if left and self.current.delivered_bytes > self._room(in_time=True):
                    self.advance()
                break
            if left:
                self.advance()
        return offered_bytes - self._waiting_bytes

    def give_up(self) -> int:
        """Ends the call under way; returns how many of its waiting bytes cannot be taken back."""
        rest = self._waiting_bytes
        kept = min(rest, self._buffer_bytes)
        self._waiting_bytes = 0
        self.backlog_bytes += kept
        self.current.discarded_bytes += rest - kept
        self.current.late += rest > 0
        self._drain()
        return kept

    def _send(self, in_time: bool) -> None:
        current = self.current
        room = max(0, self._room(in_time) - current.delivered_bytes)
        carried = min(self._waiting_bytes, room)
        current.delivered_bytes += carried
        self._waiting_bytes -= carried
        # Without capacity the robot still keeps trying for the whole period.
        share = 8 * carried / current.capacity_bits if current.capacity_bits else 1.0
        self.airtime_s += share * self._link.period_s

    def _drain(self) -> None:
        room = max(0, self._room(in_time=False) - self.current.delivered_bytes)
        carried = min(self.backlog_bytes, room)
        self.current.delivered_bytes += carried
        self.backlog_bytes -= carried
        self.current.backlog_bytes = self.backlog_bytes

    def _room(self, in_time: bool) -> int:
        """Whole bytes that the current period carries, up to its reserve or up to its end."""
        current = self.current
        bits = self._link.window_bits(current.snr_db) if in_time else current.capacity_bits
        return int(bits // 8)
