"""Training of a codec: pictures through random periods of the channel, mean squared error."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from comvla_sim.codecs.fading import draw_gains
from comvla_sim.codecs.pictures import Pictures
from comvla_sim.training.run_state import (
    RunState,
    TrainingError,
    learning_rate,
    load_run,
    optimizer_tensors,
    save_run,
    set_optimizer_tensors,
)
from comvla_vla.codecs.analogue import noise_power
from comvla_vla.codecs.image_codec import ImageCodec, config_from_json


@dataclass(frozen=True)
class CodecRecipe:
    """Everything that fixes a training run, so that two runs with one recipe are the same run.

    Attributes:
        codec: name. config: of its networks, as JSON values.
        image_size: side of a picture in pixels. layouts: tables in the data.
        seed: of weights, order, gains and noise.
        steps: optimiser steps. batch_size: pictures per step.
        learning_rate, warmup_steps, final_share: cosine schedule.
        mean_snr_db: least and greatest mean SNR; uniform in between, one draw for each picture.
        channels: kinds of fading, one drawn for each step.
    """

    codec: str
    config: dict[str, Any] = field(default_factory=dict)
    image_size: int = 128
    layouts: int = 400
    seed: int = 0
    steps: int = 3000
    batch_size: int = 8
    learning_rate: float = 1e-3
    warmup_steps: int = 50
    final_share: float = 0.02
    mean_snr_db: tuple[float, float] = (0.0, 20.0)
    channels: tuple[str, ...] = ("awgn", "rician", "rayleigh")


@dataclass(frozen=True)
class Progress:
    """One report: means since the last one."""

    step: int
    steps: int
    psnr_db: float
    pictures_per_second: float


class CodecTrainer:
    """Trains one codec.

    Args:
        recipe: of the run.
        folder: where checkpoints go.
    """

    def __init__(self, recipe: CodecRecipe, folder: Path) -> None:
        self.recipe, self.folder = recipe, folder
        torch.manual_seed(recipe.seed)
        self.codec = ImageCodec(config_from_json(recipe.codec, recipe.config))
        self.optimizer = torch.optim.Adam(self.codec.parameters(), lr=recipe.learning_rate)
        self.step = 0
        self.seconds = 0.0

    def resume(self) -> bool:
        """Takes up the last checkpoint of this folder; False where there is none.

        Raises:
            TrainingError: the folder belongs to a run with another recipe, or is damaged.
        """
        state = load_run(self.folder, self.recipe)
        if state is None:
            return False
        self.step, self.seconds = state.step, state.seconds
        weights = self.codec.state_dict()
        self.codec.load_state_dict({name: state.tensors[f"codec.{name}"] for name in weights})
        set_optimizer_tensors(self.optimizer, state.tensors)
        return True

    def save(self) -> None:
        """Writes a checkpoint."""
        tensors = {f"codec.{name}": value for name, value in self.codec.state_dict().items()}
        tensors |= optimizer_tensors(self.optimizer)
        save_run(self.folder, self.recipe, RunState(self.step, self.seconds, tensors))

    def run(
        self,
        pictures: Pictures,
        report: Callable[[Progress], None],
        report_every: int = 25,
        save_every: int = 100,
        until: int | None = None,
    ) -> None:
        """Trains to the recipe's last step, or to ``until``. Interrupting it keeps the last checkpoint."""
        end = min(self.recipe.steps, until or self.recipe.steps)
        error, begun, count = 0.0, time.monotonic(), 0
        self.codec.train()
        while self.step < end:
            started = time.monotonic()
            error += self.one_step(pictures)
            self.step, count = self.step + 1, count + 1
            self.seconds += time.monotonic() - started
            if self.step % report_every == 0 or self.step == end:
                rate = self.recipe.batch_size * count / (time.monotonic() - begun)
                psnr_db = -10 * float(np.log10(error / count))
                report(Progress(self.step, self.recipe.steps, psnr_db, rate))
                error, begun, count = 0.0, time.monotonic(), 0
            if self.step % save_every == 0 or self.step == end:
                self.save()

    def one_step(self, pictures: Pictures) -> float:
        """One step of the optimiser; returns the mean squared error before it."""
        recipe = self.recipe
        rng = np.random.default_rng((recipe.seed, 1, self.step))
        images = pictures.batch(self.step, recipe.batch_size)
        gain, noise = draw_periods(recipe, len(images), rng)
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(recipe, self.step)
        loss = mse_loss(self.codec(images, gain, noise, generator), images)
        if not torch.isfinite(loss):
            raise TrainingError(
                f"the loss is {float(loss)} at step {self.step}: lower the learning rate"
            )
        self.optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        torch.nn.utils.clip_grad_norm_(self.codec.parameters(), 1.0)
        self.optimizer.step()
        return float(loss.detach())


def draw_periods(
    recipe: CodecRecipe, count: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """A gain (count,) and a noise power (count,) for each picture of a step."""
    kind = recipe.channels[int(rng.integers(len(recipe.channels)))]
    mean_snr_db = torch.from_numpy(rng.uniform(*recipe.mean_snr_db, count).astype(np.float32))
    return torch.from_numpy(draw_gains(kind, count, rng)), noise_power(mean_snr_db)
