"""The edge's eyes: towers side by side, and the projector into the backbone's space."""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from comvla_vla.config import ModelConfig
from comvla_vla.linear import Linear
from comvla_vla.towers import build_tower

# Names of the towers in published checkpoints, in the order in which their features are concatenated.
TOWER_NAMES = ("featurizer", "fused_featurizer")


class VisionBackbone(nn.Module):
    """All towers over all views: (B, views, 3 * towers, S, S) to tokens (B, N, D)."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        for name, tower in zip(TOWER_NAMES, config.towers, strict=False):
            self.add_module(name, build_tower(tower))
        if config.projector.positions == "sine2d":
            self.view_embed = nn.Parameter(torch.zeros(config.views, config.token_dim))

    def forward(self, pixels: Tensor, language: Tensor | None = None) -> Tensor:
        """Normalised pixels (B, views, 3 * towers, S, S), channels grouped by tower, to (B, N, D).

        ``language`` is the mean text embedding (B, d) where towers listen to the instruction (FiLM).
        """
        batch, views = pixels.shape[:2]
        flat = pixels.flatten(0, 1)
        heard = None if language is None else language.repeat_interleave(views, 0)
        features = [
            cast(Tensor, self.get_submodule(name)(flat[:, 3 * i : 3 * i + 3], heard))
            for i, name in zip(range(len(self.config.towers)), TOWER_NAMES, strict=False)
        ]
        tokens: Tensor = torch.cat(features, dim=-1).view(batch, views, -1, self.config.token_dim)
        if self.config.projector.positions == "sine2d":
            tokens = tokens + self.view_embed[:, None]
        return tokens.flatten(1, 2)


class Projector(nn.Module):
    """Tokens (…, D) at positions (…) to the backbone's width (…, d).

    Positions index the unpruned sequence 0 .. N-1; they matter only where the configuration adds 2-D positions.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        dim, hidden = config.token_dim, config.backbone.hidden
        if config.projector.kind == "fused_mlp":
            self.fc1 = Linear(dim, 4 * dim)
            self.fc2 = Linear(4 * dim, hidden)
            self.fc3 = Linear(hidden, hidden)
        else:
            self.fc1 = Linear(dim, hidden)
        if config.projector.norm:
            self.norm = nn.LayerNorm(hidden)
        if config.projector.positions == "sine2d":
            self.view_embed = nn.Parameter(torch.randn(config.views, hidden) * 0.5)
            # Derived from the configuration, so neither saved nor counted as a parameter.
            self.register_buffer("sines", sine_positions(config), persistent=False)

    def derive(self) -> None:
        """Computes anew what follows from the configuration, after parameters were given memory."""
        if self.config.projector.positions == "sine2d":
            self.sines = sine_positions(self.config).to(self.fc1.weight)

    def forward(self, tokens: Tensor, positions: Tensor | None = None) -> Tensor:
        """Projects tokens (..., K, D) at ``positions`` (..., K) (None: all N in order) to (..., K, d)."""
        x: Tensor = self.fc1(tokens)
        if self.config.projector.kind == "fused_mlp":
            x = self.fc3(F.gelu(self.fc2(F.gelu(x))))
        if self.config.projector.norm:
            x = self.norm(x)
        if self.config.projector.positions == "sine2d":
            _, rows, columns = self.config.grid
            sines = self.sines
            where = sines.repeat(self.config.views, 1) + self.view_embed.repeat_interleave(
                rows * columns, 0
            )
            x = x + (where if positions is None else where[positions])
        return x


def sine_positions(config: ModelConfig) -> Tensor:
    """Two-dimensional sine positions (rows * columns, d) with the configured amplitude.

    Wavelengths run from 2 pi to 100 pi cells: the grid is 16 to 32 cells wide, so neighbours differ clearly from the
    first training step on. With weak positions a small policy stays nearly blind.
    """
    _, rows, columns = config.grid
    quarter = config.backbone.hidden // 4
    frequency = 50.0 ** -(torch.arange(quarter) / quarter)

    def wave(length: int) -> Tensor:
        phase = torch.arange(length)[:, None] * frequency
        return torch.cat([phase.sin(), phase.cos()], dim=1)

    by_row = wave(rows)[:, None].expand(rows, columns, -1)
    by_column = wave(columns)[None].expand(rows, columns, -1)
    return torch.cat([by_row, by_column], dim=-1).flatten(0, 1) * config.projector.sine_amplitude
