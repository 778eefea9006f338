"""What an edge half borrows from a cloud half in the same process, where it was split without it."""

from __future__ import annotations

from dataclasses import replace

from comvla_vla.cloud import CloudModel
from comvla_vla.edge import EdgeModel
from comvla_vla.pruning import TextProbe

PRUNERS = ("lightvla", "vla_adp")


def lend_pruners(edge: EdgeModel, cloud: CloudModel) -> None:
    """Gives the edge half the weights that LightVLA and VLA-ADP need, for evaluations in one process.

    A robot gets them when its checkpoint is split (``edge_pruners``). What an edge half has stays; nothing is copied
    but the first layer's norm, queries and keys.

    Args:
        edge: changed in place.
        cloud: the other half of the same policy.
    """
    net, config = edge.net, edge.config
    if not hasattr(net, "embed_tokens"):
        net.embed_tokens = cloud.net.embed_tokens
    if config.action.proprio_dim and not hasattr(net, "proprio_projector"):
        net.proprio_projector = cloud.net.proprio_projector
    if not hasattr(net, "probe"):
        net.probe = TextProbe(config.backbone).to(edge.device, edge.dtype).requires_grad_(False)
        net.probe.copy_from(cloud.net.backbone)
    edge.config = replace(config, edge_pruners=PRUNERS)
