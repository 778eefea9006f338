"""The L1 action head and the proprioception projector, as OpenVLA-OFT publishes them."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from comvla_vla.config import ActionConfig
from comvla_vla.linear import Linear


class ResidualBlock(nn.Module):
    """x + ReLU(Linear(LayerNorm(x))). The layers sit in a list named ``ffn`` as in the checkpoints."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.ffn = nn.Sequential(nn.LayerNorm(dim), Linear(dim, dim), nn.ReLU())

    def forward(self, x: Tensor) -> Tensor:
        """(..., dim) to (..., dim)."""
        out: Tensor = x + self.ffn(x)
        return out


class ActionHead(nn.Module):
    """Hidden states of the action slots to normalised actions, trained with an L1 loss."""

    def __init__(self, hidden: int, config: ActionConfig) -> None:
        super().__init__()
        self.config = config
        width = hidden * config.action_dim
        self.layer_norm1 = nn.LayerNorm(width)
        self.fc1 = Linear(width, config.head_hidden)
        self.mlp_resnet_blocks = nn.ModuleList(
            ResidualBlock(config.head_hidden) for _ in range(config.head_blocks)
        )
        self.layer_norm2 = nn.LayerNorm(config.head_hidden)
        self.fc2 = Linear(config.head_hidden, config.action_dim)

    def forward(self, slots: Tensor) -> Tensor:
        """(B, H * A, d) hidden states to (B, H, A) normalised actions; no tanh, no clipping."""
        x = slots.reshape(len(slots), self.config.horizon, -1)
        x = F.relu(self.fc1(self.layer_norm1(x)))
        for block in self.mlp_resnet_blocks:
            x = block(x)
        out: Tensor = self.fc2(self.layer_norm2(x))
        return out


class ProprioProjector(nn.Module):
    """Normalised proprioception (B, P) to one token (B, d)."""

    def __init__(self, proprio_dim: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = Linear(proprio_dim, hidden)
        self.fc2 = Linear(hidden, hidden)

    def forward(self, proprio: Tensor) -> Tensor:
        """(B, P) to (B, d)."""
        out: Tensor = self.fc2(F.gelu(self.fc1(proprio)))
        return out
