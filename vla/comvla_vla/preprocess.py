"""Camera pictures to normalised pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from comvla.errors import ObservationError
from comvla_vla import tf_images
from comvla_vla.config import ModelConfig, TowerConfig


def check_images(
    images: Sequence[NDArray[np.uint8]], config: ModelConfig
) -> list[NDArray[np.uint8]]:
    """The views, each (H, W, 3), after checking number, type and shape.

    Raises:
        ObservationError: naming what was expected, what came, and which view it was.
    """
    side = config.towers[0].image_size
    if len(images) != config.views:
        raise ObservationError(
            f"{config.name} expects {config.views} camera views, got {len(images)}"
        )
    for i, image in enumerate(images):
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
            kind = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
            raise ObservationError(
                f"view {i}: expected a uint8 array of shape (H, W, 3), RGB, got {kind}"
            )
        if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
            raise ObservationError(
                f"view {i}: expected a picture (H, W, 3), RGB, got {image.shape}"
            )
        if config.preprocess == "exact" and image.shape[:2] != (side, side):
            raise ObservationError(
                f"view {i}: {config.name} expects ({side}, {side}, 3) pixels, got {image.shape}: resize the picture"
            )
    return list(images)


def normalise(pixels: Tensor, towers: Sequence[TowerConfig]) -> Tensor:
    """uint8 (..., H, W, 3) to float32 (..., 3 * towers, H, W), each tower with its own mean and deviation."""
    unit = pixels.movedim(-1, -3).float() / 255
    parts = []
    for tower in towers:
        mean = torch.tensor(tower.mean, device=pixels.device)[:, None, None]
        std = torch.tensor(tower.std, device=pixels.device)[:, None, None]
        parts.append((unit - mean) / std)
    return torch.cat(parts, dim=-3)


def preprocess(images: Sequence[NDArray[np.uint8]], config: ModelConfig) -> Tensor:
    """Camera views, uint8 (H, W, 3) RGB each, to (views, 3 * towers, S, S) float32.

    Raises:
        ObservationError: see :func:`check_images`.
        DependencyError: OpenVLA's pre-processing needs packages that are not installed.
    """
    views = check_images(images, config)
    if config.preprocess == "openvla":
        side = config.towers[0].image_size
        views = [tf_images.prepare(view, side) for view in views]
    stacked = np.stack([np.ascontiguousarray(view) for view in views])
    return normalise(torch.from_numpy(stacked), config.towers)
