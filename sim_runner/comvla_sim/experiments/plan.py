"""What an evaluation runs: settings that all its episodes share, and the grid of episodes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from comvla.errors import ComVLAError
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.layouts import evaluation_layout
from comvla_sim.experiments.methods import find_method

CONDITIONS = ("normal", "blind", "wrong_instruction", "wrong_selection")
"""How an episode is run: as it should be, or with one thing wrong (:mod:`.rollout`)."""

FULL = "full"
"""The method that sends all tokens: what the others are compared with."""


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
        method: name of a method (:mod:`.methods`).
        k: tokens sent; N for methods that decide themselves what they send.
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
        methods: names of methods.
        ks: numbers of tokens; a method that decides itself what it sends runs once, not once for each.
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
        self._check_methods()
        if self.episodes < 1:
            raise EvaluationError(f"--episodes must be at least 1, got {self.episodes}")
        for episode in (0, self.episodes - 1):
            evaluation_layout(seed, episode)
        if not all(find_method(method).decides_itself for method in self.methods) and not self.ks:
            raise EvaluationError("--k is empty: give numbers of tokens such as 512,64,32,16")
        for k in self.ks:
            if not 1 <= k <= num_tokens:
                raise EvaluationError(f"--k must be from 1 to the model's {num_tokens}, got {k}")
        if not any(True for _ in self.specs(num_tokens)):
            raise EvaluationError(
                "--condition wrong_selection needs a method that listens when it selects: add "
                "hard_voting to --method"
            )

    def _check_methods(self) -> None:
        if not self.methods:
            raise EvaluationError("--method is empty: comvla-sim eval --help lists what there is")
        for name in self.methods:
            try:
                form = find_method(name).form()
            except ComVLAError as error:
                raise EvaluationError(f"--method {name}: {error}") from error
            except ValueError as error:
                raise EvaluationError(f"--method {name}: {error}") from error
            if getattr(form, "adjustable", False):
                raise EvaluationError(
                    f"--method {name}: the link decides its quality, and an ideal link decides nothing: "
                    f"name one, such as {name}-75"
                )

    def specs(self, num_tokens: int) -> Iterator[EpisodeSpec]:
        """All episodes, layout by layout, so that whatever is there already can be compared."""
        for episode, task in itertools.product(range(self.episodes), self.tasks):
            for condition, method in itertools.product(self.conditions, self.methods):
                if condition == "wrong_selection" and not find_method(method).listens:
                    continue  # what does not listen cannot be misled
                for k in (num_tokens,) if find_method(method).decides_itself else self.ks:
                    yield EpisodeSpec(condition, method, k, task, episode)


def _known(option: str, names: Sequence[str], known: Sequence[str]) -> None:
    if not names:
        raise EvaluationError(f"{option} is empty: choose among {', '.join(known)}")
    for name in names:
        if name not in known:
            raise EvaluationError(f"{option} {name!r} is unknown: choose among {', '.join(known)}")
