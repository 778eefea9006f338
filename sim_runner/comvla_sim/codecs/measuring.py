"""Curves of a trained codec over the SNR, on pictures that training never saw."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from comvla_sim.codecs.fading import draw_gains
from comvla_sim.codecs.fidelity import psnr_db, ssim
from comvla_vla.codecs.analogue import noise_power
from comvla_vla.codecs.image_codec import ImageCodec
from comvla_vla.codecs.waveform import float_to_uint8, uint8_to_float

SNRS_DB = (-5.0, 0.0, 5.0, 10.0, 15.0, 20.0)
"""Mean SNRs of a curve."""

_BATCH = 16


def reconstruct(
    codec: ImageCodec,
    pictures: npt.NDArray[np.uint8],
    kind: str,
    mean_snr_db: float,
    seed: int = 0,
) -> npt.NDArray[np.uint8]:
    """Pictures (n, H, W, 3) after one period of the channel each.

    Args:
        codec: trained.
        pictures: originals.
        kind: of fading, a key of :data:`comvla_sim.codecs.fading.RICIAN_K`.
        mean_snr_db: mean of the linear SNR over periods, in dB.
        seed: of gains and noise; the same for every SNR, so that curves differ by the SNR alone.
    """
    rng = np.random.default_rng((seed, 3))
    gains = torch.from_numpy(draw_gains(kind, len(pictures), rng))
    generator = torch.Generator().manual_seed(seed)
    noise = noise_power(torch.full((len(pictures),), mean_snr_db))
    out: list[Tensor] = []
    with torch.inference_mode():
        for start in range(0, len(pictures), _BATCH):
            part = slice(start, start + _BATCH)
            images = uint8_to_float(pictures[part])
            out.append(codec(images, gains[part], noise[part], generator))
    return float_to_uint8(torch.cat(out))


def curves(
    codec: ImageCodec,
    pictures: npt.NDArray[np.uint8],
    kinds: Sequence[str] = ("awgn", "rician", "rayleigh"),
    snrs_db: Sequence[float] = SNRS_DB,
    seed: int = 0,
) -> list[dict[str, Any]]:
    """Mean PSNR (and its deviation between pictures) and SSIM for every kind and SNR, as JSON values."""
    lines = []
    for kind in kinds:
        for snr in snrs_db:
            seen = reconstruct(codec, pictures, kind, snr, seed)
            ratios = psnr_db(pictures, seen)
            lines.append(
                {
                    "channel": kind,
                    "mean_snr_db": snr,
                    "psnr_db": round(float(ratios.mean()), 2),
                    "psnr_deviation_db": round(float(ratios.std()), 2),
                    "ssim": round(float(ssim(pictures, seen).mean()), 4),
                    "pictures": len(pictures),
                }
            )
    return lines
