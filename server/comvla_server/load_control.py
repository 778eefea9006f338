"""Keeps a batcher's promises under overload: measures costs, lets in what fits, advises robots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

from comvla_server.admission import Admission
from comvla_server.busy import BusyMeter
from comvla_server.cost_model import CostModel, Work
from comvla_server.fairness import FairShares
from comvla_server.load_policy import LoadPolicy
from comvla_server.metrics import Metrics
from comvla_server.occupancy import Occupancy
from comvla_server.offered_load import OfferedLoad
from comvla_server.refusals import Refusal
from comvla_server.tickets import Place

# Whatever held answers up is over at some time, also where nobody is let in who could show it.
_LAG_HALF_LIFE_S = 0.5
# A halt of the machine says little of the next answer: no more of it is expected again.
_MOST_LAG_S = 0.25
# Costs that were too high once are tried again after this, however busy other models keep the thread.
_UNTRIED_S = 1.0
# A deadline is in danger where waiting uses up more than this share of its time.
_DANGER = 0.5


class LoadControl:
    """What one model can do, what it is asked for, and who gets it. Times are monotonic seconds.

    Args:
        max_batch: requests in a full batch.
        num_tokens: N.
        policy: what is switched on.
        costs: what passes cost, perhaps calibrated already.
        metrics: where predictions go.
        occupancy: of the inference thread, which other models may share.
    """

    def __init__(
        self,
        max_batch: int,
        num_tokens: int,
        policy: LoadPolicy,
        costs: CostModel,
        metrics: Metrics,
        occupancy: Occupancy | None = None,
    ) -> None:
        self._costs = costs
        self._shares = FairShares()
        self._offered = OfferedLoad(costs, max_batch, num_tokens, policy)
        self._admission = Admission(costs, self._shares, policy, max_batch)
        self._metrics = metrics
        self._busy = BusyMeter()
        self._occupancy = occupancy or Occupancy()
        self._occupancy.join(self, self._offered.load, self._offered.wished_load)
        self._running = False
        self._ended_s = 0.0
        self._lag_s = 0.0
        self._lagged_s = 0.0

    def order(self, waiting: Sequence[Place]) -> list[Place]:
        """Who is computed first."""
        return self._admission.order(waiting)

    def predict(
        self, place: Place, waiting: Sequence[Place], now_s: float, *, replaces: bool
    ) -> float:
        """Predicted seconds until a request's answer; counts nothing at all.

        Args:
            place: of the new request.
            waiting: the others, in order of arrival, without one that it replaces.
            now_s: the time.
            replaces: it takes the place of an older observation of its session.

        Raises:
            Refusal: it would be late, make another late, or is above its fair share.
        """
        self._admission.lag_s = self.lag_s(now_s)
        self._admission.turn_s = self._occupancy.turn_s(self)
        return self._admission.require(
            place,
            waiting,
            self.free_s(now_s),
            now_s,
            overloaded=self._occupancy.load(now_s) > 1.0,
            replaces=replaces,
            untried=not self._running and now_s - self._ended_s >= _UNTRIED_S,
        )

    def screen(
        self, place: Place, waiting: Sequence[Place], now_s: float, *, replaces: bool
    ) -> float:
        """:meth:`predict`, and counts a refusal, unless the model at rest would be too slow as well.

        Raises:
            Refusal: see :meth:`predict`.
        """
        try:
            return self.predict(place, waiting, now_s, replaces=replaces)
        except Refusal:
            # What could never be answered takes none of the model's time, however often it is asked.
            if place.deadline_s - now_s >= self.alone_s(place.work):
                self._note_asked(place, now_s)
                self._offered.note_pressure(now_s)
            raise

    def let_in(
        self, place: Place, waiting: Sequence[Place], now_s: float, *, replaces: bool
    ) -> None:
        """:meth:`screen`, and counts the request where it may come in.

        Raises:
            Refusal: see :meth:`screen`.
        """
        wait_s = self.screen(place, waiting, now_s, replaces=replaces)
        self._note_asked(place, now_s)
        if wait_s > _DANGER * (place.deadline_s - now_s):
            self._offered.note_pressure(now_s)
        self._metrics.predicted_wait.observe(max(0.0, wait_s))
        if not replaces:
            self._shares.credit(place.robot, now_s)

    def note_full(self, now_s: float) -> None:
        """Somebody was turned away because the queue is full."""
        self._offered.note_pressure(now_s)

    def note_unanswered(self, place: Place, now_s: float) -> None:
        """Whoever was let in leaves without an answer."""
        self._shares.credit(place.robot, now_s, -1.0)

    def begin(self, work: Work, now_s: float) -> None:
        """A pass starts."""
        self._running = True
        self._busy.begin(now_s)
        self._occupancy.begin(self, self._costs.predict(work), now_s)

    def end(self, work: Work, ready_s: float, now_s: float, *, succeeded: bool) -> None:
        """A pass ended.

        Args:
            work: of the pass.
            ready_s: since when there was this work and no other before it: a pass costs what passes
                until the next can begin, not only what the model takes.
            now_s: the time.
            succeeded: whether it says anything about costs.
        """
        self._running, self._ended_s = False, now_s
        self._busy.end(now_s)
        waited_until_s = self._occupancy.end(self, now_s)
        if succeeded:
            # The passes of other models that it waited for are no cost of this one.
            self._costs.observe(work, now_s - max(ready_s, waited_until_s))

    def close(self) -> None:
        """The model is gone."""
        self._occupancy.leave(self)

    def note_lag(self, lag_s: float, now_s: float) -> None:
        """How long an answer took from the model to its caller."""
        self._lag_s = max(min(lag_s, _MOST_LAG_S), self.lag_s(now_s))
        self._lagged_s = now_s

    def lag_s(self, now_s: float) -> float:
        """The longest such time of late, in seconds; it fades."""
        halvings = max(0.0, (now_s - self._lagged_s) / _LAG_HALF_LIFE_S)
        return self._lag_s * math.pow(0.5, halvings)

    def alone_s(self, work: Work) -> float:
        """Seconds that the model takes for one request when it has nothing else to do."""
        return self._costs.predict(work)

    def free_s(self, now_s: float) -> float:
        """When the next pass can begin; ``now_s`` where the inference thread rests."""
        return self._occupancy.free_s(self, now_s)

    def usual_work(self) -> Work:
        """What requests of late took, on average."""
        return self._offered.usual_work()

    def utilization(self, now_s: float) -> float:
        """Busy share of the inference thread over the last seconds, 0 to 1."""
        return self._busy.utilization(now_s)

    def load(self, now_s: float) -> float:
        """Work asked for as a share of what the model can do; above 1 is too much."""
        return self._offered.load(now_s)

    def suggested_tokens(self, now_s: float) -> int:
        """Tokens that a request should have at most, 0 for no wish."""
        return self._offered.advice(now_s, partial(self._occupancy.share, self, now_s))

    def _note_asked(self, place: Place, now_s: float) -> None:
        if place.robot:
            self._shares.note_asked(place.robot, now_s)
        self._offered.note(place.work, now_s)
