"""``comvla-server split``: cut a published checkpoint in two, once, before anything is served."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from comvla.number_arguments import whole

_DESCRIPTION = """\
Write DST/edge for robots and DST/cloud for the server, each with only the weights that it needs.

The source is a whole policy: a folder as OpenVLA-OFT and LightVLA are published (config.json,
safetensors, action_head--*.pt, proprio_projector--*.pt, dataset_statistics.json), a repository
on the hub as hf://owner/name, or a folder of this project's own format. Weights are streamed: memory
holds one tensor at a time.
Nothing that is read is executed, and DST appears complete or not at all.
"""

_EPILOG = """\
examples:
  comvla-server split ./openvla-7b-oft-finetuned-libero-spatial ./oft-spatial --check
  comvla-server split ./lightvla ./lightvla-split --name lightvla --first-slot 1
  comvla-server split SRC DST --check             verifies only, where DST exists
"""


def add_parser(subparsers: Any) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "split",
        help="cut a published checkpoint into the robot's and the server's half",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("source", metavar="SRC", help="checkpoint folder or hf://owner/name")
    parser.add_argument("destination", metavar="DST", help="new folder for edge/ and cloud/")
    parser.add_argument(
        "--check",
        action="store_true",
        help="compare every weight with the source; where DST exists, do only that",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    published = parser.add_argument_group("what a published checkpoint does not say")
    published.add_argument("--name", default="openvla-oft", help="of the policy (%(default)s)")
    published.add_argument(
        "--views", type=whole(1, 64), default=2, metavar="N", help="cameras (%(default)s)"
    )
    published.add_argument(
        "--horizon",
        type=whole(1, 4096),
        default=8,
        metavar="H",
        help="actions in a chunk (%(default)s)",
    )
    published.add_argument(
        "--first-slot",
        type=whole(-1, 1),
        default=-1,
        choices=(-1, 0, 1),
        help="hidden states that the head reads, from the first action placeholder: -1 as OpenVLA-OFT and "
        "LightVLA are trained, 1 as LightVLA's own inference reads (%(default)s)",
    )
    published.add_argument(
        "--tokenizer", metavar="FILE", help="tokenizer.json, where the checkpoint has none"
    )
    published.add_argument(
        "--base", metavar="SRC", help="weights that an unmerged adapter belongs to"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Splits, checks, or both.

    Raises:
        CheckpointError: anything amiss with source or destination.
    """
    from comvla_vla import Recipe, check_split, split_checkpoint
    from comvla_vla.checkpoints.splitting import describe

    given = {
        "recipe": Recipe(
            name=args.name, views=args.views, horizon=args.horizon, first_slot=args.first_slot
        ),
        "tokenizer": args.tokenizer,
        "base": args.base,
    }
    only_check = args.check and Path(args.destination).exists()
    if not only_check:
        shown = sys.stderr.isatty() and not args.json
        report = split_checkpoint(
            args.source, args.destination, progress=_show if shown else None, **given
        )
    if args.check:
        report = check_split(args.source, args.destination, **given)
    if args.json:
        print(json.dumps({**dataclasses.asdict(report), "checked": args.check}))
    else:
        print(describe(report))
        print("every weight equals the source" if args.check else "not checked (--check)")
    return 0


def _show(done: int, whole: int) -> None:
    end = "\n" if done == whole else ""
    print(f"\r{done / 1e9:8.2f} of {whole / 1e9:.2f} GB", end=end, file=sys.stderr, flush=True)
