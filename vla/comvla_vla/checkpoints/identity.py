"""Who a policy is: the fingerprint that both halves carry, and what the handshake compares."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from comvla.model_info import ModelInfo
from comvla_vla.checkpoints.tensors import raw_bytes
from comvla_vla.config import ModelConfig
from comvla_vla.statistics import Statistics


def tensor_digest(tensor: Tensor) -> str:
    """Hex digest of one tensor's type, shape and elements."""
    digest = hashlib.sha256(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
    digest.update(raw_bytes(tensor))
    return digest.hexdigest()


def combine(config: ModelConfig, statistics: Mapping[str, Any], digests: Mapping[str, str]) -> str:
    """Fingerprint from the digests of single tensors, in whatever order those were computed."""
    content = [config.to_dict(), statistics, sorted(digests.items())]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]


def fingerprint(
    config: ModelConfig, tensors: Mapping[str, Tensor], statistics: Mapping[str, Any]
) -> str:
    """Hex digest over configuration, statistics and every weight of a whole policy; equal halves carry the same one."""
    return combine(config, statistics, {n: tensor_digest(t) for n, t in tensors.items()})


def model_info(config: ModelConfig, digest: str, statistics: Statistics) -> ModelInfo:
    """What the handshake compares."""
    side = config.towers[0].image_size
    return ModelInfo(
        name=config.name,
        fingerprint=digest,
        num_tokens=config.num_tokens,
        token_dim=config.token_dim,
        tower_dims=tuple(t.dim for t in config.towers),
        grid=config.grid,
        image_size=(side, side),
        action_horizon=config.action.horizon,
        action_dim=config.action.action_dim,
        proprio_dim=config.action.proprio_dim,
        max_prompt_tokens=config.prompt.max_tokens,
        delta_actions=tuple(bool(m) for m in statistics.action_mask),
        control_period_s=config.control_period_s,
    )
