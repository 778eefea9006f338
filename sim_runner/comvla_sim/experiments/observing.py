"""Looking over the edge half's shoulder: what it voted for, and whether the right thing was kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from comvla.model_info import ModelInfo
from comvla_client.edge import EdgeModel
from comvla_client.scoring import hard_votes
from comvla_client.selection import ScoringContext, Selector
from comvla_sim.worlds.base import Task, World

OBJECT_POINT = 1
"""Row of ``World.points_of_interest`` that is the object to touch."""


class ObservedEdge:
    """An edge model that remembers its last tokens, and may select by other words than it sends.

    Args:
        edge: the model.
        heard: an instruction that selects the tokens, whatever the client asks for; None selects by
            the client's own.
        look: pictures of this moment, taken when they are encoded, instead of those that the client
            has. Drawing is most of an episode's cost, and a robot that sends nothing needs none.
    """

    def __init__(
        self,
        edge: EdgeModel,
        heard: str | None = None,
        look: Callable[[], Sequence[npt.NDArray[np.uint8]]] | None = None,
    ) -> None:
        self._edge = edge
        self._heard = heard
        self._look = look
        self.tokens: Any = None
        self.projected: Any = None
        self.queries: Any = None

    @property
    def model(self) -> EdgeModel:
        """The model itself, which remembers nothing and hears what it is told."""
        return self._edge

    @property
    def info(self) -> ModelInfo:
        """Description of the model."""
        return self._edge.info

    @property
    def any_image_size(self) -> bool:
        """Whether the model resizes pictures itself."""
        return bool(getattr(self._edge, "any_image_size", False))

    @property
    def sees_instruction(self) -> bool:
        """Whether visual tokens depend on the instruction."""
        return bool(getattr(self._edge, "sees_instruction", False))

    def encode(
        self, images: Sequence[npt.NDArray[np.uint8]], instruction: str | None = None
    ) -> Any:
        """Visual tokens (N, D)."""
        self.projected = None
        edge: Any = self._edge
        if self._look is not None:
            images = self._look()
        self.tokens = (
            edge.encode(images, instruction) if self.sees_instruction else edge.encode(images)
        )
        return self.tokens

    def project(self, tokens: Any) -> Any:
        """Tokens (N, D) in the language's space: (N, d)."""
        self.projected = self._edge.project(tokens)
        return self.projected

    def text_queries(self, instruction: str) -> Any:
        """Queries (Q, d) of the instruction, or of the one that was heard instead."""
        self.queries = self._edge.text_queries(self._heard or instruction)
        return self.queries

    def lightvla_scores(self, projected: Any, instruction: str, proprio: Any) -> Any:
        """LightVLA's scores (N, N), by the words that were heard."""
        edge: Any = self._edge
        return edge.lightvla_scores(projected, self._heard or instruction, proprio)

    def text_driven_scores(self, projected: Any, instruction: str) -> Any:
        """VLA-ADP's scores (N,), by the words that were heard."""
        edge: Any = self._edge
        return edge.text_driven_scores(projected, self._heard or instruction)

    def queries_of(self, instruction: str) -> Any:
        """Queries (Q, d) of exactly these words, without remembering them."""
        return self._edge.text_queries(instruction)

    def flops(self, num_queries: int = 0) -> float:
        """Operations of one step on the robot."""
        return self._edge.flops(num_queries)


def token_at(uv: npt.NDArray[np.float64], grid: tuple[int, int, int]) -> list[int | None]:
    """The token that covers a projected point, for each view.

    Args:
        uv: (views, 2), u rightwards and v downwards in [0, 1].
        grid: (views, rows, columns) of the tokens.

    Returns:
        Index in 0..N−1, or None where the point lies outside the picture.
    """
    views, rows, columns = grid
    tokens: list[int | None] = []
    for view, (u, v) in zip(range(views), uv, strict=True):
        inside = 0 <= u < 1 and 0 <= v < 1
        cell = int(v * rows) * columns + int(u * columns) if inside else 0
        tokens.append(view * rows * columns + cell if inside else None)
    return tokens


class SelectionStatistics:
    """What an episode's selections were like, summed over its frames.

    Args:
        edge: the observed model that the episode's client uses.
        selector: one like the episode's; None where pictures were sent, so that nothing was selected.
        other_instruction: words of another task that the same pictures allow; None skips overlap.
        seed: for selectors that draw.
    """

    def __init__(
        self,
        edge: ObservedEdge,
        selector: Selector | None,
        other_instruction: str | None,
        seed: int,
    ) -> None:
        self._edge = edge
        self._selector = selector
        self._seed = seed
        self._frames = 0
        self._distinct = 0
        self._overlap = 0.0
        self._other_instruction = other_instruction
        self._other_queries: Any = None
        self._listens = selector is not None and selector.uses_language
        # What decides itself how much it keeps would keep another number for other words.
        comparable = selector is not None and self._listens and not selector.sends_all
        if other_instruction is not None and comparable:
            self._other_queries = edge.queries_of(other_instruction)
        views = edge.info.grid[0]
        self._visible = [0] * views
        self._hits = [0] * views
        self._visible_somewhere = 0
        self._hits_somewhere = 0

    def add(
        self,
        kept: npt.NDArray[np.int32],
        world: World | None,
        task: Task,
        proprio: npt.NDArray[np.float32] | None = None,
    ) -> None:
        """Takes one frame into account, before the robot moves on.

        Args:
            kept: (K,) positions that were sent.
            world: shows where the object is; None where the picture was of another place.
            task: the one whose object should be kept.
            proprio: (P,) that was sent with them.
        """
        self._frames += 1
        edge = self._edge
        if self._selector is None:
            return
        if self._listens:
            self._distinct += int((hard_votes(edge.queries, edge.projected) > 0).sum())
        if self._other_queries is not None:
            rng = np.random.default_rng([self._seed, self._frames])
            context = ScoringContext(
                edge.tokens,
                edge.projected,
                self._other_queries,
                edge.info.grid,
                rng,
                edge=edge.model,
                instruction=self._other_instruction,
                proprio=proprio,
            )
            others = self._selector.rank(context)[: len(kept)]
            self._overlap += len(np.intersect1d(kept, others)) / len(kept)
        if world is not None:
            point = world.points_of_interest(task)[OBJECT_POINT][None]
            self._count_hits(set(kept.tolist()), world.project(point)[:, 0])

    def _count_hits(self, kept: set[int], uv: npt.NDArray[np.float64]) -> None:
        tokens = token_at(uv, self._edge.info.grid)
        for view, token in enumerate(tokens):
            self._visible[view] += token is not None
            self._hits[view] += token in kept
        self._visible_somewhere += any(token is not None for token in tokens)
        self._hits_somewhere += any(token in kept for token in tokens)

    def as_dict(self) -> dict[str, Any]:
        """Sums over the frames; None for what was not looked at."""
        looked = self._listens
        compared = self._other_queries is not None
        return {
            "frames": self._frames,
            "distinct_votes": self._distinct if looked else None,
            "overlap": round(self._overlap, 6) if compared else None,
            "object_frames": self._visible_somewhere,
            "object_hits": self._hits_somewhere,
            "object_frames_by_view": self._visible,
            "object_hits_by_view": self._hits,
        }
