"""Who got how many answers lately."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass


@dataclass
class _Share:
    answers: float
    counted_s: float
    asked_s: float


class FairShares:
    """Answers of each robot, with those of long ago fading away.

    Robots that asked lately are compared with their mean: under overload the ones above it step
    back, so that robots with equal needs get equally much, and a robot that asks for little gets all
    of it.

    Args:
        memory_s: time in which an answer's weight falls to 37 %, in seconds. A robot that asked for
            nothing for three times as long is not counted any more.
        most: robots remembered.
    """

    def __init__(self, memory_s: float = 10.0, most: int = 4096) -> None:
        self._memory_s = memory_s
        self._most = most
        self._shares: OrderedDict[str, _Share] = OrderedDict()
        self._sum = 0.0
        self._sum_s = 0.0

    def __len__(self) -> int:
        return len(self._shares)

    def note_asked(self, robot: str, now_s: float) -> None:
        """A robot wants an answer, whatever becomes of it."""
        share = self._shares.get(robot)
        if share is None:
            share = self._shares[robot] = _Share(0.0, now_s, now_s)
        share.asked_s = now_s
        self._shares.move_to_end(robot)
        self._forget(now_s)

    def credit(self, robot: str, now_s: float, answers: float = 1.0) -> None:
        """A robot gets answers; a negative number takes back what it did not get after all."""
        share = self._shares.get(robot)
        if share is None:
            return
        before = self._faded(share, now_s)
        share.answers, share.counted_s = max(0.0, before + answers), now_s
        self._sum = self._total(now_s) + share.answers - before
        self._sum_s = now_s

    def above_mean(self, robot: str, now_s: float) -> bool:
        """Whether a robot got more than the mean of all robots that ask."""
        share = self._shares.get(robot)
        if share is None or len(self._shares) < 2:
            return False
        # Equal shares must not turn each other away because of rounding.
        mean = self._total(now_s) / len(self._shares)
        return self._faded(share, now_s) > mean * (1.0 + 1e-6) + 1e-9

    def _faded(self, share: _Share, now_s: float) -> float:
        return share.answers * math.exp((share.counted_s - now_s) / self._memory_s)

    def _total(self, now_s: float) -> float:
        return self._sum * math.exp((self._sum_s - now_s) / self._memory_s)

    def _forget(self, now_s: float) -> None:
        while self._shares:
            robot, share = next(iter(self._shares.items()))
            silent = now_s - share.asked_s > 3.0 * self._memory_s
            if not silent and len(self._shares) <= self._most:
                return
            self._sum = max(0.0, self._total(now_s) - self._faded(share, now_s))
            self._sum_s = now_s
            del self._shares[robot]
