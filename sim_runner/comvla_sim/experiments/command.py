"""``comvla-sim eval``: closed-loop success of methods at several K, resumable."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from comvla.number_arguments import whole
from comvla_sim.experiments.errors import EvaluationError

if TYPE_CHECKING:
    from collections.abc import Callable

    from comvla_sim.experiments.plan import EvalSettings
    from comvla_sim.experiments.runner import Subject
    from comvla_sim.worlds.base import Task

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
"""


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
    parser.add_argument(
        "--world", default="tabletop", help="tabletop, metaworld:TASK or libero:SUITE (tabletop)"
    )
    parser.add_argument(
        "--model", default="mini", help="mini, random, or a checkpoint folder (mini)"
    )
    parser.add_argument(
        "--method", type=_names, default="full,hard_voting", help="a,b,... of those below"
    )
    parser.add_argument("--k", type=_numbers, default="32", help="tokens sent: 64,32,... (32)")
    parser.add_argument("--condition", type=_names, default="normal", help="see below (normal)")
    parser.add_argument("--episodes", type=whole(), default=20, help="layouts per instruction (20)")
    parser.add_argument("--seed", type=whole(), default=0, help="chooses the layouts (0)")
    parser.add_argument(
        "--instructions", type=_names, help="names or sentences of tasks, a,b,... (all)"
    )
    parser.add_argument("--quantization", default="int8", help="of the tokens on the wire (int8)")
    parser.add_argument("--workers", type=whole(), default=0, help="processes (one per core)")
    parser.add_argument("--target", metavar="HOST:PORT", help="a running server; else in process")
    parser.add_argument("--out", type=Path, help="results file (a name in runs/eval)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
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
    settings = plan.EvalSettings(
        world=args.world,
        model=args.model,
        seed=args.seed,
        quantization=args.quantization,
        target=args.target,
    )
    subject = runner.inspect(settings)
    grid = plan.Grid(
        conditions=args.condition,
        methods=args.method,
        ks=args.k,
        tasks=_chosen_tasks(args.instructions, subject.tasks),
        episodes=args.episodes,
    )
    grid.check(num_tokens=subject.num_tokens, seed=args.seed)
    _check_server_options(args.method, args.target)
    specs = list(grid.specs(subject.num_tokens))
    path = args.out or _default_path(settings, subject)
    with ResultsFile(path, subject.settings) as results:
        done = sum(spec in results.rows for spec in specs)
        print(f"{path}: {done} of {len(specs)} episodes are there", file=sys.stderr)
        try:
            with _bar(len(specs), done) as on_row:
                runner.run(
                    settings,
                    specs,
                    results,
                    shared=subject.settings,
                    story=runner.environment(settings, _command()),
                    workers=args.workers or _cores(),
                    on_row=on_row,
                )
        except KeyboardInterrupt:
            print(f"\nstopped; the same command goes on from {path}", file=sys.stderr)
            return 130
        summary = summarise(results.rows[spec] for spec in specs)
    if args.json:
        print(json.dumps({"results": str(path), "settings": subject.settings, **summary}))
    else:
        from comvla_sim.report.terminal import print_summary

        print_summary(summary)
    if subject.settings.get("assets") == "stand-in":
        print(
            "measured with stand-in assets: not to be compared with published success rates",
            file=sys.stderr,
        )
    return 0


def _check_server_options(methods: Sequence[str], target: str | None) -> None:
    """Refuses what a server that runs already would have to be started with."""
    from comvla_sim.experiments.methods import find_method

    for name in methods:
        option = find_method(name).server_option
        if option and target is not None:
            raise EvaluationError(
                f"--method {name} is done by the cloud half, and the server at {target} runs as it was "
                f"started: leave --target out, or serve with {option} and evaluate --method full there"
            )


def _names(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(dict.fromkeys(int(name) for name in _names(text)))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"expected whole numbers such as 64,32,16, got {text!r}"
        ) from None


def _chosen_tasks(wanted: Sequence[str] | None, tasks: Sequence[Task]) -> tuple[str, ...]:
    """Names of the tasks that were asked for by name or by instruction; all where nobody asked."""
    if not wanted:
        return tuple(task.name for task in tasks)
    known = {name: task.name for task in tasks for name in (task.name, task.instruction)}
    for name in wanted:
        if name not in known:
            raise EvaluationError(
                f"--instructions {name!r} is unknown: choose among "
                f"{', '.join(task.name for task in tasks)}"
            )
    return tuple(dict.fromkeys(known[name] for name in wanted))


def _default_path(settings: EvalSettings, subject: Subject) -> Path:
    """A name that changes with everything that must not be mixed in one file."""
    world = settings.world.replace(":", "-")
    model = f"{subject.settings['model']}-{subject.settings['model_fingerprint'][:8]}"
    name = f"{world}-{model}-{settings.quantization}-seed{settings.seed}.jsonl"
    return Path("runs") / "eval" / name


def _cores() -> int:
    """Cores that this process may use, which in a container are fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _command() -> str:
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])


@contextmanager
def _bar(total: int, done: int) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A progress bar on a terminal, a line every hundred episodes elsewhere; on stderr."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    if not console.is_terminal:
        count = done

        def line(row: dict[str, Any]) -> None:
            nonlocal count
            count += 1
            if count % 100 == 0 or count == total:
                print(f"{count}/{total} episodes", file=sys.stderr, flush=True)

        yield line
        return
    columns = (
        TextColumn("episodes"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[last]}"),
    )
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("", total=total, completed=done, last="")

        def show(row: dict[str, Any]) -> None:
            outcome = "success" if row["success"] else "failure"
            last = f"{row['condition']} {row['method']} K={row['k']} {row['task']}: {outcome}"
            progress.update(bar, advance=1, last=last)

        yield show
