"""Blocks of a Swin transformer over pictures (n, height, width, channels).

Liu et al., "Swin Transformer: Hierarchical Vision Transformer using Shifted Windows", 2021.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class WindowAttention(nn.Module):
    """Attention among the tokens of one window, with a learned bias for each relative position."""

    index: Tensor

    def __init__(self, width: int, heads: int, window: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)
        span = 2 * window - 1
        self.bias = nn.Parameter(torch.zeros(span * span, heads))
        nn.init.trunc_normal_(self.bias, std=0.02)
        place = torch.stack(
            torch.meshgrid(torch.arange(window), torch.arange(window), indexing="ij")
        ).flatten(1)
        offset = place[:, :, None] - place[:, None, :] + window - 1
        self.register_buffer("index", offset[0] * span + offset[1], persistent=False)

    def forward(self, windows: Tensor, mask: Tensor | None) -> Tensor:
        """(n, W, t, width) to the same; ``mask`` is (W, t, t), −inf where tokens must not meet."""
        n, count, tokens, width = windows.shape
        qkv = self.qkv(windows).unflatten(-1, (3, self.heads, width // self.heads))
        q, k, v = qkv.permute(3, 0, 1, 4, 2, 5)  # each (n, W, heads, t, d)
        bias = self.bias[self.index].permute(2, 0, 1)  # (heads, t, t)
        if mask is not None:
            bias = bias + mask[:, None]
        # Written out: on a CPU, the fused kernel with a bias is no quicker at 64 tokens.
        scores = (q * (width // self.heads) ** -0.5) @ k.transpose(-1, -2) + bias
        mixed = scores.softmax(-1) @ v
        out: Tensor = self.proj(mixed.transpose(2, 3).reshape(n, count, tokens, width))
        return out


class SwinBlock(nn.Module):
    """Window attention and a two-layer perceptron, each behind a layer norm.

    Args:
        width: channels. heads: of the attention. window: side of a window in tokens.
        shifted: windows lie half a window further, so that neighbours of the last block meet.
    """

    def __init__(self, width: int, heads: int, window: int, shifted: bool) -> None:
        super().__init__()
        self.window, self.shifted = window, shifted
        self.norm1 = nn.LayerNorm(width)
        self.attention = WindowAttention(width, heads, window)
        self.norm2 = nn.LayerNorm(width)
        last = nn.Linear(4 * width, width)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), last)
        # As Swin begins: blocks that do little at first let the picture through.
        for branch in (self.attention.proj, last):
            nn.init.trunc_normal_(branch.weight, std=0.02)
        self._masks: dict[tuple[int, int], Tensor] = {}

    def forward(self, x: Tensor) -> Tensor:
        """(n, h, w, width) to the same; sides are multiples of the window."""
        n, h, w, width = x.shape
        side = self.window
        # Where one window covers everything there is nothing to shift.
        shift = side // 2 if self.shifted and min(h, w) > side else 0
        y = self.norm1(x)
        if shift:
            y = torch.roll(y, (-shift, -shift), (1, 2))
        y = y.reshape(n, h // side, side, w // side, side, width).transpose(2, 3)
        y = y.reshape(n, -1, side * side, width)
        y = self.attention(y, self._mask(h, w, shift).to(x.device) if shift else None)
        y = y.reshape(n, h // side, w // side, side, side, width).transpose(2, 3)
        y = y.reshape(n, h, w, width)
        if shift:
            y = torch.roll(y, (shift, shift), (1, 2))
        x = x + y
        out: Tensor = x + self.mlp(self.norm2(x))
        return out

    def _mask(self, h: int, w: int, shift: int) -> Tensor:
        """(W, t, t): after the roll, a window at the border holds tokens of opposite sides."""
        if (h, w) not in self._masks:
            side = self.window

            def part(length: int) -> Tensor:
                places = torch.arange(length)
                return (places >= length - side).int() + (places >= length - shift).int()

            region = part(h)[:, None] * 3 + part(w)[None]
            region = region.reshape(h // side, side, w // side, side).transpose(1, 2)
            region = region.reshape(-1, side * side)
            apart = region[:, :, None] != region[:, None, :]
            self._masks[h, w] = torch.zeros(apart.shape).masked_fill(apart, -torch.inf)
        return self._masks[h, w]


class Halve(nn.Module):
    """Patch merging: four neighbours become one token of another width."""

    def __init__(self, width: int, out: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * width)
        self.reduce = nn.Linear(4 * width, out, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(n, h, w, width) to (n, h/2, w/2, out)."""
        n, h, w, width = x.shape
        x = x.reshape(n, h // 2, 2, w // 2, 2, width).transpose(2, 3).reshape(n, h // 2, w // 2, -1)
        out: Tensor = self.reduce(self.norm(x))
        return out


class Double(nn.Module):
    """The reverse: one token becomes four neighbours of another width."""

    def __init__(self, width: int, out: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.expand = nn.Linear(width, 4 * out, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(n, h, w, width) to (n, 2h, 2w, out)."""
        y = F.pixel_shuffle(self.expand(self.norm(x)).permute(0, 3, 1, 2), 2)
        return y.permute(0, 2, 3, 1)


def stage(width: int, depth: int, heads: int, window: int) -> nn.Sequential:
    """``depth`` blocks, every second one shifted."""
    return nn.Sequential(*(SwinBlock(width, heads, window, i % 2 == 1) for i in range(depth)))
