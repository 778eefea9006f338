"""The report as one HTML file that needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files

from comvla_sim.report.tables import Table

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
"""Content security policy of every page: whatever a page contains, it loads nothing."""

_PLOT_CSS = """
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); gap: 1rem; }
.plots img { width: 100%; height: auto; background: #fff; border-radius: .5rem; border: 1px solid var(--line); }
"""


@dataclass(frozen=True)
class Section:
    """One evaluation on the page.

    Attributes:
        title: heading.
        story: what was measured and how, one line each.
        commands: what to type to measure it again.
        plots: (what it shows, SVG, PNG or WebP) pairs.
        tables: in reading order.
    """

    title: str
    story: Sequence[str]
    commands: Sequence[str]
    plots: Sequence[tuple[str, bytes]]
    tables: Sequence[Table]


def shared_style() -> str:
    """The style sheet of all pages."""
    return files("comvla_sim.report").joinpath("style.css").read_text(encoding="utf-8")


def document(title: str, body: str, *, style: str, command: str) -> str:
    """A page with the look of all pages, which loads nothing from outside.

    Args:
        title: of the page.
        body: HTML below the title.
        style: CSS of this page, behind that of all.
        command: what wrote it.
    """
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<title>{escape(title)}</title>
<style>{shared_style()}{style}</style>
</head>
<body><main><h1>{escape(title)}</h1>{body}
<footer>Written by <code>{escape(command)}</code>.</footer></main></body>
</html>
"""


def page(title: str, sections: Sequence[Section]) -> str:
    """The whole report.

    Args:
        title: of the page.
        sections: one for each evaluation.
    """
    body = "".join(_section(section) for section in sections)
    return document(title, body, style=_PLOT_CSS, command="comvla-sim report")


def data_uri(picture: bytes) -> str:
    """A picture (SVG, PNG or WebP) as an address that holds it."""
    kind = "svg+xml"
    if picture.startswith(b"\x89PNG"):
        kind = "png"
    elif picture[8:12] == b"WEBP":
        kind = "webp"
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"


def _section(section: Section) -> str:
    story = "".join(f"<p>{escape(line)}</p>" for line in section.story)
    plots = "".join(
        f'<img alt="{escape(name, quote=True)}" src="{data_uri(picture)}">'
        for name, picture in section.plots
    )
    tables = "".join(table.html() for table in section.tables)
    commands = escape("\n".join(section.commands))
    return (
        f"<section><h2>{escape(section.title)}</h2>{story}"
        f'<div class="plots">{plots}</div>{tables}'
        f"<h3>To measure it again</h3><pre>{commands}</pre></section>"
    )


def markdown(title: str, sections: Sequence[Section], plots: Mapping[str, Sequence[str]]) -> str:
    """The same in Markdown.

    Args:
        title: of the document.
        sections: one for each evaluation.
        plots: names of the plot files of each section, by its title.
    """
    parts = [f"# {title}\n"]
    for section in sections:
        parts.append(f"## {section.title}\n")
        parts.append("\n".join(f"- {line}" for line in section.story) + "\n")
        named = zip(section.plots, plots[section.title], strict=True)
        parts.extend(f"![{name}]({file})\n" for (name, _), file in named)
        parts.extend(table.markdown() for table in section.tables)
        parts.append("### To measure it again\n")
        parts.append("```console\n" + "\n".join(f"$ {c}" for c in section.commands) + "\n```\n")
    return "\n".join(parts)
