"""Where the reference implementation's outputs lie, and folders made of them.

They are not part of the repository: point COMVLA_GOLDEN at them, or lay them in ``../shared/golden`` beside it.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from tokenizers import AddedToken, Tokenizer, decoders, normalizers
from tokenizers.models import Unigram

GOLDEN = Path(os.environ.get("COMVLA_GOLDEN", Path(__file__).parents[3] / "shared" / "golden"))
needs_golden = pytest.mark.skipif(
    not (GOLDEN / "golden_oft_fp32.npz").is_file(),
    reason="no reference data: point COMVLA_GOLDEN at the folder with golden_oft_fp32.npz",
)
TOLERANCE = 5e-5
INSTRUCTION = "pick up the black bowl between the plate and the ramekin and place it on the plate"
# The pieces of that prompt and their ids in Llama 2's vocabulary.
_PIECES = {
    "▁In": 512, ":": 29901, "▁What": 1724, "▁action": 3158, "▁should": 881, "▁the": 278,
    "▁robot": 19964, "▁take": 2125, "▁to": 304, "▁pick": 5839, "▁up": 701, "▁black": 4628,
    "▁bow": 12580, "l": 29880, "▁between": 1546, "▁plate": 15284, "▁and": 322, "▁r": 364,
    "ame": 420, "kin": 9089, "▁place": 2058, "▁it": 372, "▁on": 373, "?": 29973, "Out": 3744,
    "▁": 29871,
}  # fmt: skip


def llama_like_tokenizer() -> Tokenizer:
    """Llama 2's rules (a space in front, ``▁`` for spaces, bytes for the unknown) with the pieces of one prompt."""
    pieces = {0: ("<unk>", 0.0), 1: ("<s>", 0.0), 2: ("</s>", 0.0)}
    pieces |= {3 + byte: (f"<0x{byte:02X}>", -9.0) for byte in range(256)}
    pieces |= {number: (piece, -1.0) for piece, number in _PIECES.items()}
    vocabulary = [pieces.get(i, (f"<unused {i}>", -99.0)) for i in range(32000)]
    tokenizer = Tokenizer(Unigram(vocabulary, unk_id=0, byte_fallback=True))
    tokenizer.normalizer = normalizers.Sequence(
        [normalizers.Prepend("▁"), normalizers.Replace(" ", "▁")]
    )
    tokenizer.decoder = decoders.ByteFallback()
    tokenizer.add_special_tokens([AddedToken(t, special=True) for t in ("<s>", "</s>", "<unk>")])
    return tokenizer


def golden(name: str) -> dict[str, np.ndarray]:
    """All arrays of one file."""
    with np.load(GOLDEN / f"{name}.npz") as archive:
        return dict(archive)


def checkpoint(folder: Path, *parts: str) -> Path:
    """A published folder: the golden checkpoint ``ckpt_<part>`` of each part over the former ones, with a tokenizer.

    A side file of a later part replaces the module's file of an earlier one.
    """
    folder.mkdir(parents=True)
    for part in parts:
        for file in (GOLDEN / f"ckpt_{part}").iterdir():
            module = file.name.split("--")[0]
            for old in folder.glob(f"{module}--*") if "--" in file.name else ():
                old.unlink()
            shutil.copyfile(file, folder / file.name)
    llama_like_tokenizer().save(str(folder / "tokenizer.json"))
    return folder
