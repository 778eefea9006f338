"""What the inference thread has before it, from all models that share it."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

_Load = Callable[[float], float]


@dataclass(frozen=True, eq=False)
class _Pass:
    owner: object
    asked_s: float
    predicted_s: float


class Occupancy:
    """Passes that were handed to one inference thread, in order; it runs one at a time.

    A model that knew only of its own passes would promise answers that wait for another's, and take
    that wait for the cost of its own. Times are monotonic seconds; used from one event loop only.
    """

    def __init__(self) -> None:
        self._passes: deque[_Pass] = deque()
        self._started_s = 0.0
        self._loads: dict[object, tuple[_Load, _Load]] = {}

    def join(self, owner: object, load: _Load, wished: _Load) -> None:
        """One more model.

        Args:
            owner: stands for it.
            load: what is asked of it at a time, as a share of what it could do alone.
            wished: what would be, if nobody sent fewer tokens for its sake.
        """
        self._loads[owner] = load, wished

    def leave(self, owner: object) -> None:
        """A model is gone; a pass that it left behind may still run, and is not waited for."""
        self._loads.pop(owner, None)
        if self._passes and self._passes[0].owner is owner and len(self._passes) > 1:
            self._started_s = max(self._started_s, self._passes[1].asked_s)
        self._passes = deque(each for each in self._passes if each.owner is not owner)

    def begin(self, owner: object, predicted_s: float, now_s: float) -> None:
        """A pass is handed to the thread."""
        if not self._passes:
            self._started_s = now_s
        self._passes.append(_Pass(owner, now_s, predicted_s))

    def end(self, owner: object, now_s: float) -> float:
        """A pass ended; returns until when it had waited for others, ``-inf`` where it had not."""
        mine = next((each for each in self._passes if each.owner is owner), None)
        if mine is None:
            return -math.inf
        self._passes.remove(mine)
        waited = self._started_s > mine.asked_s
        began_s, self._started_s = self._started_s, now_s
        return began_s if waited else -math.inf

    def free_s(self, owner: object, now_s: float) -> float:
        """When the next pass of a model can begin, as others go on like now; ``now_s`` where none is under way."""
        if not self._passes:
            return now_s
        elapsed_s, first_s = now_s - self._started_s, self._passes[0].predicted_s
        # What takes longer than expected may take as much longer again.
        free_s = now_s + max(first_s - elapsed_s, elapsed_s - first_s, 1e-6)
        for each in self._passes:
            free_s += each.predicted_s if each is not self._passes[0] else 0.0
            if each.owner is owner:
                # All others have their turn in between: those behind it, and those before it once more.
                return free_s + self.turn_s(owner)
        return free_s

    def turn_s(self, owner: object) -> float:
        """Seconds that other models take between two passes of this one, while they have work, too."""
        return sum(each.predicted_s for each in self._passes if each.owner is not owner)

    def load(self, now_s: float) -> float:
        """What is asked of all models, as a share of what the thread can do."""
        return sum(load(now_s) for load, _ in self._loads.values())

    def share(self, owner: object, now_s: float) -> float:
        """The part of the thread's time that is a model's, by what robots would like to ask of each; 0 to 1."""
        wished = {each: wish(now_s) for each, (_, wish) in self._loads.items()}
        whole = sum(wished.values())
        return wished[owner] / whole if whole > 0.0 and owner in wished else 1.0
