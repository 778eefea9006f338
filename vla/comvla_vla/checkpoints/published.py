"""Published OpenVLA-OFT and LightVLA folders: what their files say, and what they leave unsaid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from comvla.errors import CheckpointError
from comvla_vla.checkpoints.tensors import Catalogue
from comvla_vla.config import (
    ActionConfig,
    BackboneConfig,
    ModelConfig,
    TowerConfig,
)
from comvla_vla.presets import openvla_oft

MODEL_TYPE = "openvla"
_TOWERS = ("vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224")
_FIXED = {
    "arch_specifier": "no-align+fused-gelu-mlp",
    "use_fused_vision_backbone": True,
    "image_resize_strategy": "resize-naive",
}
# text_config stores only what differs from transformers' LlamaConfig at the time of writing. The rest is written out
# here, because later releases have other defaults.
_LLAMA = {
    "hidden_size": 4096,
    "intermediate_size": 11008,
    "num_hidden_layers": 32,
    "num_attention_heads": 32,
    "rms_norm_eps": 1e-6,
    "rope_theta": 10_000.0,
    "max_position_embeddings": 2048,
    "vocab_size": 32064,
    "hidden_act": "silu",
    "attention_bias": False,
    "mlp_bias": False,
    "rope_scaling": None,
}


@dataclass(frozen=True)
class Recipe:
    """What a published checkpoint was trained with and does not say.

    Attributes:
        name: what to call the policy. views: cameras. horizon: actions in a chunk.
        first_slot: see ``ActionConfig.first_slot``; -1 is how OpenVLA-OFT and LightVLA are trained, 1 how LightVLA's
            published inference reads.
        diffusion_steps: passes of a diffusion head. control_period_s: seconds between actions.
        edge_pruners: pruners whose weights the edge half carries along.
    """

    name: str = "openvla-oft"
    views: int = 2
    horizon: int = 8
    first_slot: int = -1
    diffusion_steps: int = 50
    control_period_s: float = 0.05
    edge_pruners: tuple[str, ...] = ("lightvla", "vla_adp")


def published_config(header: Mapping[str, Any], tensors: Catalogue, recipe: Recipe) -> ModelConfig:
    """Sizes from ``config.json`` and, for the side modules, from their tensors' shapes.

    Args:
        header: ``config.json``. tensors: whatever is there; the action head may be absent on a robot.
        recipe: what neither says.

    Raises:
        CheckpointError: another family, or a variant that is not implemented.
    """
    for key, value in _FIXED.items():
        if header.get(key, value) != value:
            raise CheckpointError(
                f"config.json has {key} {header[key]!r}, only {value!r} is implemented: this is another "
                "family of checkpoints"
            )
    try:
        backbone = _backbone(header["text_config"])
        towers = _towers(header)
    except (
        KeyError,
        TypeError,
        ValueError,
        IndexError,
        AttributeError,
        OverflowError,
    ) as error:
        raise CheckpointError(
            f"config.json is not one of OpenVLA-OFT: {error!r}; copy the checkpoint again"
        ) from error
    if any(".scale.weight" in name for name in tensors if name.startswith("vision_backbone.")):
        towers = tuple(replace(tower, film_dim=backbone.hidden) for tower in towers)
    return replace(
        openvla_oft(),
        name=recipe.name,
        views=recipe.views,
        towers=towers,
        backbone=backbone,
        action=_action(tensors, recipe, backbone.hidden),
        control_period_s=recipe.control_period_s,
        edge_pruners=recipe.edge_pruners,
    )


def _backbone(text: Mapping[str, Any]) -> BackboneConfig:
    values = {key: text.get(key, default) for key, default in _LLAMA.items()}
    heads = values["num_attention_heads"]
    fixed = ("hidden_act", "attention_bias", "mlp_bias", "rope_scaling")
    odd = [key for key in fixed if values[key] != _LLAMA[key]]
    if text.get("model_type") != "llama" or text.get("num_key_value_heads", heads) != heads or odd:
        raise CheckpointError(
            f"the language model is {text.get('model_type')!r} with {odd or 'grouped'} heads or layers, only "
            "Llama with full attention heads is implemented"
        )
    return BackboneConfig(
        hidden=int(values["hidden_size"]),
        intermediate=int(values["intermediate_size"]),
        layers=int(values["num_hidden_layers"]),
        heads=int(heads),
        vocab=int(values["vocab_size"]),
        rms_eps=float(values["rms_norm_eps"]),
        rope_theta=float(values["rope_theta"]),
        max_positions=int(values["max_position_embeddings"]),
    )


def _towers(header: Mapping[str, Any]) -> tuple[TowerConfig, ...]:
    ids = tuple(header["timm_model_ids"])
    if ids != _TOWERS:
        raise CheckpointError(f"the vision towers are {ids}, only {_TOWERS} are implemented")
    if any(act is not None for act in header.get("timm_override_act_layers", ())):
        raise CheckpointError(
            "the vision towers override their activation, only GELU is implemented"
        )
    overrides = header.get("x_vit_overrides", ({}, {}))
    sizes = [int(size) for size in header["image_sizes"]]
    return tuple(
        _resized(tower, size, extra)
        for tower, size, extra in zip(openvla_oft().towers, sizes, overrides, strict=True)
    )


def _resized(tower: TowerConfig, image_size: int, extra: Mapping[str, Any]) -> TowerConfig:
    """A tower with other sizes: only reference data of reduced size say so, in a key of their own."""
    dim = int(extra.get("embed_dim", tower.dim))
    ratio = float(extra.get("mlp_ratio", tower.mlp_dim / tower.dim))
    return replace(
        tower,
        image_size=image_size,
        dim=dim,
        depth=int(extra.get("depth", tower.depth)),
        heads=int(extra.get("num_heads", tower.heads)),
        patch_size=int(extra.get("patch_size", tower.patch_size)),
        register_tokens=int(extra.get("reg_tokens", tower.register_tokens)),
        mlp_dim=int(dim * ratio + 1e-6),
    )


def _action(tensors: Catalogue, recipe: Recipe, hidden: int) -> ActionConfig:
    """Sizes of the side modules; defaults where a robot holds none of them."""
    diffusion = "action_head.noise_predictor.mlp_resnet.fc2.weight"
    last = tensors.get(diffusion, tensors.get("action_head.model.fc2.weight"))
    proprio = tensors.get("proprio_projector.fc1.weight")
    blocks = {
        name.split(".mlp_resnet_blocks.")[1].split(".")[0]
        for name in tensors
        if "mlp_resnet_blocks" in name
    }
    return ActionConfig(
        horizon=recipe.horizon,
        action_dim=7 if last is None else last.shape[0],
        proprio_dim=8 if proprio is None else proprio.shape[1],
        head_hidden=hidden if last is None else last.shape[1],
        head_blocks=len(blocks) or 2,
        first_slot=recipe.first_slot,
        head="diffusion" if diffusion in tensors else "l1",
        diffusion_steps=recipe.diffusion_steps,
    )
