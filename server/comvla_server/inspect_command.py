"""``comvla-server inspect``: what a checkpoint is, what it needs and what a step of it costs."""

from __future__ import annotations

import argparse
import dataclasses
import json
from typing import Any

from comvla import codec

_DESCRIPTION = """\
Describe a checkpoint without loading it: sizes, fingerprint, parameters and memory of each half, and
for several numbers of tokens K the bytes on the link and the operations in the cloud.
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
        help="checkpoint folder, hf://owner/name on the hub, or mini, the shipped policy (default: mini)",
    )
    parser.add_argument(
        "--tokenizer", metavar="FILE", help="tokenizer.json, where a published checkpoint has none"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Prints the description.

    Raises:
        CheckpointError: missing, damaged, foreign or incomplete.
    """
    description = describe(args.source, args.tokenizer)
    if args.json:
        print(json.dumps(description))
        return 0
    for name, value in description["model"].items():
        print(f"{name:18} {value}")
    print(f"\n{'half':6} {'tensors':>8} {'parameters':>14} {'float32 GB':>11} {'bfloat16 GB':>12}")
    for half, size in description["halves"].items():
        print(
            f"{half:6} {size['tensors']:>8} {size['parameters']:>14,} "
            f"{size['float32_bytes'] / 1e9:>11.3f} {size['bfloat16_bytes'] / 1e9:>12.3f}"
        )
    print(
        f"\n{'K':>4} {'cloud GFLOPs':>13}" + "".join(f"{q + ' B':>12}" for q in codec.QUANTIZATIONS)
    )
    for row in description["steps"]:
        sizes = "".join(f"{row['encoded_bytes'][q]:>12}" for q in codec.QUANTIZATIONS)
        print(f"{row['tokens']:>4} {row['cloud_flops'] / 1e9:>13.4f}{sizes}")
    return 0


def describe(source: str, tokenizer: str | None = None) -> dict[str, Any]:
    """Model description, sizes of the halves and cost table, ready for JSON. A multiply-add counts as two FLOPs.

    Raises:
        CheckpointError: missing, damaged, foreign or incomplete.
    """
    import torch

    from comvla_vla.checkpoints import model_info, open_checkpoint
    from comvla_vla.checkpoints.accounting import HALVES, half_size

    checkpoint = open_checkpoint(source, "any", tokenizer=tokenizer)
    checkpoint.check_content()
    config = checkpoint.config
    statistics = checkpoint.chosen_statistics(sorted(checkpoint.statistics)[0])
    info = model_info(config, checkpoint.identity(), statistics)
    sizes = {half: half_size(half, config) for half in HALVES}
    counts = [k for k in _TOKEN_COUNTS if k < config.num_tokens]
    return {
        "model": dataclasses.asdict(info),
        "holds": checkpoint.half,
        "halves": {
            half: {
                **dataclasses.asdict(size),
                "float32_bytes": size.nbytes(torch.float32),
                "bfloat16_bytes": size.nbytes(torch.bfloat16),
            }
            for half, size in sizes.items()
        },
        "prompt_tokens": _PROMPT_TOKENS,
        "steps": [_cost(config, k) for k in (config.num_tokens, *counts)],
    }


def _cost(config: Any, k: int) -> dict[str, Any]:
    from comvla_vla.flops import cloud_flops

    towers = len(config.towers)
    return {
        "tokens": k,
        "cloud_flops": cloud_flops(config, k, _PROMPT_TOKENS),
        "encoded_bytes": {
            quantization: codec.encoded_bytes(k, config.token_dim, quantization, num_towers=towers)
            for quantization in codec.QUANTIZATIONS
        },
    }
