"""Below a useful minimum nothing is sent."""

from __future__ import annotations

from dataclasses import replace

from comvla.errors import LinkError
from comvla_client.sending.paper import Paper
from comvla_client.sending.plan import Outcome, Plan, SendingPolicy, Situation
from comvla_client.snr import SnrReading

USEFUL_TOKENS = 20
"""About where the success of published policies over K has its knee."""


class Floor:
    """Wraps a policy: what is too little to be useful does not cross at all.

    In a fade the robot goes on with its last chunk. At the next step the payload may take as many
    control periods as were missed, up to ``periods``, so that a thin link still gets a useful number
    of tokens across. After ``patience`` missed steps in a row the robot no longer goes on with what
    it planned long ago: it holds until something useful crosses.

    Args:
        policy: who decides how much fits.
        tokens: the useful minimum; clipped to what a step may send at all.
        periods: the most control periods that one payload may take.
        patience: missed steps in a row after which the robot holds.

    Raises:
        LinkError: a number below 1.
    """

    def __init__(
        self,
        policy: SendingPolicy | None = None,
        tokens: int = USEFUL_TOKENS,
        *,
        periods: int = 2,
        patience: int = 3,
    ) -> None:
        if min(tokens, periods, patience) < 1:
            raise LinkError(
                "expected tokens, periods and patience of at least 1, got "
                f"{tokens}, {periods} and {patience}"
            )
        self.policy = policy or Paper()
        self.tokens = tokens
        self.periods = periods
        self.patience = patience
        self.name = "floor" if isinstance(self.policy, Paper) else f"{self.policy.name}+floor"
        self.progressive = self.policy.progressive
        self._missed = 0

    def hear(self, reading: SnrReading) -> None:
        """Passes it on."""
        self.policy.hear(reading)

    def plan(self, now: Situation) -> Plan:
        """The policy's plan in as few periods as make it useful, or nothing."""
        useful = min(max(self.tokens, now.min_tokens), now.most_tokens)
        now = replace(now, min_tokens=useful)
        longest = min(self.periods, 1 + self._missed)
        for periods in range(1, longest + 1):
            plan = self.policy.plan(replace(now, periods=periods))
            if plan.count and plan.expected >= useful:
                return plan
        missed = self._missed + 1
        hold = missed > self.patience
        return replace(
            plan,
            count=0,
            hold=hold,
            detail=f"the link carries fewer than {useful} tokens in {longest} periods, missed "
            f"{missed} in a row{': holding' if hold else ''}",
        )

    def learn(self, outcome: Outcome) -> None:
        """Counts what was missed, and passes the rest on."""
        if outcome.offered_tokens:
            self._missed = 0
        else:
            self._missed += 1
        self.policy.learn(outcome)

    def reset(self) -> None:
        """Nothing was missed yet."""
        self._missed = 0
        self.policy.reset()
