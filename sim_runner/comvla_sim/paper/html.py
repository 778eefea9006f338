"""The document as one HTML page that loads nothing from outside, with its pictures and the film in it."""

from __future__ import annotations

import re
from html import escape
from pathlib import Path

from comvla_sim.paper.document import TITLE, parts
from comvla_sim.paper.part import Part
from comvla_sim.paper.results import Results
from comvla_sim.report.page import data_uri, document

_CSS = """
.wide img { width: 100%; height: auto; background: #fff; border-radius: .5rem; }
img.film { width: min(100%, 36rem); }
"""


def page(results: Results, folder: Path) -> str:
    """The whole page.

    Args:
        results: what was measured.
        folder: where the pictures lie.
    """
    body = "".join(_section(part, folder) for part in parts(results))
    return document(TITLE, body, style=_CSS, command="comvla-sim paper")


def _section(part: Part, folder: Path) -> str:
    words = "".join(_paragraph(line) for line in part.words)
    pictures = "".join(
        f'<p class="wide"><img class="{"film" if file.endswith(".webp") else "plot"}" '
        f'alt="{escape(what, quote=True)}" src="{data_uri((folder / file).read_bytes())}"></p>'
        for file, what in part.pictures
        if (folder / file).exists()
    )
    tables = "".join(table.html() for table in part.tables)
    return f"<section><h2>{escape(part.title)}</h2>{words}{pictures}{tables}</section>"


def _paragraph(line: str) -> str:
    """The little Markdown that the document's words use: lists, code, emphasis, links (which lead nowhere here)."""
    if line.startswith("```"):
        return f"<pre>{escape(line.strip('`').partition(chr(10))[2])}</pre>"
    text = escape(re.sub(r"\[([^\]]+)\]\([^)]+\)", r"\1", line.removeprefix("- ")))
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    text = re.sub(r"\*\*([^*]+)\*\*", r"<strong>\1</strong>", text)
    text = re.sub(r"\*([^*\s][^*]*)\*", r"<em>\1</em>", text)
    return f"<p>{'• ' if line.startswith('- ') else ''}{text}</p>"
