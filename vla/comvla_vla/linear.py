"""Linear layers that are exact and quick in bfloat16 on any processor.

With instructions for it (AVX-512, AMX, newer ARM) torch multiplies bfloat16 in float32 and rounds the result once.
Without them it falls back to a loop that is five to eight times slower than a float32 product, and rounds more often.
There, weights are widened block by block, in a piece of cache, and the product is a float32 one: memory still holds
bfloat16 only, and the result is rounded once as well.
"""

from __future__ import annotations

from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# Rows of weights that are widened at a time: 8 MB in float32 at a width of 4096. Twice as many leave the cache.
_BLOCK_ROWS = 512


@lru_cache(maxsize=1)
def cpu_multiplies_bfloat16() -> bool:
    """Whether torch has a quick product of bfloat16 matrices on this processor."""
    try:
        return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    except (AttributeError, RuntimeError):  # built without oneDNN, or asked in another way
        return True


class Linear(nn.Linear):
    """``torch.nn.Linear`` with the same parameters and names."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., in) to (..., out)."""
        narrow = self.weight.dtype == x.dtype == torch.bfloat16
        if narrow and x.device.type == "cpu" and not cpu_multiplies_bfloat16():
            return widened_linear(x, self.weight, self.bias)
        return F.linear(x, self.weight, self.bias)


def widened_linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """A linear layer computed in float32 from narrower weights, and rounded once.

    Args:
        x: (..., in). weight: (out, in). bias: (out,).

    Returns:
        (..., out) in the type of ``x``.
    """
    wide = x.float()
    out = x.new_empty(*x.shape[:-1], len(weight))
    for start in range(0, len(weight), _BLOCK_ROWS):
        rows = slice(start, start + _BLOCK_ROWS)
        offset = None if bias is None else bias[rows].float()
        out[..., rows] = F.linear(wide, weight[rows].float(), offset)
    return out
