"""A step between its request and its answer, and what of it crossed the link."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from comvla import codec
from comvla.v1.policy_pb2 import InferRequest
from comvla_client.report import FallbackReason, StepReport
from comvla_client.sending import Outcome, Plan
from comvla_client.streaming import PayloadStream
from comvla_client.uplink import Uplink


@dataclass(frozen=True)
class Prepared:
    """A step between its request and its answer.

    Attributes:
        request: what to send; None when nothing is sent.
        report: the account so far.
        started: when the step began, on ``time.perf_counter``.
        deadline: when its call has to be over, on the same clock.
        plan: what the policy of sending decided.
        uplink: what is sent; None when nothing is.
        stream: the payload in pieces; ``request`` then has none. None where it goes whole.
        reason: why nothing is sent, where nothing is.
        planned: when it was decided what to send, on the same clock.
    """

    request: InferRequest | None
    report: StepReport
    started: float
    deadline: float
    plan: Plan
    uplink: Uplink | None = None
    stream: PayloadStream | None = None
    reason: FallbackReason = "no_link"
    planned: float = 0.0

    def remaining_s(self) -> float:
        """Seconds left for the call; negative when the edge half alone took too long."""
        return self.deadline - time.perf_counter()

    def closed(
        self, call_s: float, arrived: int, payload_bytes: Callable[[int], int]
    ) -> tuple[StepReport, Outcome]:
        """The report with its times and with what crossed, and what the policy of sending learns.

        Args:
            call_s: seconds that the call took; 0 where there was none, and nothing crossed.
            arrived: tokens that the server used, or views where pictures were sent.
            payload_bytes: bytes of so many tokens, K·D·B.
        """
        timings_s = self.report.timings_s | {
            "call": call_s,
            "total": time.perf_counter() - self.started,
        }
        report, offered = replace(self.report, timings_s=timings_s), 0
        if self.uplink is None or self.request is None or call_s == 0.0:
            report = replace(report, positions=report.positions[:0], image_quality=None)
        elif self.stream is not None:
            offered = self.stream.taken_tokens
            report = replace(
                report,
                tokens=offered,
                positions=report.positions[:offered],
                payload_bytes=payload_bytes(offered),
                encoded_bytes=self.stream.taken_bytes,
                framed_bytes=self.stream.taken_wire_bytes,
            )
        else:
            offered = len(self.uplink.positions) or self.uplink.payload_bytes
            report = replace(
                report,
                tokens=len(self.uplink.positions),
                payload_bytes=self.uplink.payload_bytes,
                encoded_bytes=self.uplink.encoded_bytes,
                framed_bytes=codec.wire_bytes(self.request.ByteSize()),
            )
        arrived_bits = 8.0 * payload_bytes(arrived)
        if not report.tokens:  # pictures arrive whole or not at all
            arrived_bits = 8.0 * report.payload_bytes if arrived else 0.0
        outcome = Outcome(
            offered_tokens=offered,
            arrived_tokens=arrived,
            arrived_bits=arrived_bits,
            answered=arrived > 0,
            periods=self.plan.periods,
        )
        return report, outcome
