"""What a policy of sending is asked, and what it answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from comvla.errors import LinkError
from comvla_client.budget import LinkProfile
from comvla_client.snr import SnrReading


@dataclass(frozen=True)
class Situation:
    """The link and the payload at the moment of a step.

    Attributes:
        reading: the reported SNR with its age; None where nobody knows it.
        link: bandwidth, period, efficiency and reserve.
        num_tokens: N.
        most_tokens: the most that a step may send: N, or a fixed budget.
        min_tokens: fewer are not worth sending.
        tokens_in: tokens that so many bits carry, given whether they go in pieces and how many the
            first piece holds; counted as the client's ``budget`` says, and a fixed budget whatever
            the bits.
        needs_snr: whether nothing can be sized without an SNR.
        sends_all: the selector sends every token, whatever fits.
        periods: control periods that the payload may take.
    """

    reading: SnrReading | None
    link: LinkProfile
    num_tokens: int
    most_tokens: int
    min_tokens: int
    tokens_in: Callable[[float, bool, int], int]
    needs_snr: bool
    sends_all: bool = False
    periods: int = 1

    def capacity_bits(self, snr_db: float) -> float:
        """What crosses in time at this SNR: Eq. (1) over the window, bits."""
        return self.link.window_bits(snr_db, self.periods)

    def known(self, policy: str) -> SnrReading:
        """The reading of a policy that cannot do without.

        Raises:
            LinkError: there is none.
        """
        if self.reading is None:
            raise LinkError(
                f"sending={policy!r} sizes the payload by the SNR, and none is known: pass "
                "step(..., snr=dB), give the client an snr source, fix it with budget=K, or use "
                "sending='progressive'"
            )
        return self.reading

    def unsized(self, *, progressive: bool = False) -> Plan:
        """All that may be sent, where nothing limits it."""
        count = self.num_tokens if self.sends_all else self.most_tokens
        return Plan(
            count, count, count, self.periods, progressive=progressive, min_tokens=self.min_tokens
        )

    def sized(self, bits: float, *, expected_bits: float | None = None) -> Plan:
        """A payload for a link that carries ``bits``.

        Args:
            bits: what the policy allows.
            expected_bits: what it believes will cross of a payload in pieces; None sends it whole.
        """
        progressive = expected_bits is not None
        budget = self.tokens_in(bits, progressive, self.min_tokens)
        count = self.num_tokens if self.sends_all else min(budget, self.num_tokens)
        if bits <= 0.0 or count < self.min_tokens:
            count = 0  # without a link nothing is sent, whatever a fixed budget or a selector says
        expected = count
        if expected_bits is not None:
            expected = min(count, self.tokens_in(expected_bits, True, self.min_tokens))
        return Plan(
            budget,
            count,
            expected,
            self.periods,
            progressive=progressive,
            min_tokens=self.min_tokens,
            cap_bits=bits if progressive else None,
        )


@dataclass(frozen=True)
class Plan:
    """What a step sends.

    Attributes:
        budget: tokens that the policy allows, not clipped to the N there are.
        count: tokens to send; 0 sends nothing.
        expected: tokens that it counts on to arrive in time.
        periods: control periods that they may take.
        progressive: whether they go in pieces.
        min_tokens: fewer than this, arrived, are not worth computing on.
        cap_bits: bits that are handed to the network within the window at most; None: all.
        hold: whether to stand still now instead of going on with the last chunk.
        detail: why nothing is sent, in words.
    """

    budget: int
    count: int
    expected: int
    periods: int = 1
    progressive: bool = False
    min_tokens: int = 1
    cap_bits: float | None = None
    hold: bool = False
    detail: str = "the link carries too few tokens"


@dataclass(frozen=True)
class Outcome:
    """What became of a payload.

    Attributes:
        offered_tokens: tokens that were handed to the network.
        arrived_tokens: tokens that the server used; 0 where no answer came.
        arrived_bits: their share of the payload, bits.
        answered: whether an answer came.
        periods: control periods that it had.
    """

    offered_tokens: int
    arrived_tokens: int
    arrived_bits: float
    answered: bool
    periods: int = 1


class SendingPolicy(Protocol):
    """Decides at each step how much is sent, and how.

    One object serves one client. In each step ``hear`` is called once, then ``plan``, and ``learn``
    when it is known what became of the payload.

    Attributes:
        name: for reports.
        progressive: whether its payloads go in pieces, for which the server must be ready.
    """

    name: str
    progressive: bool

    def hear(self, reading: SnrReading) -> None:
        """Takes note of a reported SNR."""
        ...

    def plan(self, now: Situation) -> Plan:
        """What to send now; changes nothing that a second call would see.

        Raises:
            LinkError: it needs an SNR and there is none.
        """
        ...

    def learn(self, outcome: Outcome) -> None:
        """Takes note of what became of a payload."""
        ...

    def reset(self) -> None:
        """Begins a new episode. What was learned about the link may stay."""
        ...


class BasePolicy:
    """A policy without memory; the others derive from it.

    Attributes:
        name: for reports.
        progressive: whether its payloads go in pieces.
    """

    name = "base"
    progressive = False

    def hear(self, reading: SnrReading) -> None:
        """Takes no note."""

    def plan(self, now: Situation) -> Plan:
        """What to send now."""
        raise NotImplementedError

    def learn(self, outcome: Outcome) -> None:
        """Takes no note."""

    def reset(self) -> None:
        """Has nothing to forget."""
