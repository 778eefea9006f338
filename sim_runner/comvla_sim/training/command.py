"""``comvla-sim train``: from nothing to a policy in one resumable command."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from comvla.number_arguments import SEED, number, whole
from comvla_sim.codecs import command as codec_command

if TYPE_CHECKING:
    from comvla_sim.training.trainer import Progress, Recipe, Trainer

# Training takes layouts from 0, validation from here; evaluation starts at a million.
FIRST_VALIDATION_LAYOUT = 900_000
MOST_VALIDATION_LAYOUTS = 100_000

DESCRIPTION = """\
Generates demonstrations with scripted experts, trains a small language-following policy on them, and writes
it as a checkpoint folder that `comvla-server serve --model FOLDER` and `load_edge(FOLDER)` take.

Everything is resumable: run the same command again after an interruption. Two runs with the same options
draw the same frames, numbers of tokens and selections in the same order.
"""
EPILOG = """\
examples:
  comvla-sim train --out runs/mini                         the shipped policy: trained on voted tokens only
  comvla-sim train --out runs/fair --random-share 0.5 --steps 2000 --data runs/mini/demonstrations
                                                           a fair control for random selection
  comvla-sim train --out runs/try --layouts 50 --steps 200 a few minutes, to see it work
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "train",
        help="train the small policy from scripted experts",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, default=Path("runs/mini"), help="folder of the run")
    parser.add_argument("--data", type=Path, help="demonstrations (default: OUT/demonstrations)")
    parser.add_argument("--layouts", type=whole(), default=600, help="tables to learn from (600)")
    parser.add_argument(
        "--validation-layouts",
        type=whole(),
        default=40,
        help="tables to check on (40)",
        metavar="N",
    )
    parser.add_argument("--steps", type=whole(), default=4000, help="optimiser steps (4000)")
    parser.add_argument("--seed", type=SEED, default=0, help="of weights and sampling (0)")
    parser.add_argument(
        "--random-share",
        type=number(),
        default=0.0,
        metavar="P",
        help="how often kept tokens are random instead of voted (0)",
    )
    parser.add_argument(
        "--workers", type=whole(0, 1024), default=0, help="simulators (one per core)"
    )
    parser.add_argument(
        "--threads", type=whole(1, 1024), default=1, help="of the training itself (1)"
    )
    parser.add_argument("--float32", action="store_true", help="no bfloat16 arithmetic")
    parser.add_argument("--json", action="store_true", help="print a summary as JSON at the end")
    parser.set_defaults(run=run)
    others = parser.add_subparsers(
        title="other trainings", metavar="WHAT", help="the policy where nothing is named"
    )
    codec_command.add_parser(others)


def run(args: argparse.Namespace) -> int:
    """Generates, trains, exports. Returns 0, or 130 after Ctrl-C."""
    from comvla_sim.training.trainer import Recipe, TrainingError

    if (
        not 1 <= args.layouts <= FIRST_VALIDATION_LAYOUT
        or not 1 <= args.validation_layouts <= MOST_VALIDATION_LAYOUTS
        or args.steps < 1
        or not 0 <= args.random_share <= 1
    ):
        raise TrainingError(
            f"expected 1 to {FIRST_VALIDATION_LAYOUT} --layouts, 1 to {MOST_VALIDATION_LAYOUTS} "
            "--validation-layouts, at least one of --steps and --random-share within 0 .. 1, got "
            f"{args.layouts}, {args.validation_layouts}, {args.steps}, {args.random_share}"
        )
    recipe = Recipe(
        seed=args.seed,
        steps=args.steps,
        random_share=args.random_share,
        bfloat16=not args.float32,
    )
    data = args.data or args.out / "demonstrations"
    try:
        _demonstrate(
            data, args.layouts, args.validation_layouts, args.workers or os.cpu_count() or 1
        )
        summary = _train(args.out, data, args.layouts, recipe, args.threads)
    except KeyboardInterrupt:
        print("\nstopped; run the same command again to go on", file=sys.stderr)
        return 130
    if args.json:
        print(json.dumps(summary))
    else:
        print(f"policy written to {summary['policy']} (fingerprint {summary['fingerprint']})")
    return 0


def _demonstrate(data: Path, layouts: int, validation_layouts: int, workers: int) -> None:
    from comvla_sim.training.demonstrations import generate, progress_bar

    first = FIRST_VALIDATION_LAYOUT
    parts = {"validation": range(first, first + validation_layouts), "train": range(layouts)}
    for name, seeds in parts.items():
        with progress_bar() as bar:
            generate(data / name, layouts=seeds, workers=workers, progress=bar)


def _train(out: Path, data: Path, layouts: int, recipe: Recipe, threads: int) -> dict[str, Any]:
    import torch

    from comvla_sim.training.bar import training_bar
    from comvla_sim.training.batches import Sampler
    from comvla_sim.training.demonstrations import Demonstrations
    from comvla_sim.training.trainer import Trainer, TrainingError
    from comvla_sim.worlds.tabletop import Tabletop
    from comvla_vla import save_policy
    from comvla_vla.presets import MINI_WORDS, mini
    from comvla_vla.prompt import Prompt, word_tokenizer
    from comvla_vla.statistics import pick_statistics

    torch.set_num_threads(threads)
    train, held_out = Demonstrations(data / "train"), Demonstrations(data / "validation")
    there = len(set(train.layout.tolist()))
    if there != layouts:
        raise TrainingError(
            f"{data / 'train'} holds demonstrations of {there} layouts, --layouts asks for {layouts}: "
            "choose another --data, or the number that is there"
        )
    config, tokenizer = mini(), word_tokenizer(list(MINI_WORDS))
    table = {"tabletop": data_statistics(train)}
    bounds = pick_statistics(table, None, where=str(data))
    prompt = Prompt(config.prompt, tokenizer)
    sampler = Sampler(train, Tabletop.tasks, prompt, bounds, recipe.seed)
    trainer = Trainer(config, recipe, out, train.digest())
    trainer.resume()
    with training_bar(recipe.steps, trainer.step) as show:
        trainer.run(sampler, lambda progress: show(progress.step, _words(progress)))
    checks = Sampler(held_out, Tabletop.tasks, prompt, bounds, 0, paraphrase_share=0.0)
    validation = validate(trainer, checks)
    edge, cloud = trainer.learner.edge, trainer.learner.cloud
    fingerprint = save_policy(out / "policy", edge, cloud, tokenizer, table)
    summary = {
        "policy": str(out / "policy"),
        "fingerprint": fingerprint,
        "layouts": layouts,
        "frames": len(train),
        "steps": recipe.steps,
        "seed": recipe.seed,
        "random_share": recipe.random_share,
        "training_seconds": round(trainer.seconds, 1),
        "parameters": sum(
            p.numel() for p in {id(p): p for n in (edge, cloud) for p in n.parameters()}.values()
        ),
        "validation_action_l1": validation,
    }
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    return summary


def data_statistics(data: Any) -> dict[str, Any]:
    """Bounds of the demonstrations. Actions lie in [-1, 1] already; the gripper is left as it is."""
    width = data.chunks.shape[-1]
    return {
        "normalization": "bounds",
        "action": {
            "min": [-1.0] * width,
            "max": [1.0] * width,
            "mask": [True] * (width - 1) + [False],
        },
        "proprio": {
            "min": [round(float(v), 4) for v in data.proprio.min(0)],
            "max": [round(float(v), 4) for v in data.proprio.max(0)],
        },
        "num_transitions": len(data),
    }


def validate(trainer: Trainer, sampler: Any, frames: int = 192) -> dict[str, float]:
    """Mean absolute action error on unseen tables, by K and selection."""
    import numpy as np

    trainer.learner.eval()
    chosen = np.linspace(0, len(sampler.data) - 1, min(frames, len(sampler.data))).astype(int)
    cases = [(512, "votes"), *((k, how) for k in (32, 16, 8) for how in ("votes", "random"))]
    return {
        f"{how}:{k}" if k < 512 else "full": round(
            trainer.losses(sampler, chosen, k, how)["action"], 4
        )
        for k, how in cases
    }


def _words(progress: Progress) -> str:
    losses = " ".join(f"{name} {value:.3f}" for name, value in progress.losses.items())
    return f"{losses} {progress.pairs_per_second:.0f} pairs/s"
