"""An episode's link in simulated time: what the robot is told of it, and what it made of that."""

from __future__ import annotations

from dataclasses import dataclass, field

from comvla_client import StepReport
from comvla_client.sending import SendingPolicy
from comvla_client.snr import SnrReading
from comvla_client.transport_protocol import Transport
from comvla_sim.experiments.link_case import LEAD_IN, LinkCase
from comvla_sim.link import EnforcedLink, LinkRecord

_MOST_WAITING = 32
"""Periods that a payload may still be crossing when the episode ends, and then some."""

_MOST = 999.0
"""What stands for an overrun of a link that carries nothing at all; JSON has no infinity."""


@dataclass
class LinkUse:
    """What became of an episode's queries. An overrun is bytes offered over bytes that fit.

    Attributes:
        sent: requests that were put on the air.
        answered: requests whose answer came in time.
        lost: requests of which too little arrived in time.
        no_link: queries that sent nothing, since the budget was below the fewest tokens.
        waited_periods: control periods that the robot held while a payload was still crossing.
        held_periods: control periods in which the robot executed nothing that a policy chose, the
            waited ones included.
        offered_bytes: of all requests, every byte on the wire.
        delivered_bytes: what crossed in time.
        offered_tokens: of all requests.
        delivered_tokens: what arrived whole.
        overruns: of each request against the capacity of its period, every byte on the wire counted.
        payload_overruns: the same with K·D·B/8 alone counted, as the paper does.
    """

    sent: int = 0
    answered: int = 0
    lost: int = 0
    no_link: int = 0
    waited_periods: int = 0
    held_periods: int = 0
    offered_bytes: int = 0
    delivered_bytes: int = 0
    offered_tokens: int = 0
    delivered_tokens: int = 0
    overruns: list[float] = field(default_factory=list)
    payload_overruns: list[float] = field(default_factory=list)


class EpisodeLink:
    """Stands between the robot and the cloud for the length of one episode.

    Args:
        case: the link and how it is used.
        seed: of its fading.
        periods: control periods that the episode may last.
        transport: reaches the cloud half.

    Raises:
        LinkError: a link that cannot be.
    """

    def __init__(self, case: LinkCase, seed: int, periods: int, transport: Transport) -> None:
        self.case = case
        self.seed = seed
        self.use = LinkUse()
        values = case.make_channel(seed).snr_db(LEAD_IN + periods + _MOST_WAITING)
        self._reported = values[: len(values) - case.csi_delay]
        self.transport = EnforcedLink(
            transport,
            values[LEAD_IN:].tolist(),
            case.profile(),
            mode=case.enforce,  # type: ignore[arg-type]  # checked by the case
        )
        self._lead_in_s: float | None = None
        self._seen = 0

    def _reading(self, period: int) -> SnrReading:
        """The report in a period of the episode, those of the lead-in being negative."""
        case = self.case
        snr_db = self._reported[LEAD_IN + period - case.csi_delay]
        return SnrReading(float(snr_db), case.csi_delay * case.period_s)

    def reading(self) -> SnrReading:
        """What the robot is told now: the SNR of d periods ago."""
        return self._reading(self.transport.period)

    def _clock_s(self) -> float:
        return self.transport.time_s if self._lead_in_s is None else self._lead_in_s

    def sending(self) -> SendingPolicy:
        """The robot's policy of sending, which has listened to the reports of the lead-in."""
        policy = self.case.make_sending(self._clock_s)
        for period in range(self.case.csi_delay - LEAD_IN, 0):
            self._lead_in_s = period * self.case.period_s
            policy.hear(self._reading(period))
        self._lead_in_s = None
        return policy

    @property
    def period(self) -> int:
        """The current control period of the episode, from 0."""
        return self.transport.period

    def advance(self) -> None:
        """One control period passes."""
        self.transport.advance()

    def account(self, report: StepReport) -> LinkRecord | None:
        """Takes one query into the accounts.

        Returns:
            What the link did with its request; None where none was sent.
        """
        use, log = self.use, self.transport.log
        if len(log) == self._seen:
            use.no_link += 1
            return None
        self._seen = len(log)
        record = log[-1]
        use.sent += 1
        use.waited_periods += record.waited_periods
        if report.source == "cloud":
            use.answered += 1
        else:
            use.lost += 1
        use.offered_bytes += record.offered_bytes
        use.delivered_bytes += record.delivered_bytes
        use.offered_tokens += record.offered_tokens
        use.delivered_tokens += record.delivered_tokens
        use.overruns.append(_ratio(8 * record.offered_bytes, record.capacity_bits))
        use.payload_overruns.append(_ratio(8 * report.payload_bytes, record.capacity_bits))
        return record


def _ratio(bits: float, capacity_bits: float) -> float:
    return min(_MOST, round(bits / capacity_bits, 3)) if capacity_bits > 0 else _MOST
