"""What robots ask for, answered or not, and how many tokens the server would rather have."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from comvla_server.cost_model import CostModel, Work
from comvla_server.load_policy import LoadPolicy

# Time in which what was asked fades to 37 %: long enough for a steady rate, short enough to follow.
_MEMORY_S = 2.0
_WISHES = 256
_FEWEST_WISHES = 8
_RENEW_AFTER_S = 0.1


class OfferedLoad:
    """Rate and sizes of new requests, compared with what the model can do.

    Advice: let a fleet that asks r times per second be answered with a share ρ of the model's time.
    A request of K tokens costs c(K) = fixed / batch + request + K · token seconds where batches are
    full, so r · c = ρ says how many tokens a request may have on average. Robots whose link carries
    fewer than that leave room to the others: the level L advised is where the mean of min(K, L)
    meets it. It depends on how often robots ask and on what they would like to send, not on what
    they send after they were advised, so it does not swing. It begins when deadlines come into
    danger, since robots that wait for each answer before they ask again keep a model busy and need
    no advice, and ends when there is time for what robots would like to send.

    Args:
        costs: what passes cost.
        max_batch: requests in a full batch.
        num_tokens: N, which robots send at most.
        policy: least advice, and the share of its time that the model shall work.
    """

    def __init__(
        self, costs: CostModel, max_batch: int, num_tokens: int, policy: LoadPolicy
    ) -> None:
        self._costs = costs
        self._max_batch = max_batch
        self._num_tokens = num_tokens
        self._least = min(policy.advise_least_tokens, num_tokens)
        self._target = policy.advise_target_load
        self._active = policy.advise_tokens
        # Fading sums: requests, their tokens, those with pictures.
        self._sums = (0.0, 0.0, 0.0)
        self._summed_s = self._began_s = -math.inf
        self._wishes: deque[int] = deque(maxlen=_WISHES)
        self._unbound: deque[int] = deque(
            maxlen=_WISHES
        )  # what robots sent while nothing was advised
        self._pressed_s = -math.inf
        self._advice = 0
        self._advised_s = -math.inf

    def note(self, work: Work, now_s: float) -> None:
        """One request was made; it may be answered or not."""
        if self._began_s == -math.inf:
            self._began_s = self._summed_s = now_s
        fade = self._fade(now_s)
        parts = (work.requests, work.tokens, work.pictures)
        requests, tokens, pictures = (s * fade + p for s, p in zip(self._sums, parts, strict=True))
        self._sums, self._summed_s = (requests, tokens, pictures), now_s
        if not work.pictures:
            # Whoever sends as much as advised would perhaps send more.
            free = self._advice == 0 or work.tokens < self._advice
            self._wishes.append(work.tokens if free else self._num_tokens)
            if self._advice == 0:
                self._unbound.append(work.tokens)

    def note_pressure(self, now_s: float) -> None:
        """A deadline came into danger, or could not be kept."""
        self._pressed_s = now_s

    def requests_per_s(self, now_s: float) -> float:
        """How often robots ask."""
        # A sum that began a moment ago has not yet what a steady rate would give it.
        whole_s = -math.expm1(min(0.0, self._began_s - now_s) / _MEMORY_S) * _MEMORY_S
        return self._sums[0] * self._fade(now_s) / max(whole_s, 0.25 * _MEMORY_S)

    def usual_work(self) -> Work:
        """The mean request of late, as one that brings tokens."""
        requests, tokens, _ = self._sums
        return Work(1, max(1, round(tokens / requests)) if requests else 1)

    def load(self, now_s: float) -> float:
        """Work asked for as a share of what the model can do with full batches; above 1 is too much."""
        requests, tokens, pictures = self._sums
        if not self._costs.known or requests <= 0.0:
            return 0.0
        cost_s = self._costs.request_cost_s(self._max_batch, tokens / requests, pictures / requests)
        return self.requests_per_s(now_s) * cost_s

    def wished_load(self, now_s: float) -> float:
        """:meth:`load`, if requests were as large as those of the time before any advice."""
        requests, _, pictures = self._sums
        if not self._costs.known or requests <= 0.0 or not self._unbound:
            return self.load(now_s)
        tokens = sum(self._unbound) / len(self._unbound)
        cost_s = self._costs.request_cost_s(self._max_batch, tokens, pictures / requests)
        return self.requests_per_s(now_s) * cost_s

    def advice(self, now_s: float, share: Callable[[], float] = lambda: 1.0) -> int:
        """Tokens that a request should have at most; 0 where the server has no wish.

        Args:
            now_s: the time.
            share: tells the part of the inference thread that is this model's.
        """
        if self._active and now_s - self._advised_s >= _RENEW_AFTER_S:
            self._advice, self._advised_s = self._level(now_s, share()), now_s
        return self._advice

    def _level(self, now_s: float, share: float) -> int:
        rate = self.requests_per_s(now_s)
        token_s = self._costs.token_s
        if rate <= 0.0 or token_s <= 0.0 or len(self._wishes) < _FEWEST_WISHES:
            return 0
        if not self._advice and now_s - self._pressed_s > _MEMORY_S:
            return 0
        pictures = self._sums[2] / self._sums[0]
        if pictures > 0.99:
            return 0
        picture_s = self._costs.picture_s + token_s * self._num_tokens
        fixed_s = self._costs.fixed_s / self._max_batch + self._costs.request_s
        left_s = share * self._target / rate - fixed_s - pictures * picture_s
        mean_tokens = left_s / (token_s * (1.0 - pictures))
        wishes = np.sort(np.array(self._wishes, dtype=np.float64))
        if wishes.mean() <= mean_tokens:
            return 0
        # min(wish, L) summed, for L at each wish: those below count whole, the others L each.
        counts = np.arange(len(wishes), 0, -1)
        below = np.concatenate([[0.0], np.cumsum(wishes)[:-1]])
        budget = max(0.0, mean_tokens) * len(wishes)
        at = int(np.searchsorted(below + counts * wishes, budget))
        level = (budget - below[at]) / counts[at]
        return max(self._least, int(level))

    def _fade(self, now_s: float) -> float:
        return math.exp(min(0.0, self._summed_s - now_s) / _MEMORY_S) if self._sums[0] else 1.0
