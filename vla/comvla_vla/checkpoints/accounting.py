"""Which tensor belongs to which half, and how large each half is, without any memory for weights."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import Literal, TypeAlias

import torch
from torch import nn

from comvla_vla.config import ModelConfig, TowerConfig
from comvla_vla.naming import published_names
from comvla_vla.nets import CloudNet, EdgeNet
from comvla_vla.vision import TOWER_NAMES

Half: TypeAlias = Literal["edge", "cloud"]
HALVES: dict[Half, type[EdgeNet] | type[CloudNet]] = {"edge": EdgeNet, "cloud": CloudNet}


def empty_half(half: Half, config: ModelConfig) -> EdgeNet | CloudNet:
    """One half with shapes but without memory (torch's meta device)."""
    # Building a module draws random weights; the caller's stream of random numbers stays as it was.
    with torch.random.fork_rng(devices=[]), torch.device("meta"):
        return HALVES[half](config)


def half_shapes(half: Half, config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Checkpoint name to shape of every tensor that a half reads."""
    return published_shapes(empty_half(half, config))


def published_shapes(net: nn.Module) -> dict[str, tuple[int, ...]]:
    """Checkpoint name to shape of every parameter of a module."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name, value in net.state_dict().items():
        parts = published_names(name)
        for part in parts:
            shapes[part] = (value.shape[0] // len(parts), *value.shape[1:])
    return shapes


def unused_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Tensors of a published checkpoint that nothing here reads.

    Features are those of the second-to-last block, so the last block of each tower, its final norm and SigLIP's
    pooling head are never run; actions are regressed, so the language-model head is not either.
    """
    backbone = config.backbone
    shapes: dict[str, tuple[int, ...]] = {
        "language_model.lm_head.weight": (backbone.vocab, backbone.hidden)
    }
    edge = half_shapes("edge", config)
    for name, tower in zip(TOWER_NAMES, config.towers, strict=False):
        prefix = f"vision_backbone.{name}."
        first, last = f"{prefix}blocks.0.", f"{prefix}blocks.{tower.depth - 1}."
        shapes |= {last + n.removeprefix(first): s for n, s in edge.items() if n.startswith(first)}
        shapes |= {f"{prefix}norm.weight": (tower.dim,), f"{prefix}norm.bias": (tower.dim,)}
        if not tower.class_token:
            shapes |= {f"{prefix}attn_pool.{n}": s for n, s in _pooling_shapes(tower).items()}
    return shapes


def _pooling_shapes(tower: TowerConfig) -> dict[str, tuple[int, ...]]:
    dim, hidden = tower.dim, tower.mlp_dim
    return {
        "latent": (1, 1, dim),
        "q.weight": (dim, dim),
        "q.bias": (dim,),
        "kv.weight": (2 * dim, dim),
        "kv.bias": (2 * dim,),
        "proj.weight": (dim, dim),
        "proj.bias": (dim,),
        "norm.weight": (dim,),
        "norm.bias": (dim,),
        "mlp.fc1.weight": (hidden, dim),
        "mlp.fc1.bias": (hidden,),
        "mlp.fc2.weight": (dim, hidden),
        "mlp.fc2.bias": (dim,),
    }


@dataclass(frozen=True)
class HalfSize:
    """Size of one half.

    Attributes:
        tensors: of the checkpoint. parameters: numbers in them.
    """

    tensors: int
    parameters: int

    def nbytes(self, dtype: torch.dtype) -> int:
        """Memory and disk of the weights in one number format."""
        return self.parameters * dtype.itemsize


def half_size(half: Half, config: ModelConfig) -> HalfSize:
    """Tensors and parameters of one half; what stands in both halves is counted in each."""
    shapes = half_shapes(half, config)
    return HalfSize(len(shapes), sum(prod(shape) for shape in shapes.values()))
