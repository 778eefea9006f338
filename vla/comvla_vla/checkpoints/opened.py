"""A checkpoint that was opened and understood, but whose weights are still on disk."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from tokenizers import Tokenizer

from comvla.errors import CheckpointError
from comvla_vla.checkpoints.identity import tensor_digest
from comvla_vla.checkpoints.tensors import Catalogue
from comvla_vla.config import ModelConfig
from comvla_vla.prompt import Prompt
from comvla_vla.statistics import Statistics, pick_statistics

EMBEDDING = "language_model.model.embed_tokens."
SHARED_PREFIXES = ("projector.", EMBEDDING)
"""Tensors that both halves read."""

CONTENT = "content_sha256"
"""Key of ``config.json`` with :meth:`Checkpoint.content`."""


@dataclass(frozen=True)
class Checkpoint:
    """One policy or one half of it.

    Attributes:
        where: for messages. half: what it holds.
        config: sizes. statistics: the whole table. tokenizer: JSON text.
        tensors: everything that can be read, under published names.
        fingerprint: as stored; None where the format has none (published checkpoints).
        header: ``config.json`` as it was read.
        digests: of each tensor, as they were when the checkpoint was written; None where it says nothing of them.
    """

    where: str
    half: Literal["whole", "edge", "cloud"]
    config: ModelConfig
    statistics: Mapping[str, Any]
    tokenizer: str
    tensors: Catalogue
    fingerprint: str | None
    header: Mapping[str, Any] = field(default_factory=dict)
    digests: Mapping[str, str] | None = None

    def identity(self) -> str:
        """What the handshake compares.

        A published checkpoint that was not split is known by what both halves read of it, because each may hold
        only its own files. Splitting looks at every weight.
        """
        if self.fingerprint is not None:
            return self.fingerprint
        digests = sorted(
            (name, tensor_digest(entry.read()))
            for name, entry in self.tensors.items()
            if name.startswith(SHARED_PREFIXES)
        )
        content = [dict(self.header), dict(self.statistics), digests]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]

    def check_content(self) -> None:
        """Compares configuration, statistics, tokenizer and the list of digests with what was written.

        Raises:
            CheckpointError: one of them is damaged, or was edited by hand.
        """
        written = self.header.get(CONTENT)
        if written is not None and written != self.content():
            raise CheckpointError(
                f"{self.where}: configuration, statistics, tokenizer or list of digests are not what was written: "
                "the checkpoint is damaged or was edited by hand; copy it again, or split it again"
            )

    def content(self) -> str:
        """Hex digest over everything but the weights, and over their digests."""
        header = {key: value for key, value in self.header.items() if key != CONTENT}
        content = [header, dict(self.statistics), self.tokenizer, dict(self.digests or {})]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def check_digest(self, name: str, digest: str) -> None:
        """Compares the digest of a tensor that was read with that of what was written.

        Raises:
            CheckpointError: it differs.
        """
        if self.digests is not None and self.digests.get(name) != digest:
            raise CheckpointError(
                f"{self.where}: tensor {name} is not what was written: the weights are damaged; copy the checkpoint "
                "again, or split it again"
            )

    def prompt(self) -> Prompt:
        """The tokenizer, ready to use.

        Raises:
            CheckpointError: it is not one that the ``tokenizers`` library reads, or it belongs to another vocabulary.
        """
        try:
            tokenizer = Tokenizer.from_str(self.tokenizer)
        except Exception as error:  # tokenizers raises bare Exception
            raise CheckpointError(f"cannot read the tokenizer of {self.where}: {error}") from error
        largest, vocab = max(tokenizer.get_vocab().values(), default=0), self.config.backbone.vocab
        if largest >= vocab:
            raise CheckpointError(
                f"the tokenizer of {self.where} has ids up to {largest}, the model embeds {vocab}: it belongs to "
                "another checkpoint"
            )
        return Prompt(self.config.prompt, tokenizer)

    def chosen_statistics(self, key: str | None) -> Statistics:
        """One entry of the statistics, checked against the model's sizes.

        Raises:
            CheckpointError: no such entry, several without a choice, or those of another robot.
        """
        chosen = pick_statistics(dict(self.statistics), key, where=self.where)
        action = self.config.action
        came = len(chosen.action_low), len(chosen.action_high), len(chosen.action_mask)
        low, high = len(chosen.proprio_low), len(chosen.proprio_high)
        if set(came) != {action.action_dim} or not low == high >= action.proprio_dim:
            raise CheckpointError(
                f"statistics {chosen.key!r} describe {came} action and {low} proprioception values, the "
                f"model has {action.action_dim} and {action.proprio_dim}: they belong to another data set"
            )
        return chosen
