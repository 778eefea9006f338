"""One step without input or output; the synchronous and the asyncio client both drive this.

``prepare`` turns an observation into a request, ``complete`` an answer into a chunk, ``fail`` a
missing answer into the rest of the last chunk. Nothing here waits, calls or knows a socket.
"""

from __future__ import annotations

import math
import re
import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from comvla import codec
from comvla.model_info import PROTOCOL_VERSION, ModelInfo
from comvla.v1.policy_pb2 import GetModelResponse, InferRequest, InferResponse
from comvla_client.agreement import check_server
from comvla_client.answers import fallback_reason, read_actions
from comvla_client.budget import PAPER_LINK, LinkProfile
from comvla_client.edge import EdgeModel
from comvla_client.errors import TransportError
from comvla_client.observation import Observation, check_instruction, check_observation
from comvla_client.queue import ActionQueue, Actions
from comvla_client.report import PHASES, ActionChunk, FallbackReason, Load, StepReport
from comvla_client.selection import Selector, make_selector
from comvla_client.sizing import Budget, TokenSizer
from comvla_client.snr import SnrInput, SnrReading, as_reading, as_source
from comvla_client.uplink import TokenUplink

WIND_UP_S = 0.002
"""What is kept of a deadline for giving up a call and writing the report, in seconds."""

_SESSION_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:@/+=-]{0,99}")


@dataclass(frozen=True)
class Prepared:
    """A step between its request and its answer.

    Attributes:
        request: what to send; None when the link carries nothing.
        report: the account so far.
        started: when the step began, on ``time.perf_counter``.
        deadline: when its call has to be over, on the same clock.
    """

    request: InferRequest | None
    report: StepReport
    started: float
    deadline: float

    def remaining_s(self) -> float:
        """Seconds left for the call; negative when the edge half alone took too long."""
        return self.deadline - time.perf_counter()


class ClientCore:
    """State and decisions of one robot's client. Arguments are those of ``ComVLAClient``."""

    def __init__(
        self,
        edge: EdgeModel,
        *,
        link: LinkProfile = PAPER_LINK,
        quantization: str = "int8",
        selector: str | Selector = "hard_voting",
        budget: Budget = "paper",
        snr: SnrInput | None = None,
        deadline_s: float | None = None,
        min_tokens: int = 1,
        execute: int | None = None,
        hold: Sequence[float] | None = None,
        session_id: str | None = None,
        seed: int = 0,
    ) -> None:
        self.info: ModelInfo = edge.info
        self._any_image_size = bool(getattr(edge, "any_image_size", False))
        self.queue = ActionQueue(self.info, execute=execute, hold=hold)
        self.deadline_s = _check_deadline(
            self.queue.execute * self.info.control_period_s if deadline_s is None else deadline_s
        )
        self._quantization = quantization
        ranks = make_selector(selector)
        self._sizer = TokenSizer(
            self.info,
            link,
            quantization,
            budget,
            sends_all=ranks.sends_all,
            min_tokens=min_tokens,
        )
        self._uplink = TokenUplink(edge, ranks, quantization)
        self._snr = None if snr is None else as_source(snr)
        self._seed = seed
        self._session = _session_name(session_id)
        self._episode = 0
        self._step = 0

    @property
    def session(self) -> str:
        """Identity of the current episode on the wire."""
        return f"{self._session}.{self._episode}"

    def reset(self) -> None:
        """Begins a new episode: a new session, step 0, nothing left to execute."""
        self._episode += 1
        self._step = 0
        self.queue.clear()
        self._uplink.reset()

    def accept_server(self, response: GetModelResponse) -> ModelInfo:
        """The handshake: the server's model, if it fits the robot's half.

        Raises:
            HandshakeError: the first difference in words, with its remedy.
        """
        return check_server(
            response,
            self.info,
            quantization=self._quantization,
            most_tokens=self._sizer.most_tokens,
        )

    def prepare(
        self, obs: Observation, instruction: str, snr: float | SnrReading | None = None
    ) -> Prepared:
        """Everything a step does before it calls the server.

        Raises:
            ObservationError, InstructionError, LinkError: input that no step can use.
        """
        started = time.perf_counter()
        checked = check_observation(obs, self.info, any_size=self._any_image_size)
        queries = self._uplink.queries(check_instruction(instruction))
        reading = self._read_snr(snr)
        request = self._blank_request(instruction, checked.proprio.tolist(), reading)
        size = self._sizer.size(reading, request)
        report = StepReport(
            session=self.session,
            step=self._step,
            snr_db=None if reading is None else reading.snr_db,
            snr_age_s=None if reading is None else reading.age_s,
            capacity_bits=size.capacity_bits,
            token_budget=size.budget,
        )
        deadline = started + self.deadline_s - min(WIND_UP_S, 0.1 * self.deadline_s)
        rng = np.random.default_rng([self._seed, self._episode, self._step])
        self._step += 1
        if size.count == 0:
            return Prepared(None, report, started, deadline)
        uplink = self._uplink.compress(checked, queries, size.count, rng)
        request.payload = uplink.payload
        report = replace(
            report,
            tokens=len(uplink.positions),
            positions=uplink.positions,
            payload_bytes=codec.payload_bytes(
                len(uplink.positions), self.info.token_dim, self._quantization
            ),
            encoded_bytes=len(uplink.payload),
            framed_bytes=codec.wire_bytes(request.ByteSize()),
            timings_s=dict.fromkeys(PHASES, 0.0) | uplink.timings_s,
            edge_flops=uplink.flops,
        )
        return Prepared(request, report, started, deadline)

    def complete(self, prepared: Prepared, response: InferResponse, call_s: float) -> ActionChunk:
        """The chunk of an answer.

        Args:
            prepared: the step that was asked.
            response: the server's answer.
            call_s: seconds from sending to answer.

        Raises:
            HandshakeError: the answer comes from another model.
        """
        assert prepared.request is not None, "a step without a request has no answer"
        try:
            actions = read_actions(response, prepared.request, self.info)
        except TransportError as error:
            return self.fail(prepared, error, call_s)
        self.queue.accept(actions)
        timings = response.timings
        report = replace(
            self._timed(prepared, call_s),
            source="cloud",
            tokens_used=response.tokens_used,
            server_timings_s={
                "decode": timings.decode_s,
                "queue": timings.queue_s,
                "predict": timings.predict_s,
                "total": timings.total_s,
            },
            batch_size=response.batch_size,
            cloud_flops=response.cloud_flops,
            load=Load(
                queue_depth=response.load.queue_depth,
                utilization=response.load.utilization,
                suggested_tokens=response.load.suggested_tokens,
            ),
        )
        self._tell_source(report)
        return ActionChunk(actions=actions, planned=len(actions), report=report)

    def fail(
        self, prepared: Prepared, error: TransportError | None = None, call_s: float = 0.0
    ) -> ActionChunk:
        """The rest of the last chunk, then holding, where no answer came.

        Args:
            prepared: the step that got none.
            error: how the call ended; None where nothing was sent.
            call_s: seconds that the call took.

        Raises:
            HandshakeError, ObservationError, InstructionError, CodecError: a refusal that no later
                step can mend, in the server's words.
        """
        reason: FallbackReason = "no_link" if error is None else fallback_reason(error)
        detail = "the link carries too few tokens" if error is None else error.message
        actions, planned, source = self.queue.fall_back()
        report = replace(
            self._timed(prepared, call_s), source=source, fallback_reason=reason, detail=detail
        )
        if call_s == 0.0:  # no call was made, so nothing crossed the link
            report = replace(report, tokens=0, payload_bytes=0, encoded_bytes=0, framed_bytes=0)
        self._tell_source(report)
        return ActionChunk(actions=actions, planned=planned, report=report)

    def too_late(self, prepared: Prepared) -> TransportError:
        """The error of a step whose edge half alone used up the deadline."""
        spent_s = time.perf_counter() - prepared.started
        return TransportError(
            "DEADLINE_EXCEEDED",
            f"the edge half alone took {spent_s:.3f} s of the {self.deadline_s:.3f} s deadline, so "
            "nothing was sent: raise deadline_s or use a faster device",
        )

    def next_action(self) -> Actions | None:
        """The next action (A,) of the current chunk, or None when it is time for a step."""
        return self.queue.pop()

    def _timed(self, prepared: Prepared, call_s: float) -> StepReport:
        total_s = time.perf_counter() - prepared.started
        timings_s = prepared.report.timings_s | {"call": call_s, "total": total_s}
        return replace(prepared.report, timings_s=timings_s)

    def _read_snr(self, snr: float | SnrReading | None) -> SnrReading | None:
        if snr is not None:
            return as_reading(snr)
        return None if self._snr is None else self._snr.read()

    def _tell_source(self, report: StepReport) -> None:
        """Sources that learn from how steps end have ``observe``."""
        observe = getattr(self._snr, "observe", None)
        if observe is not None:
            observe(report)

    def _blank_request(
        self, instruction: str, proprio: list[float], reading: SnrReading | None
    ) -> InferRequest:
        request = InferRequest(
            session_id=self.session,
            step=self._step,
            instruction=instruction,
            proprio=proprio,
            model_fingerprint=self.info.fingerprint,
            protocol_version=PROTOCOL_VERSION,
        )
        if reading is not None and math.isfinite(reading.snr_db):
            request.snr_db, request.snr_age_s = reading.snr_db, reading.age_s
        return request


def _check_deadline(deadline_s: float) -> float:
    if not (math.isfinite(deadline_s) and deadline_s > 0.0):
        raise ValueError(f"expected a deadline_s > 0 in seconds, got {deadline_s!r}")
    return deadline_s


def _session_name(session_id: str | None) -> str:
    # The random part keeps a restarted robot from being answered out of the record that the
    # server holds of its former life.
    name, nonce = session_id or "robot", secrets.token_hex(4)
    if not _SESSION_NAME.fullmatch(name):
        raise ValueError(
            "expected a session_id of 1 to 100 letters, digits or ._:@/+=- that begins with a "
            f"letter or digit, got {session_id!r}"
        )
    return f"{name}.{nonce}"
