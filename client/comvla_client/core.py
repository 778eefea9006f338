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
from typing import Any

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
from comvla_client.sending import Outcome, Plan, SendingPolicy, Situation, make_policy
from comvla_client.sizing import Budget, TokenSizer
from comvla_client.snr import SnrInput, SnrReading, as_reading, as_source
from comvla_client.streaming import PayloadStream
from comvla_client.uplink import TokenUplink

WIND_UP_S = 0.002
"""What is kept of a deadline for giving up a call and writing the report, in seconds."""

_SESSION_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:@/+=-]{0,99}")


@dataclass(frozen=True)
class Prepared:
    """A step between its request and its answer.

    Attributes:
        request: what to send; None when nothing is sent.
        report: the account so far.
        started: when the step began, on ``time.perf_counter``.
        deadline: when its call has to be over, on the same clock.
        plan: what the policy of sending decided.
        stream: the payload in pieces; ``request`` then has none. None where it goes whole.
    """

    request: InferRequest | None
    report: StepReport
    started: float
    deadline: float
    plan: Plan
    stream: PayloadStream | None = None

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
        sending: str | SendingPolicy = "paper",
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
        self.sending = make_policy(sending)
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
        self.sending.reset()
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
            progressive=self.sending.progressive,
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
        plan = self._plan(reading, request)
        report = self._opened(reading, request, plan)
        deadline = started + self.deadline_s - min(WIND_UP_S, 0.1 * self.deadline_s)
        rng = np.random.default_rng([self._seed, self._episode, self._step])
        self._step += 1
        if plan.count == 0:
            return Prepared(None, report, started, deadline, plan)
        uplink = self._uplink.compress(checked, queries, plan.count, rng)
        stream = None
        if plan.progressive:
            stream = self._stream(request, uplink.payload, len(uplink.positions), plan)
        else:
            request.payload = uplink.payload
        report = replace(
            report,
            positions=uplink.positions,
            timings_s=dict.fromkeys(PHASES, 0.0) | uplink.timings_s,
            edge_flops=uplink.flops,
        )
        return Prepared(request, report, started, deadline, plan, stream)

    def call(self, transport: Any, prepared: Prepared, timeout_s: float) -> Any:
        """Hands a step to a transport in the form that its plan asks for; the transport's result.

        Args:
            transport: synchronous or asynchronous, checked by :meth:`check_transport`.
            prepared: a step with a request.
            timeout_s: seconds left for the call.
        """
        if prepared.stream is not None:
            return transport.infer_progressive(prepared.stream, timeout_s)
        if prepared.plan.periods > 1 and hasattr(transport, "infer_within"):
            return transport.infer_within(prepared.request, timeout_s, prepared.report.window_s)
        return transport.infer(prepared.request, timeout_s)

    def check_transport(self, transport: object) -> None:
        """Whether a transport can carry what the policy of sending will ask of it.

        Raises:
            ValueError: the policy sends pieces, and it takes none.
        """
        if self.sending.progressive and not hasattr(transport, "infer_progressive"):
            raise ValueError(
                f"sending={self.sending.name!r} needs a transport with infer_progressive(stream, "
                f"timeout_s), {type(transport).__name__} has none: add it, or choose another policy"
            )

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
            self._closed(prepared, call_s, response.tokens_used),
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
        detail = prepared.plan.detail if error is None else error.message
        actions, planned, source = self.queue.fall_back(hold=prepared.plan.hold)
        report = replace(
            self._closed(prepared, call_s),
            source=source,
            fallback_reason=reason,
            detail=detail,
        )
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

    def _plan(self, reading: SnrReading | None, request: InferRequest) -> Plan:
        if reading is not None:
            self.sending.hear(reading)
        sizer, link = self._sizer, self._sizer.link

        def tokens_in(bits: float, progressive: bool, least: int) -> int:
            return sizer.tokens_in(
                bits, request, progressive=progressive, least=least, window_s=link.window_s
            )

        return self.sending.plan(
            Situation(
                reading=reading,
                link=link,
                num_tokens=self.info.num_tokens,
                most_tokens=sizer.most_tokens,
                min_tokens=sizer.min_tokens,
                tokens_in=tokens_in,
                needs_snr=sizer.needs_snr,
                sends_all=sizer.sends_all,
            )
        )

    def _opened(self, reading: SnrReading | None, request: InferRequest, plan: Plan) -> StepReport:
        report = StepReport(
            session=self.session,
            step=self._step,
            policy=self.sending.name,
            token_budget=plan.budget,
            window_s=self._window_s(plan),
        )
        if reading is None:
            return report
        bits = self._sizer.link.window_bits(reading.snr_db)
        return replace(
            report,
            snr_db=reading.snr_db,
            snr_age_s=reading.age_s,
            capacity_bits=bits,
            paper_budget=self._sizer.paper_tokens(bits),
            framed_budget=self._sizer.framed_tokens(
                bits,
                request,
                progressive=plan.progressive,
                least=plan.min_tokens,
                window_s=report.window_s,
            ),
        )

    def _window_s(self, plan: Plan) -> float:
        link = self._sizer.link
        return (plan.periods - 1) * link.period_s + link.window_s

    def _stream(
        self, request: InferRequest, payload: bytes, count: int, plan: Plan
    ) -> PayloadStream:
        window_s = self._window_s(plan)
        bits = 8.0 * len(payload) if plan.cap_bits is None else plan.cap_bits
        ends = self._sizer.piece_ends(count, bits, plan.min_tokens)
        rate = None if plan.cap_bits is None else plan.cap_bits / 8.0 / window_s
        return PayloadStream(request, payload, ends, window_s, plan.min_tokens, rate)

    def _closed(self, prepared: Prepared, call_s: float, arrived: int = 0) -> StepReport:
        """The report with its times and with what crossed; the policy learns from it."""
        report, request, stream = prepared.report, prepared.request, prepared.stream
        timings_s = report.timings_s | {
            "call": call_s,
            "total": time.perf_counter() - prepared.started,
        }
        report = replace(report, timings_s=timings_s)
        # Without a call nothing crossed the link.
        if request is None or call_s == 0.0:
            report = replace(report, positions=report.positions[:0])
        else:
            sent = len(report.positions) if stream is None else stream.taken_tokens
            report = replace(
                report,
                tokens=sent,
                positions=report.positions[:sent],
                payload_bytes=self._payload_bytes(sent),
                encoded_bytes=len(request.payload) if stream is None else stream.taken_bytes,
                framed_bytes=codec.wire_bytes(request.ByteSize())
                if stream is None
                else stream.taken_wire_bytes,
            )
        self.sending.learn(
            Outcome(
                offered_tokens=report.tokens,
                arrived_tokens=arrived,
                arrived_bits=8.0 * self._payload_bytes(arrived),
                answered=arrived > 0,
                periods=prepared.plan.periods,
            )
        )
        return report

    def _payload_bytes(self, tokens: int) -> int:
        return codec.payload_bytes(tokens, self.info.token_dim, self._quantization)

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
