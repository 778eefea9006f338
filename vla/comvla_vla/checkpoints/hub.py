"""Published checkpoints by repository name: fetches only the files that one half needs."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from comvla.errors import CheckpointError, DependencyError
from comvla_vla.checkpoints.lora import ADAPTER_FOLDER
from comvla_vla.checkpoints.shards import INDEX, WEIGHTS, read_index

_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_SMALL_FILES = ["*.json", "tokenizer.model", f"{ADAPTER_FOLDER}/*"]


def looks_like_repository(source: str) -> bool:
    """Whether a source that is no folder may be ``owner/name``."""
    return _REPOSITORY.fullmatch(source) is not None


def fetch(repository: str, wanted: Callable[[str], bool] | None, side_files: list[str]) -> Path:
    """A local folder with the repository's files, from the cache where they are there already.

    The cache's place and offline mode are huggingface_hub's own (``HF_HOME``, ``HF_HUB_OFFLINE``).

    Args:
        repository: ``owner/name``.
        wanted: which tensors of the main weights are needed; None for all.
        side_files: patterns of further files.

    Raises:
        DependencyError: huggingface_hub is not installed.
        CheckpointError: no such repository, no connection, or offline and not in the cache.
    """
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise DependencyError(
            f"{repository!r} is no folder here, and fetching it from the hub needs huggingface_hub: "
            "pip install huggingface_hub"
        ) from error
    folder = _download(snapshot_download, repository, _SMALL_FILES)
    weights = [WEIGHTS]
    if (folder / INDEX).is_file():
        places = read_index(folder / INDEX)
        weights = sorted({f for name, f in places.items() if wanted is None or wanted(name)})
    folder = _download(snapshot_download, repository, [*_SMALL_FILES, *weights, *side_files])
    absent = [name for name in weights if not (folder / name).is_file()]
    if absent and not (folder / ADAPTER_FOLDER).is_dir():
        raise CheckpointError(
            f"{repository!r} holds no {absent[0]}, or it is not in the cache yet ({folder}): run once with a "
            "connection (without HF_HUB_OFFLINE), or pass a folder that holds it"
        )
    return folder


def _download(download: Callable[..., Any], repository: str, patterns: list[str]) -> Path:
    try:
        return Path(download(repo_id=repository, allow_patterns=patterns))
    except Exception as error:  # the hub's client raises many kinds: network, access, cache
        raise CheckpointError(
            f"cannot get {repository!r} from the hub ({type(error).__name__}: {_first_line(error)}): "
            "check the name and the connection (and HF_HUB_OFFLINE), or download it elsewhere and pass "
            "the folder"
        ) from error


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or ["no details"])[0]
