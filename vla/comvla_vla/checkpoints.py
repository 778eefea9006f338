"""Reading and writing policies on disk.

A checkpoint folder holds ``config.json``, ``model.safetensors`` (names as OpenVLA-OFT publishes them, side modules
under ``action_head.`` and ``proprio_projector.``), ``dataset_statistics.json`` and ``tokenizer.json``. A folder may
hold the whole policy or one half. Nothing that is read is ever executed.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from comvla.errors import CheckpointError
from comvla.model_info import ModelInfo
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tokenizers import Tokenizer
from torch import Tensor, nn

from comvla_vla.cloud import CloudModel
from comvla_vla.config import ModelConfig
from comvla_vla.edge import EdgeModel
from comvla_vla.naming import load_published, needed_names, to_published
from comvla_vla.nets import CloudNet, EdgeNet
from comvla_vla.prompt import Prompt
from comvla_vla.statistics import Statistics, pick_statistics, read_statistics

CONFIG, WEIGHTS, STATISTICS, TOKENIZER = (
    "config.json",
    "model.safetensors",
    "dataset_statistics.json",
    "tokenizer.json",
)
FORMAT = "comvla-1"


def fingerprint(
    config: ModelConfig, tensors: Mapping[str, Tensor], statistics: Mapping[str, Any]
) -> str:
    """Hex digest over configuration, statistics and every weight of a whole policy; equal halves carry the same one."""
    digest = hashlib.sha256(json.dumps([config.to_dict(), statistics], sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(
            tensor.view(torch.uint8).numpy().tobytes()
            if tensor.ndim
            else str(tensor.item()).encode()
        )
    return digest.hexdigest()[:32]


def model_info(config: ModelConfig, digest: str, statistics: Statistics) -> ModelInfo:
    """What the handshake compares."""
    side = config.towers[0].image_size
    return ModelInfo(
        name=config.name,
        fingerprint=digest,
        num_tokens=config.num_tokens,
        token_dim=config.token_dim,
        tower_dims=tuple(t.dim for t in config.towers),
        grid=config.grid,
        image_size=(side, side),
        action_horizon=config.action.horizon,
        action_dim=config.action.action_dim,
        proprio_dim=config.action.proprio_dim,
        max_prompt_tokens=config.prompt.max_tokens,
        delta_actions=tuple(bool(m) for m in statistics.action_mask),
        control_period_s=config.control_period_s,
    )


def save_policy(
    folder: Path,
    edge: EdgeNet,
    cloud: CloudNet,
    tokenizer: Tokenizer,
    statistics: Mapping[str, Any],
) -> str:
    """Writes a whole policy; returns its fingerprint. The folder appears complete or not at all."""
    config = cloud.config
    tensors = {**to_published(edge), **to_published(cloud)}
    digest = fingerprint(config, tensors, statistics)
    _write(folder, config, digest, "whole", tensors, tokenizer.to_str(), dict(statistics))
    return digest


def split_checkpoint(source: str | Path, destination: str | Path) -> None:
    """Writes ``edge/`` and ``cloud/`` under ``destination``, each with only the tensors that its half needs.

    Raises:
        CheckpointError: the source is not a whole policy, or the destination exists already.
    """
    folder, target = locate(source), Path(destination)
    header = _read_config(folder)
    config, digest = ModelConfig.from_dict(header["model"]), header["fingerprint"]
    if header["half"] != "whole":
        raise CheckpointError(
            f"{folder} holds only the {header['half']} half: split needs the whole policy"
        )
    if target.exists():
        raise CheckpointError(
            f"{target} exists already: choose a new folder, nothing is overwritten"
        )
    statistics = json.loads((folder / STATISTICS).read_text())
    tokenizer = (folder / TOKENIZER).read_text()
    partial = target.with_name(target.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        for half, net in (("edge", _empty(EdgeNet, config)), ("cloud", _empty(CloudNet, config))):
            tensors = _read_tensors(folder / WEIGHTS, needed_names(net))
            _write(partial / half, config, digest, half, tensors, tokenizer, statistics)
        partial.rename(target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def load_edge(
    source: str | Path, device: str = "cpu", dtype: torch.dtype = torch.float32
) -> EdgeModel:
    """The robot's half of a policy.

    Args:
        source: a checkpoint folder (whole or edge half) or ``"mini"``, the shipped policy.
        device: torch device. dtype: of weights and arithmetic.

    Raises:
        CheckpointError: missing, damaged, foreign or incomplete checkpoint.
    """
    config, digest, statistics, prompt, folder = _open(source, "edge", None)
    net = _load(_empty(EdgeNet, config), folder, device, dtype)
    return EdgeModel(net, prompt, model_info(config, digest, statistics))


def load_cloud(
    source: str | Path,
    device: str = "cpu",
    dtype: torch.dtype = torch.float32,
    statistics_key: str | None = None,
) -> CloudModel:
    """The server's half of a policy.

    Args:
        source: a checkpoint folder (whole or cloud half) or ``"mini"``, the shipped policy.
        device: torch device. dtype: of weights and arithmetic.
        statistics_key: which data set's statistics; the only one by default.

    Raises:
        CheckpointError: missing, damaged, foreign or incomplete checkpoint.
    """
    config, digest, statistics, prompt, folder = _open(source, "cloud", statistics_key)
    net = _load(_empty(CloudNet, config), folder, device, dtype)
    return CloudModel(net, prompt, statistics, model_info(config, digest, statistics))


def assemble(
    edge: EdgeNet, cloud: CloudNet, tokenizer: Tokenizer, statistics: Mapping[str, Any]
) -> tuple[EdgeModel, CloudModel]:
    """Both halves from modules in memory (after training, or random weights)."""
    config = cloud.config
    digest = fingerprint(config, {**to_published(edge), **to_published(cloud)}, statistics)
    chosen = pick_statistics(dict(statistics), None, where="the given statistics")
    info, prompt = model_info(config, digest, chosen), Prompt(config.prompt, tokenizer)
    return EdgeModel(edge, prompt, info), CloudModel(cloud, prompt, chosen, info)


def locate(source: str | Path) -> Path:
    """Folder of a checkpoint: a path, or the name of a shipped policy.

    Raises:
        CheckpointError: no such folder.
    """
    if str(source) == "mini":
        folder = Path(str(files("comvla_vla") / "policies" / "mini"))
    else:
        folder = Path(source).expanduser()
    if not (folder / CONFIG).is_file():
        raise CheckpointError(
            f"{source!s} is not a checkpoint folder: {folder / CONFIG} does not exist"
        )
    return folder


def _open(
    source: str | Path, half: str, statistics_key: str | None
) -> tuple[ModelConfig, str, Statistics, Prompt, Path]:
    folder = locate(source)
    header = _read_config(folder)
    if header["half"] not in ("whole", half):
        raise CheckpointError(
            f"{folder} holds the {header['half']} half, the {half} half was asked for"
        )
    config = ModelConfig.from_dict(header["model"])
    try:
        tokenizer = Tokenizer.from_file(str(folder / TOKENIZER))
    except Exception as error:  # tokenizers raises bare Exception
        raise CheckpointError(f"cannot read the tokenizer {folder / TOKENIZER}: {error}") from error
    statistics = read_statistics(folder / STATISTICS, statistics_key)
    _check_statistics(config, statistics)
    return config, header["fingerprint"], statistics, Prompt(config.prompt, tokenizer), folder


def _check_statistics(config: ModelConfig, statistics: Statistics) -> None:
    came = len(statistics.action_low), len(statistics.action_high), len(statistics.action_mask)
    want = config.action.action_dim
    if (
        set(came) != {want}
        or not len(statistics.proprio_low)
        == len(statistics.proprio_high)
        >= config.action.proprio_dim
    ):
        raise CheckpointError(
            f"statistics {statistics.key!r} describe {came} action and {len(statistics.proprio_low)} proprioception "
            f"values, the model has {want} and {config.action.proprio_dim}: they belong to another data set"
        )


def _read_config(folder: Path) -> dict[str, Any]:
    try:
        header = json.loads((folder / CONFIG).read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(f"cannot read {folder / CONFIG}: {error}") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        came = (
            header.get("format", header.get("model_type", "no format"))
            if isinstance(header, dict)
            else "no mapping"
        )
        raise CheckpointError(
            f"{folder / CONFIG} is {came!r}, this version reads {FORMAT!r} checkpoints"
        )
    missing = {"model", "fingerprint", "half"} - set(header)
    if missing:
        raise CheckpointError(
            f"{folder / CONFIG} lacks {sorted(missing)}: the checkpoint is damaged, copy it again"
        )
    return header


def _read_tensors(path: Path, names: set[str]) -> dict[str, Tensor]:
    """Only the named tensors; the rest of the file is never read."""
    try:
        with safe_open(path, framework="pt") as archive:
            there = set(archive.keys())
            missing = sorted(names - there)
            if missing:
                raise CheckpointError(
                    f"{path} lacks {len(missing)} tensors, the first is {missing[0]}"
                )
            return {name: archive.get_tensor(name) for name in sorted(names)}
    except (OSError, SafetensorError) as error:
        raise CheckpointError(
            f"cannot read the weights {path}: {error}; copy the checkpoint again"
        ) from error


def _empty(kind: type[Any], config: ModelConfig) -> Any:
    with torch.random.fork_rng(
        devices=[]
    ):  # building a module draws random weights; the caller's stream stays as it was
        return kind(config)


def _load(net: nn.Module, folder: Path, device: str, dtype: torch.dtype) -> Any:
    with torch.no_grad():
        load_published(net, _read_tensors(folder / WEIGHTS, needed_names(net)), str(folder))
    return net.to(device, dtype).requires_grad_(False)


def _write(
    folder: Path,
    config: ModelConfig,
    digest: str,
    half: str,
    tensors: Mapping[str, Tensor],
    tokenizer: str,
    statistics: dict[str, Any],
) -> None:
    partial = folder.with_name(folder.name + ".writing")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    header = {"format": FORMAT, "half": half, "fingerprint": digest, "model": config.to_dict()}
    (partial / CONFIG).write_text(json.dumps(header, indent=1) + "\n")
    (partial / STATISTICS).write_text(json.dumps(statistics, indent=1) + "\n")
    (partial / TOKENIZER).write_text(tokenizer)
    save_file(dict(tensors), partial / WEIGHTS, metadata={"format": "pt", "fingerprint": digest})
    # safetensors writes for the owner only; a policy is read by services under other accounts.
    (partial / WEIGHTS).chmod(0o644)
    if folder.exists():
        shutil.rmtree(folder)
    partial.rename(folder)
