"""The diffusion head's schedule: DDIM with a squared-cosine noise schedule, as OpenVLA-OFT uses it.

The network that predicts the noise is the L1 head's; the backbone runs once for every noise level, with the noisy
actions in place of the placeholders and the level as one more token behind proprioception.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from comvla_vla.config import ActionConfig


def noise_levels(config: ActionConfig) -> list[int]:
    """Timesteps of inference, noisiest first, evenly spaced from 0 ("leading" spacing)."""
    stride = config.diffusion_train_steps // config.diffusion_steps
    return [stride * i for i in reversed(range(config.diffusion_steps))]


def signal_levels(train_steps: int) -> Tensor:
    """Cumulative share of signal (train_steps,) float32: squared cosine, each step's noise capped at 0.999."""

    def share(t: float) -> float:
        return math.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = [
        min(1 - share((i + 1) / train_steps) / share(i / train_steps), 0.999)
        for i in range(train_steps)
    ]
    return (1 - torch.tensor(betas, dtype=torch.float32)).cumprod(dim=0)


def denoise_step(
    sample: Tensor, noise: Tensor, level: int, config: ActionConfig, signal: Tensor
) -> Tensor:
    """One deterministic DDIM step: (B, H, A) actions at ``level`` and the predicted noise to the next cleaner ones."""
    now = signal[level]
    before = level - config.diffusion_train_steps // config.diffusion_steps
    then = signal[before] if before >= 0 else torch.ones(())
    clean = (sample - (1 - now).sqrt() * noise) / now.sqrt()
    return then.sqrt() * clean.clamp(-1, 1) + (1 - then).sqrt() * noise


def level_embedding(level: int, dim: int, like: Tensor) -> Tensor:
    """Sines, then cosines, of a noise level: (1, dim) of ``like``'s type."""
    half = dim // 2
    exponent = torch.arange(half, device=like.device) * (-math.log(10_000) / (half - 1))
    angles = level * exponent.exp()
    return torch.cat([angles.sin(), angles.cos()])[None].to(like.dtype)
