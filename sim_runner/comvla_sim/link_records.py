"""What a simulated link writes down: one record for each request, one for each control period."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any


def _plain(record: Any) -> dict[str, Any]:
    plain = asdict(record)
    if math.isinf(record.snr_db):
        plain["snr_db"] = "-inf"
    return plain


@dataclass(frozen=True)
class LinkRecord:
    """What became of one request on the radio link.

    Attributes:
        period: control period in which it was sent, from 0.
        snr_db: true SNR of that period, dB.
        capacity_bits: C_link, what the link carries in the whole period (Eq. (1)).
        available_bits: what earlier requests of the same period left of it.
        offered_bytes: what the robot wanted to send.
        delivered_bytes: what crossed while the robot waited; at most ``available_bits / 8`` where
            it did not wait longer than its period.
        offered_tokens: tokens that the robot wanted to send.
        delivered_tokens: tokens that arrived whole, 0 where the request was lost.
        airtime_s: time that the delivered bytes took, in seconds.
        waited_periods: control periods that began while the robot waited for the answer.
        backlog_bytes: bytes of earlier requests that were before it in the queue.
        progressive: whether the payload went in pieces.
    """

    period: int
    snr_db: float
    capacity_bits: float
    available_bits: float
    offered_bytes: int
    delivered_bytes: int
    offered_tokens: int
    delivered_tokens: int
    airtime_s: float
    waited_periods: int = 0
    backlog_bytes: int = 0
    progressive: bool = False

    @property
    def overrun(self) -> bool:
        """Whether more was offered than the period had left: the capacity was violated.

        A payload in pieces is meant to be cut, so of one this says nothing.
        """
        return 8 * self.offered_bytes > self.available_bits

    def to_dict(self) -> dict[str, Any]:
        """Plain values for ``json.dumps``; an SNR of −inf becomes the string "-inf"."""
        return _plain(self)


@dataclass
class PeriodRecord:
    """What one control period of the link carried; grows until the next one begins.

    Over all periods, what was offered is what was delivered, what was discarded, and what the last
    period left as backlog.

    Attributes:
        period: from 0.
        snr_db: true SNR, dB.
        capacity_bits: C_link, what the link carries in the whole period (Eq. (1)).
        offered_bytes: bytes of the requests that began in it.
        delivered_bytes: bytes that crossed in it, whoever sent them and when; never more than
            ``capacity_bits / 8``.
        discarded_bytes: bytes that were given up in it.
        backlog_bytes: bytes that it left for the next period.
        late: requests that were under way when it ended, or that it did not carry whole.
    """

    period: int
    snr_db: float
    capacity_bits: float
    offered_bytes: int = 0
    delivered_bytes: int = 0
    discarded_bytes: int = 0
    backlog_bytes: int = 0
    late: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Plain values for ``json.dumps``; an SNR of −inf becomes the string "-inf"."""
        return _plain(self)
