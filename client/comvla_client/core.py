"""One step without input or output; the synchronous and the asyncio client both drive this.

``prepare`` turns an observation into a request, ``complete`` an answer into a chunk, ``fail`` a
missing answer into the rest of the last chunk. Nothing here waits, calls or knows a socket.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from comvla import codec, handshake
from comvla.errors import HandshakeError
from comvla.model_info import ModelInfo
from comvla.v1.policy_pb2 import GetModelResponse, InferResponse
from comvla_client.advice import BackOff, TokenAdvice
from comvla_client.agreement import check_model, check_successor
from comvla_client.answers import answered, fallback_reason, read_actions
from comvla_client.budget import PAPER_LINK, LinkProfile
from comvla_client.edge import EdgeModel
from comvla_client.errors import TransportError
from comvla_client.observation import Observation, check_instruction, check_observation
from comvla_client.parts import check_parts, check_transport
from comvla_client.planning import Planner
from comvla_client.prepared import Prepared
from comvla_client.queue import ActionQueue, Actions
from comvla_client.registry import make_uplink
from comvla_client.report import PHASES, ActionChunk, StepReport
from comvla_client.selection import Selector
from comvla_client.sending import SendingPolicy, make_policy
from comvla_client.session import Session
from comvla_client.sizing import Budget
from comvla_client.snr import SnrInput, SnrReading, as_reading, as_source
from comvla_client.uplink import Setup, UplinkForm

WIND_UP_S = 0.002
"""What is kept of a deadline for giving up a call and writing the report, in seconds."""


class ClientCore:
    """State and decisions of one robot's client. Arguments are those of ``ComVLAClient``."""

    queue: ActionQueue

    def __init__(
        self,
        edge: EdgeModel | ModelInfo | None,
        *,
        link: LinkProfile = PAPER_LINK,
        quantization: str = "int8",
        selector: str | Selector = "hard_voting",
        uplink: str | UplinkForm | None = None,
        budget: Budget = "paper",
        sending: str | SendingPolicy = "paper",
        snr: SnrInput | None = None,
        deadline_s: float | None = None,
        min_tokens: int = 1,
        execute: int | None = None,
        hold: Sequence[float] | None = None,
        session_id: str | None = None,
        seed: int = 0,
        model: str = "",
    ) -> None:
        self._form = make_uplink(uplink, selector)
        self.sending = make_policy(sending)
        self._takes_any = edge is None
        self._edge = None if edge is None or isinstance(edge, ModelInfo) else edge
        check_parts(self._form, self.sending, self._edge)
        self._options = link, quantization, budget, min_tokens
        self._execute, self._hold, self._deadline_s = execute, hold, deadline_s
        self._info: ModelInfo | None = None
        if edge is not None:
            self._begin(edge if isinstance(edge, ModelInfo) else edge.info)
        self._snr = None if snr is None else as_source(snr)
        self._session = Session(session_id, seed, model)

    @property
    def info(self) -> ModelInfo:
        """The model that both sides run.

        Raises:
            HandshakeError: the robot has no half of its own, and has not asked the server yet.
        """
        if self._info is None:
            raise HandshakeError(
                "a robot without an edge model learns from the server what it runs: connect first"
            )
        return self._info

    @property
    def session(self) -> str:
        """Identity of the current episode on the wire."""
        return self._session.name

    def reset(self) -> None:
        """Begins a new episode: a new session, step 0, nothing left to execute."""
        self._session.reset()
        self.queue.clear()
        self.sending.reset()
        self._form.reset()

    def accept_server(self, response: GetModelResponse) -> ModelInfo:
        """The handshake: the server's model, if it fits the robot's half.

        Raises:
            HandshakeError: the first difference in words, with its remedy.
        """
        cloud = handshake.from_response(response)
        if self._info is None:
            self._begin(cloud)
        check_model(cloud, self.info, handshake.edge_fingerprints(response))
        if self.sending.progressive and not response.progressive:
            raise HandshakeError(
                f"client sends payloads in pieces, server {response.server_version or 'of no version'} "
                "has no InferProgressive: update the server, or choose sending='margin'"
            )
        self._form.check_server(response)
        return cloud

    def may_relearn(self, error: TransportError) -> bool:
        """Whether a call ended because the server has another model, and this robot can work with any:
        it has no half of its own and was told of none."""
        return error.code == "FAILED_PRECONDITION" and self._takes_any

    def relearn(self, response: GetModelResponse) -> TransportError:
        """Takes the server's word for its new model.

        Returns:
            Why the step that found out has no answer; the next one will.

        Raises:
            ModelChangedError: the robot would have to move otherwise than before.
        """
        before, after = self.info, handshake.from_response(response)
        check_successor(after, before)
        queue = self.queue
        self._info = None
        self.accept_server(response)
        if queue.horizon == self.queue.horizon:
            self.queue = queue  # what the robot holds with is no affair of the server's
        return TransportError(
            "ABORTED",
            f"the server has another model now, {after.name}: the next step asks that one",
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
        self._form.hear(check_instruction(instruction))
        reading = self._read_snr(snr)
        request = self._session.request(self.info, instruction, checked.proprio.tolist(), reading)
        plan = self._planner.plan(reading, request)
        report = self._planner.opened(reading, request, plan)
        plan = self._planner.as_advised(plan)
        planned = time.perf_counter()
        deadline = started + self.deadline_s - min(WIND_UP_S, 0.1 * self.deadline_s)
        rng = self._session.next_step()
        pause_s = self._back_off.remaining_s
        if plan.count and pause_s > 0.0:
            words = f"the server is busy: asking again in {pause_s:.3f} s at the earliest"
            plan = replace(plan, count=0, detail=words)
            return Prepared(
                None, report, started, deadline, plan, reason="overloaded", planned=planned
            )
        if plan.count == 0:
            if not self._form.in_pieces:
                plan = replace(plan, detail="the link carries too few bytes for any picture")
            return Prepared(None, report, started, deadline, plan, planned=planned)
        uplink = self._form.compress(checked, plan.count, rng)
        report = replace(
            report,
            positions=uplink.positions,
            image_quality=uplink.quality,
            timings_s=dict.fromkeys(PHASES, 0.0) | uplink.timings_s,
            edge_flops=uplink.flops,
        )
        if not uplink.sends:
            plan = replace(plan, count=0, detail=uplink.refusal)
            return Prepared(None, report, started, deadline, plan, planned=planned)
        stream = None
        if plan.progressive:
            stream = self._planner.stream(request, uplink.payload, len(uplink.positions), plan)
        else:
            uplink.fill(request)
        return Prepared(request, report, started, deadline, plan, uplink, stream, planned=planned)

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
        check_transport(self.sending, transport)

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
        self._form.settle(prepared.request.step, True)
        self._back_off.answered()
        self._planner.advice.hear(response.load.suggested_tokens)
        report = answered(self._closed(prepared, call_s, response.tokens_used), response)
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
        if prepared.request is not None:
            self._form.settle(prepared.request.step, False)
        reason = prepared.reason if error is None else fallback_reason(error)
        if error is not None:
            self._planner.advice.hear_refusal(error.hints.suggested_tokens)
            if reason == "overloaded":
                self._back_off.refused(error.hints.retry_after_s)
        detail = prepared.plan.detail if error is None else error.message
        actions, planned, source = self.queue.fall_back(hold=prepared.plan.hold)
        report = replace(
            self._closed(prepared, call_s, refused=reason == "overloaded"),
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

    def _closed(
        self, prepared: Prepared, call_s: float, arrived: int = 0, *, refused: bool = False
    ) -> StepReport:
        """The report with its times and with what crossed; the policy learns from it."""
        report, outcome = prepared.closed(call_s, arrived, self._payload_bytes)
        if not refused:  # turned away or not tried at all: neither says anything of the link
            self.sending.learn(outcome)
        return report

    def _payload_bytes(self, tokens: int) -> int:
        return codec.payload_bytes(tokens, self.info.token_dim, self._options[1])

    def _begin(self, info: ModelInfo) -> None:
        """What waits until the model is known."""
        self._info = info
        # Without its own half a robot cannot know; what the server cannot take it refuses in words.
        self._any_image_size = bool(getattr(self._edge, "any_image_size", self._edge is None))
        self.queue = ActionQueue(info, execute=self._execute, hold=self._hold)
        deadline_s = self._deadline_s
        self.deadline_s = _check_deadline(
            self.queue.execute * info.control_period_s if deadline_s is None else deadline_s
        )
        self._back_off = BackOff(self.queue.execute * info.control_period_s)
        self._form.start(Setup(info, self._edge, *self._options))
        self._planner = Planner(self._form, self.sending, TokenAdvice(info.num_tokens))

    def _read_snr(self, snr: float | SnrReading | None) -> SnrReading | None:
        if snr is not None:
            return as_reading(snr)
        return None if self._snr is None else self._snr.read()

    def _tell_source(self, report: StepReport) -> None:
        """Sources that learn from how steps end have ``observe``."""
        observe = getattr(self._snr, "observe", None)
        if observe is not None:
            observe(report)


def _check_deadline(deadline_s: float) -> float:
    if not (math.isfinite(deadline_s) and deadline_s > 0.0):
        raise ValueError(f"expected a deadline_s > 0 in seconds, got {deadline_s!r}")
    return deadline_s
