"""Published checkpoints by repository name: fetches only the files that one half needs."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from comvla.errors import CheckpointError, DependencyError
from comvla_vla.checkpoints.lora import ADAPTER_FOLDER
from comvla_vla.checkpoints.shards import INDEX, WEIGHTS, read_index

PREFIX = "hf://"
"""What a source begins with that is fetched from the hub; nothing else ever is."""

_NAME = r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*"
# A path's own spelling has one slash less: Path("hf://owner/name") is "hf:/owner/name".
_REPOSITORY = re.compile(rf"hf:/{{1,2}}(?P<name>{_NAME})(?:@(?P<revision>[\w./-]+))?")
_SMALL_FILES = ["*.json", "tokenizer.model", f"{ADAPTER_FOLDER}/*"]


@dataclass(frozen=True)
class Repository:
    """A repository on the hub.

    Attributes:
        name: ``owner/name``. revision: branch, tag or commit; None for the default branch.
    """

    name: str
    revision: str | None = None

    def __str__(self) -> str:
        at = "" if self.revision is None else f"@{self.revision}"
        return f"{PREFIX}{self.name}{at}"


def named(source: str) -> Repository | None:
    """The repository that a source names: ``hf://owner/name`` or ``hf://owner/name@revision``; else None.

    Raises:
        CheckpointError: it begins like one and is none.
    """
    if not source.startswith("hf:/"):
        return None
    match = _REPOSITORY.fullmatch(source)
    if match is None:
        raise CheckpointError(
            f"{source!r} names no repository on the hub: write {PREFIX}owner/name, or "
            f"{PREFIX}owner/name@revision"
        )
    return Repository(match["name"], match["revision"])


def remedy(source: str) -> str:
    """What else a source that is no folder may have been meant for; empty where nothing is."""
    if re.fullmatch(_NAME, source) is None:
        return ""
    return f"; for the repository of that name on the Hugging Face hub, write {PREFIX}{source}"


def fetch(
    repository: Repository, wanted: Callable[[str], bool] | None, side_files: list[str]
) -> Path:
    """A local folder with the repository's files, from the cache where they are there already.

    The cache's place and offline mode are huggingface_hub's own (``HF_HOME``, ``HF_HUB_OFFLINE``).

    Args:
        repository: which.
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
            f"fetching {repository} needs huggingface_hub: pip install huggingface_hub"
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
            f"{repository} holds no {absent[0]}, or it is not in the cache yet ({folder}): run once with a "
            "connection (without HF_HUB_OFFLINE), or pass a folder that holds it"
        )
    return folder


def _download(download: Callable[..., Any], repository: Repository, patterns: list[str]) -> Path:
    try:
        folder = download(
            repo_id=repository.name, revision=repository.revision, allow_patterns=patterns
        )
    except Exception as error:  # the hub's client raises many kinds: network, access, cache
        raise CheckpointError(
            f"cannot get {repository} from the hub ({type(error).__name__}: {_first_line(error)}): "
            "check the name and the connection (and HF_HUB_OFFLINE), or download it elsewhere and pass "
            "the folder"
        ) from error
    return Path(folder)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or ["no details"])[0]
