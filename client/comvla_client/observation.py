"""Checks what a robot hands in before anything is computed or sent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from comvla.errors import InstructionError, ObservationError
from comvla.model_info import ModelInfo

Observation: TypeAlias = Mapping[str, Any]
"""``images``: list of uint8 (H, W, 3) RGB in the model's view order; ``proprio``: float (P,)."""


@dataclass(frozen=True)
class CheckedObservation:
    """An observation that fits the model.

    Attributes:
        images: contiguous uint8 (H, W, 3), one per view.
        proprio: (P,) finite float32; empty where the model takes none.
    """

    images: list[npt.NDArray[np.uint8]]
    proprio: npt.NDArray[np.float32]


def check_observation(
    obs: Observation, info: ModelInfo, *, any_size: bool = False
) -> CheckedObservation:
    """Checks and copies as little as possible.

    Args:
        obs: mapping with ``images`` and, where the model takes it, ``proprio``.
        info: what the model expects.
        any_size: the edge model resizes pictures itself.

    Raises:
        ObservationError: what was expected, what came, and the remedy.
    """
    if not isinstance(obs, Mapping):
        raise ObservationError(
            f"expected a mapping with images and proprio, got {type(obs).__name__}: "
            'pass {"images": [...], "proprio": ...}'
        )
    for key in ("images", "proprio") if info.proprio_dim else ("images",):
        if obs.get(key) is None:
            raise ObservationError(
                f"expected obs[{key!r}] ({info.name} needs it), got keys {sorted(map(str, obs))}: "
                "add it to the observation"
            )
    images = _check_images(obs["images"], info, any_size)
    proprio = obs["proprio"] if info.proprio_dim else ()
    return CheckedObservation(images=images, proprio=_check_proprio(proprio, info))


def check_instruction(instruction: str) -> str:
    """Refuses an instruction without words; the model itself judges its length and vocabulary.

    Raises:
        InstructionError: not a string, or blank.
    """
    if not isinstance(instruction, str):
        raise InstructionError(
            f"expected an instruction as str, got {type(instruction).__name__}: pass the sentence"
        )
    if not instruction.strip():
        raise InstructionError(
            f"expected an instruction in words, got {instruction!r}: without words nothing can vote"
        )
    return instruction


def _check_images(images: object, info: ModelInfo, any_size: bool) -> list[npt.NDArray[np.uint8]]:
    views, (height, width) = info.grid[0], info.image_size
    is_stack = isinstance(images, np.ndarray) and images.ndim == 4
    if not is_stack and (not isinstance(images, Sequence) or isinstance(images, (str, bytes))):
        raise ObservationError(
            f"expected obs['images'] as a list of {views} views (H, W, 3), got "
            f"{_describe(images)}: wrap a single picture in a list"
        )
    if len(images) != views:  # type: ignore[arg-type]
        raise ObservationError(
            f"expected {views} views ({info.name}), got {len(images)}: "  # type: ignore[arg-type]
            "pass one picture per camera, in the model's order"
        )
    checked = []
    for index, image in enumerate(images):  # type: ignore[arg-type, var-annotated]
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
            raise ObservationError(
                f"expected view {index} as a uint8 NumPy array in 0 to 255, got {_describe(image)}: "
                "convert it, e.g. (image * 255).round().astype(np.uint8) for floats in 0 to 1"
            )
        resizable = any_size and image.ndim == 3 and image.shape[2] == 3 and image.size > 0
        if image.shape != (height, width, 3) and not resizable:
            raise ObservationError(
                f"expected view {index} of shape ({height}, {width}, 3) ({info.name}), got "
                f"{image.shape}: resize it, put RGB last, and drop any alpha channel"
            )
        checked.append(np.ascontiguousarray(image))
    return checked


def _check_proprio(proprio: object, info: ModelInfo) -> npt.NDArray[np.float32]:
    try:
        values = np.asarray(proprio)
        if values.dtype.kind not in "fiu":
            raise TypeError(f"dtype {values.dtype}")
        with np.errstate(over="ignore"):
            values = values.astype(np.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ObservationError(
            f"expected obs['proprio'] as {info.proprio_dim} numbers ({info.name}), got "
            f"{_describe(proprio)} ({error}): pass a float array"
        ) from error
    if values.shape != (info.proprio_dim,):
        raise ObservationError(
            f"expected obs['proprio'] of shape ({info.proprio_dim},) ({info.name}), got "
            f"{values.shape}: pass the raw values in the order the model was trained with"
        )
    if not np.isfinite(values).all():
        raise ObservationError(
            f"expected finite obs['proprio'], got {values.tolist()}: check the joint encoders; "
            "a NaN must not steer a robot"
        )
    return values


def _describe(value: object) -> str:
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    described = type(value).__name__
    return described if shape is None else f"{described} {tuple(shape)} of {dtype}"
