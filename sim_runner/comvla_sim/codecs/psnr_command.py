"""``comvla-sim psnr``: learned codecs and JPEG over the SNR, and pictures to look at."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

from comvla.number_arguments import SEED, whole

DESCRIPTION = """\
PSNR and SSIM of learned codecs over the SNR on held-out tables of the tabletop, beside JPEG in as
many channel uses under an ideal code, and over bytes. Writes psnr.svg, psnr.png, psnr.json, and
pictures.png with originals and reconstructions.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "psnr",
        help="draw reconstruction against SNR: DeepJSCC, WITT, JPEG",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--codec",
        default="deepjscc,witt",
        help="shipped ones by name, or folders of train codec, a,b,... (deepjscc,witt)",
    )
    parser.add_argument("--data", type=Path, help="frames (runs/codecs/frames-SIZE)")
    parser.add_argument("--layouts", type=whole(), default=40, help="held-out tables (40)")
    parser.add_argument("--pictures", type=whole(), default=128, help="to measure on (128)")
    parser.add_argument("--seed", type=SEED, default=0, help="of fading and noise (0)")
    parser.add_argument("--out", type=Path, default=Path("runs/psnr"), help="(runs/psnr)")
    parser.add_argument("--json", action="store_true", help="print the curves as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measures and draws. Returns 0."""
    from comvla_sim.codecs.command import psnr_table
    from comvla_sim.codecs.digital import jpeg_ladder
    from comvla_sim.codecs.figures import Measured, pictures_figure, psnr_figure
    from comvla_sim.codecs.measuring import SNRS_DB, curves
    from comvla_sim.codecs.pictures import MOST_LAYOUTS, Pictures, render_held_out
    from comvla_sim.training.demonstrations import Demonstrations, progress_bar
    from comvla_sim.training.run_state import TrainingError
    from comvla_vla.codecs.files import load_codec
    from comvla_vla.codecs.image_codec import rate
    from comvla_vla.codecs.waveform import float_to_uint8

    names = [name.strip() for name in args.codec.split(",") if name.strip()]
    trained = [load_codec(name) for name in names]
    sizes = {codec.image_size for codec in trained}
    if len(sizes) != 1 or not 1 <= args.layouts <= MOST_LAYOUTS or args.pictures < 1:
        raise TrainingError(
            f"expected codecs of one picture size, 1 to {MOST_LAYOUTS} --layouts and at least one of "
            f"--pictures, got sizes {sorted(sizes)}, {args.layouts} and {args.pictures}"
        )
    (size,) = sizes
    data = args.data or Path(f"runs/codecs/frames-{size}")
    with progress_bar() as bar:
        render_held_out(
            data, size=size, layouts=args.layouts, workers=os.cpu_count() or 1, progress=bar
        )
    held_out = Pictures(Demonstrations(data / "validation"))
    pictures = float_to_uint8(held_out.spread(args.pictures))
    measured = [
        Measured(
            codec,
            rate(codec.codec.config, size, size),
            curves(codec.codec, pictures, seed=args.seed),
        )
        for codec in trained
    ]
    ladder = jpeg_ladder(pictures)
    args.out.mkdir(parents=True, exist_ok=True)
    for form in ("svg", "png"):
        (args.out / f"psnr.{form}").write_bytes(psnr_figure(measured, ladder, form))
    (args.out / "pictures.png").write_bytes(pictures_figure(trained, pictures[:1]))
    summary = {
        "size": size,
        "codecs": [
            {
                "codec": item.trained.name,
                "fingerprint": item.trained.fingerprint,
                "per_view": vars(item.rate),
                "curves": item.lines,
                "jpeg_at_capacity": [
                    {
                        "snr_db": snr,
                        "psnr_db": round(ladder.at_capacity(item.rate.channel_uses, snr)[0], 2),
                        "share_that_fits": ladder.at_capacity(item.rate.channel_uses, snr)[1],
                    }
                    for snr in SNRS_DB
                ],
            }
            for item in measured
        ],
    }
    (args.out / "psnr.json").write_text(json.dumps(summary, indent=1) + "\n")
    if args.json:
        print(json.dumps(summary))
        return 0
    for item in measured:
        print(f"{item.trained.name}: {item.rate.channel_uses} channel uses a view")
        print(psnr_table(item.lines))
    print(f"drawn in {args.out}")
    return 0
