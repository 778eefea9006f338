"""Configurations by name: the shipped small policy, and the published full-size one."""

from __future__ import annotations

from comvla_vla.config import (
    ActionConfig,
    BackboneConfig,
    ModelConfig,
    ProjectorConfig,
    PromptConfig,
    TowerConfig,
)

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
HALF = (0.5, 0.5, 0.5)

# Every word that the small policy is trained on; instructions are made of these and no others.
# fmt: off
MINI_WORDS = (
    "the", "green", "yellow", "grey", "black", "brown", "drawer", "button", "faucet", "lever",
    "window", "pull", "push", "press", "turn", "lower", "slide", "open", "shut", "firmly",
    "gently", "left", "right", "leftwards", "rightwards",
)
# fmt: on


def mini(vocab: int = 3 + len(MINI_WORDS)) -> ModelConfig:
    """``comvla-mini``: about 1.4 M parameters, two 128-pixel views, 512 tokens of width 96, chunks of 8 actions."""
    tower = TowerConfig(
        kind="conv",
        dim=96,
        image_size=128,
        patch_size=8,
        mean=HALF,
        std=(0.25, 0.25, 0.25),
        stem_dim=48,
        kernels=(1, 1),
    )
    return ModelConfig(
        name="comvla-mini",
        views=2,
        towers=(tower,),
        projector=ProjectorConfig(kind="linear", norm=True, positions="sine2d"),
        backbone=BackboneConfig(
            hidden=192,
            intermediate=320,
            layers=3,
            heads=4,
            vocab=vocab,
            # Slow rotations: half of the channels hardly turn over 600 positions and stay free for content.
            rope_theta=1_000_000.0,
            max_positions=640,
        ),
        action=ActionConfig(
            horizon=8, action_dim=4, proprio_dim=4, head_hidden=192, learned_placeholders=True
        ),
        prompt=PromptConfig(
            template="{instruction}",
            trailing_id=None,
            queries_per_token=4,
            unknown_words="error",
            max_tokens=32,
        ),
        control_period_s=0.05,
    )


def openvla_oft(vocab: int = 32064) -> ModelConfig:
    """OpenVLA-OFT on LIBERO at full size: DINOv2-L and SigLIP-so400m, Llama-2-7B, chunks of 8 actions of 7 values."""
    dino = TowerConfig(
        kind="vit",
        dim=1024,
        image_size=224,
        patch_size=14,
        mean=IMAGENET_MEAN,
        std=IMAGENET_STD,
        depth=24,
        heads=16,
        mlp_dim=4096,
        class_token=True,
        register_tokens=4,
        layer_scale=True,
    )
    siglip = TowerConfig(
        kind="vit",
        dim=1152,
        image_size=224,
        patch_size=14,
        mean=HALF,
        std=HALF,
        depth=27,
        heads=16,
        mlp_dim=4304,
    )
    return ModelConfig(
        name="openvla-oft",
        views=2,
        towers=(dino, siglip),
        projector=ProjectorConfig(),
        backbone=BackboneConfig(vocab=vocab),
        action=ActionConfig(horizon=8, action_dim=7, proprio_dim=8, head_hidden=4096),
        prompt=PromptConfig(),
        preprocess="openvla",
    )
