"""WITT: a Swin transformer from a picture to channel symbols, told the SNR, and one back.

Yang et al., "WITT: A Wireless Image Transmission Transformer for Semantic Communications", 2023.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from comvla_vla.codecs.swin import Double, Halve, stage


@dataclass(frozen=True)
class WITTConfig:
    """What fixes the network; the defaults are the published ones.

    Attributes:
        widths, depths, heads: of the stages, from the finest. Each stage halves the sides.
        window: side of an attention window in tokens.
        latent_channels: C, real values for each token of the coarsest stage.
        modulation_layers: of the channel ModNet. modulation_width: of its hidden layers.
    """

    name: ClassVar[str] = "witt"
    widths: tuple[int, ...] = (128, 192, 256, 320)
    depths: tuple[int, ...] = (2, 2, 6, 2)
    heads: tuple[int, ...] = (4, 6, 8, 10)
    window: int = 8
    latent_channels: int = 96
    modulation_layers: int = 7
    modulation_width: int = 480

    @property
    def multiple(self) -> int:
        """Sides of a picture have to be multiples of this: windows fill the coarsest stage."""
        return self.window << len(self.widths)

    def latent_shape(self, height: int, width: int) -> tuple[int, ...]:
        """Shape of the real latent of one picture, (tokens, C)."""
        scale = 2 ** len(self.widths)
        return (height // scale) * (width // scale), self.latent_channels


class ChannelModNet(nn.Module):
    """Scales channels of the latent by what the SNR makes of them.

    Layer by layer, a linear map of the latent is multiplied by a small network of the SNR; a
    sigmoid of the last map multiplies the latent.
    """

    def __init__(self, width: int, hidden: int, layers: int) -> None:
        super().__init__()
        self.maps = nn.ModuleList(
            nn.Linear(width if i == 0 else hidden, hidden if i < layers else width)
            for i in range(layers + 1)
        )
        self.gates = nn.ModuleList(
            nn.Sequential(
                nn.Linear(1, hidden),
                nn.ReLU(),
                nn.Linear(hidden, hidden),
                nn.ReLU(),
                nn.Linear(hidden, hidden),
                nn.Sigmoid(),
            )
            for _ in range(layers)
        )

    def forward(self, x: Tensor, snr_db: Tensor) -> Tensor:
        """(n, h, w, width) to the same; ``snr_db`` is (n,)."""
        tens_of_db = (snr_db / 10)[:, None].to(x.dtype)
        y = x
        for index, gate in enumerate(self.gates):
            y = self.maps[index](y) * gate(tens_of_db)[:, None, None]
        return x * torch.sigmoid(self.maps[-1](y))


class WITTEncoder(nn.Module):
    """Pictures to latents."""

    def __init__(self, config: WITTConfig) -> None:
        super().__init__()
        widths = config.widths
        self.patches = nn.Conv2d(3, widths[0], 2, 2)
        self.norm = nn.LayerNorm(widths[0])
        self.stages = nn.ModuleList(
            stage(w, d, h, config.window)
            for w, d, h in zip(widths, config.depths, config.heads, strict=True)
        )
        self.halves = nn.ModuleList(Halve(a, b) for a, b in itertools.pairwise(widths))
        self.last_norm = nn.LayerNorm(widths[-1])
        self.modulate = ChannelModNet(widths[-1], config.modulation_width, config.modulation_layers)
        self.head = nn.Linear(widths[-1], config.latent_channels)

    def forward(self, images: Tensor, snr_db: Tensor) -> Tensor:
        """(n, 3, H, W) in [0, 1] to (n, tokens, C)."""
        # Around zero: with all pictures bright alike, the power of the symbols would go to what they
        # have in common, and training would stand still at a grey picture for long.
        x = self.norm(self.patches(4 * (images - 0.5)).permute(0, 2, 3, 1))
        for index, blocks in enumerate(self.stages):
            x = blocks(self.halves[index - 1](x) if index else x)
        x = self.modulate(self.last_norm(x), snr_db)
        latent: Tensor = self.head(x).flatten(1, 2)
        return latent


class WITTDecoder(nn.Module):
    """Noisy latents to pictures: the encoder's mirror.

    A latent's tokens are taken as a square; pictures are square.
    """

    def __init__(self, config: WITTConfig) -> None:
        super().__init__()
        widths = config.widths[::-1]
        self.head = nn.Linear(config.latent_channels, widths[0])
        self.modulate = ChannelModNet(widths[0], config.modulation_width, config.modulation_layers)
        self.stages = nn.ModuleList(
            stage(w, d, h, config.window)
            for w, d, h in zip(widths, config.depths[::-1], config.heads[::-1], strict=True)
        )
        self.doubles = nn.ModuleList(
            Double(a, b) for a, b in zip(widths, (*widths[1:], 3), strict=True)
        )

    def forward(self, latent: Tensor, snr_db: Tensor) -> Tensor:
        """(n, tokens, C) to (n, 3, H, W) in [0, 1]."""
        side = round(latent.shape[1] ** 0.5)
        x = self.head(latent).unflatten(1, (side, side))
        x = self.modulate(x, snr_db)
        for blocks, double in zip(self.stages, self.doubles, strict=True):
            x = double(blocks(x))
        images: Tensor = x.permute(0, 3, 1, 2).sigmoid()
        return images
