"""Loading both halves of the policy that is evaluated."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from comvla_vla import CloudModel, EdgeModel

RANDOM = "random"
"""A policy with random weights: the right shapes and no skill, for tests and timings."""


def load_policy(model: str) -> tuple[EdgeModel, CloudModel]:
    """Both halves on the CPU, the edge half with the weights that LightVLA and VLA-ADP need.

    Args:
        model: ``"mini"``, ``"random"``, or a checkpoint folder.

    Raises:
        CheckpointError: missing, damaged or foreign.
    """
    from comvla_vla import lend_pruners, load_cloud, load_edge, random_policy

    if model == RANDOM:
        edge, cloud = random_policy(seed=0)
        lend_pruners(edge, cloud)
        return edge, cloud
    edge, cloud = load_edge(model), load_cloud(model)
    lend_pruners(edge, cloud)
    return edge, cloud


def load_edge_half(model: str) -> EdgeModel:
    """The robot's half alone, for a cloud half that runs in a server."""
    from comvla_vla import load_edge, random_policy

    return random_policy(seed=0)[0] if model == RANDOM else load_edge(model)


def shown_model(model: str) -> str:
    """The model as it may stand in a result: a name, or the last part of a folder."""
    return Path(model).name or model
