"""A film of an episode: what the robot sees, and which tokens it sends, query after query."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from comvla_client import ComVLAClient
from comvla_sim.experiments.methods import find_method
from comvla_sim.experiments.worker import Worker
from comvla_sim.paper.kept_tokens import Picture, dimmed
from comvla_sim.worlds.rendering import Renderer

SIDE = 192
FRAME_EVERY = 2
"""Control periods between two pictures."""

CAPTION_HEIGHT = 44
_SLOWER = 2
"""The film runs at half the speed of the robot's clock, so that eyes can follow."""

_LAST_FRAME_MS = 1500


@dataclass(frozen=True)
class Film:
    """A film and what it shows.

    Attributes:
        data: an animated WebP.
        success: whether the task was fulfilled.
        periods: control periods of the episode.
        queries: how often the robot asked.
    """

    data: bytes
    success: bool
    periods: int
    queries: int


def shoot(worker: Worker, task: str, layout_seed: int, k: int, method: str = "hard_voting") -> Film:
    """Runs one episode and films it: above as it is, below the tokens that were sent last.

    Args:
        worker: world and policy.
        task: name of the task.
        layout_seed: of the table.
        k: tokens of a query.
        method: name of the selector.
    """
    world = worker.world
    chosen = world.find_task(task)
    observation, _ = world.reset(seed=layout_seed, options={"task": task})
    renderer = Renderer(world.model, SIDE)
    frames: list[Picture] = []
    period = queries = 0
    success = False
    kept = np.zeros(0, np.int64)

    def keep(done: bool = False) -> None:
        words = (
            f"“{chosen.instruction}”",
            (
                f"{method.replace('_', ' ')}, {k} of {worker.edge.info.num_tokens} tokens   "
                f"period {period:3d}, query {queries}{'   done' if done else ''}"
            ),
        )
        frames.append(
            _frame(np.array(renderer.draw(world.data)), worker.edge.info.grid, kept, words)
        )

    client = ComVLAClient(
        worker.target(find_method(method)),
        edge=worker.edge,
        uplink=find_method(method).form(),
        budget=k,
        deadline_s=600.0,
        seed=layout_seed,
    )
    try:
        with client:
            while not success and period < world.max_episode_steps:
                chunk = client.step(observation, chosen.instruction)
                kept = chunk.report.positions.astype(np.int64)
                queries += 1
                for action in world.from_policy(chunk.actions):
                    if period % FRAME_EVERY == 0:
                        keep()
                    world.advance(action)
                    period += 1
                    success = world.successes()[task]
                    if success or period == world.max_episode_steps:
                        break
                observation = world.observe()
        keep(done=success)
    finally:
        renderer.close()
    every_ms = round(1000 * FRAME_EVERY * worker.edge.info.control_period_s * _SLOWER)
    return Film(_encoded(frames, every_ms), success, period, queries)


def _frame(
    views: Picture, grid: tuple[int, int, int], kept: npt.NDArray[np.int64], words: tuple[str, str]
) -> Picture:
    from PIL import Image, ImageDraw, ImageFont

    everything = np.arange(np.prod(grid))
    body = np.concatenate([dimmed(views, grid, everything), dimmed(views, grid, kept)])
    picture = Image.new("RGB", (body.shape[1], body.shape[0] + CAPTION_HEIGHT), "#14181d")
    picture.paste(Image.fromarray(body), (0, CAPTION_HEIGHT))
    pen = ImageDraw.Draw(picture)
    pen.text((8, 4), words[0], font=ImageFont.load_default(15), fill="#ffd400")
    pen.text((8, 24), words[1], font=ImageFont.load_default(12), fill="#e6e6e6")
    return np.asarray(picture)


def _encoded(frames: list[Picture], every_ms: int) -> bytes:
    from PIL import Image

    pictures = [Image.fromarray(frame) for frame in frames]
    buffer = io.BytesIO()
    durations = [every_ms] * (len(pictures) - 1) + [_LAST_FRAME_MS]
    pictures[0].save(
        buffer,
        "webp",
        save_all=True,
        append_images=pictures[1:],
        duration=durations,
        loop=0,
        quality=60,
        method=4,
    )
    return buffer.getvalue()
