"""Camera pictures as OpenVLA-OFT's evaluation prepares them, without TensorFlow.

The policy was trained on pictures that went through TensorFlow's JPEG coder, its Lanczos resize and its bilinear crop,
and it notices the difference. Each function here repeats one TensorFlow operation to within rounding.
Source: moojink/openvla-oft, ``experiments/robot/openvla_utils.py``; tensorflow/tensorflow, the kernels named below.
"""

from __future__ import annotations

import io
import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from comvla.errors import DependencyError

Picture = NDArray[np.uint8]
Floats = NDArray[np.float32]

_QUALITY = 95  # TensorFlow's default
_HALVED_CHROMA = 2  # 4:2:0
_LOBES = 3  # of the Lanczos kernel
_CROPPED_AREA = 0.9  # share of the picture that training's random crops kept on average


def through_jpeg(image: Picture) -> Picture:
    """Encodes and decodes as ``tf.image.encode_jpeg`` and ``tf.io.decode_image`` do: (H, W, 3) to the same shape.

    TensorFlow decodes with the fast integer transform, which most decoders do not offer and which moves two pixels
    out of three by a level or more.

    Raises:
        DependencyError: pillow (to encode) or simplejpeg (to decode) is not installed.
    """
    try:
        import simplejpeg
        from PIL import Image
    except ImportError as error:
        raise DependencyError(
            "preparing pictures as OpenVLA-OFT does needs pillow and simplejpeg: "
            "pip install 'comvla[openvla]'"
        ) from error
    coded = io.BytesIO()
    # simplejpeg never encodes with the accurate transform at this quality, pillow always does.
    Image.fromarray(image).save(coded, "JPEG", quality=_QUALITY, subsampling=_HALVED_CHROMA)
    decoded: Picture = simplejpeg.decode_jpeg(coded.getvalue(), fastdct=True, fastupsample=False)
    return decoded


def lanczos_resize(image: Picture, side: int) -> Floats:
    """``tf.image.resize(method="lanczos3", antialias=True)``: (H, W, 3) to (side, side, 3) float32, not rounded."""
    height, width = image.shape[:2]
    rows, columns = _lanczos_weights(height, side), _lanczos_weights(width, side)
    # Rows first, then columns, in float32, as the ScaleAndTranslate kernel does.
    tall = np.tensordot(rows, image.astype(np.float32), axes=(1, 0))
    out: Floats = np.einsum("xw,hwc->hxc", columns, tall, optimize=True)
    return out


def round_to_bytes(pixels: Floats) -> Picture:
    """Rounds half to even and clips, as ``tf.clip_by_value(tf.round(x), 0, 255)`` cast to uint8 does."""
    return np.clip(np.rint(pixels), 0, 255).astype(np.uint8)


def center_crop(image: Picture) -> Picture:
    """The central 90 % of the area, back at the old size: (S, S, 3) to (S, S, 3).

    ``tf.image.crop_and_resize`` with bilinear sampling puts the corner samples on the corners of the crop; conversion
    back to bytes truncates ``x * 255.5``.
    """
    share = np.sqrt(np.float32(_CROPPED_AREA))
    near = (np.float32(1) - share) / np.float32(2)
    far = near + share
    unit = image.astype(np.float32) * np.float32(1 / 255)
    top, bottom, down = _crop_samples(image.shape[0], near, far)
    left, right, across = _crop_samples(image.shape[1], near, far)
    upper = _blend(unit[top][:, left], unit[top][:, right], across[None, :, None])
    lower = _blend(unit[bottom][:, left], unit[bottom][:, right], across[None, :, None])
    cropped = np.clip(_blend(upper, lower, down[:, None, None]), 0, 1)
    out: Picture = (cropped * np.float32(255.5)).astype(np.uint8)
    return out


def prepare(image: Picture, side: int) -> Picture:
    """One camera picture (H, W, 3) of any size to (side, side, 3), cropped as in evaluation.

    A picture that already has the size is only cropped: whoever resized it is taken to have done it this way.

    Raises:
        DependencyError: see :func:`through_jpeg`.
    """
    if image.shape[:2] != (side, side):
        image = round_to_bytes(lanczos_resize(through_jpeg(image), side))
    return center_crop(image)


@lru_cache(maxsize=8)
def _lanczos_weights(length: int, out: int) -> Floats:
    """(out, length) weights of the resize along one axis; source: TensorFlow's ``ComputeSpansCore``."""
    stride = np.float32(length) / np.float32(out)
    stretch = max(stride, np.float32(1))
    radius = np.float32(_LOBES) * stretch
    weights = np.zeros((out, length), np.float32)
    for row in range(out):
        middle = (np.float32(row) + np.float32(0.5)) * stride
        first = max(math.ceil(middle - radius - np.float32(0.5)), 0)
        last = min(math.floor(middle + radius - np.float32(0.5)), length - 1)
        where = np.arange(first, last + 1, dtype=np.float32) + np.float32(0.5) - middle
        span = _lanczos(np.abs(where / stretch))
        weights[row, first : last + 1] = span / span.sum(dtype=np.float32)
    weights.flags.writeable = False
    return weights


def _lanczos(x: Floats) -> Floats:
    angle = np.float32(math.pi) * x
    with np.errstate(divide="ignore", invalid="ignore"):
        lobes = np.float32(_LOBES)
        value = lobes * np.sin(angle) * np.sin(angle / lobes) / (angle * angle)
    return np.where(x > _LOBES, 0, np.where(x <= 1e-3, 1, value)).astype(np.float32)


def _crop_samples(
    length: int, near: np.float32, far: np.float32
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Neighbours of each sample along one axis, and how far it is from the first towards the second."""
    most = np.float32(length - 1)
    step = (far - near) * most / most
    where = near * most + np.arange(length, dtype=np.float32) * step
    first = np.floor(where)
    return first.astype(np.intp), np.ceil(where).astype(np.intp), where - first


def _blend(first: Floats, second: Floats, share: Floats) -> Floats:
    return first + (second - first) * share
