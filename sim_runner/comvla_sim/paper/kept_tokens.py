"""Figure 3 for people: which tokens are kept, on one picture, by instruction, method and K."""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from comvla_client.registry import make_selector
from comvla_client.selection import ScoringContext
from comvla_sim.experiments.observing import OBJECT_POINT, token_at
from comvla_sim.experiments.worker import Worker
from comvla_sim.worlds.rendering import Renderer

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from comvla_sim.worlds.base import Task, World

Picture = npt.NDArray[np.uint8]

SIDE = 256
"""Pixels of a view in figures and films; the policy's own are smaller."""

METHODS = ("hard_voting", "soft_voting", "random")
BUDGETS = (128, 64, 48, 32, 16)
MOST_INSTRUCTIONS = 3

_DIMMED, _GREY = 0.22, 0.6


@dataclass(frozen=True)
class Selection:
    """What one method keeps for one instruction.

    Attributes:
        task: name of the task.
        instruction: the words; empty for a method that does not listen.
        method: name of the selector.
        ranking: (N,) positions, most important first.
        object_uv: (views, 2) where the named thing is, u to the right and v downwards, in [0, 1] inside a picture.
    """

    task: str
    instruction: str
    method: str
    ranking: npt.NDArray[np.int64]
    object_uv: npt.NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """One moment of one table.

    Attributes:
        views: (views, SIDE, SIDE, 3) uint8, for people.
        grid: (views, rows, columns) of the tokens.
        selections: in reading order.
        layout_seed: of the table.
    """

    views: Picture
    grid: tuple[int, int, int]
    selections: list[Selection]
    layout_seed: int


def large_views(world: World) -> Picture:
    """The present moment in pictures for people: drawn anew where that can be, else the world's own enlarged."""
    if world.model is None:
        views = world.observe()["images"]
        factor = max(1, SIDE // views.shape[1])
        return views.repeat(factor, axis=1).repeat(factor, axis=2)
    renderer = Renderer(world.model, SIDE)
    try:
        return np.array(renderer.draw(world.data))
    finally:
        renderer.close()


def select_on_one_picture(
    worker: Worker, layout_seed: int, methods: Sequence[str] = METHODS
) -> Scene:
    """Every method on the same picture under several instructions that the table allows.

    Args:
        worker: world and policy.
        layout_seed: of the table; one on which one thing allows opposite instructions shows most.
        methods: names of selectors.
    """
    world, edge = worker.world, worker.edge
    observation, _ = world.reset(seed=layout_seed)
    tokens = edge.encode(list(observation["images"]))
    projected = edge.project(tokens)
    tasks = _unlike(world.possible_tasks())
    selections = []
    for number, task in enumerate(tasks):
        point = world.points_of_interest(task)[OBJECT_POINT][None]
        for method in methods:
            selector = make_selector(method)
            if not selector.uses_language and number + 1 < len(tasks):
                continue  # what does not listen keeps the same tokens whatever is said
            context = ScoringContext(
                tokens,
                projected,
                edge.text_queries(task.instruction),
                edge.info.grid,
                np.random.default_rng([layout_seed, 0]),
                edge,
                task.instruction,
                world.proprio(),
            )
            ranking = np.asarray(selector.rank(context)).astype(np.int64)
            uv = np.asarray(world.project(point))[:, 0]
            words = task.instruction if selector.uses_language else ""
            selections.append(Selection(task.name, words, method, ranking, uv))
    return Scene(large_views(world), edge.info.grid, selections, layout_seed)


def _unlike(tasks: Sequence[Task]) -> list[Task]:
    """One task of each fixture first, then others, up to the number of rows that a page holds."""
    first = {task.fixture: task for task in reversed(tasks)}
    ordered = [*first.values(), *(task for task in tasks if task not in first.values())]
    return ordered[:MOST_INSTRUCTIONS]


def dimmed(
    views: Picture, grid: tuple[int, int, int], kept: npt.NDArray[np.int64]
) -> npt.NDArray[np.uint8]:
    """The views side by side, as they are where a token is kept, and grey and dark elsewhere.

    Args:
        views: (views, S, S, 3) uint8.
        grid: (views, rows, columns) of the tokens.
        kept: positions of the kept tokens.

    Returns:
        (S, views · S, 3) uint8.
    """
    count, rows, columns = grid
    height, width = views.shape[1:3]
    mask = np.zeros(count * rows * columns, bool)
    mask[kept] = True
    cells = mask.reshape(count, rows, columns)
    down = np.arange(height) * rows // height
    across = np.arange(width) * columns // width
    lit = cells[:, down][:, :, across][..., None]
    grey = views.mean(axis=-1, keepdims=True)
    dark = (_GREY * grey + (1 - _GREY) * views) * _DIMMED
    shown = np.where(lit, views, dark).astype(np.uint8)
    return np.concatenate(list(shown), axis=1)


def draw(scene: Scene, budgets: Sequence[int] = BUDGETS) -> bytes:
    """The figure as PNG: a row for each instruction and method, a column for each K.

    Args:
        scene: the selections.
        budgets: K of the columns.
    """
    import matplotlib
    from matplotlib.figure import Figure

    rows = len(scene.selections)
    with matplotlib.rc_context({"font.size": 10}):
        figure = Figure(
            figsize=(2.55 * (len(budgets) + 1), 1.42 * rows + 0.5), layout="constrained"
        )
        engine: Any = figure.get_layout_engine()
        engine.set(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
        grid = figure.subplots(rows, len(budgets) + 1, squeeze=False)
        everything = np.arange(np.prod(scene.grid))
        said = None
        for axes, selection in zip(grid, scene.selections, strict=True):
            first, said = selection.instruction != said, selection.instruction
            _panel(axes[0], dimmed(scene.views, scene.grid, everything))
            axes[0].set_ylabel(selection.method.replace("_", " "), fontsize=11)
            if said:
                _mark(axes[0], scene.views, selection.object_uv)
            if first:
                words = f"“{said}”" if said else "whatever is said"
                axes[0].set_title(
                    words, fontsize=11, fontweight="bold", loc="left", color="#0072B2"
                )
            for panel, k in zip(axes[1:], budgets, strict=True):
                _panel(panel, dimmed(scene.views, scene.grid, selection.ranking[:k]))
                if first:
                    panel.set_title(f"K = {k}", fontsize=11)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return _fewer_colours(buffer.getvalue())


def _panel(axes: Axes, picture: Picture) -> None:
    axes.imshow(picture, interpolation="none")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(False)


def _mark(axes: Axes, views: Picture, uv: npt.NDArray[np.float64]) -> None:
    """A ring around the thing that the instruction names."""
    size = views.shape[2]
    for view, (u, v) in enumerate(uv):
        if 0 <= u < 1 and 0 <= v < 1:
            axes.plot(
                view * size + u * size, v * size, "o", ms=11, mfc="none", mec="#FFD400", mew=1.8
            )


def _fewer_colours(png: bytes) -> bytes:
    """The same picture with 256 colours, a third of the bytes."""
    from PIL import Image

    picture = Image.open(io.BytesIO(png)).convert("RGB")
    small = picture.quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    small.save(buffer, "png", optimize=True)
    return buffer.getvalue()


def overlaps(scene: Scene, budgets: Sequence[int] = BUDGETS) -> list[dict[str, Any]]:
    """For methods that listen and every K: the share of kept tokens that two instructions have in common, and for how
    many instructions the token of the named thing is kept in some view.
    """
    found = []
    for method in dict.fromkeys(s.method for s in scene.selections if s.instruction):
        own = [s for s in scene.selections if s.method == method]
        for k in budgets:
            pairs = itertools.combinations([s.ranking[:k] for s in own], 2)
            shares = [len(np.intersect1d(a, b)) / k for a, b in pairs]
            hits = [
                not {x for x in token_at(s.object_uv, scene.grid) if x is not None}.isdisjoint(
                    s.ranking[:k].tolist()
                )
                for s in own
            ]
            found.append(
                {
                    "method": method,
                    "k": k,
                    "overlap": round(float(np.mean(shares)), 3) if shares else None,
                    "object_kept": sum(hits),
                    "instructions": len(own),
                }
            )
    return found
