"""Numbers on a command line: read and bounded by argparse, so that a wrong one is exit code 2 and a clear line."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable


def whole(low: int = -(2**63), high: int = 2**63 - 1) -> Callable[[str], int]:
    """The ``type`` of an option that takes a whole number from ``low`` to ``high``."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = None
        if value is None or not low <= value <= high:
            raise argparse.ArgumentTypeError(
                f"expected a whole number{_bounds(low, high, 2**63 - 1)}, got {text[:40]!r}"
            )
        return value

    return parse


def number(
    low: float = -math.inf,
    high: float = math.inf,
    *,
    above_low: bool = False,
    endless: bool = False,
) -> Callable[[str], float]:
    """The ``type`` of an option that takes a finite number from ``low`` to ``high``.

    Args:
        low, high: bounds.
        above_low: ``low`` itself is refused.
        endless: infinities within the bounds will do.
    """

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        sound = low <= value <= high and not (above_low and value == low)
        if not sound or not (endless or math.isfinite(value)):
            finite = "a number" if endless else "a finite number"
            least = f" above {low:g}" if above_low else _bounds(low, high, math.inf)
            raise argparse.ArgumentTypeError(f"expected {finite}{least}, got {text[:40]!r}")
        return value

    return parse


def _bounds(low: float, high: float, none: float) -> str:
    if high < none:
        return f" from {low:g} to {high:g}"
    return f" >= {low:g}" if low > -none - 1 else ""


SECONDS = number(0.0, 1e9, above_low=True)
"""A time to wait."""

SNR_DB = number(-math.inf, 1e3, endless=True)
"""A signal-to-noise ratio in dB; ``-inf`` is no link."""

SEED = whole(0, 2**31 - 1)
"""Of anything random."""
