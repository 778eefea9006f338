"""Rows as aligned text."""

from __future__ import annotations

from collections.abc import Sequence


def render(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose first column is left-aligned and whose others are right-aligned."""
    widths = [max(len(row[i]) for row in (heads, *rows)) for i in range(len(heads))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in (heads, *rows)
    )


def milliseconds(seconds: float) -> str:
    """Three decimals, so that microseconds stay visible."""
    return f"{seconds * 1e3:.3f}"


def percent(share: float) -> str:
    """A share in percent, with one decimal."""
    return f"{100.0 * share:.1f}"
