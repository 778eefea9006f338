"""The robot's half: cameras to visual tokens, words to queries."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from comvla.model_info import ModelInfo
from numpy.typing import NDArray
from torch import Tensor

from comvla_vla.config import ModelConfig
from comvla_vla.flops import edge_flops
from comvla_vla.nets import EdgeNet
from comvla_vla.preprocess import preprocess
from comvla_vla.prompt import Prompt


class EdgeModel:
    """Vision towers, projector and text embedding of one policy, ready to run.

    Not thread-safe: one control loop, one edge model.

    Attributes:
        config: sizes. info: what the handshake compares. net: the torch module, in evaluation mode.
    """

    def __init__(self, net: EdgeNet, prompt: Prompt, info: ModelInfo) -> None:
        self.net = net.eval()
        self.config: ModelConfig = net.config
        self.info = info
        self.prompt = prompt
        parameter = next(net.parameters())
        self.device, self.dtype = parameter.device, parameter.dtype

    def preprocess(self, images: Sequence[NDArray[np.uint8]]) -> Tensor:
        """Camera views, each uint8 (H, W, 3) RGB, to (views, 3 * towers, S, S) float32.

        Raises:
            ObservationError: wrong number of views, type or shape.
        """
        return preprocess(images, self.config)

    @torch.inference_mode()
    def vision(self, pixels: Tensor) -> Tensor:
        """Pre-processed pixels (views, 3 * towers, S, S) to visual tokens (N, D) float32."""
        tokens: Tensor = self.net.vision_backbone(pixels[None].to(self.device, self.dtype))
        return tokens[0].float().cpu()

    def encode(self, images: Sequence[NDArray[np.uint8]]) -> Tensor:
        """Camera views to visual tokens (N, D) float32: ``vision(preprocess(images))``."""
        return self.vision(self.preprocess(images))

    @torch.inference_mode()
    def project(self, tokens: Tensor) -> Tensor:
        """All N tokens (N, D), in order, to the backbone's space (N, d) float32, where words and pixels meet."""
        projected: Tensor = self.net.projector(tokens.to(self.device, self.dtype))
        return projected.float().cpu()

    @torch.inference_mode()
    def text_queries(self, instruction: str) -> Tensor:
        """Language queries (Q, d) float32: every prompt token after begin-of-sequence votes.

        Raises:
            InstructionError: empty, too long, or with words that a closed vocabulary lacks.
        """
        ids = torch.tensor(self.prompt.ids(instruction)[1:], device=self.device)
        return self.net.queries(ids).float().cpu()

    def flops(self, num_queries: int = 0) -> int:
        """Operations of one step on the robot: vision, projection, and votes of ``num_queries`` queries."""
        return edge_flops(self.config, num_queries)
