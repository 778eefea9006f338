"""Whether a new request can be answered in time, and whose turn it is: decided at the door.

A request that waits and dies has cost its robot a period and the link its bytes; one that is turned
away at once has cost a round trip, and learns when to come back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import attrgetter

from comvla_server.cost_model import CostModel, Work
from comvla_server.fairness import FairShares
from comvla_server.load_policy import LoadPolicy
from comvla_server.refusals import Reason, Refusal
from comvla_server.tickets import Place
from comvla_server.wording import shown

# Under overload a longer queue gives no more answers, only older ones, and nothing to spare where something is
# slower than predicted: beyond a full batch nobody is let in who would wait for more than this share of its time,
# and beyond the other share only who did not get more than others.
_FULL_AT = 0.6
_FAIR_FROM = 0.3
# No hint is shorter: it would be over before the robot has read it.
_LEAST_RETRY_S = 0.001


class Admission:
    """Predicts when whoever waits will be answered, by the costs that were measured.

    Args:
        costs: what passes cost.
        shares: who got how many answers.
        policy: what is switched on.
        max_batch: requests in a full batch.

    Attributes:
        lag_s: how long answers take lately from the model to the network, seconds.
        turn_s: what other models take between two passes of this one, seconds.
    """

    def __init__(
        self, costs: CostModel, shares: FairShares, policy: LoadPolicy, max_batch: int
    ) -> None:
        self._costs = costs
        self._shares = shares
        self._policy = policy
        self._max_batch = max_batch
        self.lag_s = self.turn_s = 0.0

    def order(self, waiting: Sequence[Place]) -> list[Place]:
        """Who is computed first: whose place is due first, else in order of arrival."""
        if self._policy.earliest_deadline_first:
            return sorted(waiting, key=attrgetter("due_s"))
        return list(waiting)

    def finish_s(self, ordered: Sequence[Place], free_s: float) -> list[float]:
        """When each of them will be answered, margins for what is uncertain included.

        Args:
            ordered: who waits, first to be computed first.
            free_s: when the model is done with what it computes now.

        Returns:
            Monotonic seconds, in the same order. All of one pass are answered at its end.
        """
        times: list[float] = []
        margin_s = self._policy.deadline_margin_s + self.lag_s
        for passes, start in enumerate(range(0, len(ordered), self._max_batch), 1):
            batch = ordered[start : start + self._max_batch]
            # What other models compute now is part of free_s; before each later pass comes their turn again.
            turn_s = self.turn_s if passes > 1 else 0.0
            free_s += turn_s + self._costs.predict(Work.of([place.work for place in batch]))
            # Misses of several passes cancel out in part.
            spread_s = math.sqrt(passes) * self._costs.spread_s
            times += [free_s + spread_s + margin_s] * len(batch)
        return times

    def require(
        self,
        place: Place,
        waiting: Sequence[Place],
        free_s: float,
        now_s: float,
        *,
        overloaded: bool,
        replaces: bool,
        untried: bool = False,
    ) -> float:
        """Lets a request in, or says why not.

        Args:
            place: of the new one.
            waiting: the others, in order of arrival; not the one that it replaces.
            free_s: when the model is done with what it computes now; ``now_s`` where it is idle.
            now_s: monotonic seconds.
            overloaded: robots ask for more than the model can do.
            replaces: it takes the place of an older one of its session.
            untried: the model computed nothing for a while, though others may use its thread.

        Returns:
            Predicted seconds until its answer.

        Raises:
            Refusal: predicted late, or above its fair share; with a hint when to retry.
        """
        ordered = self.order([*waiting, place])
        times = self.finish_s(ordered, free_s)
        mine = ordered.index(place)
        wait_s = times[mine] - now_s
        # A model that rests tries everything: a prediction that was wrong could not be mended else.
        rests = free_s <= now_s or (untried and free_s < place.deadline_s)
        idle = not waiting and rests
        if not self._policy.admission or idle:
            return wait_s
        if (
            self._policy.fair_shares
            and overloaded
            and not replaces
            and 2 * len(waiting) >= self._max_batch
            and wait_s > _FAIR_FROM * (place.deadline_s - now_s)
            and self._shares.above_mean(place.robot, now_s)
        ):
            pass_s = self._pass_s(ordered)
            raise Refusal(
                Reason.FAIR_SHARE,
                f"{len(waiting)} requests wait, and {shown(place.robot)} got more answers lately than "
                f"other robots: retry in {pass_s:.3f} s, send fewer tokens, or add a replica",
                retry_after_s=max(_LEAST_RETRY_S, pass_s),
            )
        limit_s = place.deadline_s
        if overloaded and len(waiting) >= self._max_batch:
            limit_s = now_s + _FULL_AT * (limit_s - now_s)
        if times[mine] > limit_s:
            raise self._late(place, wait_s, now_s, times[mine] - limit_s)
        self._require_others(place, ordered, times, mine, free_s, wait_s, now_s)
        return wait_s

    def _require_others(
        self,
        place: Place,
        ordered: list[Place],
        times: list[float],
        mine: int,
        free_s: float,
        wait_s: float,
        now_s: float,
    ) -> None:
        """Nobody who was let in may become late because of a new one."""
        first = mine - mine % self._max_batch
        late = [
            other
            for other, at_s in zip(ordered[first:], times[first:], strict=True)
            if at_s > other.deadline_s and other is not place
        ]
        if not late:
            return
        without = [other for other in ordered if other is not place]
        before = dict(zip(map(id, without), self.finish_s(without, free_s), strict=True))
        if any(before[id(other)] <= other.deadline_s for other in late):
            raise self._late(place, wait_s, now_s, self._pass_s(ordered))

    def _pass_s(self, ordered: list[Place]) -> float:
        """Seconds of the next pass."""
        batch = ordered[: self._max_batch]
        return self._costs.predict(Work.of([place.work for place in batch]))

    def _late(self, place: Place, wait_s: float, now_s: float, excess_s: float) -> Refusal:
        retry_s = max(_LEAST_RETRY_S, excess_s)
        return Refusal(
            Reason.PREDICTED_LATE,
            f"expected an answer within {place.deadline_s - now_s:.3f} s, this one or one that "
            f"waits already would be late: {wait_s:.3f} s are predicted for {place.work.tokens} "
            f"tokens; retry in {retry_s:.3f} s, send fewer tokens, or add a replica",
            retry_after_s=retry_s,
        )
