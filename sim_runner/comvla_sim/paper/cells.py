"""What is measured for the tables: cells that several tables share, each measured once."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from comvla_sim.experiments.methods import find_method, sends_pictures
from comvla_sim.experiments.plan import EpisodeSpec
from comvla_sim.paper.published import TABLE1, TABLE_K

DEFAULT_QUANTIZATION = "int8"

CODEC_SNR_DB = 10
"""At which the learned codecs stand in the tables; the paper calls them unconstrained and names no SNR."""


@dataclass(frozen=True)
class Cell:
    """One way of sending.

    Attributes:
        method: name of a method, as ``comvla-sim eval --method`` takes it.
        k: tokens; None for a method that decides itself what it sends.
        quantization: of the tokens on the wire.
    """

    method: str
    k: int | None = None
    quantization: str = DEFAULT_QUANTIZATION

    @property
    def name(self) -> str:
        """For tables: method, K, and the number format where it is not the usual one."""
        parts = [self.method]
        if self.k is not None:
            parts.append(f"K={self.k}")
        if self.quantization != DEFAULT_QUANTIZATION:
            parts.append(self.quantization)
        return " ".join(parts)

    @property
    def pictures(self) -> bool:
        """Whether pictures cross the link, so that the number format means nothing."""
        return sends_pictures(self.method)

    def specs(self, tasks: tuple[str, ...], episode: int, num_tokens: int) -> Iterator[EpisodeSpec]:
        """Its episodes on one layout, one for each task."""
        k = num_tokens if find_method(self.method).decides_itself else self.k
        for task in tasks:
            yield EpisodeSpec("normal", self.method, k, task, episode)


PAPER_CELLS: Mapping[Cell, tuple[str, int | None]] = {
    Cell(f"{method}-{CODEC_SNR_DB}" if method in ("deepjscc", "witt") else method, k): (method, k)
    for method, k in TABLE1
}
"""Cells that stand for a line of Table I, with that line's key."""

BUDGETS = (128, 64, 48, 32, 16, 8)
"""K of Table I, and one below it."""

VOTES = ("multi_voting", "diverse_voting", "view_quotas")
"""This project's selectors beyond the paper's."""

_MAIN = tuple(
    Cell(method, k) for k, method in itertools.product(BUDGETS, ("hard_voting", "random"))
)
TABLE1_GROUPS: tuple[tuple[Cell, ...], ...] = (
    (Cell("full"), *_MAIN),
    (*(Cell(f"jpeg-{q}") for q in (75, 25, 5)), Cell("soft_voting", 32)),
    tuple(Cell(m) for m in ("lightvla", "vla_adp", "fastv", "deepjscc-10", "witt-10")),
    (
        *(Cell(f"jpeg-{q}") for q in (90, 50, 10)),
        *(Cell(name) for name in ("webp-50", "avif-50", "h264-28", "h264-40")),
    ),
    tuple(Cell(m, k) for k in (16, 8) for m in VOTES),
    (Cell("soft_voting", 16), Cell("soft_voting", 8)),
    (*(Cell(m, 32) for m in VOTES), Cell("token_norm", 32)),
    tuple(Cell(m, 4) for m in ("hard_voting", "random", "soft_voting", *VOTES)),
    tuple(Cell("token_norm", k) for k in (16, 8)),
    *(tuple(Cell(m, k) for m in ("soft_voting", *VOTES, "token_norm")) for k in (48, 64, 128)),
)
"""All lines of Table I, what matters most first; the cells of a group advance together, layout by layout."""

TABLE3_CELLS = tuple(
    Cell(method, k) for k in (TABLE_K, 16, 8, 4) for method in ("soft_voting", "hard_voting")
)
TABLE4_CELLS = tuple(
    Cell("hard_voting", TABLE_K, quantization) for quantization in ("int4", "float16", "int8")
)

GROUPS: Mapping[str, tuple[tuple[Cell, ...], ...]] = {
    "table1": TABLE1_GROUPS,
    "table2": (),
    "table3": (TABLE3_CELLS,),
    "table4": (TABLE4_CELLS,),
}
"""What each table needs, in the order in which it is measured."""


def of_method(name: str) -> tuple[Cell, ...]:
    """A method at every K, or once where it decides itself what it sends.

    Raises:
        UnknownMethodError: there is none of that name.
    """
    if find_method(name).decides_itself:
        return (Cell(name),)
    return tuple(Cell(name, k) for k in BUDGETS)


def ordered(
    tables: tuple[str, ...], also: tuple[tuple[Cell, ...], ...] = ()
) -> list[tuple[Cell, ...]]:
    """Groups of cells of several tables, each cell once; the tables' first groups come first.

    Args:
        tables: their names.
        also: groups of cells that no table has, measured last.
    """
    seen: set[Cell] = set()
    found = []
    first = [GROUPS[name][:2] for name in tables]
    rest = [GROUPS[name][2:] for name in tables]
    for group in itertools.chain(*first, *rest, also):
        new = tuple(cell for cell in group if cell not in seen)
        seen.update(new)
        if new:
            found.append(new)
    return found
