"""What an evaluation runs: settings that all its episodes share, and the grid of episodes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from comvla.errors import ComVLAError
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.layouts import evaluation_layout
from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.experiments.methods import find_method

if TYPE_CHECKING:
    from comvla_sim.worlds.base import Task

CONDITIONS = ("normal", "blind", "wrong_instruction", "wrong_selection")
"""How an episode is run: as it should be, or with one thing wrong (:mod:`.rollout`)."""

FULL = "full"
"""The method that sends all tokens: what the others are compared with."""

_UNTOLD = "untold"
"""Stands for the source of a method of one's own in rows of versions that did not look at it."""


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


@dataclass(frozen=True)
class EpisodeSpec:
    """One episode. Equal specs under equal settings give equal results.

    Attributes:
        condition: one of :data:`CONDITIONS`.
        method: name of a method (:mod:`.methods`).
        k: tokens sent; N for methods that decide themselves what they send; None for as many as the
            link carries.
        task: name of the world's task.
        episode: number that chooses the layout.
        link: that the episode runs over; None loses nothing and takes no time.
        source_sha256: of the file of a method of one's own (``package.module:ClassName``), which may change under
            its name; empty for the others, whose versions stand in the settings.

    Raises:
        UnknownMethodError: no class of that name.
    """

    condition: str
    method: str
    k: int | None
    task: str
    episode: int
    link: LinkCase | None = None
    source_sha256: str = ""

    def __post_init__(self) -> None:
        if ":" in self.method and not self.source_sha256:
            object.__setattr__(self, "source_sha256", find_method(self.method).source_sha256)

    def to_row(self) -> dict[str, Any]:
        """Plain JSON values, as they stand in a row of results."""
        row = {**vars(self), "link": None if self.link is None else self.link.to_dict()}
        if not self.source_sha256:
            del row["source_sha256"]
        return row

    @classmethod
    def from_row(cls, row: Mapping[str, Any]) -> EpisodeSpec:
        """The episode that a row reports.

        Raises:
            KeyError, TypeError: the row says too little.
        """
        own = {"source_sha256": _UNTOLD} if ":" in row["method"] else {"source_sha256": ""}
        named = {field.name: {**own, **row}[field.name] for field in fields(cls)}
        if named["link"] is not None:
            named["link"] = LinkCase.from_dict(named["link"])
        return cls(**named)


@dataclass(frozen=True)
class Grid:
    """Which episodes are wanted.

    Attributes:
        conditions: see :data:`CONDITIONS`.
        methods: names of methods.
        ks: numbers of tokens, None for what the link carries; a method that decides itself what it
            sends runs once, not once for each.
        tasks: names of tasks.
        episodes: layouts for each task.
        links: that every episode is run over; None is the ideal one.
    """

    conditions: tuple[str, ...]
    methods: tuple[str, ...]
    ks: tuple[int | None, ...]
    tasks: tuple[str, ...]
    episodes: int
    links: tuple[LinkCase | None, ...] = (None,)

    def check(self, *, num_tokens: int, seed: int) -> None:
        """Refuses a grid that cannot be run.

        Args:
            num_tokens: N of the model.
            seed: of the evaluation.

        Raises:
            EvaluationError: names what is wrong.
        """
        _known("--condition", self.conditions, CONDITIONS)
        check_methods(self.methods, ideal=None in self.links)
        if self.episodes < 1:
            raise EvaluationError(f"--episodes must be at least 1, got {self.episodes}")
        for episode in (0, self.episodes - 1):
            evaluation_layout(seed, episode)
        if not all(find_method(method).decides_itself for method in self.methods) and not self.ks:
            raise EvaluationError("--k is empty: give numbers of tokens such as 512,64,32,16")
        for k in self.ks:
            if k is None and None in self.links:
                raise EvaluationError("--k link needs a link that limits it: choose a --channel")
            if k is not None and not 1 <= k <= num_tokens:
                raise EvaluationError(f"--k must be from 1 to the model's {num_tokens}, got {k}")
        if not any(True for _ in self.specs(num_tokens)):
            raise EvaluationError(
                "--condition wrong_selection needs a method that listens when it selects: add "
                "hard_voting to --method"
            )

    def specs(self, num_tokens: int) -> Iterator[EpisodeSpec]:
        """All episodes, layout by layout, so that whatever is there already can be compared."""
        for episode, task, link in itertools.product(range(self.episodes), self.tasks, self.links):
            for condition, method in itertools.product(self.conditions, self.methods):
                if condition == "wrong_selection" and not find_method(method).listens:
                    continue  # what does not listen cannot be misled
                for k in (num_tokens,) if find_method(method).decides_itself else self.ks:
                    yield EpisodeSpec(condition, method, k, task, episode, link)


def check_methods(names: Sequence[str], *, ideal: bool, option: str = "--method") -> None:
    """Refuses names of methods that cannot be run.

    Args:
        names: as they were given.
        ideal: whether some episodes run over a link that loses nothing.
        option: that gave them.

    Raises:
        EvaluationError: names what is wrong.
    """
    if not names:
        raise EvaluationError(f"{option} is empty: comvla-sim eval --help lists what there is")
    for name in names:
        try:
            form = find_method(name).form()
        except (ComVLAError, ValueError) as error:
            raise EvaluationError(f"{option} {name}: {error}") from error
        if ideal and getattr(form, "adjustable", False):
            raise EvaluationError(
                f"{option} {name}: the link decides its quality, and an ideal link decides nothing: "
                f"name one, such as {name}-75{', or a --channel' if option == '--method' else ''}"
            )


def _known(option: str, names: Sequence[str], known: Sequence[str]) -> None:
    if not names:
        raise EvaluationError(f"{option} is empty: choose among {', '.join(known)}")
    for name in names:
        if name not in known:
            raise EvaluationError(f"{option} {name!r} is unknown: choose among {', '.join(known)}")


def chosen_tasks(wanted: Sequence[str] | None, tasks: Sequence[Task]) -> tuple[str, ...]:
    """Names of the tasks that were asked for by name or by instruction; all where nobody asked.

    Raises:
        EvaluationError: an unknown one.
    """
    if not wanted:
        return tuple(task.name for task in tasks)
    known = {name: task.name for task in tasks for name in (task.name, task.instruction)}
    for name in wanted:
        if name not in known:
            raise EvaluationError(
                f"--instructions {name!r} is unknown: choose among "
                f"{', '.join(task.name for task in tasks)}"
            )
    return tuple(dict.fromkeys(known[name] for name in wanted))
