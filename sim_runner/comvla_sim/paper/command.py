"""``comvla-sim paper``: the paper's tables and figures by one command each."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from comvla.number_arguments import whole
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.link_options import listed

if TYPE_CHECKING:
    from comvla_sim.paper.results import Results

PARTS = {
    "table1": "success, bytes, operations and latency of every method (Table I)",
    "table2": "operations and latency of the parts of one query (Table II)",
    "table3": "hard against soft voting (Table III)",
    "table4": "FP16, INT8 and INT4, and the error behind each layer (Table IV)",
    "fig3": "pictures of kept tokens by instruction, method and K, and a film (Fig. 3)",
    "fig4": "success under Rayleigh and Rician fading (Fig. 4)",
    "fig5": "success with stale channel state (Fig. 5)",
    "all": "all of them",
}
DESCRIPTION = """\
Measures what the paper's tables and figures show, and puts the paper's numbers beside it, each with a
verdict: agrees, differs (by how much), or cannot be tested here (why). Writes results.json, results.md,
results.html and the pictures into the output folder.

Cells that several tables share are measured once; one line per episode is appended as it ends, and the
same command goes on where it was stopped.
"""
EPILOG = """\
examples:
  comvla-sim paper all --quick
  comvla-sim paper table1 --episodes 20 --json
  comvla-sim paper table1 --also centre:CentreFirst
  comvla-sim paper table1 --ray head-node:6379
  comvla-sim paper all --docs docs
  comvla-sim paper all --world libero --model ./oft-{suite}
  comvla-sim paper table1 --world libero --suites libero_spatial --model ./oft-spatial --target gpu:50051
"""

QUICK_EPISODES = 2


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers the subcommand."""
    known = "\n".join(f"  {name:8}{what}" for name, what in PARTS.items())
    parser = subparsers.add_parser(
        "paper",
        help="the paper's tables and figures, measured here beside its numbers",
        description=DESCRIPTION,
        epilog=f"parts:\n{known}\n\n{EPILOG}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("part", choices=tuple(PARTS), help="see below")
    parser.add_argument(
        "--quick", action="store_true", help=f"{QUICK_EPISODES} tables per instruction: minutes"
    )
    parser.add_argument(
        "--episodes", type=whole(), default=20, help="tables per instruction and method (20)"
    )
    parser.add_argument(
        "--also",
        type=listed(str),
        default=(),
        metavar="METHOD",
        help="further methods for Table I, e.g. my_module:MySelector; as for comvla-sim eval",
    )
    parser.add_argument("--world", choices=("tabletop", "libero"), default="tabletop")
    parser.add_argument(
        "--model",
        default="mini",
        help="mini, or a checkpoint folder; {suite} in it stands for each LIBERO suite (mini)",
    )
    parser.add_argument(
        "--suites", type=listed(str), default=(), help="of LIBERO: libero_spatial,... (all four)"
    )
    parser.add_argument(
        "--target", metavar="HOST:PORT", help="a server that runs the cloud half, e.g. on a GPU"
    )
    parser.add_argument("--seed", type=whole(), default=0, help="chooses the tables (0)")
    parser.add_argument("--workers", type=whole(), default=0, help="processes (one per core)")
    parser.add_argument("--ray", metavar="ADDRESS", help="as for comvla-sim eval")
    parser.add_argument("--out", type=Path, default=Path("runs/paper"), help="(runs/paper)")
    parser.add_argument(
        "--reuse",
        type=Path,
        action="append",
        metavar="FOLDER",
        help="take over episodes of other runs (runs/figure and runs/eval)",
    )
    parser.add_argument(
        "--measured-only",
        action="store_true",
        help="measure nothing; report what is there, and leave out what is not",
    )
    parser.add_argument(
        "--docs", type=Path, metavar="FOLDER", help="also write the page and its pictures here"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measures what is missing and writes the documents. Returns 0, or 130 after Ctrl-C."""
    from comvla_sim.paper import gathering
    from comvla_sim.paper.measuring import Plan

    plan = Plan(
        world=args.world,
        model=_model(args),
        episodes=QUICK_EPISODES if args.quick else args.episodes,
        seed=args.seed,
        out=args.out,
        workers=args.workers,
        ray=args.ray,
        target=args.target,
        only=args.suites,
        reuse=tuple(args.reuse) if args.reuse else gathering.default_reuse(),
        measured_only=args.measured_only,
        also=args.also,
    )
    if args.also and args.part not in ("table1", "all"):
        raise EvaluationError(
            f"--also adds lines to Table I, not to {args.part}: ask for table1 or all"
        )
    wanted = [part for part in PARTS if part != "all"] if args.part == "all" else [args.part]
    if args.world == "libero":
        wanted = _on_libero(wanted, everything=args.part == "all")
    try:
        results = gathering.gather(plan, wanted, quick=args.quick)
    except KeyboardInterrupt:
        print(f"\nstopped; the same command goes on from {args.out}", file=sys.stderr)
        return 130
    files = write_documents(results, args.out)
    if args.docs is not None:
        files += publish(results, args.out, args.docs)
    if args.json:
        print(
            json.dumps(
                {"files": [str(path) for path in files], **verdicts(results), **results.data}
            )
        )
    else:
        _print(results)
        print("\n".join(str(path) for path in files))
    return 0


def _model(args: argparse.Namespace) -> str:
    if args.world == "libero" and args.model == "mini":
        raise EvaluationError(
            "--world libero needs --model PATH: a folder with OpenVLA-OFT's published weights, split or as published "
            "(docs/openvla-oft.md); ./oft-{suite} for one of each suite"
        )
    return str(args.model)


def _on_libero(wanted: list[str], *, everything: bool) -> list[str]:
    """Figs. 4 and 5 are drawn suite by suite there, with the command that knows worlds."""
    kept = [part for part in wanted if part not in ("fig4", "fig5")]
    if not kept or (not everything and kept != wanted):
        raise EvaluationError(
            "on LIBERO figs. 4 and 5 are drawn suite by suite: comvla-sim figure fading --world libero:libero_object "
            "--model PATH --bandwidth-hz 20e6"
        )
    return kept


def write_documents(results: Results, out: Path) -> list[Path]:
    """results.json, results.md, results.html and the plot of Table I.

    Raises:
        EvaluationError: a file cannot be written.
    """
    from comvla_sim.paper.document import markdown
    from comvla_sim.paper.html import page
    from comvla_sim.paper.part import PICTURES
    from comvla_sim.paper.plot import success_against_bytes
    from comvla_sim.paper.results import write

    paths = [out / name for name in ("results.json", "results.md", "results.html")]
    results.save(paths[0])
    if results.data["cells"]:
        paths.append(out / PICTURES["table1"][0])
        write(paths[-1], success_against_bytes(results))
    for key, name in (("fig3", "fig3.png"), ("film", "film.webp")):
        if results.data.get("figure3") and (out / name).exists():
            paths.append(out / PICTURES[key][0])
            write(paths[-1], (out / name).read_bytes())
    write(paths[1], markdown(results).encode())
    write(paths[2], page(results, out).encode())
    return paths


def publish(results: Results, out: Path, docs: Path) -> list[Path]:
    """Copies the page, what it is made of, and its pictures.

    Raises:
        EvaluationError: a file cannot be written.
    """
    from comvla_sim.paper.part import PICTURES

    files = []
    for name in ("results.md", "results.json", *(file for file, _ in PICTURES.values())):
        if (out / name).exists():
            try:
                docs.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(out / name, docs / name)
            except OSError as error:
                raise EvaluationError(f"cannot write {docs / name}: {error.strerror}") from error
            files.append(docs / name)
    return files


def verdicts(results: Results) -> dict[str, object]:
    """Every claim, and every table as it stands in the document, for programs."""
    from comvla_sim.paper.claims import claims
    from comvla_sim.paper.document import parts

    return {
        "claims": [
            {"claim": claim, "here": here, "verdict": verdict.kind, "detail": verdict.detail}
            for claim, here, verdict in claims(results)
        ],
        "tables": [
            {"part": part.title, "title": t.title, "header": t.header, "rows": t.rows}
            for part in parts(results)
            for t in part.tables
        ],
    }


def _print(results: Results) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table as Grid

    from comvla_sim.paper.document import parts

    console = Console()
    for part in parts(results):
        for table in part.tables:
            grid = Grid(box=box.SIMPLE_HEAD, pad_edge=False, title=f"{part.title} · {table.title}")
            for number, name in enumerate(table.header):
                grid.add_column(name, justify="left" if not number else "right", overflow="fold")
            for row in table.rows:
                grid.add_row(*row)
            console.print(grid)
