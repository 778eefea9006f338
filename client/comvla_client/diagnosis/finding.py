"""What a check found, and how much time the checks have."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

Status: TypeAlias = Literal["ok", "note", "fail", "skip"]
"""``note``: could be better, and was not seen to do harm. ``skip``: could not be looked at."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        check: its name.
        status: see :data:`Status`; only ``fail`` counts against the link.
        found: what was measured or read.
        remedy: what to do about it; empty when all is well.
        values: the numbers behind ``found``, for ``--json``.
    """

    check: str
    status: Status
    found: str
    remedy: str = ""
    values: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether nothing has to be done about it."""
        return self.status != "fail"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {**dataclasses.asdict(self), "ok": self.ok}


class Allowance:
    """The time that an examination may take.

    Args:
        seconds: in all, from now.
        clock: monotonic seconds.
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._began_s = clock()
        self.seconds = seconds

    def elapsed_s(self) -> float:
        """Seconds since the beginning."""
        return self._clock() - self._began_s

    @contextmanager
    def paused(self) -> Iterator[None]:
        """What runs inside is work of this machine alone, and takes nothing of the time."""
        began_s = self._clock()
        try:
            yield
        finally:
            self._began_s += self._clock() - began_s

    def left_s(self) -> float:
        """Seconds left; 0 when none are."""
        return max(0.0, self.seconds - self.elapsed_s())

    def at_most_s(self, seconds: float, share: float = 1.0) -> float:
        """So many seconds, or a share of what is left where that is less."""
        return min(seconds, share * self.left_s())


def out_of_time(check: str, allowance: Allowance) -> Finding:
    """The finding of a check that had no time."""
    return Finding(
        check,
        "skip",
        f"no time left of {allowance.seconds:g} s",
        f"--seconds {2 * allowance.seconds:g} allows more",
    )
