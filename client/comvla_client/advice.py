"""What a busy server asked of the robot: fewer tokens, and a pause after it turned a request away.

Both are wishes of the moment. The robot follows them, and forgets them by itself.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable

_FIRST_SHARE = 0.25


class TokenAdvice:
    """The server's upper bound on K, until it has no such wish any more.

    A new hint holds at once, also for a robot that asks but once in some seconds. After an answer
    without one, or when nothing was heard for ``hold_s``, the bound doubles every ``recovery_s``
    until it bounds nothing: a server that was just relieved is not met by everybody's full K at
    the same moment.

    Args:
        num_tokens: N.
        recovery_s: time in which a bound that is not wished any more doubles, seconds.
        hold_s: how long a wish holds when nothing is heard, seconds.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        num_tokens: int,
        *,
        recovery_s: float = 1.0,
        hold_s: float = 5.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._num_tokens = num_tokens
        self._recovery_s = recovery_s
        self._hold_s = hold_s
        self._clock = clock
        self._bound: int | None = None
        self._holds_until_s = 0.0

    def hear(self, suggested_tokens: int) -> None:
        """Takes note of the hint of an answer; 0 is no wish."""
        now_s = self._clock()
        if suggested_tokens > 0:
            self._bound, self._holds_until_s = suggested_tokens, now_s + self._hold_s
        else:
            self._holds_until_s = min(self._holds_until_s, now_s)

    def hear_refusal(self, suggested_tokens: int) -> None:
        """Takes note of the hint of a call without an answer, whose silence says nothing of the server's wishes."""
        if suggested_tokens > 0:
            self.hear(suggested_tokens)

    @property
    def most_tokens(self) -> int | None:
        """Tokens that a step should send at most; None where nothing bounds it."""
        if self._bound is None:
            return None
        faded_s = max(0.0, self._clock() - self._holds_until_s)
        bound = int(self._bound * 2.0 ** min(32.0, faded_s / self._recovery_s))
        if bound >= self._num_tokens:
            self._bound = None
            return None
        return bound


class BackOff:
    """When the robot asks again after it was turned away.

    While it waits it goes on with its chunk and sends nothing. The pause is what the server asks
    for, or else a quarter of the longest; it doubles with each refusal in a row, never exceeds
    ``longest_s``, and is drawn from its upper half, so that robots which were turned away together
    do not come back together.

    Args:
        longest_s: longest pause, seconds: the time between two queries.
        clock: monotonic seconds.
        draw: a number in [0, 1).
    """

    def __init__(
        self,
        longest_s: float,
        *,
        clock: Callable[[], float] = time.monotonic,
        draw: Callable[[], float] = random.random,
    ) -> None:
        self._longest_s = longest_s
        self._clock = clock
        self._draw = draw
        self._refusals = 0
        self._until_s = 0.0

    def refused(self, retry_after_s: float | None) -> float:
        """The server was too busy; returns the pause in seconds.

        Args:
            retry_after_s: the server's hint, where it gave one.
        """
        first_s = _FIRST_SHARE * self._longest_s if retry_after_s is None else retry_after_s
        ceiling_s = min(self._longest_s, first_s * 2.0 ** min(self._refusals, 32))
        pause_s = ceiling_s * (1.0 - 0.5 * self._draw())
        self._refusals += 1
        self._until_s = self._clock() + pause_s
        return pause_s

    def answered(self) -> None:
        """The server had time."""
        self._refusals, self._until_s = 0, 0.0

    @property
    def remaining_s(self) -> float:
        """Seconds until the robot may ask again; 0 where it may now."""
        return max(0.0, self._until_s - self._clock())
