"""``comvla-sim report``: tables and plots from results of ``comvla-sim eval``."""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from comvla_sim.experiments.errors import EvaluationError

if TYPE_CHECKING:
    from comvla_sim.report.page import Section

DESCRIPTION = """\
Writes report.md, report.html (self-contained) and the plots as SVG files.
Files measured with equal settings but for the seed are put together; the others get a section each.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "report",
        help="tables and plots from results of eval",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "results", nargs="+", metavar="[NAME=]FILE", help="results of comvla-sim eval"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/report"), help="(runs/report)")
    parser.add_argument("--title", default="Closed-loop evaluation", help="of the report")
    parser.add_argument("--json", action="store_true", help="print all figures as one JSON object")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Writes the report and says where."""
    from comvla_sim.experiments.summary import summarise
    from comvla_sim.report.page import markdown, page

    groups = read_groups(args.results)
    summaries = {name: summarise(rows) for name, rows in groups.items()}
    sections = [section(name, groups[name], summaries[name]) for name in groups]
    plots: dict[str, list[str]] = {}
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        for part in sections:
            plots[part.title] = []
            for what, svg in part.plots:
                file = re.sub(r"[^a-z0-9]+", "-", f"{part.title} {what}".lower()).strip("-")
                plots[part.title].append(f"{file}.svg")
                (args.out / f"{file}.svg").write_bytes(svg)
        (args.out / "report.md").write_text(markdown(args.title, sections, plots), encoding="utf-8")
        html_path = args.out / "report.html"
        html_path.write_text(page(args.title, sections), encoding="utf-8")
    except OSError as error:
        raise EvaluationError(f"cannot write to {args.out}: {error.strerror}") from error
    if args.json:
        print(json.dumps({"report": str(html_path), "groups": summaries}))
    else:
        print(f"report written to {html_path} and {args.out / 'report.md'}")
    return 0


def read_groups(arguments: list[str]) -> dict[str, list[dict[str, Any]]]:
    """Rows by group: those of one name, or of equal settings but for the seed. An episode that stands in several
    files of a group counts once, as the first of them has it; of an own selector's versions the last one counts.

    Raises:
        EvaluationError: a file that is none of results, has no rows, or was measured otherwise than
            the others of its name.
    """
    from comvla_sim.experiments.results import key_of, read_rows

    groups: dict[str, list[dict[str, Any]]] = {}
    seen: dict[str, set[Any]] = {}
    settings: dict[str, dict[str, Any]] = {}
    for argument in arguments:
        name, _, file = argument.rpartition("=")
        rows, _ = read_rows(Path(file))
        if not rows:
            raise EvaluationError(f"{file} has no results yet: run comvla-sim eval first")
        repeated = 0
        for row in rows:
            shared = {key: value for key, value in row["settings"].items() if key != "seed"}
            group = name or _name(shared)
            if settings.setdefault(group, shared) != shared:
                raise EvaluationError(
                    f"{file} was measured with other settings than the rest of {group!r}: "
                    "give it a name of its own, NAME=FILE"
                )
            if key_of(row) in seen.setdefault(group, set()):
                repeated += 1
                continue
            seen[group].add(key_of(row))
            groups.setdefault(group, []).append(row)
        if repeated:
            print(
                f"{file}: {repeated} of {len(rows)} episodes stand in a file before it and count once",
                file=sys.stderr,
            )
    return {group: _of_newest_sources(group, rows) for group, rows in groups.items()}


def _of_newest_sources(group: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of a selector that was edited between its episodes those of its last version."""
    newest = {row["method"]: row.get("source_sha256") for row in rows}
    found = [row for row in rows if row.get("source_sha256") == newest[row["method"]]]
    if len(found) < len(rows):
        print(
            f"{group}: {len(rows) - len(found)} of {len(rows)} episodes are left out, the source of their selector "
            "is another one in the last row",
            file=sys.stderr,
        )
    return found


def _name(shared: dict[str, Any]) -> str:
    fingerprint = shared["model_fingerprint"][:8]
    ways = "".join(f", {option}" for option in shared.get("run_options", ()))
    return f"{shared['model']} {fingerprint} in {shared['world']}, {shared['quantization']}{ways}"


def _links(rows: list[dict[str, Any]]) -> str:
    ideal = {row["link"] is None for row in rows}
    if ideal == {True}:
        return "a link that loses nothing"
    limited = "the links that the tables name"
    return limited if ideal == {False} else f"a link that loses nothing, and over {limited}"


def section(name: str, rows: list[dict[str, Any]], summary: dict[str, Any]) -> Section:
    """The section of one group."""
    from comvla_sim.report.page import Section
    from comvla_sim.report.plots import success_against_bytes, success_against_tokens
    from comvla_sim.report.tables import all_tables

    shared = rows[0]["settings"]
    seeds = sorted({row["settings"]["seed"] for row in rows})
    layouts = {row["layout_seed"] for row in rows}
    versions = {**shared["versions"], **rows[0]["environment"]["versions"]}
    story = [
        f"{len(rows)} episodes in {shared['world']} on {len(layouts)} layouts that training never "
        f"saw; evaluation seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}.",
        f"Model {shared['model']}, fingerprint {shared['model_fingerprint']}; tokens sent as "
        f"{shared['quantization']} over {_links(rows)}.",
        "Measured with " + ", ".join(f"{k} {v}" for k, v in versions.items()) + ".",
    ]
    if "run_options" in shared:
        story.append(f"The server runs the model with {', '.join(shared['run_options'])}.")
    if shared.get("assets") == "stand-in":
        story.append(
            "Drawn with stand-in assets: these success rates must not be compared with published "
            "ones."
        )
    aggregate = summary["aggregate"]
    return Section(
        title=name,
        story=story,
        commands=list(dict.fromkeys(row["environment"]["command"] for row in rows)),
        plots=[
            ("success against tokens", success_against_tokens(aggregate)),
            ("success against bytes", success_against_bytes(aggregate)),
        ],
        tables=all_tables(summary),
    )
