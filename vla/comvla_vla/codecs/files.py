"""A trained codec on disk: a folder with ``codec.json`` and ``codec.safetensors``."""

from __future__ import annotations

import functools
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from comvla.errors import CheckpointError, CodecError
from comvla_vla.codecs.image_codec import (
    CODECS,
    ImageCodec,
    check_size,
    config_from_json,
    config_to_json,
)

FORMAT = "comvla-codec-1"
NOTES, WEIGHTS = "codec.json", "codec.safetensors"
_SHIPPED = Path(__file__).with_name("shipped")


@dataclass(frozen=True)
class TrainedCodec:
    """A codec with its weights.

    Attributes:
        codec: the networks, in evaluation mode.
        name: of the kind, a key of ``CODECS``.
        image_size: side in pixels of the pictures it was trained on.
        fingerprint: hex digest of configuration and weights; both ends of a link need the same.
        notes: how it was trained and what was measured, as JSON values.
    """

    codec: ImageCodec
    name: str
    image_size: int
    fingerprint: str
    notes: dict[str, Any]


def save_codec(folder: Path, codec: ImageCodec, image_size: int, notes: dict[str, Any]) -> str:
    """Writes a codec, its weights in half precision; returns its fingerprint.

    Args:
        folder: is made.
        codec: trained networks.
        image_size: side in pixels.
        notes: training and measurements, as JSON values.
    """
    check_size(codec.config, image_size, image_size)
    weights = {
        name: value.detach().half().contiguous() for name, value in codec.state_dict().items()
    }
    config = config_to_json(codec.config)
    digest = _fingerprint(codec.config.name, config, weights)
    folder.mkdir(parents=True, exist_ok=True)
    header = {
        "format": FORMAT,
        "codec": codec.config.name,
        "config": config,
        "image_size": image_size,
        "fingerprint": digest,
        "notes": notes,
    }
    # The notes last: they hold the fingerprint, so a folder cut short does not load.
    for name, content in (
        (WEIGHTS, save(weights)),
        (NOTES, (json.dumps(header, indent=1) + "\n").encode()),
    ):
        partial = folder / f".{name}.writing"
        partial.write_bytes(content)
        partial.replace(folder / name)
    return digest


def load_codec(source: str | Path) -> TrainedCodec:
    """A trained codec on the CPU, in float32.

    Args:
        source: ``"deepjscc"`` or ``"witt"`` for the shipped ones, or a folder.

    Raises:
        CheckpointError: missing, damaged, or written by another version.
    """
    return _shipped(str(source)) if str(source) in CODECS else _read(Path(source), str(source))


@functools.cache
def _shipped(name: str) -> TrainedCodec:
    """Read once in a process: every episode of an evaluation asks for it."""
    return _read(_SHIPPED / name, name)


def _read(folder: Path, source: str) -> TrainedCodec:
    path = folder / NOTES
    if not path.is_file():
        raise CheckpointError(
            f"no codec in {source} (no {NOTES}): give a folder that `comvla-sim train codec` made, "
            f"or one of {', '.join(CODECS)}"
        )
    try:
        header = json.loads(path.read_text(encoding="utf-8"))
        if header["format"] != FORMAT:
            raise CheckpointError(
                f"{path} has format {header['format']!r}, this release reads {FORMAT!r}: train it "
                "again, or install the release that wrote it"
            )
        name, size = str(header["codec"]), int(header["image_size"])
        codec = ImageCodec(config_from_json(name, header["config"]))
        check_size(codec.config, size, size)
        weights = load_file(folder / WEIGHTS)
        if _fingerprint(name, header["config"], weights) != header["fingerprint"]:
            raise CheckpointError(f"{folder} is damaged or mixed from two codecs: copy it again")
        codec.load_state_dict({key: value.float() for key, value in weights.items()})
    except CodecError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, SafetensorError) as error:
        raise CheckpointError(f"cannot read the codec in {folder}: {error}") from error
    return TrainedCodec(
        codec.eval(), name, size, str(header["fingerprint"]), dict(header.get("notes") or {})
    )


def _fingerprint(name: str, config: dict[str, Any], weights: dict[str, Tensor]) -> str:
    digest = hashlib.sha256(json.dumps([name, config], sort_keys=True).encode())
    for key in sorted(weights):
        value = weights[key].contiguous()
        digest.update(f"{key} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
