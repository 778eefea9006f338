"""``comvla-server inspect``: what a checkpoint is and what a step of it costs."""

from __future__ import annotations

import argparse
import dataclasses
import json
from typing import TYPE_CHECKING, Any

from comvla import codec
from comvla_server.serve_command import load_engine

if TYPE_CHECKING:  # torch takes seconds to import: --help does without it
    from comvla_server.engine import Engine

_DESCRIPTION = """\
Load the cloud half of a checkpoint and describe it: sizes, fingerprint, and for several numbers
of tokens K the bytes on the link and the operations in the cloud.
"""

_TOKEN_COUNTS = (512, 256, 128, 64, 32, 16, 8, 4)
# Length of a typical prompt; its words do not change the cost.
_PROMPT_TOKENS = 10


def add_parser(subparsers: Any) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "inspect",
        help="describe a checkpoint",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "source",
        nargs="?",
        default="mini",
        help="checkpoint folder, hub repository, or mini, the shipped policy (default: mini)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Prints the description.

    Raises:
        CheckpointError: missing, damaged, foreign or incomplete.
    """
    description = describe(load_engine(args.source, "cpu", "float32", None))
    if args.json:
        print(json.dumps(description))
        return 0
    for name, value in description["model"].items():
        print(f"{name:18} {value}")
    print(
        f"\n{'K':>4} {'cloud GFLOPs':>13}" + "".join(f"{q + ' B':>12}" for q in codec.QUANTIZATIONS)
    )
    for row in description["steps"]:
        sizes = "".join(f"{row['encoded_bytes'][q]:>12}" for q in codec.QUANTIZATIONS)
        print(f"{row['tokens']:>4} {row['cloud_flops'] / 1e9:>13.4f}{sizes}")
    return 0


def describe(engine: Engine) -> dict[str, Any]:
    """Model description and cost table, ready for JSON. A multiply-add counts as two FLOPs."""
    info = engine.info
    counts = [k for k in _TOKEN_COUNTS if k < info.num_tokens]
    return {
        "model": dataclasses.asdict(info),
        "prompt_tokens": _PROMPT_TOKENS,
        "steps": [_cost(engine, k) for k in (info.num_tokens, *counts)],
    }


def _cost(engine: Engine, k: int) -> dict[str, Any]:
    info = engine.info
    request = engine.blank_request(k, _PROMPT_TOKENS)
    return {
        "tokens": k,
        "cloud_flops": engine.flops(request),
        "encoded_bytes": {
            quantization: codec.encoded_bytes(
                k, info.token_dim, quantization, num_towers=len(info.tower_dims)
            )
            for quantization in codec.QUANTIZATIONS
        },
    }
