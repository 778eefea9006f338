"""Where each parameter of ours stands in a checkpoint of the published naming.

Our backbone fuses query, key and value (and gate and up) into one matrix; checkpoints keep them apart. Everything
else differs by prefix only. What the small policy has beyond the published layout gets a name in the same style.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from comvla.errors import CheckpointError

_PREFIXES = (
    ("backbone.", "language_model.model."),
    ("embed_tokens.", "language_model.model.embed_tokens."),
    ("query_embed.", "language_model.query_embed."),
    ("placeholders", "language_model.action_placeholders"),
    ("action_head.", "action_head.model."),
    ("noise_predictor.", "action_head.noise_predictor.mlp_resnet."),
    ("probe.", "language_model.model.layers.0."),
)
_FUSED = {
    "qk_proj": ("q_proj", "k_proj"),
    "qkv_proj": ("q_proj", "k_proj", "v_proj"),
    "gate_up_proj": ("gate_proj", "up_proj"),
}


def published_names(name: str) -> tuple[str, ...]:
    """Checkpoint names of one parameter; several where ours is fused, in the order of its rows."""
    for ours, theirs in _PREFIXES:
        if name.startswith(ours):
            name = theirs + name[len(ours) :]
            break
    for fused, parts in _FUSED.items():
        if f".{fused}." in name:
            return tuple(name.replace(f".{fused}.", f".{part}.") for part in parts)
    return (name,)


def to_published(net: nn.Module) -> dict[str, Tensor]:
    """All parameters of a half under their checkpoint names."""
    tensors: dict[str, Tensor] = {}
    for name, value in net.state_dict().items():
        names = published_names(name)
        for part, chunk in zip(names, value.chunk(len(names)), strict=True):
            tensors[part] = chunk.detach().contiguous().clone()
    return tensors


def needed_names(net: nn.Module) -> set[str]:
    """Checkpoint names that a half reads."""
    return {part for name in net.state_dict() for part in published_names(name)}


def load_published(net: nn.Module, tensors: Mapping[str, Tensor], where: str) -> None:
    """Fills a half from checkpoint tensors; every parameter must be there with its shape.

    Raises:
        CheckpointError: naming the missing or misshapen tensor.
    """
    for name, target in net.state_dict().items():
        names = published_names(name)
        rows = torch.Size([target.shape[0] // len(names), *target.shape[1:]])
        for part, chunk in zip(names, target.chunk(len(names)), strict=True):
            if part not in tensors:
                raise CheckpointError(
                    f"{where} lacks the tensor {part} {tuple(rows)}: the checkpoint is incomplete"
                )
            if tensors[part].shape != rows:
                raise CheckpointError(
                    f"{where}: tensor {part} has shape {tuple(tensors[part].shape)}, the configuration asks for "
                    f"{tuple(rows)}: config.json and weights belong to different checkpoints"
                )
            chunk.copy_(tensors[part])
