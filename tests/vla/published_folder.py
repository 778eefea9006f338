"""A checkpoint folder in exactly the published layout, tiny and with random weights."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from reference_data import llama_like_tokenizer
from safetensors.torch import save_file

from comvla_vla import Recipe
from comvla_vla.checkpoints.accounting import half_shapes, unused_shapes
from comvla_vla.checkpoints.published import published_config
from comvla_vla.config import ModelConfig

HEADER: dict[str, Any] = {
    "arch_specifier": "no-align+fused-gelu-mlp",
    "hf_llm_id": "meta-llama/Llama-2-7b-hf",
    "image_resize_strategy": "resize-naive",
    "image_sizes": [28, 28],
    "model_type": "openvla",
    "norm_stats": {},
    "text_config": {
        "model_type": "llama",
        "hidden_size": 16,
        "intermediate_size": 24,
        "num_attention_heads": 2,
        "num_hidden_layers": 3,
        "vocab_size": 32064,
    },
    "timm_model_ids": [
        "vit_large_patch14_reg4_dinov2.lvd142m",
        "vit_so400m_patch14_siglip_224",
    ],
    "timm_override_act_layers": [None, None],
    "use_fused_vision_backbone": True,
    # Real checkpoints have no such key: their towers have the sizes that their names say.
    "x_vit_overrides": [
        {"depth": 3, "embed_dim": 8, "num_heads": 2, "mlp_ratio": 2.0},
        {"depth": 3, "embed_dim": 12, "num_heads": 2, "mlp_ratio": 2.0},
    ],
}
_BOUNDS = {"q01": [-1.0] * 7, "q99": [1.0] * 7, "mask": [True] * 6 + [False]}
STATISTICS = {
    "libero_spatial_no_noops": {
        "action": _BOUNDS,
        "proprio": {"q01": [-2.0] * 8, "q99": [2.0] * 8},
    }
}
SIDE_MODULES = ("action_head", "proprio_projector", "noisy_action_projector")


def tiny_config() -> ModelConfig:
    """The model that :data:`HEADER` describes: 8 tokens of width 20."""
    return published_config(HEADER, {}, Recipe())


def random_tensors(seed: int = 0) -> dict[str, torch.Tensor]:
    """Every tensor of the layout under its canonical name, those that nothing reads included."""
    config, generator = tiny_config(), torch.Generator().manual_seed(seed)
    shapes = half_shapes("edge", config) | half_shapes("cloud", config) | unused_shapes(config)
    return {
        name: torch.randn(shape, generator=generator).mul(0.3).to(torch.bfloat16)
        for name, shape in shapes.items()
    }


def write_published(
    folder: Path,
    tensors: Mapping[str, torch.Tensor],
    *,
    shards: int = 1,
    prefix: str = "module.",
) -> Path:
    """Writes a published folder: main weights in ``shards`` files, side modules in ``.pt`` files."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(HEADER))
    (folder / "dataset_statistics.json").write_text(json.dumps(STATISTICS))
    llama_like_tokenizer().save(str(folder / "tokenizer.json"))
    main = {n: t for n, t in tensors.items() if n.split(".")[0] not in SIDE_MODULES}
    for module in SIDE_MODULES:
        side = {
            n.removeprefix(f"{module}."): t
            for n, t in tensors.items()
            if n.startswith(f"{module}.")
        }
        if side:
            torch.save(
                {prefix + n: t for n, t in side.items()}, folder / f"{module}--latest_checkpoint.pt"
            )
    if shards == 1:
        save_file(main, folder / "model.safetensors")
        return folder
    places = {}
    for i in range(shards):
        name = f"model-{i + 1:05}-of-{shards:05}.safetensors"
        part = {n: main[n] for n in sorted(main)[i::shards]}
        save_file(part, folder / name)
        places |= dict.fromkeys(part, name)
    index = {"metadata": {}, "weight_map": places}
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))
    return folder
