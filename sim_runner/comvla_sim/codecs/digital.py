"""What a digital system would get out of the same channel uses, at its very best.

JPEG files sent by a code that reaches the channel's capacity: in k uses of a channel whose SNR both
sides know, k · log2(1 + SNR) bits arrive without error. No real code does this in the few thousand
uses of one control period; those that exist lose 1 to 3 dB. Huffman tables are taken as agreed
upon: only the scan of a file counts.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from comvla_sim.codecs.fidelity import psnr_db

QUALITIES = (1, 2, 3, 4, 5, 7, 10, 15, 20, 30, 40, 50, 60, 70, 75, 80, 85, 90, 95)
_START_OF_SCAN = b"\xff\xda"
_GREY = 128


@dataclass(frozen=True)
class JpegLadder:
    """Pictures as JPEG at every quality.

    Attributes:
        file_bytes: (Q, n) of whole files.
        scan_bytes: (Q, n) without headers and tables.
        psnr_db: (Q, n).
        grey_psnr_db: (n,) of a grey picture, which is what arrives where nothing fits.
    """

    file_bytes: npt.NDArray[np.int64]
    scan_bytes: npt.NDArray[np.int64]
    psnr_db: npt.NDArray[np.float64]
    grey_psnr_db: npt.NDArray[np.float64]

    def at_capacity(self, channel_uses: int, snr_db: float) -> tuple[float, float]:
        """Mean PSNR in dB with the best quality that fits each picture, and the share that fits.

        Args:
            channel_uses: for one picture.
            snr_db: of the channel, without fading.
        """
        bits = channel_uses * math.log2(1 + 10 ** (snr_db / 10))
        fits = self.scan_bytes * 8 <= bits
        best = np.where(fits, self.psnr_db, -np.inf).max(0)
        any_fits = fits.any(0)
        values = np.where(any_fits, best, self.grey_psnr_db)
        return float(values.mean()), float(any_fits.mean())


def jpeg_ladder(pictures: npt.NDArray[np.uint8]) -> JpegLadder:
    """Codes pictures (n, H, W, 3) at every quality of :data:`QUALITIES`."""
    from PIL import Image

    files: list[list[int]] = []
    scans: list[list[int]] = []
    quality_psnr = []
    for quality in QUALITIES:
        lengths, scan_lengths, decoded = [], [], []
        for picture in pictures:
            buffer = io.BytesIO()
            Image.fromarray(picture).save(buffer, "JPEG", quality=quality)
            data = buffer.getvalue()
            lengths.append(len(data))
            scan_lengths.append(len(data) - data.rindex(_START_OF_SCAN))
            with Image.open(io.BytesIO(data)) as image:
                decoded.append(np.asarray(image))
        files.append(lengths)
        scans.append(scan_lengths)
        quality_psnr.append(psnr_db(pictures, np.stack(decoded)))
    grey = psnr_db(pictures, np.full_like(pictures, _GREY))
    return JpegLadder(np.asarray(files), np.asarray(scans), np.stack(quality_psnr), grey)
