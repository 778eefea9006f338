"""What both halves of a split model must agree on before the robot moves."""

from __future__ import annotations

from dataclasses import dataclass

PROTOCOL_VERSION = 1


@dataclass(frozen=True)
class ModelInfo:
    """Description of one split model, the same on the edge and in the cloud.

    Attributes:
        name: family and checkpoint, e.g. ``comvla-mini``.
        fingerprint: hex digest over configuration and weights of the *whole* model; equal halves
            match.
        num_tokens: N, visual tokens per observation over all views.
        token_dim: D, width of a transmitted (pre-projector) token.
        tower_dims: widths of the vision towers whose features are concatenated; they sum to
            ``token_dim``.
        grid: (views, rows, columns); their product is ``num_tokens``.
        image_size: (height, width) in pixels that :meth:`EdgeModel.preprocess` expects of each
            view.
        action_horizon: H, actions per chunk.
        action_dim: A.
        proprio_dim: P, 0 where the model takes no proprioception.
        max_prompt_tokens: longest tokenised prompt that the backbone accepts.
        delta_actions: for each action dimension, True where 0 means "stand still" (velocities,
            deltas) and False where the last value must be kept to hold (grippers).
        control_period_s: seconds between two actions for which the policy was trained.
    """

    name: str
    fingerprint: str
    num_tokens: int
    token_dim: int
    tower_dims: tuple[int, ...]
    grid: tuple[int, int, int]
    image_size: tuple[int, int]
    action_horizon: int
    action_dim: int
    proprio_dim: int
    max_prompt_tokens: int
    delta_actions: tuple[bool, ...]
    control_period_s: float = 0.05
