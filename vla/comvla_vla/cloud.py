"""The server's half: pruned tokens to a chunk of actions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from comvla.errors import ObservationError
from comvla.model_info import ModelInfo
from comvla_vla.config import ModelConfig
from comvla_vla.flops import cloud_flops
from comvla_vla.nets import CloudNet
from comvla_vla.options import CloudOptions
from comvla_vla.prompt import Prompt
from comvla_vla.request import PolicyRequest
from comvla_vla.statistics import Statistics


class CloudModel:
    """Projector, backbone and action head of one policy, ready to run.

    Attributes:
        config: sizes. info: what the handshake compares. net: the torch module, in evaluation mode.
        statistics: how proprioception is normalised and actions un-normalised.
        options: how it is run.
    """

    def __init__(
        self,
        net: CloudNet,
        prompt: Prompt,
        statistics: Statistics,
        info: ModelInfo,
        options: CloudOptions | None = None,
    ) -> None:
        self.net = net.eval()
        self.config: ModelConfig = net.config
        self.info = info
        self.prompt = prompt
        self.statistics = statistics
        self.options = options if options is not None else CloudOptions()
        parameter = next(net.parameters())
        self.device, self.dtype = parameter.device, parameter.dtype
        if self.options.compile:
            net.backbone.compile_rows()

    def with_options(self, options: CloudOptions) -> CloudModel:
        """The same weights run another way; both may be used."""
        return CloudModel(self.net, self.prompt, self.statistics, self.info, options)

    @property
    def run_options(self) -> tuple[str, ...]:
        """How it is run where that changes answers: ``"dtype=bfloat16"``, ``"compact_positions"``, …"""
        dtype = str(self.dtype).removeprefix("torch.")
        return (*([] if dtype == "float32" else [f"dtype={dtype}"]), *self.options.describe())

    def check_instruction(self, instruction: str) -> None:
        """Raises InstructionError where :meth:`predict` would."""
        self.prompt.ids(instruction)

    @torch.inference_mode()
    def predict(self, requests: Sequence[PolicyRequest]) -> list[NDArray[np.float32]]:
        """Finishes the forward pass of a batch with any mixture of K.

        Rows are packed without padding, so a request's answer does not depend on who shared the batch beyond the
        rounding of a larger matrix product.

        Args:
            requests: at least one; positions within 0 .. N-1.

        Returns:
            For each request its un-normalised actions (H, A) float32.

        Raises:
            InstructionError, ObservationError: a request that this model cannot read.
        """
        if not requests:
            return []
        positions = [self._positions(r) for r in requests]
        tokens = [torch.as_tensor(r.tokens).to(self.device, self.dtype) for r in requests]
        sizes = [len(t) for t in tokens]
        projected = self.net.projector(torch.cat(tokens), torch.cat(positions)).split(sizes)
        prompts = [torch.tensor(self._ids(r.instruction), device=self.device) for r in requests]
        proprio = self._proprio(requests)
        if self.config.action.head == "diffusion":
            noise = self._noise().expand(len(requests), -1, -1)
            actions = self.net.denoise(projected, positions, prompts, proprio, noise, self.options)
        else:
            actions, _ = self.net(projected, positions, prompts, proprio, self.options)
        return list(self.statistics.unnormalise_actions(actions.float().cpu().numpy()))

    def flops(self, num_tokens: int, instruction: str | Sequence[int]) -> int:
        """Operations of one request with ``num_tokens`` visual tokens."""
        prompt_tokens = len(self._ids(instruction))
        return cloud_flops(self.config, num_tokens, prompt_tokens, self.options.fastv)

    def _noise(self) -> Tensor:
        """Where denoising starts (1, H, A): the same for every request, so that a retry gets the same answer."""
        action = self.config.action
        generator = torch.Generator().manual_seed(self.options.noise_seed)
        shape = (1, action.horizon, action.action_dim)
        return torch.randn(shape, generator=generator).to(self.device)

    def _ids(self, instruction: str | Sequence[int]) -> Sequence[int]:
        return self.prompt.ids(instruction) if isinstance(instruction, str) else list(instruction)

    def _positions(self, request: PolicyRequest) -> Tensor:
        at = torch.as_tensor(request.positions).to(self.device, torch.long)
        k, dim, n = len(request.tokens), self.config.token_dim, self.config.num_tokens
        if request.tokens.shape != (k, dim) or at.shape != (k,) or not k:
            raise ObservationError(
                f"{self.config.name} expects tokens (K, {dim}) with K positions and K > 0, "
                f"got {tuple(request.tokens.shape)} and {tuple(at.shape)}"
            )
        if int(at.min()) < 0 or int(at.max()) >= n:
            raise ObservationError(
                f"positions must lie in 0 .. {n - 1}, got {int(at.min())} .. {int(at.max())}: "
                "they index the unpruned sequence"
            )
        return at

    def _proprio(self, requests: Sequence[PolicyRequest]) -> Tensor | None:
        width = self.config.action.proprio_dim
        if not width:
            return None
        rows = []
        for request in requests:
            if request.proprio is None or np.shape(request.proprio) != (width,):
                came = "none" if request.proprio is None else str(np.shape(request.proprio))
                raise ObservationError(
                    f"{self.config.name} expects proprioception of shape ({width},), got {came}"
                )
            rows.append(self.statistics.normalise_proprio(request.proprio))
        return torch.from_numpy(np.stack(rows)).to(self.device, self.dtype)
