"""The two halves as torch modules.

``EdgeNet`` and ``CloudNet`` each hold only what they need; the projector and the text embedding stand in both
(the edge scores in the backbone's space, the cloud projects what arrives). Training joins them by sharing those.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from comvla_vla.backbone import Backbone
from comvla_vla.config import ModelConfig
from comvla_vla.diffusion import denoise_step, level_embedding, noise_levels, signal_levels
from comvla_vla.heads import ActionHead, ProprioProjector
from comvla_vla.options import CloudOptions
from comvla_vla.pruning import TextProbe
from comvla_vla.vision import Projector, VisionBackbone


class EdgeNet(nn.Module):
    """Vision towers, projector, language queries, and what other pruners need on the robot."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.vision_backbone = VisionBackbone(config)
        self.projector = Projector(config)
        hidden, per_token = config.backbone.hidden, config.prompt.queries_per_token
        if per_token == 1:
            self.embed_tokens = nn.Embedding(config.backbone.vocab, hidden)
        else:
            self.query_embed = nn.Embedding(config.backbone.vocab, per_token * hidden)
        if "lightvla" in config.edge_pruners and config.action.proprio_dim:
            self.proprio_projector = ProprioProjector(config.action.proprio_dim, hidden)
        if "vla_adp" in config.edge_pruners:
            self.probe = TextProbe(config.backbone)

    def queries(self, ids: Tensor) -> Tensor:
        """Language queries (..., Q, d) for prompt ids (..., T) without begin-of-sequence; Q = T * queries_per_token."""
        if self.config.prompt.queries_per_token == 1:
            words: Tensor = self.embed_tokens(ids)
            return words
        table: Tensor = self.query_embed(ids)
        hidden = self.config.backbone.hidden
        return table.view(*ids.shape[:-1], -1, hidden)


class CloudNet(nn.Module):
    """Projector, text embedding, proprioception, backbone and action head."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        hidden = config.backbone.hidden
        self.projector = Projector(config)
        self.embed_tokens = nn.Embedding(config.backbone.vocab, hidden)
        self.backbone = Backbone(config.backbone)
        if config.action.proprio_dim:
            self.proprio_projector = ProprioProjector(config.action.proprio_dim, hidden)
        if config.action.learned_placeholders:
            self.placeholders = nn.Parameter(torch.randn(config.action.slots, hidden))
        if config.action.head == "diffusion":
            self.noise_predictor = ActionHead(hidden, config.action)
            self.noisy_action_projector = ProprioProjector(1, hidden)
        else:
            self.action_head = ActionHead(hidden, config.action)

    def forward(
        self,
        projected: Sequence[Tensor],
        positions: Sequence[Tensor],
        prompts: Sequence[Tensor],
        proprio: Tensor | None,
        options: CloudOptions | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Runs a batch of sequences of any mixture of lengths through an L1 head.

        Each sequence is ``[BOS | K visual | proprio | text | H * A action placeholders | stop]``.

        Args:
            projected: per request (K, d) projected visual tokens.
            positions: per request (K,) positions 0 .. N-1 in the unpruned sequence.
            prompts: per request (T,) prompt ids, begin-of-sequence first.
            proprio: (B, P) normalised proprioception, None where the model takes none.
            options: how to run; the configuration's way by default.

        Returns:
            Normalised actions (B, H, A) and the final hidden state of each BOS (B, d).
        """
        text = [self.embed_tokens(ids) for ids in prompts]
        state = self._state(proprio, text)
        slots = [self._placeholders(text[0])] * len(text)
        hidden, first = self._hidden(projected, positions, text, state, slots, options)
        return self.action_head(hidden), first

    def denoise(
        self,
        projected: Sequence[Tensor],
        positions: Sequence[Tensor],
        prompts: Sequence[Tensor],
        proprio: Tensor | None,
        noise: Tensor,
        options: CloudOptions | None = None,
    ) -> Tensor:
        """Runs a batch through a diffusion head, once for every noise level.

        The sequence holds one more token, the noise level behind proprioception.

        Args:
            projected, positions, prompts, proprio, options: as in :meth:`forward`.
            noise: (B, H, A) float32 where denoising starts.

        Returns:
            Normalised actions (B, H, A) float32.
        """
        action = self.config.action
        text = [self.embed_tokens(ids) for ids in prompts]
        state = self._state(proprio, text)
        signal = signal_levels(action.diffusion_train_steps).to(noise.device)
        sample = noise
        for level in noise_levels(action):
            when = level_embedding(level, self.config.backbone.hidden, text[0])
            noisy = self.noisy_action_projector(sample.reshape(len(text), -1, 1).to(when.dtype))
            hidden, _ = self._hidden(
                projected,
                positions,
                text,
                [torch.cat([body, when]) for body in state],
                list(noisy),
                options,
            )
            predicted = self.noise_predictor(hidden).float()
            sample = denoise_step(sample, predicted, level, action, signal)
        return sample

    def _hidden(
        self,
        projected: Sequence[Tensor],
        positions: Sequence[Tensor],
        text: Sequence[Tensor],
        state: Sequence[Tensor],
        slots: Sequence[Tensor],
        options: CloudOptions | None,
    ) -> tuple[Tensor, Tensor]:
        """Final hidden states of the action slots (B, H * A, d) and of BOS (B, d)."""
        options = options if options is not None else CloudOptions()
        stop = self._stop(text[0])
        rows, where = [], []
        for visual, at, words, body, slot in zip(
            projected, positions, text, state, slots, strict=True
        ):
            rows.append(torch.cat([words[:1], visual, body, words[1:], slot, stop]))
            # Tokens after the visual ones keep the place they had behind all N of them.
            after = 1 + (len(at) if options.compact_positions else self.config.num_tokens)
            if options.compact_positions:
                at = at.argsort().argsort()
            rest = torch.arange(after, after + len(rows[-1]) - 1 - len(at), device=at.device)
            where.append(torch.cat([at.new_zeros(1), at + 1, rest]))
        order = sorted(range(len(rows)), key=lambda i: len(rows[i]))
        packed, lengths = self.backbone(
            torch.cat([rows[i] for i in order]),
            torch.cat([where[i] for i in order]),
            [len(rows[i]) for i in order],
            [len(projected[i]) for i in order],
            options.fastv,
        )
        sorted_hidden = packed.split(lengths)
        hidden = [
            sorted_hidden[place] for place in sorted(range(len(order)), key=order.__getitem__)
        ]
        first_slot = self.config.action.first_slot
        if options.first_slot is not None:
            first_slot = options.first_slot
        from_end = self.config.action.slots + 1 - first_slot
        read = [h[len(h) - from_end :][: self.config.action.slots] for h in hidden]
        return torch.stack(read), torch.stack([h[0] for h in hidden])

    def _state(self, proprio: Tensor | None, text: Sequence[Tensor]) -> list[Tensor]:
        """Proprioception as tokens, one (1, d) or (0, d) for each request."""
        if proprio is None:
            return [words[:0] for words in text]
        return list(self.proprio_projector(proprio).unsqueeze(1).unbind(0))

    def _placeholders(self, like: Tensor) -> Tensor:
        """What stands where actions will be read (H * A, d)."""
        if self.config.action.learned_placeholders:
            return self.placeholders.to(like.dtype)
        return like.new_zeros(self.config.action.slots, like.shape[-1])

    def _stop(self, like: Tensor) -> Tensor:
        """The stop token (1, d)."""
        stop_id = torch.tensor([self.config.prompt.stop_id], device=like.device)
        out: Tensor = self.embed_tokens(stop_id)
        return out


def join(config: ModelConfig) -> tuple[EdgeNet, CloudNet]:
    """Both halves of one undivided model: what stands in both is one module. For training and for comparisons."""
    edge, cloud = EdgeNet(config), CloudNet(config)
    cloud.projector = edge.projector
    if config.prompt.queries_per_token == 1:
        edge.embed_tokens = cloud.embed_tokens
    if hasattr(edge, "proprio_projector"):
        edge.proprio_projector = cloud.proprio_projector
    if hasattr(edge, "probe"):
        edge.probe.copy_from(cloud.backbone)
    return edge, cloud
