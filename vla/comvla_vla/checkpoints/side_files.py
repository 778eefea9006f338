"""The ``.pt`` files beside a published checkpoint: ``action_head--150000_checkpoint.pt`` and its kin.

They are pickles. ``torch.load(weights_only=True)`` refuses everything but tensors, and is the only way they are read.
"""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path

import torch

from comvla.errors import CheckpointError
from comvla_vla.checkpoints.tensors import TensorEntry, from_memory

ACTION_HEAD = "action_head"
PROPRIO_PROJECTOR = "proprio_projector"
NOISY_ACTION_PROJECTOR = "noisy_action_projector"
VISION_BACKBONE = "vision_backbone"


def find_side_file(folder: Path, module: str) -> Path | None:
    """The one file of a module, or None.

    Raises:
        CheckpointError: several files fit.
    """
    found = sorted(folder.glob(f"{module}--*checkpoint*.pt"))
    if len(found) > 1:
        raise CheckpointError(
            f"{folder} holds {len(found)} files for {module}: {', '.join(f.name for f in found)}; "
            "keep the one that belongs to the weights"
        )
    return found[0] if found else None


def _is_torchscript(path: Path) -> bool:
    """Whether a file is what torch.jit.save writes: a ZIP archive with constants.pkl or code beside its tensors."""
    try:
        with zipfile.ZipFile(path) as archive:
            inside = [name.partition("/")[2] for name in archive.namelist()]
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return False  # torch says what else is wrong with it
    return any(name == "constants.pkl" or name.startswith("code/") for name in inside)


def open_side_file(path: Path, prefix: str) -> dict[str, TensorEntry]:
    """Catalogue of one side file, names prefixed and without the ``module.`` of distributed training.

    Raises:
        CheckpointError: not a file of named tensors, and nothing else, that torch reads safely.
    """
    if _is_torchscript(path):
        raise CheckpointError(
            f"{path} is a TorchScript archive, which holds code, and was not opened: export the module's "
            "state_dict alone with torch.save"
        )
    try:
        table = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{path} holds more than tensors and was not opened, because that could run code: "
            "export its state_dict alone with torch.save"
        ) from error
    except (OSError, RuntimeError, ValueError, EOFError, KeyError, AttributeError) as error:
        raise CheckpointError(f"cannot read {path}: {error}; copy the file again") from error
    if not isinstance(table, dict) or not all(
        isinstance(name, str) and isinstance(value, torch.Tensor) for name, value in table.items()
    ):
        raise CheckpointError(
            f"{path} is not a mapping of names to tensors: export the module's state_dict"
        )
    names = {name.removeprefix("module."): value for name, value in table.items()}
    return from_memory({prefix + name: value for name, value in names.items()}, path)
