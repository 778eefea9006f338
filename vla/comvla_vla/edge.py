"""The robot's half: cameras to visual tokens, words to queries."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from comvla.errors import CheckpointError, InstructionError, ObservationError
from comvla.model_info import ModelInfo
from comvla_vla.config import ModelConfig
from comvla_vla.flops import edge_flops, vision_flops
from comvla_vla.nets import EdgeNet
from comvla_vla.preprocess import preprocess
from comvla_vla.prompt import Prompt
from comvla_vla.pruning import lightvla_scores
from comvla_vla.statistics import Statistics


class EdgeModel:
    """Vision towers, projector and text embedding of one policy, ready to run.

    Not thread-safe: one control loop, one edge model.

    Attributes:
        config: sizes. info: what the handshake compares. net: the torch module, in evaluation mode.
    """

    def __init__(
        self, net: EdgeNet, prompt: Prompt, info: ModelInfo, statistics: Statistics | None = None
    ) -> None:
        self.net = net.eval()
        self.config: ModelConfig = net.config
        self.info = info
        self.prompt = prompt
        self.statistics = statistics
        parameter = next(net.parameters())
        self.device, self.dtype = parameter.device, parameter.dtype

    @property
    def any_image_size(self) -> bool:
        """Whether pictures of any size will do, because pre-processing resizes them."""
        return self.config.preprocess == "openvla"

    @property
    def sees_instruction(self) -> bool:
        """Whether visual tokens depend on the instruction, so that :meth:`encode` has to be told it (FiLM)."""
        return self.config.film

    def preprocess(self, images: Sequence[NDArray[np.uint8]]) -> Tensor:
        """Camera views, each uint8 (H, W, 3) RGB, to (views, 3 * towers, S, S) float32.

        Raises:
            ObservationError: wrong number of views, type or shape.
        """
        return preprocess(images, self.config)

    @torch.inference_mode()
    def vision(self, pixels: Tensor, instruction: str | Sequence[int] | None = None) -> Tensor:
        """Pre-processed pixels (views, 3 * towers, S, S) to visual tokens (N, D) float32.

        Raises:
            InstructionError: the towers listen to the instruction (FiLM) and there is none.
        """
        language = self._language(instruction) if self.sees_instruction else None
        batch = pixels[None].to(self.device, self.dtype)
        tokens: Tensor = self.net.vision_backbone(batch, language)
        return tokens[0].float().cpu()

    def encode(
        self,
        images: Sequence[NDArray[np.uint8]],
        instruction: str | Sequence[int] | None = None,
    ) -> Tensor:
        """Camera views to visual tokens (N, D) float32: ``vision(preprocess(images))``.

        ``instruction`` (a sentence or its token ids) is used only where :attr:`sees_instruction`.
        """
        return self.vision(self.preprocess(images), instruction)

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

    @torch.inference_mode()
    def lightvla_scores(
        self, projected: Tensor, instruction: str | Sequence[int], proprio: NDArray[np.float32]
    ) -> Tensor:
        """LightVLA's scores (N, N) of projected tokens (N, d): row i votes for its largest column.

        Args:
            projected: from :meth:`project`, all N in order.
            instruction: a sentence, or its token ids.
            proprio: (P,) raw proprioception; LightVLA's choice depends on it.

        Raises:
            CheckpointError: this half was made without LightVLA's weights.
        """
        self._require("lightvla")
        words = self._words(instruction)
        rows = [words[1:-1], words.new_zeros(self.config.action.slots, words.shape[1]), words[-1:]]
        if self.config.action.proprio_dim:
            if self.statistics is None:
                raise ObservationError(
                    "this edge model was built without data-set statistics, LightVLA needs them to "
                    "normalise proprioception: load it with load_edge"
                )
            state = torch.from_numpy(self.statistics.normalise_proprio(proprio))
            rows.insert(0, self.net.proprio_projector(state.to(self.device, self.dtype))[None])
        return lightvla_scores(projected.to(self.device), torch.cat(rows)).cpu()

    @torch.inference_mode()
    def text_driven_scores(self, projected: Tensor, instruction: str | Sequence[int]) -> Tensor:
        """VLA-ADP's scores (N,) float32 of projected tokens (N, d), from the backbone's first layer.

        Raises:
            CheckpointError: this half was made without VLA-ADP's weights.
        """
        self._require("vla_adp")
        visual = projected.to(self.device, self.dtype)
        scores: Tensor = self.net.probe(self._words(instruction), visual)
        return scores.cpu()

    def flops(self, num_queries: int = 0) -> int:
        """Operations of one step on the robot: vision, projection, and votes of ``num_queries`` queries."""
        return edge_flops(self.config, num_queries)

    def vision_flops(self) -> int:
        """Operations of :meth:`encode` alone: the towers over all views."""
        return vision_flops(self.config)

    def _words(self, instruction: str | Sequence[int]) -> Tensor:
        """Embedded prompt with begin-of-sequence and stop (T + 1, d)."""
        ids = self.prompt.ids(instruction) if isinstance(instruction, str) else tuple(instruction)
        padded = torch.tensor([*ids, self.config.prompt.stop_id], device=self.device)
        words: Tensor = self.net.embed_tokens(padded)
        return words

    def _language(self, instruction: str | Sequence[int] | None) -> Tensor:
        """What FiLM towers hear: the mean embedding of the whole prompt (1, d)."""
        if instruction is None:
            raise InstructionError(
                f"the cameras of {self.config.name} listen to the instruction (FiLM), got none: "
                "pass it to encode"
            )
        return self._words(instruction).mean(dim=0, keepdim=True)

    def _require(self, pruner: str) -> None:
        if pruner not in self.config.edge_pruners:
            raise CheckpointError(
                f"this edge half of {self.config.name} holds no weights for {pruner!r}, it holds "
                f"{list(self.config.edge_pruners)}: split the published checkpoint again with that pruner"
            )
