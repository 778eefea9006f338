"""A sweep from its episodes to its files: measured, drawn, counted and compared."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from comvla_sim.experiments.errors import EvaluationError, NothingMeasuredError
from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.figures import sweeps
from comvla_sim.figures.measuring import Study, kept, measure, specs
from comvla_sim.figures.points import pairs, points
from comvla_sim.figures.series import Series
from comvla_sim.figures.tables import comparison_table, tables


def run_sweep(
    figure: str,
    study: Study,
    series: Mapping[str, Series],
    links: Sequence[LinkCase],
    *,
    measured_only: bool = False,
) -> tuple[dict[str, Any], str]:
    """Measures what is missing, then draws PNG and SVG and writes all points as JSON and Markdown.

    Args:
        figure: ``"fading"`` or ``"csi-delay"``.
        study: what is measured on, and where files go.
        series: lines by name.
        links: before the lines use them their way.
        measured_only: run nothing; points without an episode are left out.

    Returns:
        Everything as JSON values, and the tables as Markdown.

    Raises:
        KeyboardInterrupt: after Ctrl-C, with everything measured so far in the file.
        NothingMeasuredError: nothing was measured yet.
        EvaluationError: a file cannot be read or written.
    """
    wanted = specs(study, series, links)
    rows = kept(figure, study, wanted) if measured_only else measure(figure, study, wanted)
    found = [point for point in points(rows, series, links) if point.episodes]
    if not found:
        raise NothingMeasuredError(
            f"no episode of {figure} is there yet: run comvla-sim figure {figure}"
        )
    draw = sweeps.draw_fading if figure == "fading" else sweeps.draw_csi_delay
    files = draw(found, study, links[0], study.out)
    printed: dict[str, Any] = {
        "figure": figure,
        "files": [str(path) for path in files],
        "results": str(study.out / f"{figure}.jsonl"),
        "caption": sweeps.caption(found, study, links[0]),
        "settings": study.subject.settings,
        "points": [point.to_dict() for point in found],
        "comparisons": _comparisons(rows, series, links),
    }
    shown = [*tables(figure, found), comparison_table(printed["comparisons"])]
    text = f"{printed['caption']}\n\n" + "\n".join(table.markdown() for table in shown)
    for suffix, content in (("json", json.dumps(printed, indent=1) + "\n"), ("md", text)):
        write_text(study.out / f"{figure}.{suffix}", content)
    return printed, text


def write_text(path: Path, text: str) -> None:
    """Writes a file and the folders that it needs.

    Raises:
        EvaluationError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise EvaluationError(f"cannot write {path}: {error.strerror}") from error


def _comparisons(
    rows: Mapping[Any, Any], series: Mapping[str, Series], links: Sequence[LinkCase]
) -> list[dict[str, Any]]:
    """Every line against the first that is not ideal: link by link, and all links together."""
    names = [name for name, line in series.items() if not line.ideal]
    found = []
    for second in names[1:]:
        for scope in (*([link] for link in links), links):
            where = scope[0].to_dict() if len(scope) == 1 else None
            test = pairs(rows, series[names[0]], series[second], scope)
            found.append({"first": names[0], "second": second, "link": where, **test})
    return found
