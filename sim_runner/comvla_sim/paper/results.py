"""What was measured, as one JSON object: all that the document is made of."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.statistics import wilson_interval
from comvla_sim.paper.cells import Cell
from comvla_sim.paper.published import SUITES
from comvla_sim.paper.verdicts import Rate

FORMAT = 2

Json = dict[str, Any]


@dataclass(frozen=True)
class Results:
    """Measured values by cell.

    Attributes:
        data: ``format``, ``story`` (what was run on what), ``cells``, ``pairs``, and where they were measured
            ``latency``, ``layers``, ``figure3``, ``fading``, ``csi-delay``.
    """

    data: Json

    @property
    def story(self) -> Json:
        """What was run on what."""
        story: Json = self.data["story"]
        return story

    @property
    def suites(self) -> list[str]:
        """Worlds that were measured, in order."""
        return list(self.story["suites"])

    @property
    def libero(self) -> bool:
        """Whether the paper's own benchmark was run."""
        return bool(self.story["world"] == "libero")

    @property
    def some_suites(self) -> bool:
        """Whether it was run on a part of LIBERO only, so that the paper's averages say nothing."""
        return self.libero and len(self.suites) < len(SUITES)

    @property
    def stand_in(self) -> bool:
        """Whether it was drawn with stand-in assets, so that nothing may be compared."""
        return bool(self.story["settings"].get("assets") == "stand-in")

    @property
    def cells(self) -> list[Cell]:
        """Everything that has at least one episode."""
        found = (Cell(c["method"], c["k"], c["quantization"]) for c in self.data["cells"])
        return list(dict.fromkeys(found))

    def find(self, cell: Cell, suite: str | None = None) -> Json | None:
        """Counts of a cell: of one suite, or of all together; None where nothing was measured."""
        found = [
            c
            for c in self.data["cells"]
            if Cell(c["method"], c["k"], c["quantization"]) == cell and suite in (None, c["suite"])
        ]
        if not found:
            return None
        return found[0] if len(found) == 1 else _pooled(found)

    def rate(self, cell: Cell, suite: str | None = None) -> Rate | None:
        """Its success rate."""
        found = self.find(cell, suite)
        return None if found is None else Rate(found["successes"], found["episodes"])

    def pair(self, first: Cell, second: Cell, suite: str | None = None) -> Json | None:
        """The paired test of two cells, in this order: of one of LIBERO's suites, or of all together."""
        for test in self.data["pairs"]:
            cells = Cell(**test["first"]), Cell(**test["second"])
            if cells == (first, second) and test["suite"] == suite:
                found: Json = test
                return found
        return None

    def shared(
        self, first: Cell, second: Cell, suite: str | None = None
    ) -> tuple[Rate, Rate] | None:
        """Success rates of two cells on the episodes that both have; None where there are none."""
        turned = self.pair(second, first, suite)
        test = self.pair(first, second, suite) or turned
        if test is None:
            return None
        rates = [
            Rate(test["both"] + test[only], test["pairs"]) for only in ("only_first", "only_second")
        ]
        return (rates[1], rates[0]) if test is turned else (rates[0], rates[1])

    @property
    def same_tables(self) -> bool:
        """Whether every cell has the same episodes, so that no comparison leaves any out."""
        counts = {found["episodes"] for cell in self.cells if (found := self.find(cell))}
        return len(counts) <= 1 and all(
            test["pairs"] in counts for test in self.data["pairs"] if test["suite"] is None
        )

    def latency(self, cell: Cell) -> Json | None:
        """Median times of a query."""
        for row in self.data.get("latency", {}).get("rows", ()):
            if Cell(row["method"], row["k"], row["quantization"]) == cell:
                found: Json = row
                return found
        return None

    def save(self, path: Path) -> None:
        """Writes the object, the same bytes for the same results.

        Raises:
            EvaluationError: the file cannot be written.
        """
        write(path, (json.dumps(self.data, indent=1, ensure_ascii=False) + "\n").encode())

    @classmethod
    def load(cls, path: Path) -> Results:
        """Reads what :meth:`save` wrote.

        Raises:
            EvaluationError: it cannot be read, or is of another version.
        """
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise EvaluationError(f"cannot read results from {path}: {error}") from error
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise EvaluationError(
                f"{path} holds no results of format {FORMAT}: run comvla-sim paper all again"
            )
        return cls(data)


def _pooled(found: list[Json]) -> Json:
    """Several suites as one: counts added, means weighted by queries."""
    episodes, successes = (sum(c[key] for c in found) for key in ("episodes", "successes"))
    queries = sum(c["queries"] for c in found)
    low, high = wilson_interval(successes, episodes)
    means = {
        key: round(sum(c[key] * c["queries"] for c in found) / queries, 1)
        for key in ("payload_bytes", "wire_bytes", "edge_flops", "cloud_flops")
    }
    tasks = {f"{c['suite']} {task}": count for c in found for task, count in c["tasks"].items()}
    return {
        **found[0],
        **means,
        "suite": "all",
        "episodes": episodes,
        "successes": successes,
        "low": low,
        "high": high,
        "queries": queries,
        "tasks": tasks,
        "object_hit_rate": None,
    }


def write(path: Path, content: bytes) -> None:
    """Writes a file whole: whoever reads it, also after this process died, sees what was there before or all of this.

    Raises:
        EvaluationError: it cannot be written.
    """
    path = path.resolve()  # what a link leads to is written, not the link
    half = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            half.write_bytes(content)
            half.replace(path)
        finally:
            half.unlink(missing_ok=True)
    except OSError as error:
        raise EvaluationError(f"cannot write {path}: {error.strerror}") from error
