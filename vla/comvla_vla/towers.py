"""Vision towers: pixels of one view to a grid of features.

``ViTTower`` follows the public DINOv2 and SigLIP layout (parameter names as in published OpenVLA checkpoints) and
stops after the second-to-last block, whose un-normalised output is what the projector was trained on.
``ConvTower`` is a small ConvNeXt-type tower for policies of a million parameters.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from comvla_vla.config import TowerConfig
from comvla_vla.linear import Linear


class LayerScale(nn.Module):
    """Per-channel learned scale of a residual branch (published name: ``scale_factor``)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.scale_factor = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor) -> Tensor:
        """(..., dim) to (..., dim)."""
        return x * self.scale_factor


class Attention(nn.Module):
    """Multi-head self-attention over all tokens of one view."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = Linear(dim, 3 * dim)
        self.proj = Linear(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, dim) to (B, T, dim)."""
        b, t, dim = x.shape
        q, k, v = self.qkv(x).view(b, t, 3, self.heads, dim // self.heads).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(q, k, v)
        out: Tensor = self.proj(mixed.transpose(1, 2).reshape(b, t, dim))
        return out


class Mlp(nn.Module):
    """Linear, exact GELU, linear."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = Linear(dim, hidden)
        self.fc2 = Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """(..., dim) to (..., dim)."""
        out: Tensor = self.fc2(F.gelu(self.fc1(x)))
        return out


class Block(nn.Module):
    """Pre-norm transformer block with optional LayerScale."""

    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        dim = config.dim
        self.norm1 = nn.LayerNorm(dim, eps=config.norm_eps)
        self.attn = Attention(dim, config.heads)
        self.ls1 = LayerScale(dim) if config.layer_scale else nn.Identity()
        self.norm2 = nn.LayerNorm(dim, eps=config.norm_eps)
        self.mlp = Mlp(dim, config.mlp_dim)
        self.ls2 = LayerScale(dim) if config.layer_scale else nn.Identity()

    def attend(self, x: Tensor) -> Tensor:
        """The first half: (B, T, dim) to (B, T, dim)."""
        out: Tensor = x + self.ls1(self.attn(self.norm1(x)))
        return out

    def feed(self, x: Tensor) -> Tensor:
        """The second half: (B, T, dim) to (B, T, dim)."""
        out: Tensor = x + self.ls2(self.mlp(self.norm2(x)))
        return out

    def forward(self, x: Tensor, language: Tensor | None = None) -> Tensor:
        """(B, T, dim) to (B, T, dim); ``language`` is for blocks that listen."""
        return self.feed(self.attend(x))


class FilmBlock(nn.Module):
    """A block whose tokens the instruction scales and shifts between attention and feed-forward (FiLM).

    Source: moojink/openvla-oft, ``film_vit_wrapper.py``. Prefix tokens are modulated too.
    """

    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        self.block = Block(config)
        self.scale = Linear(config.film_dim, config.dim)
        self.shift = Linear(config.film_dim, config.dim)

    def forward(self, x: Tensor, language: Tensor | None = None) -> Tensor:
        """(B, T, dim) and the mean text embedding (B, film_dim) to (B, T, dim)."""
        assert language is not None, "a FiLM tower needs the instruction"
        gain, offset = self.scale(language)[:, None], self.shift(language)[:, None]
        return self.block.feed(self.block.attend(x) * (1 + gain) + offset)


class PatchEmbed(nn.Module):
    """Non-overlapping patches to tokens, row-major."""

    def __init__(self, dim: int, patch_size: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, patch_size, patch_size)

    def forward(self, pixels: Tensor) -> Tensor:
        """(B, 3, S, S) to (B, rows * columns, dim)."""
        out: Tensor = self.proj(pixels).flatten(2).transpose(1, 2)
        return out


class ViTTower(nn.Module):
    """DINOv2- or SigLIP-type ViT, run up to and including its second-to-last block, no final norm."""

    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        self.config = config
        self.patch_embed = PatchEmbed(config.dim, config.patch_size)
        self.pos_embed = nn.Parameter(torch.zeros(1, config.side**2, config.dim))
        if config.class_token:
            self.cls_token = nn.Parameter(torch.zeros(1, 1, config.dim))
        if config.register_tokens:
            self.reg_token = nn.Parameter(torch.zeros(1, config.register_tokens, config.dim))
        block = FilmBlock if config.film_dim else Block
        self.blocks = nn.ModuleList(block(config) for _ in range(config.depth - 1))

    def forward(self, pixels: Tensor, language: Tensor | None = None) -> Tensor:
        """(B, 3, S, S) normalised pixels to (B, rows * columns, dim); ``language`` (B, film_dim) where FiLM is on."""
        x: Tensor = self.patch_embed(pixels) + self.pos_embed
        prefix = []
        if self.config.class_token:
            prefix.append(self.cls_token.expand(len(x), -1, -1))
        if self.config.register_tokens:
            prefix.append(self.reg_token.expand(len(x), -1, -1))
        x = torch.cat([*prefix, x], dim=1)
        for block in self.blocks:
            x = block(x, language)
        return x[:, self.config.prefix_tokens :]


class ConvBlock(nn.Module):
    """ConvNeXt-type block: depthwise convolution, LayerNorm, pointwise expansion by two, residual."""

    def __init__(self, dim: int, kernel: int, eps: float) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(dim, dim, kernel, padding=kernel // 2, groups=dim)
        self.norm = nn.LayerNorm(dim, eps=eps)
        self.mlp = Mlp(dim, 2 * dim)

    def forward(self, x: Tensor) -> Tensor:
        """(B, dim, h, w) to (B, dim, h, w)."""
        y = self.depthwise(x).permute(0, 2, 3, 1)
        out: Tensor = x + self.mlp(self.norm(y)).permute(0, 3, 1, 2)
        return out


class ConvTower(nn.Module):
    """Stride-4 stem, one 3x3 block, stride to the patch size, then blocks with the configured kernels.

    Kernels of 1 keep the receptive field of a token to its own patch, so that what a token says is what lies under
    it and selecting the right tokens matters.
    """

    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        stride = config.patch_size // 4
        self.stem = nn.Conv2d(3, config.stem_dim, 4, 4)
        self.stem_block = ConvBlock(config.stem_dim, 3, config.norm_eps)
        self.down = nn.Conv2d(config.stem_dim, config.dim, stride, stride)
        self.blocks = nn.ModuleList(
            ConvBlock(config.dim, k, config.norm_eps) for k in config.kernels
        )

    def forward(self, pixels: Tensor, language: Tensor | None = None) -> Tensor:
        """(B, 3, S, S) normalised pixels to (B, rows * columns, dim); this tower does not listen."""
        x = pixels.contiguous(memory_format=torch.channels_last)
        x = self.down(self.stem_block(F.gelu(self.stem(x))))
        for block in self.blocks:
            x = block(x)
        out: Tensor = x.permute(0, 2, 3, 1).flatten(1, 2)
        return out


def build_tower(config: TowerConfig) -> ViTTower | ConvTower:
    """The module for a tower's configuration."""
    return ViTTower(config) if config.kind == "vit" else ConvTower(config)
