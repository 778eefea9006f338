"""From a source's name to an opened checkpoint, whichever format it has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, TypeAlias

from comvla.errors import CheckpointError
from comvla_vla.checkpoints import hub, lora, side_files
from comvla_vla.checkpoints.accounting import Half, half_shapes, unused_shapes
from comvla_vla.checkpoints.native import (
    CONFIG,
    FORMAT,
    STATISTICS,
    TOKENIZER,
    open_native,
    read_json,
    read_text,
)
from comvla_vla.checkpoints.opened import SHARED_PREFIXES, Checkpoint
from comvla_vla.checkpoints.published import MODEL_TYPE, Recipe, published_config
from comvla_vla.checkpoints.shards import INDEX, WEIGHTS, open_weights
from comvla_vla.checkpoints.tensors import TensorEntry, check_shapes

Part: TypeAlias = Literal["whole", "edge", "cloud", "any"]
"""What a checkpoint is needed for; ``"any"`` takes whatever it holds."""

_SIDE_FILES: dict[Part, list[str]] = {
    "whole": ["*--*checkpoint*.pt"],
    "any": ["*--*checkpoint*.pt"],
    "edge": ["vision_backbone--*", "proprio_projector--*"],
    "cloud": ["action_head--*", "proprio_projector--*", "noisy_action_projector--*"],
}
_EDGE_PREFIXES = (
    *SHARED_PREFIXES,
    "vision_backbone.",
    "language_model.model.layers.0.input_layernorm.",
    "language_model.model.layers.0.self_attn.",
)
_CLOUD_PREFIXES = ("projector.", "language_model.model.")


def open_checkpoint(
    source: str | Path,
    part: Part,
    recipe: Recipe | None = None,
    tokenizer: str | Path | None = None,
    base: str | Path | None = None,
) -> Checkpoint:
    """Opens a policy or one half of it and accounts for its tensors; no weight is read yet.

    Args:
        source: a folder of this project's or the published format, the folder of a split (its ``edge`` or ``cloud``
            is taken, whichever ``part`` says), a repository on the hub as ``"hf://owner/name"`` or
            ``"hf://owner/name@revision"``, or ``"mini"``.
        part: what it is needed for.
        recipe: of a published checkpoint.
        tokenizer: a ``tokenizer.json``, where the folder has none.
        base: the checkpoint that an unmerged adapter belongs to; the one that the adapter names where None.

    Raises:
        CheckpointError: missing, damaged, foreign or incomplete checkpoint.
        DependencyError: a hub repository, and huggingface_hub is not installed.
    """
    folder, fetched = _locate(source, part)
    weights = _weights_folder(folder, base, part, from_hub=hub.named(str(source)) is not None)
    path = (folder if (folder / CONFIG).is_file() else weights) / CONFIG
    header = read_json(path, "the configuration")
    if header.get("format") == FORMAT:
        checkpoint = open_native(folder, header)
    elif header.get("model_type") == MODEL_TYPE:
        recipe = recipe if recipe is not None else Recipe()
        checkpoint = _open_published(folder, weights, header, fetched, recipe, tokenizer)
    else:
        came = header.get("format", header.get("model_type", "of no known format"))
        raise CheckpointError(
            f"{path} is {came!r}, this version reads {FORMAT!r} and published {MODEL_TYPE!r} checkpoints"
        )
    if part != "any" and checkpoint.half not in ("whole", part):
        raise CheckpointError(
            f"{folder} holds the {checkpoint.half} half, the {part} half was asked for"
            if part != "whole"
            else f"{folder} holds only the {checkpoint.half} half: split needs the whole policy"
        )
    return checkpoint


def locate(source: str | Path, part: Part = "any") -> Path:
    """Folder of a checkpoint on this machine: a path, or the name of a shipped policy.

    Args:
        source: the folder, or that of a split, whose ``part`` is then taken.
        part: what it is needed for.

    Raises:
        CheckpointError: no such folder.
    """
    if str(source) == "mini":
        return Path(str(files("comvla_vla") / "policies" / "mini"))
    folder = Path(source).expanduser()
    if (folder / CONFIG).is_file() or lora.find_adapter(folder) is not None:
        return folder
    halves = [half for half in ("edge", "cloud") if (folder / half / CONFIG).is_file()]
    if part in halves:
        return folder / part
    if halves:
        raise CheckpointError(f"{source!s} holds halves of a split: name {folder / halves[0]}")
    raise CheckpointError(
        f"{source!s} is not a checkpoint folder: {folder / CONFIG} does not exist"
        f"{hub.remedy(str(source))}"
    )


def _locate(source: str | Path, part: Part) -> tuple[Path, Half | None]:
    """The folder, and the half whose files alone were fetched into it (None: everything is there)."""
    repository = hub.named(str(source))
    if repository is None:
        return locate(source, part), None
    half = part if part in ("edge", "cloud") else None
    return hub.fetch(repository, _wanted(half), _SIDE_FILES[part]), half


def _wanted(half: Half | None) -> Callable[[str], bool] | None:
    """Which tensors of the main weights a half reads; None for all of them."""
    if half is None:
        return None
    prefixes = _EDGE_PREFIXES if half == "edge" else _CLOUD_PREFIXES
    return lambda name: name.startswith(prefixes)


def _weights_folder(folder: Path, base: str | Path | None, part: Part, *, from_hub: bool) -> Path:
    """Where the main weights are: here, or in the checkpoint that an unmerged adapter belongs to."""
    adapter = lora.find_adapter(folder)
    if adapter is None or (folder / WEIGHTS).is_file() or (folder / INDEX).is_file():
        return folder
    if base is None:
        base = lora.read_adapter_config(adapter).get("base_model_name_or_path")
        if base and not Path(str(base)).expanduser().exists():
            # A file in a folder must not send anybody to the hub; a repository that was asked for may.
            base = f"{hub.PREFIX}{base}" if from_hub else None
    if not base:
        raise CheckpointError(
            f"{folder} holds an adapter without the weights it belongs to: name their checkpoint (base=, --base), "
            f"a folder or {hub.PREFIX}owner/name"
        )
    return _locate(base, part)[0]


def _open_published(
    folder: Path,
    weights: Path,
    header: Mapping[str, Any],
    fetched: Half | None,
    recipe: Recipe,
    tokenizer: str | Path | None,
) -> Checkpoint:
    entries = open_weights(weights, _wanted(fetched))
    adapter = lora.find_adapter(folder)
    if adapter is not None and weights != folder:
        entries = lora.merge_adapter(entries, adapter)
    entries |= _side_modules(folder, fetched)
    vision = side_files.find_side_file(folder, side_files.VISION_BACKBONE)
    if vision is not None:
        alpha = float(lora.read_adapter_config(adapter)["lora_alpha"]) if adapter else None
        seen = lora.unwrap(side_files.open_side_file(vision, ""), alpha)
        # The file replaces the towers of the main weights, which hold none of FiLM.
        entries = {n: e for n, e in entries.items() if not n.startswith("vision_backbone.")} | seen
    config = published_config(header, entries, recipe)
    if fetched is None:
        expected = half_shapes("edge", config) | half_shapes("cloud", config)
        check_shapes(entries, expected | unused_shapes(config), str(folder), exhaustive=True)
    else:
        check_shapes(entries, half_shapes(fetched, config), str(folder), exhaustive=False)
    table = folder / STATISTICS
    statistics = (
        read_json(table, "the data-set statistics") if table.is_file() else header.get("norm_stats")
    )
    if not isinstance(statistics, dict) or not statistics:
        raise CheckpointError(
            f"{folder} holds no data-set statistics, neither {STATISTICS} nor norm_stats in {CONFIG}: "
            "copy the statistics that were saved with the checkpoint"
        )
    return Checkpoint(
        where=str(folder),
        half="whole" if fetched is None else fetched,
        config=config,
        statistics=statistics,
        tokenizer=_tokenizer(folder, weights, tokenizer),
        tensors=entries,
        fingerprint=None,
        header=header,
    )


def _side_modules(folder: Path, fetched: Half | None) -> dict[str, TensorEntry]:
    """Action head and projectors from their ``.pt`` files."""
    entries: dict[str, TensorEntry] = {}
    modules = {
        side_files.ACTION_HEAD: fetched != "edge",
        side_files.PROPRIO_PROJECTOR: True,
        side_files.NOISY_ACTION_PROJECTOR: False,
    }
    for module, needed in modules.items():
        path = side_files.find_side_file(folder, module)
        if path is not None:
            entries |= side_files.open_side_file(path, f"{module}.")
        elif needed:
            raise CheckpointError(
                f"{folder} lacks {module}--*_checkpoint.pt: copy it from the same training step as the weights"
            )
    return entries


def _tokenizer(folder: Path, weights: Path, given: str | Path | None) -> str:
    places = [Path(given)] if given is not None else [folder / TOKENIZER, weights / TOKENIZER]
    for path in places:
        if path.is_file():
            return read_text(path, "the tokenizer")
    if given is not None:
        raise CheckpointError(f"there is no tokenizer {given}")
    if any((place / "tokenizer.model").is_file() for place in (folder, weights)):
        raise CheckpointError(
            f"{folder} holds tokenizer.model but no {TOKENIZER}: convert it once with transformers, "
            f"AutoTokenizer.from_pretrained({str(folder)!r}).save_pretrained({str(folder)!r})"
        )
    raise CheckpointError(
        f"{folder} holds no {TOKENIZER}: copy the one of Llama 2 (from the checkpoint's repository), or name it "
        "(tokenizer=, --tokenizer)"
    )
