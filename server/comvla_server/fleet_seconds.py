"""One second of one robot, or of all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from comvla.v1 import policy_pb2

COLUMNS = (
    "at_s",
    "answered",
    "refused",
    "bridged",
    "snr_db",
    "snr_db_low",
    "snr_db_high",
    "tokens",
    "tokens_low",
    "tokens_high",
    "payload_bytes",
    "wire_bytes",
    "decode_ms",
    "queue_ms",
    "predict_ms",
    "total_ms",
    "slowest_ms",
)
"""What :meth:`Second.row` holds. Without ``_low`` or ``_high`` SNR and tokens are means over reports
and answers, and times are means over answers; ``total_ms`` contains the other times."""


@dataclass(slots=True, eq=False)
class CallFigures:
    """What one call adds, read once for all who count it.

    Attributes:
        payload_bytes: paper's accounting.
        wire_bytes: with all framing.
        snr_db: as reported; None where it was not, or is not finite.
        bridged: steps without an answer before it.
        answered: whether it ended with actions; the rest is 0 where not.
        tokens: used for the answer.
        decode_s, queue_s, predict_s, total_s: as they were told to the robot.
    """

    payload_bytes: int
    wire_bytes: int
    snr_db: float | None
    bridged: int = 0
    answered: bool = False
    tokens: int = 0
    decode_s: float = 0.0
    queue_s: float = 0.0
    predict_s: float = 0.0
    total_s: float = 0.0

    def note_answer(self, response: policy_pb2.InferResponse) -> None:
        """The call ended with actions."""
        timings = response.timings
        self.answered = True
        self.tokens = response.tokens_used
        self.decode_s, self.queue_s = timings.decode_s, timings.queue_s
        self.predict_s, self.total_s = timings.predict_s, timings.total_s


@dataclass(slots=True, eq=False)
class Totals:
    """Sums over everything.

    Attributes:
        answered, refused, bridged, payload_bytes, wire_bytes: as of :class:`Second`.
    """

    answered: int = 0
    refused: int = 0
    bridged: int = 0
    payload_bytes: int = 0
    wire_bytes: int = 0

    def add(self, call: CallFigures) -> None:
        """Counts one call."""
        if call.answered:
            self.answered += 1
        else:
            self.refused += 1
        self.bridged += call.bridged
        self.payload_bytes += call.payload_bytes
        self.wire_bytes += call.wire_bytes


@dataclass(slots=True, eq=False)
class Second:
    """Sums over calls.

    Attributes:
        at_s: which second, since 1970.
        answered: calls that ended with actions.
        refused: calls that did not.
        bridged: steps that robots had to do without an answer for, noticed at the next one.
        snr_reports, snr_db_sum, snr_db_low, snr_db_high: of the SNR that was reported, dB.
        tokens_sum, tokens_low, tokens_high: of the tokens used for answers.
        payload_bytes: paper's accounting, of all calls.
        wire_bytes: with all framing, of all calls.
        decode_s, queue_s, predict_s, total_s: sums over answers, as they were told to the robots.
        slowest_s: largest total.
    """

    at_s: int
    answered: int = 0
    refused: int = 0
    bridged: int = 0
    snr_reports: int = 0
    snr_db_sum: float = 0.0
    snr_db_low: float = math.inf
    snr_db_high: float = -math.inf
    tokens_sum: int = 0
    tokens_low: int = 2**31
    tokens_high: int = 0
    payload_bytes: int = 0
    wire_bytes: int = 0
    decode_s: float = 0.0
    queue_s: float = 0.0
    predict_s: float = 0.0
    total_s: float = 0.0
    slowest_s: float = 0.0

    def add(self, call: CallFigures) -> None:
        """Counts one call."""
        self.bridged += call.bridged
        self.payload_bytes += call.payload_bytes
        self.wire_bytes += call.wire_bytes
        snr_db = call.snr_db
        if snr_db is not None:
            self.snr_reports += 1
            self.snr_db_sum += snr_db
            if snr_db < self.snr_db_low:
                self.snr_db_low = snr_db
            if snr_db > self.snr_db_high:
                self.snr_db_high = snr_db
        if not call.answered:
            self.refused += 1
            return
        self.answered += 1
        tokens = call.tokens
        self.tokens_sum += tokens
        if tokens < self.tokens_low:
            self.tokens_low = tokens
        if tokens > self.tokens_high:
            self.tokens_high = tokens
        self.decode_s += call.decode_s
        self.queue_s += call.queue_s
        self.predict_s += call.predict_s
        self.total_s += call.total_s
        if call.total_s > self.slowest_s:
            self.slowest_s = call.total_s

    def row(self) -> Sequence[float | None]:
        """Numbers in the order of :data:`COLUMNS`; None where there was nothing to average."""
        reports, answered = self.snr_reports, self.answered
        ms = 1000.0 / answered if answered else 0.0
        snr = (self.snr_db_sum / reports, self.snr_db_low, self.snr_db_high) if reports else _NONE
        tokens = (
            (self.tokens_sum / answered, self.tokens_low, self.tokens_high) if answered else _NONE
        )
        times = (
            (self.decode_s * ms, self.queue_s * ms, self.predict_s * ms, self.total_s * ms)
            if answered
            else (None, *_NONE)
        )
        slowest_ms = 1000.0 * self.slowest_s if answered else None
        return [
            self.at_s,
            answered,
            self.refused,
            self.bridged,
            *(_rounded(value, 1) for value in (*snr, *tokens)),
            self.payload_bytes,
            self.wire_bytes,
            *(_rounded(value, 2) for value in (*times, slowest_ms)),
        ]


_NONE = (None, None, None)


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
