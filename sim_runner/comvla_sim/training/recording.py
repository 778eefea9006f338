"""Recording of noisy expert episodes, with a clean label for every instruction at every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from comvla_sim.worlds.base import ACTION_DIM, Task, World


@dataclass(frozen=True)
class Recording:
    """How episodes are recorded. Shards of different recordings are never mixed.

    Attributes:
        world: name of the world.
        image_size: side of a picture in pixels.
        image_stride: a frame is kept every so many control steps.
        horizon: steps of a labelled chunk.
        episodes_per_layout: episodes of one layout, each with a fixture of its own where possible.
        noise: standard deviation of the Gaussian noise on the expert's actions.
        burst_probability: chance per step that a burst of one random action begins.
        burst_steps: shortest and longest burst, so that recovery is seen, too.
        max_steps: an episode ends here.
        steps_after_success: and is followed so long after its success.
        layouts_per_shard: layouts in a file of the data set.
    """

    world: str = "tabletop"
    image_size: int = 128
    image_stride: int = 2
    horizon: int = 8
    episodes_per_layout: int = 2
    noise: float = 0.12
    burst_probability: float = 0.04
    burst_steps: tuple[int, int] = (2, 6)
    max_steps: int = 170
    steps_after_success: int = 10
    layouts_per_shard: int = 25

    def as_json(self) -> dict[str, Any]:
        """The settings as plain JSON values."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}


@dataclass
class Frames:
    """Frames of one or more episodes, as lists with one entry a frame.

    The shapes of the entries, with T tasks, V views and H labelled steps:
    images (V, S, S, 3) uint8; proprio (4,) float32; chunks (T, H, 4) float16; possible (T,) bool;
    points (T, 4, 3) float32 in metres (hand, object, goal, fixture's centre); uv (T, V, 4, 2)
    float32 in [0, 1]; task, t int16; layout, episode int32. What is not possible is zero.
    """

    images: list[npt.NDArray[np.uint8]] = field(default_factory=list)
    proprio: list[npt.NDArray[np.float32]] = field(default_factory=list)
    chunks: list[npt.NDArray[np.float16]] = field(default_factory=list)
    possible: list[npt.NDArray[np.bool_]] = field(default_factory=list)
    points: list[npt.NDArray[np.float32]] = field(default_factory=list)
    uv: list[npt.NDArray[np.float32]] = field(default_factory=list)
    task: list[np.int16] = field(default_factory=list)
    layout: list[np.int32] = field(default_factory=list)
    t: list[np.int16] = field(default_factory=list)
    episode: list[np.int32] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.images)


def clean_chunk(world: World, task: Task, horizon: int) -> npt.NDArray[np.float16]:
    """(horizon, 4) what the expert would do from here without noise; the world stays as it is."""
    start = world.get_state()
    chunk = np.empty((horizon, ACTION_DIM), np.float16)
    for h in range(horizon):
        action = world.expert_action(task)
        chunk[h] = action
        world.advance(action)
    world.set_state(start)
    return chunk


def choose_tasks(
    possible: Sequence[Task], counts: dict[str, int], number: int, random: np.random.RandomState
) -> list[Task]:
    """Tasks to record in one layout: seldom recorded ones first, each fixture once if possible.

    Args:
        possible: what the layout allows.
        counts: how often each task was chosen so far; counted on.
        number: how many tasks are wanted.
        random: breaks ties.
    """
    chosen: list[Task] = []
    for _ in range(number):
        used = {task.fixture for task in chosen}
        candidates = [task for task in possible if task.fixture not in used] or list(possible)
        tie_break = random.uniform(size=len(candidates))
        _, _, task = min(
            (counts.get(task.name, 0), tie, task)
            for task, tie in zip(candidates, tie_break, strict=True)
        )
        counts[task.name] = counts.get(task.name, 0) + 1
        chosen.append(task)
    return chosen


def record_frame(world: World, recording: Recording, frames: Frames) -> None:
    """Appends the present moment: picture, proprioception, and labels for every possible task."""
    observation = world.observe()
    number = len(world.tasks)
    views = len(observation["images"])
    chunks = np.zeros((number, recording.horizon, ACTION_DIM), np.float16)
    possible = np.zeros(number, np.bool_)
    points = np.zeros((number, 4, 3), np.float32)
    uv = np.zeros((number, views, 4, 2), np.float32)
    for task in world.possible_tasks():
        index = world.tasks.index(task)
        possible[index] = True
        places = world.points_of_interest(task)
        points[index] = places
        uv[index] = world.project(places)
        chunks[index] = clean_chunk(world, task, recording.horizon)
    frames.images.append(observation["images"])
    frames.proprio.append(observation["proprio"])
    frames.chunks.append(chunks)
    frames.possible.append(possible)
    frames.points.append(points)
    frames.uv.append(uv)


def record_episode(
    world: World, recording: Recording, frames: Frames, *, seed: int, number: int, task: Task
) -> bool:
    """Records one noisy expert episode and says whether the task succeeded in it.

    Args:
        world: is reset here.
        recording: the settings.
        frames: where the frames go.
        seed: the layout.
        number: which episode of this layout; gives the noise a stream of its own.
        task: one that the layout allows.
    """
    random = np.random.RandomState([seed, number])
    world.reset(seed=seed, options={"task": task.name})
    index = world.tasks.index(task)
    succeeded_at: int | None = None
    burst_left = 0
    burst = np.zeros(ACTION_DIM)
    for t in range(recording.max_steps):
        if t % recording.image_stride == 0:
            record_frame(world, recording, frames)
            frames.task.append(np.int16(index))
            frames.layout.append(np.int32(seed))
            frames.t.append(np.int16(t))
            frames.episode.append(np.int32(seed * recording.episodes_per_layout + number))
        if burst_left == 0 and random.uniform() < recording.burst_probability:
            low, high = recording.burst_steps
            burst_left = int(random.randint(low, high + 1))
            burst = random.uniform(-1, 1, ACTION_DIM)
        if burst_left:
            burst_left -= 1
            world.advance(burst)
        else:
            noise = recording.noise * random.standard_normal(ACTION_DIM)
            world.advance(world.expert_action() + noise)
        if succeeded_at is None and world.successes()[task.name]:
            succeeded_at = t
        if succeeded_at is not None and t - succeeded_at >= recording.steps_after_success:
            break
    return succeeded_at is not None
