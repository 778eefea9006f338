"""How close reconstructions are: PSNR and SSIM, picture by picture, as the policy sees them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import conv2d

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def psnr_db(
    originals: npt.NDArray[np.uint8], pictures: npt.NDArray[np.uint8]
) -> npt.NDArray[np.float64]:
    """(n,) peak signal-to-noise ratio in dB of each picture (n, H, W, 3); equal ones give inf."""
    difference = originals.astype(np.float64) - pictures
    error = np.square(difference).mean((1, 2, 3))
    with np.errstate(divide="ignore"):
        return np.asarray(10 * np.log10(255.0**2 / error))


def ssim(
    originals: npt.NDArray[np.uint8], pictures: npt.NDArray[np.uint8]
) -> npt.NDArray[np.float64]:
    """(n,) structural similarity of each picture (n, H, W, 3), mean over pixels and colours.

    Wang et al. 2004: Gaussian window of 11 × 11 pixels with σ = 1.5, without padding.
    """
    a, b = _planes(originals), _planes(pictures)
    mean_a, mean_b = _blur(a), _blur(b)
    var_a = _blur(a * a) - mean_a**2
    var_b = _blur(b * b) - mean_b**2
    covariance = _blur(a * b) - mean_a * mean_b
    light = (2 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1)
    structure = (2 * covariance + _C2) / (var_a + var_b + _C2)
    values = (light * structure).mean((1, 2)).reshape(len(originals), 3).mean(1)
    return np.asarray(values.numpy(), np.float64)


def _planes(pictures: npt.NDArray[np.uint8]) -> Tensor:
    """(3n, H, W) in [0, 1]; double precision, because variances are small differences."""
    planes = torch.from_numpy(np.ascontiguousarray(pictures.transpose(0, 3, 1, 2))).double() / 255
    return planes.flatten(0, 1)


def _blur(planes: Tensor) -> Tensor:
    offsets = torch.arange(_WINDOW, dtype=planes.dtype) - _WINDOW // 2
    weights = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    weights = weights / weights.sum()
    rows = conv2d(planes[:, None], weights[None, None, :, None])
    return conv2d(rows, weights[None, None, None, :])[:, 0]
