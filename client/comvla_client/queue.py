"""Open-loop execution of a chunk, and what the robot does when no new one comes.

When an answer is missing the robot finishes what the last chunk still holds, then stands still, and
takes the next answer as if nothing had happened.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from comvla.model_info import ModelInfo
from comvla_client.report import Source

Actions = npt.NDArray[np.float32]


class ActionQueue:
    """The last chunk, how far the robot got in it, and the rows it is about to execute.

    Args:
        info: gives H, A, and which action dimensions stand still at 0.
        execute: rows that the robot executes of a chunk before it asks again, 1 to H; None means H.
        hold: (A,) action to hold with. None holds with the last action, its velocities and deltas
            set to 0 and its other dimensions (grippers) kept; all zeros before the first answer.

    Raises:
        ValueError: ``execute`` outside 1 to H, or ``hold`` of the wrong shape or not finite.
    """

    def __init__(
        self, info: ModelInfo, *, execute: int | None = None, hold: Sequence[float] | None = None
    ) -> None:
        self.horizon = info.action_horizon
        self.execute = self.horizon if execute is None else execute
        if not 1 <= self.execute <= self.horizon:
            raise ValueError(
                f"expected execute in 1 to {self.horizon} (the chunk of {info.name}), got {execute}"
            )
        self._stands_still_at_zero = np.array(info.delta_actions, dtype=bool)
        self._fixed_hold: Actions | None = None
        if hold is not None:
            self._fixed_hold = np.asarray(hold, dtype=np.float32)
            if (
                self._fixed_hold.shape != (info.action_dim,)
                or not np.isfinite(self._fixed_hold).all()
            ):
                raise ValueError(
                    f"expected hold as {info.action_dim} finite numbers (actions of {info.name}), "
                    f"got {hold!r}"
                )
        self._nothing_yet: Actions = np.zeros(info.action_dim, dtype=np.float32)
        self.clear()

    def clear(self) -> None:
        """Forgets the last chunk and what was left of it."""
        self._chunk: Actions | None = None
        self._started = 0
        self._pending: deque[Actions] = deque()

    def accept(self, chunk: Actions) -> None:
        """Takes a new chunk (H, A); its first ``execute`` rows are next."""
        self._chunk = chunk.copy()
        self._started = self.execute
        self._pending = deque(self._chunk[: self.execute])

    def fall_back(self, *, hold: bool = False) -> tuple[Actions, int, Source]:
        """What to do without an answer.

        Args:
            hold: stand still, whatever the last chunk still has.

        Returns:
            (H, A) actions, how many leading rows come from the last chunk, and where they come from.
            It is taken as given that the robot executes ``execute`` rows before it asks again.
        """
        if hold:
            self._started = self.horizon
        rest = self._nothing_yet[None][:0] if self._chunk is None else self._chunk[self._started :]
        self._started += self.execute
        actions = np.tile(self.hold_action, (self.horizon, 1))
        planned = len(rest)
        if planned:
            actions[:planned] = rest
        # While holding, ask again after every period: the link may be back, and nothing is lost.
        self._pending = deque(actions[: max(1, min(planned, self.execute))])
        return actions, planned, "rest" if planned else "hold"

    def pop(self) -> Actions | None:
        """The next (A,) row to execute, or None when it is time to ask."""
        return self._pending.popleft().copy() if self._pending else None

    @property
    def hold_action(self) -> Actions:
        """The action (A,) to hold with now."""
        if self._fixed_hold is not None:
            return self._fixed_hold
        if self._chunk is None:
            return self._nothing_yet
        held: Actions = np.where(self._stands_still_at_zero, np.float32(0.0), self._chunk[-1])
        return held
