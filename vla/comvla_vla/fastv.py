"""FastV: after a few layers, keep the visual tokens that the last token attends to most.

Source: pkunlp-icler/FastV, the LLaVA modelling file. Under bidirectional attention the last token is the stop token.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from comvla_vla.options import FastV

if TYPE_CHECKING:
    from comvla_vla.backbone import Layer


def last_row_attention(
    layer: Layer, rows: Tensor, cos: Tensor, sin: Tensor, lengths: Sequence[int]
) -> list[Tensor]:
    """What the last token of each sequence attends to in one layer, mean over heads.

    The kernel that runs the layer returns no weights, so this one row is computed again.

    Args:
        layer: the layer whose attention is asked for.
        rows: (R, d) its input. cos, sin: rotary tables of the rows. lengths: rows of each sequence.

    Returns:
        One (L,) float32 distribution for each sequence.
    """
    q, k, _ = layer.before(rows, cos, sin)
    out: list[Tensor] = []
    end = 0
    for length in lengths:
        start, end = end, end + length
        scores = torch.einsum("hc,lhc->hl", q[end - 1], k[start:end]) / math.sqrt(q.shape[-1])
        out.append(scores.float().softmax(dim=-1).mean(dim=0))
    return out


def surviving_rows(
    attention: Sequence[Tensor], visual: Sequence[int], fastv: FastV
) -> tuple[Tensor, list[int]]:
    """Rows that stay, in order, over all packed sequences.

    Args:
        attention: per sequence (L,), from :func:`last_row_attention`.
        visual: visual tokens of each sequence; they stand right behind begin-of-sequence.
        fastv: how many stay.

    Returns:
        Row indices into the packed rows, and the new lengths.
    """
    rows, lengths, start = [], [], 0
    for weights, count in zip(attention, visual, strict=True):
        best = weights[1 : 1 + count].topk(fastv.kept(count)).indices.sort().values + 1
        here = torch.arange(len(weights), device=weights.device)
        kept = torch.cat([here[:1], best, here[1 + count :]])
        rows.append(kept + start)
        lengths.append(len(kept))
        start += len(weights)
    return torch.cat(rows), lengths
