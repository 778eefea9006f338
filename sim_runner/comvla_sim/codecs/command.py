"""``comvla-sim train codec``: a learned image codec from the world's own frames, resumable."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from comvla.number_arguments import SEED, number, whole

if TYPE_CHECKING:
    from comvla_sim.codecs.pictures import Pictures
    from comvla_sim.codecs.trainer import CodecRecipe, Progress
    from comvla_vla.codecs.image_codec import CodecConfig

DESCRIPTION = """\
Trains a codec that sends pictures as analogue symbols: DeepJSCC (as published) or WITT (its
structure at a size for a CPU; --published takes the published one). Pictures are frames of expert
episodes, both views; every picture of a step crosses one period of AWGN, Rician or Rayleigh fading
at a random mean SNR. Afterwards PSNR and SSIM over the SNR are measured on tables that training
never saw, and drawn.

Everything is resumable: run the same command again after an interruption.
"""
EPILOG = """\
examples:
  comvla-sim train codec --codec deepjscc                 the shipped one; under an hour on one core
  comvla-sim train codec --codec witt --out runs/witt
  comvla-sim train codec --codec witt --published --size 256
                                                          14 M + 14 M parameters: for a GPU's patience
  comvla-sim train codec --codec deepjscc --layouts 8 --steps 50 --out runs/try
                                                          a minute, to see it work
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers ``codec`` below ``train``."""
    parser = subparsers.add_parser(
        "codec",
        help="a learned image codec, the competition",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--codec", default="deepjscc", choices=("deepjscc", "witt"), help="(deepjscc)"
    )
    parser.add_argument("--out", type=Path, help="folder of the run (runs/codecs/CODEC)")
    parser.add_argument("--data", type=Path, help="frames (runs/codecs/frames-SIZE)")
    parser.add_argument("--size", type=whole(), default=128, help="side of a picture, pixels (128)")
    parser.add_argument("--published", action="store_true", help="the published network's size")
    parser.add_argument("--layouts", type=whole(), default=400, help="tables to learn from (400)")
    parser.add_argument(
        "--held-out-layouts",
        type=whole(),
        default=40,
        help="tables to measure on (40)",
        metavar="N",
    )
    parser.add_argument("--steps", type=whole(), help="optimiser steps (deepjscc 3000, witt 1500)")
    parser.add_argument("--batch-size", type=whole(), help="pictures per step (deepjscc 8, witt 4)")
    parser.add_argument("--learning-rate", type=number(), default=1e-3, help="highest (0.001)")
    parser.add_argument("--seed", type=SEED, default=0, help="of everything random (0)")
    parser.add_argument(
        "--workers", type=whole(0, 1024), default=0, help="simulators (one per core)"
    )
    parser.add_argument(
        "--threads", type=whole(1, 1024), default=1, help="of the training itself (1)"
    )
    parser.add_argument("--json", action="store_true", help="print a summary as JSON at the end")
    parser.set_defaults(run=run)


_STEPS = {"deepjscc": 3000, "witt": 1500}
_BATCH_SIZE = {"deepjscc": 8, "witt": 4}  # about the same time per step
_MEASURED_PICTURES = 128
_SHOWN_PICTURES = 2


def run(args: argparse.Namespace) -> int:
    """Renders, trains, measures, draws. Returns 0, or 130 after Ctrl-C."""
    import torch

    from comvla_sim.codecs.pictures import MOST_LAYOUTS, Pictures, render
    from comvla_sim.codecs.trainer import CodecRecipe
    from comvla_sim.training.demonstrations import Demonstrations, progress_bar
    from comvla_sim.training.run_state import TrainingError
    from comvla_vla.codecs.image_codec import CODECS, SMALL, check_size, config_to_json

    steps = _STEPS[args.codec] if args.steps is None else args.steps
    batch_size = _BATCH_SIZE[args.codec] if args.batch_size is None else args.batch_size
    numbers = (args.layouts, args.held_out_layouts, steps, batch_size, args.threads)
    if min(numbers) < 1 or max(numbers[:2]) > MOST_LAYOUTS or not args.learning_rate > 0:
        raise TrainingError(
            f"expected 1 to {MOST_LAYOUTS} --layouts and --held-out-layouts, at least one of --steps, "
            f"--batch-size and --threads, and a --learning-rate above 0, got {args.layouts}, "
            f"{args.held_out_layouts}, {steps}, {batch_size}, {args.threads}, {args.learning_rate}"
        )
    config: CodecConfig = CODECS[args.codec]() if args.published else SMALL[args.codec]
    check_size(config, args.size, args.size)
    out = args.out or Path("runs/codecs") / args.codec
    data = args.data or Path(f"runs/codecs/frames-{args.size}")
    recipe = CodecRecipe(
        codec=args.codec,
        config=config_to_json(config),
        image_size=args.size,
        layouts=args.layouts,
        seed=args.seed,
        steps=steps,
        batch_size=batch_size,
        learning_rate=args.learning_rate,
    )
    torch.set_num_threads(args.threads)
    try:
        with progress_bar() as bar:
            render(
                data,
                size=args.size,
                layouts=args.layouts,
                held_out_layouts=args.held_out_layouts,
                workers=args.workers or os.cpu_count() or 1,
                progress=bar,
            )
        train = Pictures(Demonstrations(data / "train"), args.seed)
        held_out = Pictures(Demonstrations(data / "validation"))
        summary = _train(out, recipe, train, held_out)
    except KeyboardInterrupt:
        print("\nstopped; run the same command again to go on", file=sys.stderr)
        return 130
    if args.json:
        print(json.dumps(summary))
    else:
        print(
            f"{args.codec} written to {summary['folder']} (fingerprint {summary['fingerprint'][:16]})"
        )
        print(psnr_table(summary["curves"]))
    return 0


def _train(out: Path, recipe: CodecRecipe, train: Pictures, held_out: Pictures) -> dict[str, Any]:
    from comvla_sim.codecs.digital import jpeg_ladder
    from comvla_sim.codecs.figures import Measured, pictures_figure, psnr_figure
    from comvla_sim.codecs.measuring import curves
    from comvla_sim.codecs.trainer import CodecTrainer
    from comvla_sim.training.bar import training_bar
    from comvla_vla.codecs.files import load_codec, save_codec
    from comvla_vla.codecs.image_codec import rate
    from comvla_vla.codecs.waveform import float_to_uint8

    trainer = CodecTrainer(recipe, out)
    trainer.resume()
    with training_bar(recipe.steps, trainer.step) as show:
        trainer.run(train, lambda progress: show(progress.step, _words(progress)))
    cost = rate(trainer.codec.config, recipe.image_size, recipe.image_size)
    notes: dict[str, Any] = {
        "recipe": json.loads(json.dumps(vars(recipe))),
        "training_seconds": round(trainer.seconds, 1),
        "training_pictures": len(train),
        "parameters": {
            name: sum(p.numel() for p in half.parameters())
            for name, half in (
                ("encoder", trainer.codec.encoder),
                ("decoder", trainer.codec.decoder),
            )
        },
        "per_view": vars(cost),
    }
    folder = out / "codec"
    # What is measured is what is written, half-precision weights included.
    save_codec(folder, trainer.codec, recipe.image_size, notes)
    trained = load_codec(folder)
    pictures = float_to_uint8(held_out.spread(_MEASURED_PICTURES))
    notes["curves"] = curves(trained.codec, pictures)
    fingerprint = save_codec(folder, trained.codec, recipe.image_size, notes)
    measured, ladder = Measured(trained, cost, notes["curves"]), jpeg_ladder(pictures)
    for form in ("svg", "png"):
        (out / f"psnr.{form}").write_bytes(psnr_figure([measured], ladder, form))
    (out / "pictures.png").write_bytes(pictures_figure([trained], pictures[:_SHOWN_PICTURES]))
    summary = {"folder": str(folder), "fingerprint": fingerprint, **notes}
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    return summary


def psnr_table(lines: list[dict[str, Any]]) -> str:
    """Curves as a table for a terminal: a row for each SNR, PSNR in dB and SSIM for each channel."""
    kinds = list(dict.fromkeys(line["channel"] for line in lines))
    cells = {(line["channel"], line["mean_snr_db"]): line for line in lines}
    rows = ["mean SNR".rjust(9) + "".join(kind.rjust(18) for kind in kinds)]
    for snr in dict.fromkeys(line["mean_snr_db"] for line in lines):
        found = [cells[kind, snr] for kind in kinds]
        values = (f"{line['psnr_db']:.1f} dB / {line['ssim']:.3f}".rjust(18) for line in found)
        rows.append(f"{snr:g} dB".rjust(9) + "".join(values))
    return "\n".join(rows)


def _words(progress: Progress) -> str:
    return f"PSNR {progress.psnr_db:.2f} dB, {progress.pictures_per_second:.0f} pictures/s"
