"""Batches from demonstrations: each picture under two of the instructions that its table allows.

The same picture gets another chunk under another instruction, so only the words can tell the policy what to do.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from comvla_sim.training.demonstrations import Demonstrations
from comvla_sim.training.grounding import query_targets
from comvla_sim.training.objective import Batch
from comvla_sim.worlds.base import Task
from comvla_vla.prompt import Prompt
from comvla_vla.statistics import Statistics


class Sampler:
    """Draws batches; a batch depends on (seed, step) only, so an interrupted run goes on as if it had not stopped.

    Args:
        data: demonstrations. tasks: of the world, in the demonstrations' order.
        prompt: of the model. statistics: normalises proprioception.
        seed: of the order of frames. paraphrase_share: how often a paraphrase replaces the instruction.
    """

    def __init__(
        self,
        data: Demonstrations,
        tasks: Sequence[Task],
        prompt: Prompt,
        statistics: Statistics,
        seed: int,
        paraphrase_share: float = 0.25,
    ) -> None:
        self.data = data
        self.statistics = statistics
        self.seed = seed
        self.paraphrase_share = paraphrase_share
        self._wordings = [
            [_wording(prompt, text) for text in (t.instruction, *t.paraphrases)] for t in tasks
        ]

    def batch(self, step: int, size: int) -> Batch:
        """The ``step``-th batch of ``size`` pictures, each under two instructions."""
        frames = np.arange(len(self.data))
        per_epoch = len(frames) // size
        if not per_epoch:
            raise ValueError(
                f"a batch of {size} pictures needs at least as many frames, there are {len(frames)}"
            )
        epoch, place = divmod(step, per_epoch)
        order = np.random.default_rng((self.seed, epoch)).permutation(frames)
        return self.of(
            order[place * size : (place + 1) * size], np.random.default_rng((self.seed, 1, step))
        )

    def of(self, frames: NDArray[np.integer], rng: np.random.Generator) -> Batch:
        """The given frames, each under its own task and one other that its table allows."""
        data = self.data
        tasks = []
        for frame in frames:
            own = int(data.task[frame])
            others = [t for t in np.flatnonzero(data.possible[frame]) if t != own]
            tasks += [own, int(rng.choice(others))]
        pairs, chosen = np.repeat(frames, 2), np.asarray(tasks)
        wordings = []
        for task in tasks:
            options = self._wordings[task]
            paraphrase = len(options) > 1 and rng.random() < self.paraphrase_share
            wordings.append(
                options[int(rng.integers(1, len(options)))] if paraphrase else options[0]
            )
        return Batch(
            images=torch.from_numpy(data.gather_images(frames)),
            proprio=torch.from_numpy(self.statistics.normalise_proprio(data.proprio[pairs])),
            prompts=_padded([ids for ids, _ in wordings], -1),
            wanted=_padded([wanted for _, wanted in wordings], 0),
            chunks=torch.from_numpy(data.chunks[pairs, chosen].astype(np.float32)),
            points=torch.from_numpy(np.asarray(data.points[pairs, chosen], np.float32)),
            uv=torch.from_numpy(np.asarray(data.uv[pairs, chosen], np.float32)),
        )


def _wording(prompt: Prompt, text: str) -> tuple[list[int], list[tuple[int, int]]]:
    """Prompt ids and the point that each query of the wording should find."""
    ids = list(prompt.ids(text))
    words = [str(prompt.tokenizer.id_to_token(i)) for i in ids[1:]]
    return ids, query_targets(words)


def _padded(rows: Sequence[Sequence[object]], value: int) -> torch.Tensor:
    longest = max(map(len, rows))
    tensors = [torch.tensor(row) for row in rows]
    out = torch.full((len(rows), longest, *tensors[0].shape[1:]), value, dtype=torch.long)
    for target, row in zip(out, tensors, strict=True):
        target[: len(row)] = row
    return out
