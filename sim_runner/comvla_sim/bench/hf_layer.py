"""One Llama layer of Hugging Face transformers, run eagerly: what most servers of such policies run."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from comvla_vla.config import BackboneConfig


def hf_layer(
    config: BackboneConfig, device: str, dtype: torch.dtype, seed: int
) -> Callable[[Tensor], Tensor] | None:
    """A call that runs rows (R, d) through the layer, bidirectionally; None where transformers is not installed.

    Args:
        config: sizes. device, dtype: where and how. seed: of the weights.
    """
    try:
        llama: Any = importlib.import_module("transformers.models.llama.modeling_llama")
        configuration: Any = importlib.import_module("transformers").LlamaConfig
    except ImportError:
        return None
    settings = configuration(
        hidden_size=config.hidden,
        intermediate_size=config.intermediate,
        num_attention_heads=config.heads,
        num_key_value_heads=config.heads,
        num_hidden_layers=1,
        vocab_size=32,
        rms_norm_eps=config.rms_eps,
        max_position_embeddings=config.max_positions,
        attn_implementation="eager",
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layer = llama.LlamaDecoderLayer(settings, layer_idx=0).to(device, dtype).eval()
        rotary = llama.LlamaRotaryEmbedding(config=settings).to(device)

    def call(rows: Tensor) -> Tensor:
        batch = rows[None]
        positions = torch.arange(len(rows), device=device)[None]
        # Zeros everywhere: a mask that masks nothing keeps attention bidirectional.
        mask = torch.zeros(1, 1, len(rows), len(rows), dtype=dtype, device=device)
        out = layer(
            batch,
            attention_mask=mask,
            position_ids=positions,
            position_embeddings=rotary(batch, positions),
        )
        hidden: Tensor = out[0] if isinstance(out, tuple) else out
        return hidden

    return call
