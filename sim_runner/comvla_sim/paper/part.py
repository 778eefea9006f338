"""One section of the document."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from comvla_sim.report.tables import Table

PICTURES = {
    "table1": ("results-bytes.svg", "Success against bytes on the wire, every method"),
    "fig3": ("results-tokens.png", "Kept tokens by instruction, method and K"),
    "film": ("results-episode.webp", "Kept tokens over an episode"),
}
"""File in docs/ and what it shows."""


@dataclass(frozen=True)
class Part:
    """One section.

    Attributes:
        title: heading.
        words: paragraphs.
        tables: in reading order.
        pictures: keys of :data:`PICTURES`, or names of other files in docs/ with what they show.
    """

    title: str
    words: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[tuple[str, str]] = field(default=())
