"""DeepJSCC: five convolutions from a picture to channel symbols, and five back.

Bourtsoulatze, Kurka, Gündüz, "Deep Joint Source-Channel Coding for Wireless Image Transmission",
2019. Fully convolutional: one set of weights serves every size divisible by four.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

_KERNEL = 5


@dataclass(frozen=True)
class DeepJSCCConfig:
    """What fixes the network.

    Attributes:
        channels: c; the latent has 2c real channels, c = 8 is one sixth of a symbol per pixel value.
        widths: of the convolutions before the last; the first two halve the picture's sides.
    """

    name: ClassVar[str] = "deepjscc"
    channels: int = 8
    widths: tuple[int, int, int, int] = (16, 32, 32, 32)

    @property
    def multiple(self) -> int:
        """Sides of a picture have to be multiples of this."""
        return 4

    def latent_shape(self, height: int, width: int) -> tuple[int, ...]:
        """Shape of the real latent of one picture, (2c, H/4, W/4)."""
        return 2 * self.channels, height // 4, width // 4


def _strides(config: DeepJSCCConfig) -> list[tuple[int, int, int]]:
    """(channels in, channels out, stride) of every convolution of the encoder."""
    widths = (3, *config.widths, 2 * config.channels)
    return [(a, b, 2 if i < 2 else 1) for i, (a, b) in enumerate(itertools.pairwise(widths))]


class DeepJSCCEncoder(nn.Module):
    """Pictures to latents."""

    def __init__(self, config: DeepJSCCConfig) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for before, after, stride in _strides(config):
            convolution = nn.Conv2d(before, after, _KERNEL, stride, padding=_KERNEL // 2)
            layers += [convolution, nn.PReLU()]
        self.layers = nn.Sequential(*layers)

    def forward(self, images: Tensor, snr_db: Tensor) -> Tensor:
        """(n, 3, H, W) in [0, 1] to (n, 2c, H/4, W/4). The SNR is not used: one code for all."""
        del snr_db
        latent: Tensor = self.layers(images)
        return latent


class DeepJSCCDecoder(nn.Module):
    """Noisy latents to pictures: the encoder's mirror, with a sigmoid at its end."""

    def __init__(self, config: DeepJSCCConfig) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for before, after, stride in reversed(_strides(config)):
            layers += [
                nn.ConvTranspose2d(
                    after,
                    before,
                    _KERNEL,
                    stride,
                    padding=_KERNEL // 2,
                    output_padding=stride - 1,
                ),
                nn.PReLU() if before != 3 else nn.Sigmoid(),
            ]
        self.layers = nn.Sequential(*layers)

    def forward(self, latent: Tensor, snr_db: Tensor) -> Tensor:
        """(n, 2c, h, w) to (n, 3, 4h, 4w) in [0, 1]."""
        del snr_db
        images: Tensor = self.layers(latent)
        return images
