"""A Llama-type transformer that looks both ways.

OpenVLA-OFT switches causal masking off, so every token sees every token of its own sequence and no mask is needed
where there is no padding. There is none here: the rows of a batch are packed end to end, whatever their lengths,
and only attention looks at where one sequence ends. 99.5 % of the arithmetic is row-wise and pays no padding.

Rotary embeddings use the position that a token had in the *unpruned* sequence.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from comvla_vla.attention import attend
from comvla_vla.config import BackboneConfig
from comvla_vla.fastv import last_row_attention, surviving_rows
from comvla_vla.linear import Linear
from comvla_vla.options import FastV


class RMSNorm(nn.Module):
    """Root-mean-square norm, computed in float32, scaled in the model's dtype (as Llama does)."""

    def __init__(self, dim: int, eps: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(dim))
        self.eps = eps

    def forward(self, x: Tensor) -> Tensor:
        """(..., dim) to (..., dim)."""
        wide = x.float()
        wide = wide * torch.rsqrt(wide.square().mean(-1, keepdim=True) + self.eps)
        return self.weight * wide.to(x.dtype)


def rotary_tables(
    positions: Tensor, config: BackboneConfig, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Cosine and sine, each (R, head_dim), for integer ``positions`` (R,). Angles are computed in float32."""
    exponent = (
        torch.arange(0, config.head_dim, 2, device=positions.device).float() / config.head_dim
    )
    angles = positions.float()[:, None] * (config.rope_theta**-exponent)
    angles = torch.cat([angles, angles], dim=-1)
    return angles.cos().to(dtype), angles.sin().to(dtype)


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotary embedding in the rotate-half convention; x (R, heads, head_dim)."""
    first, second = x.chunk(2, dim=-1)
    return x * cos[:, None] + torch.cat([-second, first], dim=-1) * sin[:, None]


class SelfAttention(nn.Module):
    """Weights of bidirectional attention; those of query, key and value are one matrix."""

    def __init__(self, config: BackboneConfig) -> None:
        super().__init__()
        self.config = config
        self.qkv_proj = Linear(config.hidden, 3 * config.hidden, bias=False)
        self.o_proj = Linear(config.hidden, config.hidden, bias=False)

    def queries_keys_values(
        self, x: Tensor, cos: Tensor, sin: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Rotated queries and keys, and values, each (R, heads, head_dim), of normalised rows (R, d)."""
        q, k, v = self.qkv_proj(x).view(-1, 3, self.config.heads, self.config.head_dim).unbind(1)
        return rotate(q, cos, sin), rotate(k, cos, sin), v


def packed_attention(q: Tensor, k: Tensor, v: Tensor, lengths: Sequence[int]) -> Tensor:
    """Attention inside each packed sequence; the only place that knows where one ends.

    Neighbouring sequences of one length share a kernel call, so callers sort by length.

    Args:
        q, k, v: (R, heads, head_dim). lengths: of the sequences, summing to R.

    Returns:
        (R, heads * head_dim).
    """
    heads, width = q.shape[1:]
    mixed, start = [], 0
    for length, run in groupby(lengths):
        count = len(list(run))
        rows = slice(start, start + count * length)
        start = rows.stop
        q_, k_, v_ = (t[rows].view(count, length, heads, width).transpose(1, 2) for t in (q, k, v))
        mixed.append(attend(q_, k_, v_).transpose(1, 2).flatten(0, 1))
    return torch.cat(mixed).flatten(1)


class SwiGLU(nn.Module):
    """Gated feed-forward with fused gate and up weights."""

    def __init__(self, config: BackboneConfig) -> None:
        super().__init__()
        self.gate_up_proj = Linear(config.hidden, 2 * config.intermediate, bias=False)
        self.down_proj = Linear(config.intermediate, config.hidden, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(R, d) to (R, d)."""
        gate, up = self.gate_up_proj(x).chunk(2, dim=-1)
        out: Tensor = self.down_proj(F.silu(gate) * up)
        return out


class Layer(nn.Module):
    """Pre-norm attention and feed-forward, both residual."""

    def __init__(self, config: BackboneConfig) -> None:
        super().__init__()
        self.input_layernorm = RMSNorm(config.hidden, config.rms_eps)
        self.self_attn = SelfAttention(config)
        self.post_attention_layernorm = RMSNorm(config.hidden, config.rms_eps)
        self.mlp = SwiGLU(config)

    def before(self, x: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What comes before attention, row by row: queries, keys and values of rows (R, d)."""
        return self.self_attn.queries_keys_values(self.input_layernorm(x), cos, sin)

    def after(self, x: Tensor, mixed: Tensor) -> Tensor:
        """What comes after attention, row by row: (R, d) and attention's (R, d) to (R, d)."""
        x = x + self.self_attn.o_proj(mixed)
        out: Tensor = x + self.mlp(self.post_attention_layernorm(x))
        return out

    def forward(self, x: Tensor, cos: Tensor, sin: Tensor, lengths: Sequence[int]) -> Tensor:
        """Rows (R, d) of sequences with ``lengths`` (summing to R) to (R, d)."""
        return self.after(x, packed_attention(*self.before(x, cos, sin), lengths))


class Backbone(nn.Module):
    """The transformer between input embeddings and action head; no LM head, which nothing here uses."""

    def __init__(self, config: BackboneConfig) -> None:
        super().__init__()
        self.config = config
        self.layers = nn.ModuleList(Layer(config) for _ in range(config.layers))
        self.norm = RMSNorm(config.hidden, config.rms_eps)
        self._before, self._after = Layer.before, Layer.after

    def compile_rows(self) -> None:
        """Compiles what is done row by row, once for any number of rows; attention stays as it is."""
        self._before = torch.compile(Layer.before, dynamic=True)
        self._after = torch.compile(Layer.after, dynamic=True)

    def forward(
        self,
        rows: Tensor,
        positions: Tensor,
        lengths: Sequence[int],
        visual: Sequence[int] = (),
        fastv: FastV | None = None,
    ) -> tuple[Tensor, list[int]]:
        """Final hidden states after the last norm.

        Args:
            rows: (R, d) input embeddings, sequences end to end.
            positions: (R,) rotary positions in the unpruned sequence.
            lengths: rows of each sequence; they sum to R.
            visual: visual tokens of each sequence, right behind its first row; for ``fastv`` only.
            fastv: drops visual tokens on the way.

        Returns:
            (R', d) hidden states and the length of each sequence, R' = R and ``lengths`` without ``fastv``.
        """
        cos, sin = rotary_tables(positions, self.config, rows.dtype)
        lengths = list(lengths)
        before = rows
        for index, layer in enumerate(self.layers):
            assert isinstance(layer, Layer)
            if fastv is not None and index == fastv.layer:
                ranking = self.layers[index - 1]
                assert isinstance(ranking, Layer)
                seen = last_row_attention(ranking, before, cos, sin, lengths)
                kept, lengths = surviving_rows(seen, visual, fastv)
                rows, cos, sin = rows[kept], cos[kept], sin[kept]
            before = rows
            mixed = packed_attention(*self._before(layer, rows, cos, sin), lengths)
            rows = self._after(layer, rows, mixed)
        out: Tensor = self.norm(rows)
        return out, lengths
