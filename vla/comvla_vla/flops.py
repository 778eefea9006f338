"""Floating-point operations, a multiply-add counted as two.

``layer_flops`` is the paper's Eq. (5); ``backbone_flops`` sums it over the layers. The ``*_flops`` functions below it
count every matrix product of a half as it is really run.
"""

from __future__ import annotations

from comvla_vla.config import BackboneConfig, ModelConfig, TowerConfig
from comvla_vla.options import FastV


def layer_flops(s: int, d: int, f: int) -> int:
    """Eq. (5): 8 s d^2 (QKV and output projection) + 4 s^2 d (attention) + 6 s d f (SwiGLU)."""
    return 8 * s * d * d + 4 * s * s * d + 6 * s * d * f


def backbone_flops(config: BackboneConfig, sequence_length: int) -> int:
    """Eq. (5) over all layers for one sequence of ``sequence_length`` tokens, visual and others."""
    return config.layers * layer_flops(sequence_length, config.hidden, config.intermediate)


def non_visual_tokens(config: ModelConfig, prompt_tokens: int) -> int:
    """Tokens beside the visual ones: prompt (with BOS), proprioception, action placeholders, stop."""
    level = config.action.head == "diffusion"  # the noise level is a token
    return prompt_tokens + int(config.action.proprio_dim > 0) + int(level) + config.action.slots + 1


def projector_flops(config: ModelConfig, tokens: int) -> int:
    """Projecting ``tokens`` visual tokens."""
    dim, hidden = config.token_dim, config.backbone.hidden
    if config.projector.kind == "linear":
        return 2 * tokens * dim * hidden
    return 2 * tokens * (dim * 4 * dim + 4 * dim * hidden + hidden * hidden)


def tower_flops(tower: TowerConfig) -> int:
    """One view through one tower, without the last block, which is never run."""
    patches, dim = tower.side**2, tower.dim
    if tower.kind == "vit":
        t = patches + tower.prefix_tokens
        film = 4 * tower.film_dim * dim
        block = film + 8 * t * dim * dim + 4 * t * t * dim + 4 * t * dim * tower.mlp_dim
        return 2 * patches * 3 * tower.patch_size**2 * dim + (tower.depth - 1) * block
    stride = tower.patch_size // 4
    cells = patches * stride**2
    stem = 2 * cells * 48 * tower.stem_dim + cells * (18 * tower.stem_dim + 8 * tower.stem_dim**2)
    down = 2 * patches * stride**2 * tower.stem_dim * dim
    return stem + down + sum(patches * (2 * k * k * dim + 8 * dim * dim) for k in tower.kernels)


def vision_flops(config: ModelConfig) -> int:
    """All towers over all views."""
    return config.views * sum(tower_flops(t) for t in config.towers)


def scoring_flops(num_queries: int, num_tokens: int, hidden: int) -> int:
    """Eq. (3): q V^T, alpha V and h V^T."""
    return 6 * num_queries * num_tokens * hidden


def edge_flops(config: ModelConfig, num_queries: int) -> int:
    """The robot's share of one step: vision, projection of all tokens for scoring, votes."""
    tokens = config.num_tokens
    scoring = scoring_flops(num_queries, tokens, config.backbone.hidden)
    return vision_flops(config) + projector_flops(config, tokens) + scoring


def cloud_flops(
    config: ModelConfig, visual_tokens: int, prompt_tokens: int, fastv: FastV | None = None
) -> int:
    """The cloud's share of one request: projector, backbone, proprioception and action head.

    A diffusion head runs backbone and head once for every noise level; FastV runs the later layers on fewer tokens.
    """
    action, hidden, backbone = config.action, config.backbone.hidden, config.backbone
    others = non_visual_tokens(config, prompt_tokens)
    head_in = hidden * action.action_dim
    head = head_in * action.head_hidden + action.head_blocks * action.head_hidden**2
    head += action.head_hidden * action.action_dim
    proprio = action.proprio_dim * hidden + hidden * hidden if action.proprio_dim else 0
    full = backbone.layers if fastv is None else min(fastv.layer, backbone.layers)
    fewer = visual_tokens if fastv is None else fastv.kept(visual_tokens)
    layers = full * layer_flops(visual_tokens + others, hidden, backbone.intermediate)
    layers += (backbone.layers - full) * layer_flops(fewer + others, hidden, backbone.intermediate)
    one_pass = layers + 2 * action.horizon * head
    passes = 1
    if action.head == "diffusion":
        passes = action.diffusion_steps
        one_pass += 2 * action.slots * (hidden + hidden * hidden)  # projecting the noisy actions
    return passes * one_pass + projector_flops(config, visual_tokens) + 2 * proprio
