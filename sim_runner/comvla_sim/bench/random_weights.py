"""Halves of any size with random weights, made in seconds: the arithmetic of the real thing, no skill."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import nn

from comvla_vla import CloudModel, CloudOptions, EdgeModel
from comvla_vla.checkpoints import model_info
from comvla_vla.checkpoints.accounting import Half, empty_half
from comvla_vla.checkpoints.loading import allocate
from comvla_vla.checkpoints.memory import check_memory
from comvla_vla.config import ModelConfig
from comvla_vla.nets import CloudNet, EdgeNet
from comvla_vla.presets import MINI_WORDS
from comvla_vla.prompt import Prompt, word_tokenizer
from comvla_vla.random import unit_statistics
from comvla_vla.statistics import pick_statistics

# Drawing seven billion normals takes minutes; a matrix product does not mind that they repeat.
_BLOCK = 2**20 + 7


def random_half(
    half: Half,
    config: ModelConfig,
    device: str,
    dtype: torch.dtype,
    seed: int,
    options: CloudOptions | None = None,
) -> EdgeModel | CloudModel:
    """One half of a model, resident in memory.

    Args:
        half: which. config: its sizes. device, dtype: where and how it runs. seed: of the weights.
        options: of the cloud half.

    Raises:
        CheckpointError: too little memory, and how much is needed.
    """
    net = empty_half(half, config)
    nbytes = weight_bytes(net, dtype)
    if torch.device(device).type == "cpu":
        check_memory(nbytes, f"the {half} half of {config.name} in {dtype}")
    allocate(net, device, dtype)
    _fill(net, seed)
    statistics = pick_statistics(unit_statistics(config), None, "random weights")
    info = model_info(config, "random", statistics)
    prompt = Prompt(config.prompt, word_tokenizer(list(MINI_WORDS)))
    if isinstance(net, EdgeNet):
        return EdgeModel(net, prompt, info, statistics)
    assert isinstance(net, CloudNet)
    return CloudModel(net, prompt, statistics, info, options)


def weight_bytes(net: nn.Module, dtype: torch.dtype) -> int:
    """Memory of a module's parameters in one number format."""
    return sum(parameter.numel() for parameter in net.parameters()) * dtype.itemsize


@torch.no_grad()
def _fill(net: nn.Module, seed: int) -> None:
    block = np.random.default_rng(seed).standard_normal(_BLOCK, np.float32)
    for name, parameter in net.named_parameters():
        if parameter.ndim < 2:
            parameter.fill_(0.0 if name.endswith("bias") else 1.0)
            continue
        # Norms of rows stay what they were through a layer.
        scale = 1 / math.sqrt(parameter[0].numel())
        source = torch.from_numpy(block * np.float32(scale)).to(parameter)
        flat = parameter.view(-1)
        for start in range(0, len(flat), _BLOCK):
            piece = flat[start : start + _BLOCK]
            piece.copy_(source[: len(piece)])
