"""The vision half in the cloud, for robots that send pictures instead of tokens."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from comvla.model_info import ModelInfo
from comvla_server.image_decoders import ImageDecoder, available_decoders
from comvla_vla.request import ImageRequest

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from comvla_vla import CloudModel, EdgeModel

_log = logging.getLogger(__name__)


class Vision(Protocol):
    """What the server needs in order to look at pictures.

    Attributes:
        decoders: by name of the coding (:data:`comvla.images.IMAGE_CODINGS`), those that are read.
    """

    @property
    def info(self) -> ModelInfo:
        """Description of the model; the cloud half must have the same."""

    @property
    def any_image_size(self) -> bool:
        """Whether pictures of any size will do."""

    @property
    def decoders(self) -> Mapping[str, ImageDecoder]: ...

    def encode(
        self, images: Sequence[NDArray[np.uint8]], instruction: str | Sequence[int]
    ) -> NDArray[np.float32] | Tensor:
        """All visual tokens (N, D) of the views."""

    def flops(self, request: ImageRequest) -> float:
        """Multiply-adds counted twice of :meth:`encode`."""


class VisionHalf:
    """An edge model that works in the cloud.

    Args:
        edge: the robot's half; only its towers are used.
        decoders: what turns bytes into pictures, by coding; all that are installed by default.
    """

    def __init__(self, edge: EdgeModel, decoders: Mapping[str, ImageDecoder] | None = None) -> None:
        self._edge = edge
        self.info = edge.info
        self.decoders = available_decoders() if decoders is None else decoders

    @property
    def any_image_size(self) -> bool:
        """Whether pictures of any size will do."""
        return self._edge.any_image_size

    @property
    def weight_bytes(self) -> int:
        """Memory of the towers' weights, which a server without vision saves."""
        towers = self._edge.net.vision_backbone
        return sum(p.numel() * p.element_size() for p in towers.parameters())

    def encode(
        self, images: Sequence[NDArray[np.uint8]], instruction: str | Sequence[int]
    ) -> Tensor:
        """All visual tokens (N, D) float32 of the views."""
        return self._edge.encode(images, instruction)

    def flops(self, request: ImageRequest) -> float:
        """Multiply-adds counted twice of the towers over all views."""
        return float(self._edge.vision_flops())

    def keep_decoders(self, before: Vision) -> None:
        """Goes on with the decoders of the vision half that this one replaces."""
        self.decoders = before.decoders


def load_vision(
    source: str,
    cloud: CloudModel,
    device: str = "cpu",
    dtype: torch.dtype | None = None,
    statistics_key: str | None = None,
) -> VisionHalf:
    """The vision half of a checkpoint beside its cloud half. What stands in both is held once.

    Args:
        source: the cloud half's own source, whole or an edge half.
        cloud: the loaded cloud half.
        device: torch device.
        dtype: of weights and arithmetic; the cloud half's by default.
        statistics_key: as for the cloud half.

    Raises:
        CheckpointError: missing, damaged, foreign, or without an edge half.
    """
    from comvla_vla import load_edge

    edge = load_edge(source, device, cloud.dtype if dtype is None else dtype, statistics_key)
    edge.net.projector = cloud.net.projector
    if hasattr(edge.net, "embed_tokens"):
        edge.net.embed_tokens = cloud.net.embed_tokens
    vision = VisionHalf(edge)
    _log.info(
        "vision half loaded: %.1f MB of weights, reads %s",
        vision.weight_bytes / 1e6,
        ", ".join(vision.decoders) or "no pictures: pip install 'comvla[images]'",
    )
    return vision


def holds_whole(source: str) -> bool:
    """Whether a checkpoint on this machine holds both halves; a hub's is not fetched to find out."""
    from comvla.errors import CheckpointError
    from comvla_vla.checkpoints import locate, open_checkpoint

    try:
        return open_checkpoint(locate(source), "any").half == "whole"
    except CheckpointError:
        return False
