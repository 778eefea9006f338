"""The training loop: resumable, seeded, one thread or more on a CPU."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from comvla_sim.training.batches import Sampler
from comvla_sim.training.objective import Learner, Weights
from comvla_sim.training.run_state import (
    RunState,
    TrainingError,
    learning_rate,
    load_run,
    optimizer_tensors,
    save_run,
    set_optimizer_tensors,
)
from comvla_vla.config import ModelConfig
from comvla_vla.linear import cpu_multiplies_bfloat16
from comvla_vla.nets import join

__all__ = ["Progress", "Recipe", "Trainer", "TrainingError", "learning_rate"]


@dataclass(frozen=True)
class Recipe:
    """Everything that fixes a training run, so that two runs with one recipe are the same run.

    Attributes:
        seed: of weights, order of frames, numbers of tokens and random selections.
        steps: optimiser steps. batch_size: pictures per step, each under two instructions.
        learning_rate, warmup_steps, final_share: cosine schedule from the rate to ``final_share`` of it.
        weight_decay: of matrices; vectors have none.
        token_counts, token_shares: K drawn at each step, and how often.
        random_share: how often the kept tokens are random instead of voted. 0 trains for votes only; 0.5 gives a
            policy on which random selection is a fair control.
        bfloat16: matrix products in bfloat16, on processors that have instructions for it; others run in float32,
            which is many times quicker there.
    """

    seed: int = 0
    steps: int = 4000
    batch_size: int = 32
    learning_rate: float = 1e-3
    warmup_steps: int = 50
    final_share: float = 0.03
    weight_decay: float = 0.05
    token_counts: tuple[int, ...] = (512, 128, 64, 32, 16)
    token_shares: tuple[float, ...] = (0.04, 0.08, 0.20, 0.34, 0.34)
    random_share: float = 0.0
    bfloat16: bool = True


@dataclass(frozen=True)
class Progress:
    """One report of a running training; losses are means since the last report."""

    step: int
    steps: int
    losses: dict[str, float]
    pairs_per_second: float


class Trainer:
    """Trains both halves together on batches of a :class:`Sampler`.

    Args:
        config: of the policy. recipe: of the run.
        folder: where checkpoints go (``state.safetensors``, ``state.json``).
        data: digest of the demonstrations, by which a run that goes on knows them; None where nobody asks.
    """

    def __init__(
        self, config: ModelConfig, recipe: Recipe, folder: Path, data: str | None = None
    ) -> None:
        self.config, self.recipe, self.folder, self.data = config, recipe, folder, data
        torch.manual_seed(recipe.seed)
        self.learner = Learner(*join(config))
        matrices = [p for p in self.learner.parameters() if p.ndim >= 2]
        vectors = [p for p in self.learner.parameters() if p.ndim < 2]
        groups = [
            {"params": matrices, "weight_decay": recipe.weight_decay},
            {"params": vectors, "weight_decay": 0.0},
        ]
        self.optimizer = torch.optim.AdamW(groups, lr=recipe.learning_rate, betas=(0.9, 0.98))
        self.step = 0
        self.seconds = 0.0

    def resume(self) -> bool:
        """Takes up the last checkpoint of this folder; False where there is none.

        Raises:
            TrainingError: the folder belongs to a run with another recipe or other demonstrations.
        """
        state = load_run(self.folder, self.recipe, self.data)
        if state is None:
            return False
        self.step, self.seconds = state.step, state.seconds
        self._set_state(state.tensors)
        return True

    def save(self) -> None:
        """Writes a checkpoint; the notes name it only once it is whole."""
        save_run(
            self.folder, self.recipe, RunState(self.step, self.seconds, self._state()), self.data
        )

    def run(
        self,
        sampler: Sampler,
        report: Callable[[Progress], None],
        report_every: int = 25,
        save_every: int = 250,
    ) -> None:
        """Trains to the recipe's last step. Interrupting it keeps the last checkpoint."""
        sums: dict[str, float] = {}
        begun, count = time.monotonic(), 0
        self.learner.train()
        while self.step < self.recipe.steps:
            started = time.monotonic()
            for name, value in self._one_step(sampler).items():
                sums[name] = sums.get(name, 0.0) + value
            self.step, count = self.step + 1, count + 1
            self.seconds += time.monotonic() - started
            last = self.step == self.recipe.steps
            if self.step % report_every == 0 or last:
                rate = 2 * self.recipe.batch_size * count / (time.monotonic() - begun)
                means = {name: value / count for name, value in sums.items()}
                report(Progress(self.step, self.recipe.steps, means, rate))
                sums, begun, count = {}, time.monotonic(), 0
            if self.step % save_every == 0 or last:
                self.save()

    def losses(self, sampler: Sampler, frames: Any, k: int, selection: str) -> dict[str, float]:
        """Loss terms on given frames without learning (validation)."""
        generator = torch.Generator().manual_seed(0)
        with torch.no_grad():
            batch = sampler.of(frames, np.random.default_rng(0))
            terms = self.learner(batch, k, selection, generator)
        return {name: float(value.detach()) for name, value in terms.items()}

    def _one_step(self, sampler: Sampler) -> dict[str, float]:
        recipe, weights = self.recipe, Weights()
        rng = np.random.default_rng((recipe.seed, 2, self.step))
        shares = np.asarray(recipe.token_shares) / sum(recipe.token_shares)
        k = int(rng.choice(recipe.token_counts, p=shares))
        selection = "random" if rng.random() < recipe.random_share else "votes"
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        batch = sampler.batch(self.step, recipe.batch_size)
        narrow = recipe.bfloat16 and cpu_multiplies_bfloat16()
        with torch.autocast("cpu", torch.bfloat16, enabled=narrow):
            terms: dict[str, Tensor] = self.learner(batch, k, selection, generator)
        loss = terms["action"] + weights.state * terms["state"]
        loss = loss + weights.attention * terms["attention"] + weights.matching * terms["matching"]
        if not torch.isfinite(loss):
            raise TrainingError(
                f"the loss is {float(loss)} at step {self.step}: lower the learning rate"
            )
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(recipe, self.step)
        self.optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        torch.nn.utils.clip_grad_norm_(self.learner.parameters(), 1.0)
        self.optimizer.step()
        return {name: float(value.detach()) for name, value in terms.items()}

    def _state(self) -> dict[str, Tensor]:
        tensors = {f"learner.{name}": value for name, value in self._own_state().items()}
        return tensors | optimizer_tensors(self.optimizer)

    def _own_state(self) -> dict[str, Tensor]:
        # The projector stands in both halves but is one module: save it once.
        return {
            k: v
            for k, v in self.learner.state_dict().items()
            if not k.startswith("cloud.projector.")
        }

    def _set_state(self, tensors: dict[str, Tensor]) -> None:
        with torch.no_grad():
            for name, value in self._own_state().items():
                value.copy_(tensors[f"learner.{name}"])
        set_optimizer_tensors(self.optimizer, tensors)
