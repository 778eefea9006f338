"""One half of a policy from disk into memory, ready to run."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import torch
from tokenizers import Tokenizer
from torch import Tensor

from comvla_vla.checkpoints.accounting import Half, empty_half, published_shapes
from comvla_vla.checkpoints.identity import fingerprint, model_info, tensor_digest
from comvla_vla.checkpoints.memory import check_memory
from comvla_vla.checkpoints.opened import Checkpoint
from comvla_vla.checkpoints.opening import open_checkpoint
from comvla_vla.checkpoints.published import Recipe
from comvla_vla.checkpoints.tensors import check_shapes
from comvla_vla.cloud import CloudModel
from comvla_vla.config import ModelConfig
from comvla_vla.edge import EdgeModel
from comvla_vla.naming import published_names, to_published
from comvla_vla.nets import CloudNet, EdgeNet
from comvla_vla.options import CloudOptions
from comvla_vla.prompt import Prompt
from comvla_vla.statistics import pick_statistics
from comvla_vla.vision import Projector


def load_edge(
    source: str | Path,
    device: str = "cpu",
    dtype: torch.dtype = torch.float32,
    statistics_key: str | None = None,
    *,
    recipe: Recipe | None = None,
    tokenizer: str | Path | None = None,
    base: str | Path | None = None,
    verify: bool = True,
) -> EdgeModel:
    """The robot's half of a policy.

    Args:
        source: a checkpoint folder (whole or edge half, ours or published; of a split, its ``edge``), a repository
            on the hub as ``"hf://owner/name"`` or ``"hf://owner/name@revision"``, or ``"mini"``, the shipped policy.
        device: torch device. dtype: of weights and arithmetic.
        statistics_key: which data set's statistics; the only one by default.
        recipe, tokenizer, base: of a published checkpoint, see :func:`~comvla_vla.checkpoints.open_checkpoint`.
        verify: compare every weight with the digest that was written beside it (formats that have one: this
            project's own); about 0.7 s of processor time per GB, beside the reading.

    Raises:
        CheckpointError: missing, damaged, foreign or incomplete checkpoint, or too little memory for it.
        DependencyError: a hub repository, and huggingface_hub is not installed.
    """
    checkpoint = open_checkpoint(source, "edge", recipe, tokenizer, base)
    statistics, prompt = checkpoint.chosen_statistics(statistics_key), checkpoint.prompt()
    checkpoint.check_content()
    net = cast(EdgeNet, read_half("edge", checkpoint, device, dtype, verify=verify))
    info = model_info(checkpoint.config, checkpoint.identity(), statistics)
    return EdgeModel(net, prompt, info, statistics)


def load_cloud(
    source: str | Path,
    device: str = "cpu",
    dtype: torch.dtype = torch.float32,
    statistics_key: str | None = None,
    *,
    options: CloudOptions | None = None,
    recipe: Recipe | None = None,
    tokenizer: str | Path | None = None,
    base: str | Path | None = None,
    verify: bool = True,
) -> CloudModel:
    """The server's half of a policy.

    Args:
        source, device, dtype, statistics_key, recipe, tokenizer, base, verify: as in :func:`load_edge`.
        options: how it is run.

    Raises:
        CheckpointError, DependencyError: as :func:`load_edge`.
    """
    checkpoint = open_checkpoint(source, "cloud", recipe, tokenizer, base)
    statistics, prompt = checkpoint.chosen_statistics(statistics_key), checkpoint.prompt()
    checkpoint.check_content()
    net = cast(CloudNet, read_half("cloud", checkpoint, device, dtype, verify=verify))
    info = model_info(checkpoint.config, checkpoint.identity(), statistics)
    return CloudModel(net, prompt, statistics, info, options)


def read_half(
    half: Half, checkpoint: Checkpoint, device: str, dtype: torch.dtype, *, verify: bool = True
) -> EdgeNet | CloudNet:
    """The module of one half with its weights, tensor by tensor: never two copies of the model in memory.

    Raises:
        CheckpointError: a tensor is missing, misshapen, damaged or unreadable, or there is too little memory.
    """
    net = empty_half(half, checkpoint.config)
    check_shapes(checkpoint.tensors, published_shapes(net), checkpoint.where, exhaustive=False)
    weight_bytes = sum(p.numel() for p in net.parameters()) * dtype.itemsize
    if torch.device(device).type == "cpu":
        check_memory(weight_bytes, f"the {half} half of {checkpoint.config.name} in {dtype}")
    allocate(net, device, dtype)
    verify = verify and checkpoint.digests is not None
    with torch.no_grad(), ThreadPoolExecutor(1, "digests") as beside:
        waiting: Future[None] | None = None
        for name, target in net.state_dict().items():
            parts = published_names(name)
            for part, chunk in zip(parts, target.chunk(len(parts)), strict=True):
                tensor = checkpoint.tensors[part].read()
                if waiting is not None:
                    waiting.result()  # so that at most two tensors are in flight
                if verify:
                    waiting = beside.submit(_check_tensor, checkpoint, part, tensor)
                chunk.copy_(tensor)
        if waiting is not None:
            waiting.result()
    return net


def _check_tensor(checkpoint: Checkpoint, name: str, tensor: Tensor) -> None:
    checkpoint.check_digest(name, tensor_digest(tensor))


def allocate(net: EdgeNet | CloudNet, device: str, dtype: torch.dtype) -> None:
    """Gives a module without memory its memory, whose content is left to the caller."""
    net.to(dtype).to_empty(device=device)
    net.requires_grad_(False)
    for module in net.modules():
        if isinstance(module, Projector):
            module.derive()


def assemble(
    edge: EdgeNet, cloud: CloudNet, tokenizer: Tokenizer, statistics: Mapping[str, Any]
) -> tuple[EdgeModel, CloudModel]:
    """Both halves from modules in memory (after training, or random weights)."""
    config: ModelConfig = cloud.config
    digest = fingerprint(config, {**to_published(edge), **to_published(cloud)}, statistics)
    chosen = pick_statistics(dict(statistics), None, where="the given statistics")
    info, prompt = model_info(config, digest, chosen), Prompt(config.prompt, tokenizer)
    return EdgeModel(edge, prompt, info, chosen), CloudModel(cloud, prompt, chosen, info)
