"""The training loss: imitation of the expert's chunk, and the two auxiliary terms that make a small policy see.

Selection happens inside the forward pass as it will at run time (hard votes, Eq. 3), with a number of tokens drawn
anew at each step, so the policy is at home at every K.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from comvla_sim.training.grounding import grounding_targets
from comvla_vla.nets import CloudNet, EdgeNet
from comvla_vla.preprocess import normalise

# Centre and scale of the hand, object and goal positions (metres) that the auxiliary head predicts.
_CENTRE, _SCALE = (0.0, 0.65, 0.15), (0.2, 0.1, 0.08)


@dataclass(frozen=True)
class Batch:
    """Pictures, each under ``per_picture`` instructions.

    Attributes:
        images: (B, views, H, W, 3) uint8. proprio: (P, 4) normalised, P = B * per_picture pairs.
        prompts: (P, T) ids, begin-of-sequence first, padded with -1. wanted: (P, Q, 2) kind and view of each query.
        chunks: (P, H, A) expert actions. points: (P, 4, 3) metres. uv: (P, views, 4, 2) in [0, 1].
    """

    images: Tensor
    proprio: Tensor
    prompts: Tensor
    wanted: Tensor
    chunks: Tensor
    points: Tensor
    uv: Tensor


@dataclass(frozen=True)
class Weights:
    """How much each auxiliary term counts beside the action loss."""

    state: float = 0.2
    attention: float = 0.1
    matching: float = 0.05


class Learner(nn.Module):
    """Both halves with what only training needs: the state head.

    Attributes:
        edge, cloud: the halves, sharing their projector.
    """

    def __init__(self, edge: EdgeNet, cloud: CloudNet) -> None:
        super().__init__()
        self.edge, self.cloud = edge, cloud
        self.state = nn.Linear(cloud.config.backbone.hidden, 9)

    def forward(
        self, batch: Batch, k: int, selection: str, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Loss terms (scalars) with ``k`` tokens kept by ``selection`` (``votes`` or ``random``)."""
        config = self.cloud.config
        per_picture = len(batch.prompts) // len(batch.images)
        pixels = normalise(batch.images, config.towers)
        projected = self.edge.projector(self.edge.vision_backbone(pixels))
        projected = projected.repeat_interleave(per_picture, 0)
        there = batch.prompts >= 0
        ids = batch.prompts.clamp(min=0)
        voters = there[:, 1:].repeat_interleave(config.prompt.queries_per_token, 1)
        logits, matching = score(self.edge.queries(ids[:, 1:]), projected)
        if k >= config.num_tokens:
            keep = torch.arange(config.num_tokens).expand(len(ids), -1)
        elif selection == "random":
            keep = torch.rand(len(ids), config.num_tokens, generator=generator).topk(k).indices
        else:
            keep = voted(logits.detach(), matching.detach(), voters, k)
        visual = projected.gather(1, keep[..., None].expand(-1, -1, projected.shape[-1]))
        prompts = [row[mask] for row, mask in zip(ids, there, strict=True)]
        actions, start = self.cloud(visual.unbind(0), keep.unbind(0), prompts, batch.proprio)
        return {
            "action": (actions.float() - batch.chunks).abs().mean(),
            "state": F.smooth_l1_loss(self.state(start).float(), state_targets(batch.points)),
            **self._grounding(batch, logits, matching, voters),
        }

    def _grounding(
        self, batch: Batch, logits: Tensor, matching: Tensor, voters: Tensor
    ) -> dict[str, Tensor]:
        config = self.cloud.config
        targets = grounding_targets(batch.uv, batch.wanted, config.grid) * voters[..., None]
        count = voters.sum()
        scale = math.sqrt(config.backbone.hidden)
        return {
            "attention": -(targets * logits.float().log_softmax(-1)).sum() / count,
            "matching": -(targets * (matching.float() / scale).log_softmax(-1)).sum() / count,
        }


def score(queries: Tensor, tokens: Tensor) -> tuple[Tensor, Tensor]:
    """Attention logits and matching scores of Eq. (3), both (B, Q, N), for (B, Q, d) queries and (B, N, d) tokens."""
    logits = queries @ tokens.mT / math.sqrt(tokens.shape[-1])
    gathered = logits.softmax(-1) @ tokens
    return logits, gathered @ tokens.mT


def voted(logits: Tensor, matching: Tensor, voters: Tensor, k: int) -> Tensor:
    """The k tokens with most hard votes, ties broken by summed attention: positions (B, k).

    Args:
        logits, matching: (B, Q, N). voters: (B, Q) False for padding, which has no vote.
        k: tokens to keep.
    """
    ballots = voters.float()
    favourite = matching.argmax(-1)
    votes = torch.zeros(len(ballots), logits.shape[-1]).scatter_add_(1, favourite, ballots)
    attention = (logits.float().softmax(-1) * ballots[..., None]).sum(1)
    # Below one vote whatever the sum, so attention only orders tokens with equal votes.
    tie_break = 0.5 * attention / (attention.amax(-1, keepdim=True) + 1e-6)
    return (votes + tie_break).topk(k).indices


def state_targets(points: Tensor) -> Tensor:
    """Hand, object and goal positions (B, 4, 3) in metres to nine centred values (B, 9)."""
    centred = (points - points.new_tensor(_CENTRE)) / points.new_tensor(_SCALE)
    return centred[:, :3].flatten(1)
