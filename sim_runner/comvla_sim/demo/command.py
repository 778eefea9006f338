"""``comvla-sim demo``: four instructions over a fading link, and one page that shows it."""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeAlias

from comvla.number_arguments import number, whole
from comvla_sim.experiments.errors import EvaluationError

if TYPE_CHECKING:
    from comvla_sim.demo.episode import Episode
    from comvla_sim.demo.scenario import Scene
    from comvla_sim.demo.server_process import ServerProcess

    Show: TypeAlias = Callable[[str, Scene], Callable[[Episode], None]]

DESCRIPTION = """\
Starts a policy server as a process of its own and lets a simulated arm obey instructions about
different fixtures, its tokens crossing a simulated Rician link that withholds whatever exceeds the
capacity of a control period. Each episode is repeated with every token on a link without limit.
What happened is left as one HTML file that loads nothing.

With --fleet N arms go on, in real time, until Ctrl-C, and the server's own live page shows them.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "demo",
        help="watch a robot obey over a rate-limited link",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/demo/demo.html"), help="(runs/demo/demo.html)"
    )
    parser.add_argument("--seed", type=whole(), default=0, help="of tables and fading (0)")
    parser.add_argument(
        "--mean-snr-db", type=number(-200, 200), default=10.0, help="of the link, dB (10)"
    )
    parser.add_argument("--episodes", type=whole(), default=4, help="instructions to obey (4)")
    parser.add_argument(
        "--fleet", type=whole(1), metavar="N", help="N arms for the server's live page, no film"
    )
    parser.add_argument(
        "--seconds", type=number(0.0), metavar="S", help="how long the fleet works (until Ctrl-C)"
    )
    parser.add_argument("--model", default="mini", help="mini or a checkpoint folder (mini)")
    parser.add_argument("--open", action="store_true", help="show the page in a browser")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Runs the demo. Returns 0 when it ran, however the robot did; 1 when the server failed."""
    from comvla_sim.demo.scenario import fading, scenes
    from comvla_sim.demo.server_process import ServerProcess, ServerProcessError
    from comvla_sim.worlds.tabletop import Tabletop

    if args.fleet is not None:
        return _run_fleet(args)
    if args.seconds is not None:
        raise EvaluationError("--seconds is how long a fleet works: give --fleet N as well")
    started = time.monotonic()
    # What is wrong with the options is said before anything is started.
    scenes(Tabletop.tasks, seed=args.seed, episodes=args.episodes)
    fading(args.mean_snr_db, seed=0)
    _claim(args.out)
    with _terminated_like_interrupted():
        try:
            with ServerProcess(args.model) as server:
                outcome = _play(args, server)
        except ServerProcessError as error:
            print(f"comvla-sim demo: {error}", file=sys.stderr)
            return 1
    outcome["wall_s"] = round(time.monotonic() - started, 1)
    if args.json:
        print(json.dumps(outcome))
    else:
        print(
            f"{outcome['successes']} of {outcome['episodes']} episodes succeeded; "
            f"{outcome['link']['above_capacity']} of {outcome['link']['requests']} requests above "
            f"the link's capacity; {outcome['wall_s']:.0f} s\n{outcome['page']}"
        )
    if args.open:
        import webbrowser

        webbrowser.open(args.out.resolve().as_uri())
    return 0


def _run_fleet(args: argparse.Namespace) -> int:
    """Robots that go on until somebody has seen enough. Returns 1 when server or robots failed."""
    from comvla_sim.demo.fleet import FleetError, FleetOfRobots, FleetPlan
    from comvla_sim.demo.scenario import fading
    from comvla_sim.demo.server_process import ServerProcess, ServerProcessError

    fading(args.mean_snr_db, seed=0)  # what is wrong with it is said before anything is started
    counts = {"episodes": 0, "successes": 0}

    def count(success: bool) -> None:
        counts["episodes"] += 1
        counts["successes"] += success

    with _terminated_like_interrupted():
        try:
            with contextlib.suppress(KeyboardInterrupt), ServerProcess(args.model) as server:
                plan = FleetPlan(server.target, args.model, args.fleet, args.mean_snr_db, args.seed)
                print(f"{args.fleet} robots, to watch at {server.admin_url}", flush=True)
                if args.open:
                    import webbrowser

                    webbrowser.open(server.admin_url)
                with FleetOfRobots(plan, count) as fleet:
                    fleet.watch(args.seconds, lambda: server.running)
                server.require_running()
        except (ServerProcessError, FleetError) as error:
            print(f"comvla-sim demo: {error}", file=sys.stderr)
            return 1
    said = f"{counts['successes']} of {counts['episodes']} episodes succeeded"
    print(json.dumps(counts) if args.json else said)
    return 0


def _claim(out: Path) -> None:
    """Fails now, not after the episodes, where the page cannot be written."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("a", encoding="utf-8"):
            pass
    except OSError as error:
        raise EvaluationError(f"cannot write {out}: {error.strerror}: choose --out") from error


@contextlib.contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM unwinds the stack, so that the server is ended with the demo."""

    def leave(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    try:
        before = signal.signal(signal.SIGTERM, leave)
    except ValueError:  # not the main thread, where signals are none of our business
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _play(args: argparse.Namespace, server: ServerProcess) -> dict[str, Any]:
    """Both rounds of episodes, the page, and what the command reports."""
    import torch

    from comvla_sim import worlds
    from comvla_sim.demo import figures, rounds
    from comvla_sim.demo.page import render
    from comvla_sim.demo.scenario import LINK, scenes
    from comvla_sim.experiments.policy import load_edge_half

    torch.set_num_threads(1)  # small pictures: more threads only wait for each other
    edge = load_edge_half(args.model)
    world = worlds.make("tabletop", image_size=edge.info.image_size[0])
    try:
        program = scenes(world.tasks, seed=args.seed, episodes=args.episodes)
        with _progress(world.max_episode_steps) as show:
            stage = rounds.Stage(server, world, edge, args.mean_snr_db)
            limited = [stage.over_link(s, show("voted tokens", s)) for s in program]
            unlimited = [stage.without_limit(s, show("all tokens", s)) for s in program]
    finally:
        world.close()
    use = figures.link_use(limited)
    full_air_s = rounds.full_air_s(limited, unlimited, args.mean_snr_db)
    full = figures.figures_of(unlimited, full_air_s)
    ours = figures.figures_of(limited)
    command = _command(args)
    args.out.write_text(
        render(
            limited,
            unlimited,
            ours,
            full,
            use,
            info=edge.info,
            link=LINK,
            mean_snr_db=args.mean_snr_db,
            seed=args.seed,
            command=command,
        ),
        encoding="utf-8",
    )
    return {
        "page": str(args.out),
        "command": command,
        "episodes": len(limited),
        "successes": ours.successes,
        "link": {**asdict(LINK), "mean_snr_db": args.mean_snr_db, **asdict(use)},
        "voted": asdict(ours),
        "full": asdict(full),
        "rows": [
            _row(episode, reference) for episode, reference in zip(limited, unlimited, strict=True)
        ],
    }


def _row(episode: Episode, reference: Episode) -> dict[str, Any]:
    """One instruction in the command's JSON."""
    return {
        "task": episode.scene.task.name,
        "instruction": episode.scene.task.instruction,
        "layout_seed": episode.scene.layout_seed,
        "success": episode.success,
        "periods": episode.periods,
        "success_with_all_tokens": reference.success,
        "periods_with_all_tokens": reference.periods,
        "log": [query.record.to_dict() for query in episode.queries if query.record],
    }


def _command(args: argparse.Namespace) -> str:
    command = f"comvla-sim demo --seed {args.seed} --mean-snr-db {args.mean_snr_db:g}"
    return f"{command} --episodes {args.episodes} --model {Path(args.model).name}"


@contextlib.contextmanager
def _progress(periods: int) -> Iterator[Show]:
    """A bar for each episode on stderr, with what the link is doing."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:

        def begin(way: str, scene: Scene) -> Callable[[Episode], None]:
            bar = progress.add_task(f"{way}: {scene.task.instruction}", total=periods, note="")

            def show(episode: Episode) -> None:
                note = f"{len(episode.queries)} queries"
                if episode.queries:
                    note += f", {episode.queries[-1].report.tokens} tokens"
                if episode.snr_db:
                    note += f", {episode.snr_db[-1]:.0f} dB"
                if episode.success:
                    note += ", done"
                total = episode.periods if episode.success else periods
                progress.update(bar, completed=episode.periods, total=total, note=note)

            return show

        yield begin
