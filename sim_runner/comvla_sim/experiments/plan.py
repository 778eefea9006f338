"""What an evaluation runs: settings that all its episodes share, and the grid of episodes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.layouts import evaluation_layout
from comvla_sim.experiments.selectors import METHODS

CONDITIONS = ("normal", "blind", "wrong_instruction", "wrong_selection")
"""How an episode is run: as it should be, or with one thing wrong (:mod:`.rollout`)."""

FULL = "full"
"""The method that sends all tokens; it has one K only."""


@dataclass(frozen=True)
class EvalSettings:
    """What every episode of an evaluation shares.

    Attributes:
        world: name of the world (:func:`comvla_sim.worlds.make`).
        model: ``"mini"``, ``"random"`` (untrained weights), or a checkpoint folder.
        seed: chooses the layouts.
        quantization: of the tokens on the wire.
        target: ``host:port`` of a running server; None runs the cloud half in the worker.
    """

    world: str = "tabletop"
    model: str = "mini"
    seed: int = 0
    quantization: str = "int8"
    target: str | None = None


@dataclass(frozen=True, order=True)
class EpisodeSpec:
    """One episode. Equal specs under equal settings give equal results.

    Attributes:
        condition: one of :data:`CONDITIONS`.
        method: name of a selector.
        k: tokens sent; N for ``"full"``.
        task: name of the world's task.
        episode: number that chooses the layout.
    """

    condition: str
    method: str
    k: int
    task: str
    episode: int


@dataclass(frozen=True)
class Grid:
    """Which episodes are wanted.

    Attributes:
        conditions: see :data:`CONDITIONS`.
        methods: names of selectors.
        ks: numbers of tokens; ``"full"`` runs once, not once for each.
        tasks: names of tasks.
        episodes: layouts for each task.
    """

    conditions: tuple[str, ...]
    methods: tuple[str, ...]
    ks: tuple[int, ...]
    tasks: tuple[str, ...]
    episodes: int

    def check(self, *, num_tokens: int, seed: int) -> None:
        """Refuses a grid that cannot be run.

        Args:
            num_tokens: N of the model.
            seed: of the evaluation.

        Raises:
            EvaluationError: names what is wrong.
        """
        _known("--condition", self.conditions, CONDITIONS)
        _known("--method", self.methods, tuple(METHODS))
        if self.episodes < 1:
            raise EvaluationError(f"--episodes must be at least 1, got {self.episodes}")
        for episode in (0, self.episodes - 1):
            evaluation_layout(seed, episode)
        if any(method != FULL for method in self.methods) and not self.ks:
            raise EvaluationError("--k is empty: give numbers of tokens such as 512,64,32,16")
        for k in self.ks:
            if not 1 <= k <= num_tokens:
                raise EvaluationError(f"--k must be from 1 to the model's {num_tokens}, got {k}")
        if not any(True for _ in self.specs(num_tokens)):
            raise EvaluationError(
                "--condition wrong_selection needs a method that listens when it selects: add "
                "hard_voting to --method"
            )

    def specs(self, num_tokens: int) -> Iterator[EpisodeSpec]:
        """All episodes, layout by layout, so that whatever is there already can be compared."""
        for episode, task in itertools.product(range(self.episodes), self.tasks):
            for condition, method in itertools.product(self.conditions, self.methods):
                if condition == "wrong_selection" and not METHODS[method].uses_language:
                    continue  # what does not listen cannot be misled
                for k in (num_tokens,) if method == FULL else self.ks:
                    yield EpisodeSpec(condition, method, k, task, episode)


def _known(option: str, names: Sequence[str], known: Sequence[str]) -> None:
    if not names:
        raise EvaluationError(f"{option} is empty: choose among {', '.join(known)}")
    for name in names:
        if name not in known:
            raise EvaluationError(f"{option} {name!r} is unknown: choose among {', '.join(known)}")
