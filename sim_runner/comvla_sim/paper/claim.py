"""What a claim of the paper becomes in the document, and rules that several claims share."""

from __future__ import annotations

from collections.abc import Sequence

from comvla_sim.paper.changes import gap_text
from comvla_sim.paper.verdicts import AGREES, DIFFERS, Rate, Verdict, contrast

Claim = tuple[str, str, Verdict]
"""What the paper says, what came out here, the verdict."""

NEGLIGIBLE = 0.03
"""Points of success, as a share, within which a change counts as small: twice the paper's own 1.5."""


def gap(first: Rate, second: Rate) -> str:
    """By how much the first rate is ahead, in words."""
    return gap_text((first, second), " points")


def worst(verdicts: Sequence[Verdict]) -> Verdict:
    """What a claim of several parts comes to: its first part that does not agree, else its first."""
    return next((verdict for verdict in verdicts if verdict.kind != AGREES), verdicts[0])


def ahead(first: Rate, second: Rate) -> Verdict:
    """Whether the first rate is ahead beyond chance."""
    value, low, high = contrast([(1, first), (-1, second)])
    if low > 0:
        return Verdict(AGREES)
    return Verdict(
        DIFFERS, "in that no difference was found" if high >= 0 else f"by {100 * value:+.1f} points"
    )
