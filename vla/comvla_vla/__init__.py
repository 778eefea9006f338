"""The policy, cut in two: an edge half that sees and a cloud half that acts.

Needs torch; the edge SDK imports this package only where a model is loaded.
"""

from comvla_vla.checkpoints import (
    Recipe,
    check_split,
    load_cloud,
    load_edge,
    save_policy,
    split_checkpoint,
)
from comvla_vla.cloud import CloudModel
from comvla_vla.config import ModelConfig
from comvla_vla.edge import EdgeModel
from comvla_vla.lending import lend_pruners
from comvla_vla.options import CloudOptions, FastV
from comvla_vla.random import random_policy
from comvla_vla.request import ImageRequest, PolicyRequest

__all__ = [
    "CloudModel",
    "CloudOptions",
    "EdgeModel",
    "FastV",
    "ImageRequest",
    "ModelConfig",
    "PolicyRequest",
    "Recipe",
    "check_split",
    "lend_pruners",
    "load_cloud",
    "load_edge",
    "random_policy",
    "save_policy",
    "split_checkpoint",
]
