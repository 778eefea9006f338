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
from comvla_vla.heads import ActionHead, ProprioProjector
from comvla_vla.vision import Projector, VisionBackbone


class EdgeNet(nn.Module):
    """Vision towers, projector and language queries."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.vision_backbone = VisionBackbone(config)
        self.projector = Projector(config)
        per_token = config.prompt.queries_per_token
        if per_token == 1:
            self.embed_tokens = nn.Embedding(config.backbone.vocab, config.backbone.hidden)
        else:
            self.query_embed = nn.Embedding(
                config.backbone.vocab, per_token * config.backbone.hidden
            )

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
        self.action_head = ActionHead(hidden, config.action)

    def forward(
        self,
        projected: Sequence[Tensor],
        positions: Sequence[Tensor],
        prompts: Sequence[Tensor],
        proprio: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Runs a batch of sequences of any mixture of lengths.

        Each sequence is ``[BOS | K visual | proprio | text | H * A action placeholders | stop]``.

        Args:
            projected: per request (K, d) projected visual tokens.
            positions: per request (K,) positions 0 .. N-1 in the unpruned sequence.
            prompts: per request (T,) prompt ids, begin-of-sequence first.
            proprio: (B, P) normalised proprioception, None where the model takes none.

        Returns:
            Normalised actions (B, H, A) and the final hidden state of each BOS (B, d).
        """
        text = [self.embed_tokens(ids) for ids in prompts]
        tail = self._tail(text[0])
        nothing = [tail[:0]] * len(text)
        state = (
            nothing if proprio is None else self.proprio_projector(proprio).unsqueeze(1).unbind(0)
        )
        rows, where = [], []
        for visual, at, words, body in zip(projected, positions, text, state, strict=True):
            rows.append(torch.cat([words[:1], visual, body, words[1:], tail]))
            # Tokens after the visual ones keep the place they had behind all N of them.
            after = 1 + self.config.num_tokens
            rest = torch.arange(after, after + len(rows[-1]) - 1 - len(at), device=at.device)
            where.append(torch.cat([at.new_zeros(1), at + 1, rest]))
        order = sorted(range(len(rows)), key=lambda i: len(rows[i]))
        lengths = [len(rows[i]) for i in order]
        hidden = self.backbone(
            torch.cat([rows[i] for i in order]), torch.cat([where[i] for i in order]), lengths
        ).split(lengths)
        hidden = [hidden[place] for place in sorted(range(len(order)), key=order.__getitem__)]
        stop = len(tail) - self.config.action.first_slot
        slots = torch.stack([h[len(h) - stop :][: self.config.action.slots] for h in hidden])
        return self.action_head(slots), torch.stack([h[0] for h in hidden])

    def _tail(self, like: Tensor) -> Tensor:
        """Action placeholders and stop token (H * A + 1, d)."""
        action, stop_id = self.config.action, self.config.prompt.stop_id
        if action.learned_placeholders:
            placeholders = self.placeholders.to(like.dtype)
        else:
            placeholders = like.new_zeros(action.slots, like.shape[-1])
        stop = self.embed_tokens(torch.tensor([stop_id], device=like.device))
        return torch.cat([placeholders, stop])


def join(config: ModelConfig) -> tuple[EdgeNet, CloudNet]:
    """Both halves of one undivided model: what stands in both is one module. For training and for comparisons."""
    edge, cloud = EdgeNet(config), CloudNet(config)
    cloud.projector = edge.projector
    if config.prompt.queries_per_token == 1:
        edge.embed_tokens = cloud.embed_tokens
    return edge, cloud
