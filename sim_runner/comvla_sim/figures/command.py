"""``comvla-sim figure fading|csi-delay|episode``: success over links that really withhold bytes."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from comvla.number_arguments import number, whole
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.link_options import listed

if TYPE_CHECKING:
    from comvla_sim.experiments.link_case import LinkCase
    from comvla_sim.figures.measuring import Study

FIGURES = {
    "fading": """\
Success against mean SNR over Rayleigh and Rician fading (the paper's Fig. 4), and the same link
enforced beside it.
""",
    "csi-delay": """\
Success, violations of the capacity, and time against the age of the reported SNR (the paper's
Fig. 5), not enforced and enforced.
""",
    "episode": """\
One episode, period by period: SNR, capacity, tokens, bytes, and when the robot fell back.
""",
}
HOW = """
Runs the episodes that are missing, then draws PNG and SVG and writes all points as JSON and
Markdown. One line per episode is appended to a results file in the output folder as it ends; the
same command goes on where it was stopped, and figures in one folder share their episodes. All lines
meet the same tables, instructions and fading.
"""
EPILOG = """\
lines (--series):
{series}

examples:
  comvla-sim figure csi-delay --workers 1
  comvla-sim figure fading --series full,unenforced,queue --mean-snr-db 5,10 --episodes 5
  comvla-sim figure episode --series progressive+floor --mean-snr-db 5 --json
"""

QUICK_EPISODES = 2
QUICK_SNR_DB, QUICK_DELAYS = (0.0, 10.0, 20.0), (0, 2)

BANDWIDTH_HZ, TOKEN_DIM = 0.18e6, 96
"""One LTE resource block, the carrier of NB-IoT, and the shipped policy's tokens: from 0 to 20 dB
K* by Eq. (4) goes from 3 to 26 on average, across the policy's knee between 4 and 16."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers the subcommand and its figures."""
    from comvla_sim.figures.series import SERIES

    parser = subparsers.add_parser("figure", help="what fading and stale reports cost, drawn")
    figures = parser.add_subparsers(metavar="NAME", title="figures", required=True)
    lines = "\n".join(f"  {name:19}{series.label}" for name, series in SERIES.items())
    for name, what in FIGURES.items():
        parser = figures.add_parser(
            name,
            help=" ".join(what.split()),
            description=what if name == "episode" else what + HOW,
            epilog=EPILOG.format(series=lines),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        _add_options(parser, one=name == "episode")
        parser.set_defaults(run=run, figure=name)


def _add_options(parser: argparse.ArgumentParser, *, one: bool) -> None:
    names, numbers = listed(str), listed(number())
    parser.add_argument("--series", type=names, help="lines to draw, a,b,... (the figure's own)")
    parser.add_argument("--channel", type=names, help="rayleigh,rician,... (the figure's own)")
    parser.add_argument("--mean-snr-db", type=numbers, help="0,5,... (the figure's own)")
    parser.add_argument(
        "--csi-delay", type=listed(whole()), help="age of reports in periods, 0,1,... (its own)"
    )
    parser.add_argument(
        "--bandwidth-hz", type=number(), help="W (0.18 MHz scaled to the width of the tokens)"
    )
    parser.add_argument("--doppler-hz", type=number(), default=10.0, help="f_d (10)")
    parser.add_argument("--rician-k", type=number(), default=3.0, help="κ of Rician fading (3)")
    parser.add_argument("--instructions", type=names, help="names of tasks (all)")
    parser.add_argument("--world", default="tabletop", help="(tabletop)")
    parser.add_argument("--model", default="mini", help="mini or a checkpoint folder (mini)")
    parser.add_argument("--seed", type=whole(), default=0, help="chooses the tables (0)")
    if one:
        parser.add_argument("--episode", type=whole(), default=0, help="number of the table (0)")
        parser.set_defaults(episodes=1, quick=False, workers=1, ray=None)
    else:
        parser.add_argument(
            "--episodes", type=whole(), default=20, help="tables per instruction (20)"
        )
        parser.add_argument("--quick", action="store_true", help="fewer points, 2 tables: minutes")
        parser.add_argument(
            "--measured-only",
            action="store_true",
            help="measure nothing; draw what is there, and leave out what is not",
        )
        parser.add_argument("--workers", type=whole(), default=0, help="processes (one per core)")
        parser.add_argument("--ray", metavar="ADDRESS", help="as for comvla-sim eval")
    parser.add_argument("--out", type=Path, default=Path("runs/figure"), help="(runs/figure)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(args: argparse.Namespace) -> int:
    """Measures what is missing, draws, prints. Returns 0, or 130 after Ctrl-C."""
    from comvla_sim.experiments import plan, runner
    from comvla_sim.figures.measuring import Study

    settings = plan.EvalSettings(world=args.world, model=args.model, seed=args.seed)
    subject = runner.inspect(settings)
    study = Study(
        settings,
        subject,
        plan.chosen_tasks(args.instructions, subject.tasks),
        QUICK_EPISODES if args.quick else args.episodes,
        args.out,
        args.workers,
        args.ray,
    )
    study.check()
    if args.figure == "episode":
        printed = _episode(args, study)
    else:
        try:
            printed = _sweep(args, study)
        except KeyboardInterrupt:
            return 130
    if args.json:
        print(json.dumps(printed))
    return 0


def figure_bandwidth_hz(token_dim: int) -> float:
    """W of the figures for tokens of another width than the shipped policy's: to two digits, the same budgets."""
    return float(f"{BANDWIDTH_HZ * token_dim / TOKEN_DIM:.2g}")


def _sweep(args: argparse.Namespace, study: Study) -> dict[str, Any]:
    from comvla_sim.figures.running import run_sweep
    from comvla_sim.figures.series import chosen
    from comvla_sim.figures.sweeps import SWEEPS

    sweep = SWEEPS[args.figure]
    series = chosen(sweep.series if args.series is None else args.series)
    links = _links(args, study, sweep)
    printed, text = run_sweep(args.figure, study, series, links, measured_only=args.measured_only)
    if not args.json:
        print(text)
        print("\n".join(printed["files"]))
        print("\n".join(str(args.out / f"{args.figure}.{suffix}") for suffix in ("json", "md")))
    return printed


def _episode(args: argparse.Namespace, study: Study) -> dict[str, Any]:
    from comvla_sim.figures.episode import draw_episode, episode_caption, run_one, story_dict
    from comvla_sim.figures.running import write_text
    from comvla_sim.figures.series import chosen
    from comvla_sim.figures.sweeps import EPISODE

    task = study.tasks[0]
    found: dict[str, Any] = {"figure": "episode", "files": [], "lines": {}}
    links = _links(args, study, EPISODE)
    if len(links) > 1:
        raise EvaluationError("an episode has one link: give one --channel, SNR and delay")
    for name, line in chosen(EPISODE.series if args.series is None else args.series).items():
        story = run_one(study, line, links[0], task, args.episode)
        paths = draw_episode(story, study, f"episode-{name.replace('+', '-')}", args.out)
        found["files"] += [str(path) for path in paths]
        found["lines"][name] = {"caption": episode_caption(story, study), **story_dict(story)}
        if not args.json:
            print(episode_caption(story, study), *paths, sep="\n")
    write_text(args.out / "episode.json", json.dumps(found, indent=1) + "\n")
    return found


def _links(args: argparse.Namespace, study: Study, sweep: Any) -> list[LinkCase]:
    from comvla_sim.experiments.link_case import LinkCase

    def values(given: Any, own: Sequence[Any], quick: Sequence[Any] | None = None) -> Sequence[Any]:
        if given is not None:
            if not given:
                raise EvaluationError("an option that lists values is empty")
            return given  # type: ignore[no-any-return]
        return quick if args.quick and quick is not None and len(own) > 1 else own

    links = [
        LinkCase(
            channel=channel,
            mean_snr_db=mean_snr_db,
            csi_delay=delay,
            bandwidth_hz=figure_bandwidth_hz(study.subject.token_dim)
            if args.bandwidth_hz is None
            else args.bandwidth_hz,
            doppler_hz=args.doppler_hz,
            rician_k=args.rician_k,
        )
        for channel in values(args.channel, sweep.channels)
        for mean_snr_db in values(args.mean_snr_db, sweep.mean_snr_db, QUICK_SNR_DB)
        for delay in values(args.csi_delay, sweep.csi_delay, QUICK_DELAYS)
    ]
    for link in links:
        link.check()
    return links
