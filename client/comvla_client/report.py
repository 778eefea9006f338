"""What a step did: the chunk of actions and the account of how it came about."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

Source: TypeAlias = Literal["cloud", "rest", "hold"]
FallbackReason: TypeAlias = Literal[
    "no_link", "deadline", "unavailable", "overloaded", "rejected", "unauthorized"
]

PHASES = ("encode", "project", "score", "select", "quantize", "call", "total")


def _no_positions() -> npt.NDArray[np.int32]:
    return np.zeros(0, dtype=np.int32)


@dataclass(frozen=True)
class Load:
    """How busy the server was when it answered.

    Attributes:
        queue_depth: requests waiting.
        utilization: share of recent time that inference was busy, 0 to 1.
        suggested_tokens: tokens per request that the server would like; 0 for no wish.
    """

    queue_depth: int
    utilization: float
    suggested_tokens: int


@dataclass(frozen=True)
class StepReport:
    """Account of one step. Counts are 0 and timings 0.0 for what did not happen.

    Attributes:
        session: identity of the episode on the wire.
        step: number of the query in its session, from 0.
        uplink: name of the form in which it was sent: a selector, or a picture coding such as jpeg-75.
        source: where the actions came from: ``cloud``, the ``rest`` of the last chunk, or ``hold``.
        fallback_reason: why not from the cloud; None where they are.
        detail: the server's or the channel's own words about a fallback.
        snr_db: SNR that sized the payload, in dB; None where nobody gave one.
        snr_age_s: its age in seconds.
        capacity_bits: C_link of Eq. (1) at that SNR, over the period less the link's reserve; None
            without an SNR.
        policy: name of the policy of sending.
        token_budget: what that policy allowed, before it is clipped to the N tokens there are; bytes
            where pictures are sent.
        advised_tokens: the most that a busy server asked for lately; None where it has no such wish.
        paper_budget: K* of Eq. (4) at that SNR; None without an SNR, or for pictures.
        framed_budget: the same by all bytes that cross the wire; None as above.
        window_s: seconds that the payload had to cross.
        tokens: tokens handed to the network; 0 where pictures were.
        tokens_used: tokens that the server received whole and used, or made of the pictures.
        positions: (K,) int32 positions sent, most important first.
        image_quality: of the pictures, where the link decided it.
        payload_bytes: the paper's accounting, K·D·B/8; for pictures their files.
        encoded_bytes: length of the coded payload, with positions and scales, or of the pictures with
            their sizes.
        framed_bytes: what crossed the socket for the request: protobuf, gRPC and HTTP/2 framing.
        timings_s: seconds by phase on the robot's clock: those of :data:`PHASES`.
        server_timings_s: seconds by phase on the server's clock: decode, queue, predict, total.
        batch_size: requests that shared the forward pass.
        edge_flops: floating point operations of this step on the robot.
        cloud_flops: this request's share of the operations in the cloud.
        load: the server's hint; None without an answer.
    """

    session: str
    step: int
    uplink: str = ""
    source: Source = "hold"
    fallback_reason: FallbackReason | None = None
    detail: str = ""
    snr_db: float | None = None
    snr_age_s: float | None = None
    capacity_bits: float | None = None
    policy: str = "paper"
    token_budget: int = 0
    advised_tokens: int | None = None
    paper_budget: int | None = None
    framed_budget: int | None = None
    window_s: float = 0.0
    tokens: int = 0
    tokens_used: int = 0
    positions: npt.NDArray[np.int32] = field(default_factory=_no_positions)
    image_quality: int | None = None
    payload_bytes: int = 0
    encoded_bytes: int = 0
    framed_bytes: int = 0
    timings_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    server_timings_s: dict[str, float] = field(default_factory=dict)
    batch_size: int = 0
    edge_flops: float = 0.0
    cloud_flops: float = 0.0
    load: Load | None = None

    def to_dict(self) -> dict[str, Any]:
        """The report as plain values for ``json.dumps``: an SNR of −inf becomes the string "-inf"."""
        plain = dataclasses.asdict(self)
        plain["positions"] = self.positions.tolist()
        # JSON has no infinity, and a reader in another language must not stumble over Python's own.
        if self.snr_db is not None and math.isinf(self.snr_db):
            plain["snr_db"] = "-inf"
        return plain


@dataclass(frozen=True, eq=False)
class ActionChunk:
    """Actions to execute next.

    Attributes:
        actions: (H, A) float32, un-normalised. Always H rows: a fallback is filled up by holding.
        planned: how many of the leading rows a policy chose; the others hold.
        report: how they came about.
    """

    actions: npt.NDArray[np.float32]
    planned: int
    report: StepReport

    @property
    def source(self) -> Source:
        """``cloud``, the ``rest`` of the last chunk, or ``hold``."""
        return self.report.source
