"""Runs the episodes of a figure that no earlier run has left behind."""

from __future__ import annotations

import functools
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from comvla_sim.experiments import runner
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.layouts import evaluation_layout
from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.experiments.progress import cores, episode_bar, typed_command
from comvla_sim.experiments.results import ResultsFile, Row, read_rows
from comvla_sim.figures.series import Series


@dataclass(frozen=True)
class Study:
    """What a figure is measured on.

    Attributes:
        settings: of the evaluation.
        subject: the model and the world.
        tasks: names of tasks.
        episodes: layouts for each task.
        out: folder of results and pictures.
        workers: processes; 0 for one per core.
        ray: address of a Ray cluster; None for processes of this machine.
        reuse: folders of other runs, whose episodes are taken over.
    """

    settings: EvalSettings
    subject: runner.Subject
    tasks: tuple[str, ...]
    episodes: int
    out: Path
    workers: int
    ray: str | None = None
    reuse: tuple[Path, ...] = ()

    def check(self) -> None:
        """Refuses what cannot be run.

        Raises:
            EvaluationError: names what is wrong.
        """
        if self.workers < 0:
            raise EvaluationError(f"--workers must be 0 (one per core) or more, got {self.workers}")
        if self.episodes < 1:
            raise EvaluationError(f"--episodes must be at least 1, got {self.episodes}")
        evaluation_layout(self.settings.seed, self.episodes - 1)
        for folder in self.reuse:
            if not folder.is_dir():
                raise EvaluationError(
                    f"--reuse {folder} is no folder: name one with results of earlier runs, such as runs/eval"
                )


def specs(
    study: Study, series: Mapping[str, Series], links: Sequence[LinkCase]
) -> list[EpisodeSpec]:
    """Every episode of every line over every link, layout by layout, each once."""
    count = study.subject.num_tokens
    return list(
        dict.fromkeys(
            line.spec(link, task, episode, count)
            for episode in range(study.episodes)
            for task in study.tasks
            for link in links
            for line in series.values()
        )
    )


def measure(name: str, study: Study, wanted: Sequence[EpisodeSpec]) -> dict[EpisodeSpec, Row]:
    """The rows of all episodes; those that another figure in the same folder has are taken over.

    Args:
        name: of the figure, and of its results file.
        study: what is measured on.
        wanted: episodes.

    Raises:
        KeyboardInterrupt: after Ctrl-C, with everything measured so far in the file.
        ComVLAError: whatever an episode raised.
    """
    study.check()
    shared = study.subject.settings
    path = study.out / f"{name}.jsonl"
    with ResultsFile(path, shared) as results:
        missing = [spec for spec in wanted if spec not in results.rows]
        for row in kept(name, study, missing, own=False).values():
            results.append(row)
        done = sum(spec in results.rows for spec in wanted)
        print(f"{path}: {done} of {len(wanted)} episodes are there", file=sys.stderr)
        try:
            with episode_bar(len(wanted), done) as on_row:
                runner.run(
                    study.settings,
                    wanted,
                    results,
                    shared=shared,
                    story=runner.environment(study.settings, typed_command()),
                    workers=study.workers or cores(),
                    ray=study.ray,
                    on_row=on_row,
                )
        except KeyboardInterrupt:
            print(f"\nstopped; the same command goes on from {path}", file=sys.stderr)
            raise
        return {spec: results.rows[spec] for spec in wanted}


def kept(
    name: str, study: Study, wanted: Sequence[EpisodeSpec], *, own: bool = True
) -> dict[EpisodeSpec, Row]:
    """The rows that earlier runs have left behind, in the order in which they are wanted.

    Other files that are no results, or those of a version to come, are left out, and standard error says so.

    Args:
        name: of the figure, and of its results file.
        study: what is measured on.
        wanted: episodes.
        own: whether the file of that name is read, too.

    Raises:
        EvaluationError: the file of that name is none of results.
    """
    path = study.out / f"{name}.jsonl"
    missing, found = set(wanted), {}
    for folder in dict.fromkeys((study.out, *study.reuse)):
        for file in sorted(folder.glob("*.jsonl"), key=lambda file: file != path):
            if (file == path and not own) or not missing:
                continue
            for row in read_rows(file)[0] if file == path else _rows_of_others(file):
                spec = EpisodeSpec.from_row(row)
                if row["settings"] == study.subject.settings and spec in missing:
                    found[spec] = row
                    missing.discard(spec)
    return {spec: found[spec] for spec in wanted if spec in found}


def _rows_of_others(file: Path) -> list[Row]:
    try:
        return read_rows(file)[0]
    except EvaluationError as error:
        _say_once(f"left out: {error}")
        return []


@functools.cache
def _say_once(text: str) -> None:
    """Each group of cells asks for the same files again."""
    print(text, file=sys.stderr)
