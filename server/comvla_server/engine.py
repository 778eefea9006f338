"""The cloud half of a model, as the server sees it: plain calls, no queue, no network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from comvla import handshake
from comvla.errors import HandshakeError
from comvla.model_info import ModelInfo
from comvla_server.calibration import calibrate
from comvla_server.cost_model import CostModel
from comvla_server.vision import Vision
from comvla_vla.request import AnyRequest, ImageRequest, PolicyRequest

# Id 1 begins a sequence in every vocabulary that this project builds or loads.
_BOS_ID = 1


class CloudHalf(Protocol):
    """What :class:`Engine` needs of a model; :class:`comvla_vla.CloudModel` has it."""

    @property
    def info(self) -> ModelInfo:
        """Description of the model."""

    def predict(self, requests: list[PolicyRequest]) -> list[NDArray[np.float32]]:
        """One (H, A) chunk of un-normalised actions for each request."""

    def flops(self, num_tokens: int, instruction: str | Sequence[int]) -> float:
        """Multiply-adds counted twice for one request of K tokens."""

    def check_instruction(self, instruction: str) -> object:
        """Raises :class:`comvla.errors.InstructionError` where the model cannot read it."""


class ModelOutputError(RuntimeError):
    """The model returned something that must not reach a robot."""


class Engine:
    """Runs the cloud half and vouches for what comes out of it.

    Args:
        cloud: the cloud half.
        vision: the vision half of the same model, for robots that send pictures; None reads tokens only.
        edge_identity: digest over the edge half that goes with it, where the checkpoint says.

    Attributes:
        info: description of the model.
        vision, edge_identity: as given.
        costs: what forward passes take, learned from the warm-up on.

    Raises:
        HandshakeError: vision and cloud half are of different models.
    """

    def __init__(
        self, cloud: CloudHalf, vision: Vision | None = None, edge_identity: str | None = None
    ) -> None:
        self._cloud = cloud
        self.info = cloud.info
        self.vision = vision
        self.costs = CostModel()
        self.edge_identity = edge_identity
        if vision is not None:
            difference = handshake.mismatch(vision.info, cloud.info)
            if difference is not None:
                raise HandshakeError(f"vision and cloud half are of different models: {difference}")

    @property
    def image_codings(self) -> tuple[str, ...]:
        """Picture codings that are read."""
        return () if self.vision is None else tuple(self.vision.decoders)

    @property
    def run_options(self) -> tuple[str, ...]:
        """How the model is run where that changes answers; empty for models that do not say."""
        return tuple(getattr(self._cloud, "run_options", ()))

    def predict(self, requests: Sequence[AnyRequest]) -> list[NDArray[np.float32]]:
        """Actions for a batch of requests, whose numbers of tokens may differ; pictures are looked at first.

        Args:
            requests: at least one.

        Returns:
            One float32 array (H, A) per request, in order.

        Raises:
            ModelOutputError: wrong number of chunks, a wrong shape, or a value that is not finite.
        """
        chunks = self._cloud.predict([self._seen(request) for request in requests])
        if len(chunks) != len(requests):
            raise ModelOutputError(
                f"the model answered {len(chunks)} chunks to {len(requests)} requests"
            )
        expected = (self.info.action_horizon, self.info.action_dim)
        actions = [np.asarray(chunk, dtype=np.float32) for chunk in chunks]
        for chunk in actions:
            if chunk.shape != expected:
                raise ModelOutputError(
                    f"the model answered shape {chunk.shape}, expected {expected}"
                )
            if not np.isfinite(chunk).all():
                raise ModelOutputError("the model answered actions that are not finite")
        return actions

    def num_tokens(self, request: AnyRequest) -> int:
        """Visual tokens that the backbone gets for this request: those that came, or all of a picture's."""
        if isinstance(request, ImageRequest):
            return self.info.num_tokens
        return len(request.positions)

    def flops(self, request: AnyRequest) -> float:
        """Multiply-adds counted twice that this request costs here: vision too where pictures came."""
        seen = 0.0
        if isinstance(request, ImageRequest) and self.vision is not None:
            seen = float(self.vision.flops(request))
        return seen + float(self._cloud.flops(self.num_tokens(request), request.instruction))

    def check_instruction(self, instruction: str) -> None:
        """Asks the model's own prompt code.

        Raises:
            InstructionError: the model cannot read it.
        """
        self._cloud.check_instruction(instruction)

    def warm_up(self, max_batch: int) -> None:
        """Runs the model once alone and once at the largest batch, so that no robot waits for it.

        Observations are unpruned, so this is also the memory peak: a GPU that cannot hold it fails
        here, before the server says that it is ready. Then a few passes teach it what they cost.
        """
        for size in sorted({1, max_batch}):
            self.predict([self.blank_request(self.info.num_tokens)] * size)
            if self.vision is not None:
                self.predict([self._blank_pictures()] * size)
        calibrate(self, max_batch, self.costs)

    def _seen(self, request: AnyRequest) -> PolicyRequest:
        """All tokens of a request's pictures; one that brings tokens as it is."""
        if not isinstance(request, ImageRequest):
            return request
        if self.vision is None:
            raise ModelOutputError("pictures came, and there is no vision half to look at them")
        return PolicyRequest(
            tokens=self.vision.encode(request.images, request.instruction),
            positions=np.arange(self.info.num_tokens, dtype=np.int32),
            instruction=request.instruction,
            proprio=request.proprio,
        )

    def _blank_pictures(self) -> ImageRequest:
        blank, info = self.blank_request(1), self.info
        images = [np.zeros((*info.image_size, 3), np.uint8)] * info.grid[0]
        return ImageRequest(images, blank.instruction, blank.proprio)

    def blank_request(self, num_tokens: int, prompt_tokens: int = 16) -> PolicyRequest:
        """A request of the right shapes without meaning, for warm-up and cost.

        Args:
            num_tokens: K, 1 to N.
            prompt_tokens: length of the prompt, cut to what the model reads.
        """
        info = self.info
        return PolicyRequest(
            tokens=np.zeros((num_tokens, info.token_dim), np.float32),
            positions=np.arange(num_tokens, dtype=np.int32),
            instruction=[_BOS_ID] * min(prompt_tokens, info.max_prompt_tokens),
            proprio=np.zeros(info.proprio_dim, np.float32) if info.proprio_dim else None,
        )
