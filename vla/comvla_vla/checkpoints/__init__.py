"""Reading, writing and splitting policies on disk.

Two formats are read: this project's own (:mod:`~comvla_vla.checkpoints.native`) and the one in which OpenVLA-OFT and
LightVLA are published (:mod:`~comvla_vla.checkpoints.published` and its neighbours). Nothing that is read is executed.
"""

from comvla_vla.checkpoints.identity import fingerprint, model_info
from comvla_vla.checkpoints.loading import assemble, load_cloud, load_edge
from comvla_vla.checkpoints.native import CONFIG, FORMAT, STATISTICS, TOKENIZER, WEIGHTS
from comvla_vla.checkpoints.opening import locate, open_checkpoint
from comvla_vla.checkpoints.published import Recipe
from comvla_vla.checkpoints.saving import save_policy
from comvla_vla.checkpoints.splitting import SplitReport, check_split, split_checkpoint

__all__ = [
    "CONFIG",
    "FORMAT",
    "STATISTICS",
    "TOKENIZER",
    "WEIGHTS",
    "Recipe",
    "SplitReport",
    "assemble",
    "check_split",
    "fingerprint",
    "load_cloud",
    "load_edge",
    "locate",
    "model_info",
    "open_checkpoint",
    "save_policy",
    "split_checkpoint",
]
