"""``comvla-sim eval``: closed-loop success of methods at several K, resumable."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from comvla.number_arguments import whole
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.link_options import add_link_options, links_of, listed
from comvla_sim.experiments.progress import Pace, cores, episode_bar, typed_command

if TYPE_CHECKING:
    from comvla_sim.experiments.plan import EvalSettings
    from comvla_sim.experiments.runner import Subject

DESCRIPTION = """\
Runs a policy in closed loop: every method at every K on the same layouts, which training never saw.
One line per episode is appended to the results file as it ends; the same command goes on where it
was stopped, and runs only what is missing.
"""
OWN = """\
  package.module:ClassName a selector of your own (docs/selectors.md)
Pictures, and methods that decide themselves how much they send, run once, whatever --k says.
"""
EPILOG = """\
conditions:
  normal             as it should be
  blind              pictures of an expert doing the same task in another layout
  wrong_instruction  the instruction of another fixture on the table; "other" counts that task
  wrong_selection    tokens selected by another fixture's instruction, sent with the right one

examples:
  comvla-sim eval --method full,hard_voting,random --k 32,16 --episodes 20
  comvla-sim eval --method hard_voting --k 16 --condition blind,wrong_instruction --json
  comvla-sim eval --method full,hard_voting,jpeg-75,h264-28 --k 32
  comvla-sim eval --method hard_voting --k 32 --target robot-cloud:50051
  comvla-sim eval --method hard_voting,random --k 32 --ray head-node:6379
  comvla-sim eval --method hard_voting --channel rician --mean-snr-db 0,10 --enforce none,prefix
"""

LONGEST_OPTIONS = 100
"""Characters of a server's run options in the name of a file: systems allow 255 in all."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers the subcommand."""
    from comvla_sim.experiments.methods import table

    parser = subparsers.add_parser(
        "eval",
        help="measure success in closed loop, with intervals and paired tests",
        description=DESCRIPTION,
        epilog=f"methods:\n{table()}\n{OWN}\n{EPILOG}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    names = listed(str)
    parser.add_argument(
        "--world", default="tabletop", help="tabletop, metaworld:TASK or libero:SUITE (tabletop)"
    )
    parser.add_argument(
        "--model", default="mini", help="mini, random, or a checkpoint folder (mini)"
    )
    parser.add_argument(
        "--method", type=names, default="full,hard_voting", help="a,b,... of those below"
    )
    parser.add_argument(
        "--k",
        type=listed(_tokens),
        help='tokens sent: 64,32,... ; "link" for what the link carries (32; link with --channel)',
    )
    parser.add_argument("--condition", type=names, default="normal", help="see below (normal)")
    parser.add_argument("--episodes", type=whole(), default=20, help="layouts per instruction (20)")
    parser.add_argument("--seed", type=whole(), default=0, help="chooses the layouts (0)")
    parser.add_argument(
        "--instructions", type=names, help="names or sentences of tasks, a,b,... (all)"
    )
    parser.add_argument("--quantization", default="int8", help="of the tokens on the wire (int8)")
    parser.add_argument("--workers", type=whole(), default=0, help="processes (one per core)")
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="run over Ray: local, auto, or HOST:PORT of a cluster's head node",
    )
    parser.add_argument("--target", metavar="HOST:PORT", help="a running server; else in process")
    parser.add_argument("--out", type=Path, help="results file (a name in runs/eval)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    add_link_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Runs what is missing and prints a summary. Returns 0, or 130 after Ctrl-C."""
    from comvla import codec
    from comvla_sim.experiments import plan, runner
    from comvla_sim.experiments.results import ResultsFile
    from comvla_sim.experiments.summary import summarise

    if args.workers < 0:
        raise EvaluationError(f"--workers must be 0 (one per core) or more, got {args.workers}")
    if args.quantization not in codec.QUANTIZATIONS:
        raise EvaluationError(
            f"--quantization {args.quantization!r} is unknown: choose among "
            f"{', '.join(codec.QUANTIZATIONS)}"
        )
    _check_server_options(args.method, args.target)
    settings = plan.EvalSettings(
        world=args.world,
        model=args.model,
        seed=args.seed,
        quantization=args.quantization,
        target=args.target,
    )
    subject = runner.inspect(settings)
    links = links_of(args, subject.token_dim)
    grid = plan.Grid(
        conditions=args.condition,
        methods=args.method,
        ks=args.k if args.k is not None else (32,) if links == (None,) else (None,),
        tasks=plan.chosen_tasks(args.instructions, subject.tasks),
        episodes=args.episodes,
        links=links,
    )
    grid.check(num_tokens=subject.num_tokens, seed=args.seed)
    specs = list(grid.specs(subject.num_tokens))
    path = args.out or default_path(settings, subject)
    with ResultsFile(path, subject.settings) as results:
        done = sum(spec in results.rows for spec in specs)
        print(f"{path}: {done} of {len(specs)} episodes are there", file=sys.stderr)
        pace = Pace()
        try:
            with episode_bar(len(specs), done) as on_row:
                runner.run(
                    settings,
                    specs,
                    results,
                    shared=subject.settings,
                    story=runner.environment(settings, typed_command()),
                    workers=args.workers or cores(),
                    ray=args.ray,
                    on_row=pace.counting(on_row),
                )
        except KeyboardInterrupt:
            print(f"\nstopped; the same command goes on from {path}", file=sys.stderr)
            return 130
        summary = summarise(results.rows[spec] for spec in specs)
    if pace.episodes:
        print(pace, file=sys.stderr)
    if args.json:
        head = {"results": str(path), "settings": subject.settings, "pace": pace.to_dict()}
        print(json.dumps({**head, **summary}))
    else:
        from comvla_sim.report.terminal import print_summary

        print_summary(summary)
    if subject.settings.get("assets") == "stand-in":
        print(
            "measured with stand-in assets: not to be compared with published success rates",
            file=sys.stderr,
        )
    return 0


def _check_server_options(names: Sequence[str], target: str | None) -> None:
    """Refuses what a server that runs already would have to be started with."""
    from comvla_sim.experiments.methods import IN_CLOUD

    for method in IN_CLOUD:
        if method.name in names and target is not None:
            raise EvaluationError(
                f"--method {method.name} is done by the cloud half, and the server at {target} runs as it was "
                f"started: leave --target out, or serve with {method.server_option} and evaluate --method full there"
            )


def _tokens(text: str) -> int | None:
    return None if text == "link" else whole()(text)


def default_path(settings: EvalSettings, subject: Subject) -> Path:
    """A name that changes with everything that must not be mixed in one file."""
    world = settings.world.replace(":", "-")
    model = f"{subject.settings['model']}-{subject.settings['model_fingerprint'][:8]}"
    name = f"{world}-{model}-{settings.quantization}-seed{settings.seed}"
    options = "-".join(subject.settings.get("run_options", ()))
    if options:
        # No "=" either: comvla-sim report takes NAME=FILE.
        name += "-" + re.sub(r"[^A-Za-z0-9._-]", "-", options)[:LONGEST_OPTIONS]
    return Path("runs") / "eval" / f"{name}.jsonl"
