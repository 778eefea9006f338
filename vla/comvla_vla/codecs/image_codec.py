"""A learned codec as one thing: pictures to channel symbols of unit power, and back."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from comvla.errors import CodecError
from comvla_vla.codecs.analogue import (
    equalise_mmse,
    instantaneous_snr_db,
    normalise_power,
    to_latent,
    to_symbols,
    transmit,
)
from comvla_vla.codecs.deep_jscc import DeepJSCCConfig, DeepJSCCDecoder, DeepJSCCEncoder
from comvla_vla.codecs.witt import WITTConfig, WITTDecoder, WITTEncoder

CodecConfig = DeepJSCCConfig | WITTConfig

CODECS: dict[str, type[DeepJSCCConfig] | type[WITTConfig]] = {
    "deepjscc": DeepJSCCConfig,
    "witt": WITTConfig,
}
"""Codecs by name; a configuration without arguments is the published one."""

SMALL_WITT = WITTConfig(
    widths=(16, 32, 48, 80),
    depths=(2, 2, 2, 1),
    heads=(1, 2, 3, 5),
    modulation_layers=3,
    modulation_width=48,
)
"""WITT's structure, latent and rate at a size that one core trains in under an hour."""

SMALL: dict[str, CodecConfig] = {"deepjscc": DeepJSCCConfig(), "witt": SMALL_WITT}
"""What is trained and shipped here. DeepJSCC is small as published."""


@dataclass(frozen=True)
class Rate:
    """What one picture costs.

    Attributes:
        values: real values of the latent.
        latent_bytes: of them in float32, as the paper counts.
        channel_uses: complex symbols.
        per_pixel_value: channel uses over 3 · height · width ("bandwidth ratio").
    """

    values: int
    latent_bytes: int
    channel_uses: int
    per_pixel_value: float


def rate(config: CodecConfig, height: int, width: int) -> Rate:
    """The rate for pictures of this size.

    Raises:
        CodecError: a size that the codec cannot take.
    """
    check_size(config, height, width)
    values = 1
    for side in config.latent_shape(height, width):
        values *= side
    return Rate(values, 4 * values, values // 2, values / 2 / (3 * height * width))


def check_size(config: CodecConfig, height: int, width: int) -> None:
    """CodecError unless the codec takes pictures of this size."""
    multiple = config.multiple
    square = height == width or isinstance(config, DeepJSCCConfig)
    if height < 1 or height % multiple or width % multiple or not square:
        raise CodecError(
            f"{config.name} takes {'square ' if config.name == 'witt' else ''}pictures with sides "
            f"that are multiples of {multiple} pixels, got {height}×{width}: resize them"
        )


class ImageCodec(nn.Module):
    """Encoder and decoder of one configuration.

    Args:
        config: of the networks.
    """

    def __init__(self, config: CodecConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder: nn.Module
        self.decoder: nn.Module
        if isinstance(config, WITTConfig):
            self.encoder, self.decoder = WITTEncoder(config), WITTDecoder(config)
        else:
            self.encoder, self.decoder = DeepJSCCEncoder(config), DeepJSCCDecoder(config)

    def encode(self, images: Tensor, snr_db: Tensor) -> Tensor:
        """Pictures to symbols.

        Args:
            images: (n, 3, H, W) float in [0, 1].
            snr_db: (n,) SNR in dB that the sender believes in. DeepJSCC does not look at it.

        Returns:
            (n, k) complex64; each picture's mean power is 1.
        """
        check_size(self.config, *images.shape[-2:])
        return normalise_power(to_symbols(self.encoder(images, snr_db)))

    def decode(self, symbols: Tensor, size: tuple[int, int], snr_db: Tensor) -> Tensor:
        """Equalised symbols to pictures.

        Args:
            symbols: (n, k) complex.
            size: height and width of a picture in pixels.
            snr_db: (n,) SNR in dB of the period at the receiver.

        Returns:
            (n, 3, H, W) float in [0, 1].

        Raises:
            CodecError: another number of symbols than such pictures have.
        """
        expected = rate(self.config, *size).channel_uses
        if symbols.ndim != 2 or symbols.shape[1] != expected:
            raise CodecError(
                f"{self.config.name} expects {expected} symbols for a picture of "
                f"{size[0]}×{size[1]} pixels, got shape {tuple(symbols.shape)}"
            )
        latent = to_latent(symbols, self.config.latent_shape(*size))
        images: Tensor = self.decoder(latent, snr_db)
        return images

    def receive(
        self, received: Tensor, size: tuple[int, int], gain: Tensor, noise: Tensor
    ) -> Tensor:
        """Pictures from what arrived: MMSE equalisation, then :meth:`decode`.

        Args:
            received: (n, k) complex.
            size: height and width in pixels.
            gain: (n,) complex. noise: (n,) N0 (:mod:`comvla_vla.codecs.analogue`).
        """
        equalised = equalise_mmse(received, gain, noise)
        return self.decode(equalised, size, told_snr_db(instantaneous_snr_db(gain, noise)))

    def forward(
        self,
        images: Tensor,
        gain: Tensor,
        noise: Tensor,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Pictures through one period of the channel each; both sides know its SNR.

        Args:
            images: (n, 3, H, W) float in [0, 1].
            gain: (n,) complex. noise: (n,) N0. generator: of the noise.
        """
        symbols = self.encode(images, told_snr_db(instantaneous_snr_db(gain, noise)))
        height, width = images.shape[-2:]
        return self.receive(transmit(symbols, gain, noise, generator), (height, width), gain, noise)


SNR_RANGE_DB = (-10.0, 30.0)
"""What networks are told about the SNR stays within; a deep fade is told as its lower end."""


def told_snr_db(snr_db: Tensor) -> Tensor:
    """SNRs in dB as the networks are told."""
    return snr_db.clamp(*SNR_RANGE_DB)


def codec_flops(config: CodecConfig, height: int, width: int) -> tuple[int, int]:
    """Multiply-adds counted twice of encoder and decoder for one picture.

    Matrix products and convolutions, as torch counts them; nothing is computed.
    """
    from torch.utils.flop_counter import FlopCounterMode

    check_size(config, height, width)
    counts = []
    with torch.device("meta"):
        codec, snr = ImageCodec(config), torch.zeros(1)
        latent = torch.zeros(1, *config.latent_shape(height, width))
        for half, value in (
            (codec.encoder, torch.zeros(1, 3, height, width)),
            (codec.decoder, latent),
        ):
            with FlopCounterMode(display=False) as counter:
                half(value, snr)
            counts.append(counter.get_total_flops())
    return counts[0], counts[1]


def config_to_json(config: CodecConfig) -> dict[str, Any]:
    """Plain JSON values."""
    return {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(config).items()}


def config_from_json(name: str, values: dict[str, Any]) -> CodecConfig:
    """The configuration that :func:`config_to_json` wrote.

    Raises:
        CodecError: an unknown codec or setting.
    """
    if name not in CODECS:
        raise CodecError(f"unknown codec {name!r}: choose among {', '.join(CODECS)}")
    read: dict[str, Any] = {
        key: tuple(v) if isinstance(v, list) else v for key, v in values.items()
    }
    try:
        return CODECS[name](**read)
    except TypeError as error:
        raise CodecError(f"the codec file does not fit this release: {error}") from error
