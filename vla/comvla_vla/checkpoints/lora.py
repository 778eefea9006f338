"""Low-rank adapters: W + (alpha / r) B A, merged while tensors are read.

Two layouts occur. The FiLM vision file holds its layers still wrapped (``base_layer``, ``lora_A``, ``lora_B``); an
adapter folder holds ``adapter_config.json`` and ``adapter_model.safetensors`` for the tensors of a base checkpoint.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from torch import Tensor

from comvla.errors import CheckpointError
from comvla_vla.checkpoints.tensors import (
    Catalogue,
    TensorEntry,
    open_safetensors,
    with_reader,
)

ADAPTER_FOLDER = "lora_adapter"
ADAPTER_CONFIG = "adapter_config.json"
ADAPTER_WEIGHTS = "adapter_model.safetensors"

_FACTOR = re.compile(r"^(?P<layer>.*)\.lora_(?P<factor>[AB])(\.[^.]+)?\.weight$")
_TRAINED_ALPHA = 16  # OpenVLA-OFT trains with alpha = min(r, 16)


def unwrap(entries: Catalogue, alpha: float | None = None) -> dict[str, TensorEntry]:
    """Merges wrapped layers inside one catalogue; what is not wrapped stays.

    Args:
        entries: with names such as ``x.base_layer.weight``, ``x.lora_A.default.weight``, ``x.lora_B.default.weight``.
        alpha: scale of training, OpenVLA-OFT's own rule where None.

    Raises:
        CheckpointError: factors that lack their partner or their layer, or do not fit.
    """
    plain = {n: e for n, e in entries.items() if not _FACTOR.match(n)}
    base = {n.replace(".base_layer.", "."): e for n, e in plain.items()}
    return merge(base, {n: e for n, e in entries.items() if _FACTOR.match(n)}, alpha)


def merge(
    base: Catalogue, factors: Catalogue, alpha: float | None = None
) -> dict[str, TensorEntry]:
    """Base tensors with the factors merged into those that have some.

    Raises:
        CheckpointError: see :func:`unwrap`.
    """
    pairs: dict[str, dict[str, TensorEntry]] = {}
    for name, entry in factors.items():
        match = _FACTOR.match(name)
        if match is None:
            raise CheckpointError(
                f"{entry.file} holds {name}, which is not a low-rank factor: only plain LoRA is merged"
            )
        pairs.setdefault(match["layer"], {})[match["factor"]] = entry
    merged = dict(base)
    for layer, pair in pairs.items():
        name = f"{layer}.weight"
        if name not in merged or set(pair) != {"A", "B"}:
            held = sorted(pair) + (["base"] if name in merged else [])
            raise CheckpointError(
                f"the adapter of {layer} is incomplete, found {held}: need base weight, lora_A and lora_B"
            )
        merged[name] = _merged(name, merged[name], pair["A"], pair["B"], alpha)
    return merged


def _merged(
    name: str, base: TensorEntry, a: TensorEntry, b: TensorEntry, alpha: float | None
) -> TensorEntry:
    rank = a.shape[0] if a.shape else 0
    if len(base.shape) != 2 or a.shape[1:] != base.shape[1:] or b.shape != (base.shape[0], rank):
        raise CheckpointError(
            f"the adapter of {name} {base.shape} has factors {a.shape} and {b.shape}: it belongs to "
            "another checkpoint"
        )
    scale = (min(rank, _TRAINED_ALPHA) if alpha is None else alpha) / rank

    def read() -> Tensor:
        # In float32 and rounded once: bfloat16 would lose most of a small update.
        change = b.read().float() @ a.read().float()
        return change.mul_(scale).add_(base.read().float()).to(base.dtype)

    return with_reader(base, read)


def find_adapter(folder: Path) -> Path | None:
    """The adapter folder in a checkpoint folder (or that folder itself), or None."""
    for place in (folder / ADAPTER_FOLDER, folder):
        if (place / ADAPTER_CONFIG).is_file():
            return place
    return None


def read_adapter_config(adapter: Path) -> dict[str, Any]:
    """``adapter_config.json``, checked to be plain LoRA.

    Raises:
        CheckpointError: unreadable, or a variant that a plain merge would get wrong.
    """
    path = adapter / ADAPTER_CONFIG
    try:
        config = json.loads(path.read_text())
        rank, alpha = int(config["r"]), float(config["lora_alpha"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"cannot read the adapter {path}: {error!r}") from error
    special = [
        key
        for key in ("use_dora", "use_rslora", "fan_in_fan_out", "rank_pattern", "alpha_pattern")
        if config.get(key)
    ]
    if config.get("peft_type") != "LORA" or rank < 1 or alpha <= 0 or special:
        raise CheckpointError(
            f"{path} describes {config.get('peft_type')!r} with {special or 'odd values'}: only plain "
            "LoRA is merged here; merge it with peft and use the merged weights"
        )
    return dict(config)


def merge_adapter(base: Catalogue, adapter: Path) -> dict[str, TensorEntry]:
    """A base checkpoint with an adapter folder merged in.

    Raises:
        CheckpointError: damaged adapter, or one of another checkpoint.
    """
    config = read_adapter_config(adapter)
    factors = {
        name.removeprefix("base_model.model."): entry
        for name, entry in open_safetensors(adapter / ADAPTER_WEIGHTS).items()
    }
    return merge(base, factors, float(config["lora_alpha"]))
