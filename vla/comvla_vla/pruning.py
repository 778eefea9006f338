"""What pruners other than the vote compute with the model's own weights.

LightVLA (LiAutoAD/LightVLA) needs the rows that its visual tokens attend to; VLA-ADP (chen7086/VLA-ADP) needs queries
and keys of the backbone's first layer. How they choose among the scores is up to ``comvla_client.pruners``.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from comvla_vla.backbone import Backbone, Layer, RMSNorm
from comvla_vla.config import BackboneConfig
from comvla_vla.linear import Linear

_LIGHTVLA_EPS = 1e-6


def lightvla_scores(patches: Tensor, task: Tensor) -> Tensor:
    """LightVLA's scores: what each visual token, dressed in the task's words, finds most like itself.

    Source: LiAutoAD/LightVLA, ``modeling_prismatic.py`` (inference: without the noise of training).

    Args:
        patches: (N, d) projected visual tokens.
        task: (T, d) everything else in the sequence except begin-of-sequence.

    Returns:
        (N, N) float32; row i votes for its largest column.
    """

    def unit(x: Tensor) -> Tensor:
        return x * torch.rsqrt(x.square().mean(-1, keepdim=True) + _LIGHTVLA_EPS)

    patches, task = unit(patches.float()), unit(task.float())
    scale = 1 / math.sqrt(patches.shape[-1])
    queries = unit((patches @ task.T * scale).softmax(dim=-1) @ task)
    return queries @ patches.T * scale


def text_driven_scores(queries: Tensor, keys: Tensor) -> Tensor:
    """VLA-ADP's scores: how well the words' queries fit each visual token's key, without softmax or rotation.

    Args:
        queries: (T, heads, head_dim) of the words. keys: (N, heads, head_dim) of the visual tokens.

    Returns:
        (N,) float32, mean over words and heads.
    """
    scores = torch.einsum("thc,nhc->htn", queries, keys) / math.sqrt(queries.shape[-1])
    return scores.float().mean(dim=(0, 1))


class QueryKey(nn.Module):
    """Query and key weights of one attention layer, in one matrix."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.qk_proj = Linear(hidden, 2 * hidden, bias=False)


class TextProbe(nn.Module):
    """Norm, query and key weights of the backbone's first layer: VLA-ADP's share of the robot's half."""

    def __init__(self, config: BackboneConfig) -> None:
        super().__init__()
        self.config = config
        self.input_layernorm = RMSNorm(config.hidden, config.rms_eps)
        self.self_attn = QueryKey(config.hidden)

    def forward(self, words: Tensor, visual: Tensor) -> Tensor:
        """Embedded words (T, d) and projected visual tokens (N, d) to scores (N,)."""
        hidden = self.config.hidden
        heads = (-1, self.config.heads, self.config.head_dim)
        weight = self.self_attn.qk_proj.weight
        queries = F.linear(self.input_layernorm(words), weight[:hidden]).view(heads)
        keys = F.linear(self.input_layernorm(visual), weight[hidden:]).view(heads)
        return text_driven_scores(queries, keys)

    @torch.no_grad()
    def copy_from(self, backbone: Backbone) -> None:
        """Takes the weights of a backbone's first layer."""
        first = backbone.layers[0]
        assert isinstance(first, Layer)
        rows = 2 * self.config.hidden
        self.input_layernorm.weight.copy_(first.input_layernorm.weight)
        self.self_attn.qk_proj.weight.copy_(first.self_attn.qkv_proj.weight[:rows])
