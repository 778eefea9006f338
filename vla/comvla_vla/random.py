"""Policies with random weights, for tests and benchmarks: the right shapes, no skill."""

from __future__ import annotations

from typing import Any

import torch

from comvla_vla.checkpoints import assemble
from comvla_vla.cloud import CloudModel
from comvla_vla.config import ModelConfig
from comvla_vla.edge import EdgeModel
from comvla_vla.nets import join
from comvla_vla.presets import MINI_WORDS, mini
from comvla_vla.prompt import word_tokenizer


def unit_statistics(config: ModelConfig) -> dict[str, Any]:
    """Statistics that leave actions and proprioception as they are; the last action is taken for a gripper."""
    action, proprio = config.action.action_dim, config.action.proprio_dim
    return {
        "unit": {
            "action": {
                "q01": [-1.0] * action,
                "q99": [1.0] * action,
                "mask": [True] * (action - 1) + [False],
            },
            "proprio": {"q01": [-1.0] * proprio, "q99": [1.0] * proprio},
        }
    }


def random_policy(seed: int = 0, config: ModelConfig | None = None) -> tuple[EdgeModel, CloudModel]:
    """Both halves of one policy with random weights (default: the architecture of the shipped one)."""
    config = config if config is not None else mini()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        edge, cloud = join(config)
    edge.requires_grad_(False)
    cloud.requires_grad_(False)
    return assemble(edge, cloud, word_tokenizer(list(MINI_WORDS)), unit_statistics(config))
