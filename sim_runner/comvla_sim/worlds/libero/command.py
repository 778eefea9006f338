"""``comvla-sim libero``: set LIBERO's environment up, and see that its world can be solved."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from comvla.number_arguments import whole
from comvla_sim.worlds.libero.errors import LiberoError

if TYPE_CHECKING:
    from comvla_sim.worlds.libero.world import LiberoWorld

EPILOG = """\
examples:
  comvla-sim libero setup --download                  authentic assets from the hub
  COMVLA_LIBERO_ASSETS=packs comvla-sim libero setup  packs with stand-ins, for tests
  comvla-sim libero expert --suite libero_spatial --episodes 2
  comvla-sim eval --world libero:libero_spatial --model CHECKPOINT --episodes 50
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "libero",
        help="set up the LIBERO worlds, and run a scripted expert in them",
        description="LIBERO runs in a Python environment of its own, made here.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    setup = actions.add_parser("setup", help="make the environment; again, complete it")
    setup.add_argument("--download", action="store_true", help="authentic assets from the hub")
    setup.add_argument(
        "--packs", type=Path, help="folder with packs of assets (default: COMVLA_LIBERO_ASSETS)"
    )
    setup.add_argument("--python", help="interpreter to make it with, 3.10 to 3.12 (found)")
    setup.set_defaults(run=_setup)
    expert = actions.add_parser("expert", help="run the scripted expert: is the world right?")
    expert.add_argument("--suite", default="libero_spatial", help="(libero_spatial)")
    expert.add_argument("--episodes", type=whole(), default=2, help="initial states per task (2)")
    expert.add_argument("--tasks", help="numbers of tasks from 0, a,b,... (all)")
    expert.add_argument("--out", type=Path, help="write the episodes here as JSON")
    expert.add_argument("--json", action="store_true", help="print one JSON object")
    expert.set_defaults(run=_expert)


def _say(text: str) -> None:
    print(f"libero: {text}", file=sys.stderr, flush=True)


def _setup(args: argparse.Namespace) -> int:
    from comvla_sim.worlds.libero.assets import PACKS_VARIABLE
    from comvla_sim.worlds.libero.environment import LiberoEnvironment, default_home
    from comvla_sim.worlds.libero.installation import set_up
    from comvla_sim.worlds.libero.world import LiberoWorld

    given = os.environ.get(PACKS_VARIABLE)
    packs = args.packs or (Path(given) if given else None)
    environment = LiberoEnvironment(default_home())
    assets = set_up(environment, python=args.python, packs=packs, download=args.download, say=_say)
    world = LiberoWorld("libero_spatial", render=False)
    world.close()
    _say(f"{environment.home} works, with {assets.label} assets from {assets.folder}")
    return 0


def _chosen(text: str | None, number: int) -> list[int]:
    if text is None:
        return list(range(number))
    try:
        chosen = [int(part) for part in text.split(",")]
    except ValueError:
        chosen = [-1]
    if not all(0 <= index < number for index in chosen):
        raise LiberoError(f"--tasks are numbers from 0 to {number - 1}, got {text!r}")
    return chosen


def _expert(args: argparse.Namespace) -> int:
    from comvla_sim.worlds.libero.world import SUITES, LiberoWorld

    if args.suite not in SUITES:
        raise LiberoError(f"--suite {args.suite!r} is unknown: choose among {', '.join(SUITES)}")
    if args.episodes < 1:
        raise LiberoError(f"--episodes must be at least 1, got {args.episodes}")
    world = LiberoWorld(args.suite, render=False)
    try:
        report = _run_expert(world, args)
    finally:
        world.close()
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(report, indent=1) + "\n")
    if args.json:
        print(json.dumps(report))
    else:
        print(
            f"{report['successes']} of {report['episodes']} episodes of {args.suite} solved, "
            f"{report['mean_steps_of_successes']} steps on average ({world.assets} assets)"
        )
    return 0


def _run_expert(world: LiberoWorld, args: argparse.Namespace) -> dict[str, Any]:
    from comvla_sim.experiments.statistics import wilson_interval
    from comvla_sim.worlds.libero.rollout import run_experts

    tasks = [world.tasks[index].name for index in _chosen(args.tasks, len(world.tasks))]
    rows = []
    for row in run_experts(world, tasks, range(args.episodes)):
        rows.append(row)
        outcome = "solved" if row["success"] else row["reason"] or "failed"
        _say(f"{row['instruction']}, {row['init_state']}: {outcome} ({row['steps']} steps)")
    solved = [row["steps"] for row in rows if row["success"]]
    low, high = wilson_interval(len(solved), len(rows))
    return {
        "suite": args.suite,
        **world.labels,
        "episodes": len(rows),
        "successes": len(solved),
        "low": low,
        "high": high,
        "mean_steps_of_successes": round(sum(solved) / len(solved), 1) if solved else None,
        "versions": world.versions,
        "rows": rows,
    }
