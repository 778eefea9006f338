"""How much a step may send, and in which form."""

from __future__ import annotations

from dataclasses import replace

from comvla.v1.policy_pb2 import InferRequest
from comvla_client.advice import TokenAdvice
from comvla_client.report import StepReport
from comvla_client.sending import Plan, SendingPolicy, Situation
from comvla_client.sizing import TokenSizer
from comvla_client.snr import SnrReading
from comvla_client.streaming import PayloadStream
from comvla_client.uplink import UplinkForm


class Planner:
    """Asks the policy of sending, within what a busy server wishes.

    Args:
        form: of what goes up; started.
        sending: the policy.
        advice: the server's wishes.

    Attributes:
        advice: the server's wishes.
    """

    def __init__(self, form: UplinkForm, sending: SendingPolicy, advice: TokenAdvice) -> None:
        self._form = form
        self._sending = sending
        self.advice = advice

    def plan(self, reading: SnrReading | None, request: InferRequest) -> Plan:
        """What the policy of sending decides.

        Args:
            reading: the link's state as far as it is known.
            request: without its payload; its frame is counted.
        """
        if reading is not None:
            self._sending.hear(reading)
        sizer, link = self._form.sizer, self._form.sizer.link

        def tokens_in(bits: float, progressive: bool, least: int) -> int:
            return sizer.tokens_in(
                bits, request, progressive=progressive, least=least, window_s=link.window_s
            )

        return self._sending.plan(
            Situation(
                reading=reading,
                link=link,
                num_tokens=sizer.num_tokens,
                most_tokens=sizer.most_tokens,
                min_tokens=sizer.min_tokens,
                tokens_in=tokens_in,
                needs_snr=sizer.needs_snr,
                sends_all=sizer.sends_all,
            )
        )

    def as_advised(self, plan: Plan) -> Plan:
        """No more tokens than a busy server asked for, but what the policy of sending finds useful."""
        bound = self.advice.most_tokens
        if bound is None or not self._form.in_pieces or self._form.sizer.sends_all:
            return plan
        bound = max(bound, plan.min_tokens)
        return replace(plan, count=min(plan.count, bound), expected=min(plan.expected, bound))

    def opened(self, reading: SnrReading | None, request: InferRequest, plan: Plan) -> StepReport:
        """The account of a step of which only the plan is known."""
        report = StepReport(
            session=request.session_id,
            step=request.step,
            uplink=self._form.name,
            policy=self._sending.name,
            token_budget=plan.budget,
            advised_tokens=self.advice.most_tokens,
            window_s=self._window_s(plan),
        )
        if reading is None:
            return report
        sizer = self._form.sizer
        bits = sizer.link.window_bits(reading.snr_db)
        budgets = sizer.token_budgets(
            bits,
            request,
            progressive=plan.progressive,
            least=plan.min_tokens,
            window_s=report.window_s,
        )
        paper_budget, framed_budget = (None, None) if budgets is None else budgets
        return replace(
            report,
            snr_db=reading.snr_db,
            snr_age_s=reading.age_s,
            capacity_bits=bits,
            paper_budget=paper_budget,
            framed_budget=framed_budget,
        )

    def _window_s(self, plan: Plan) -> float:
        link = self._form.sizer.link
        return (plan.periods - 1) * link.period_s + link.window_s

    def stream(
        self, request: InferRequest, payload: bytes, count: int, plan: Plan
    ) -> PayloadStream:
        """A payload in the pieces that the plan asks for.

        Args:
            request: without its payload.
            payload: all of it, most important tokens first.
            count: tokens in it.
            plan: for it.
        """
        sizer, window_s = self._form.sizer, self._window_s(plan)
        assert isinstance(sizer, TokenSizer), "only tokens go in pieces"
        bits = 8.0 * len(payload) if plan.cap_bits is None else plan.cap_bits
        ends = sizer.piece_ends(count, bits, plan.min_tokens)
        rate = None if plan.cap_bits is None else plan.cap_bits / 8.0 / window_s
        return PayloadStream(request, payload, ends, window_s, plan.min_tokens, rate)
