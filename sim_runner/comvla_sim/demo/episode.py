"""One episode of the demo in closed loop, with everything that the page shows of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from comvla_client import ComVLAClient, StepReport
from comvla_sim.demo.film import FilmCamera
from comvla_sim.demo.scenario import Scene
from comvla_sim.link import EnforcedLink, LinkRecord

if TYPE_CHECKING:
    from comvla_sim.worlds.base import World

FRAME_EVERY = 2
"""Control periods between two pictures of the film."""


@dataclass(frozen=True)
class Query:
    """One request for a chunk of actions.

    Attributes:
        period: control period of the episode in which it was made.
        report: the client's account.
        record: what the link did with it; None without a link, or where nothing was sent.
    """

    period: int
    report: StepReport
    record: LinkRecord | None


@dataclass
class Episode:
    """What happened.

    Attributes:
        scene: instruction and table.
        success: whether the task was fulfilled in time.
        periods: control periods that passed.
        queries: requests in order.
        snr_db: of every control period, dB; empty without a link.
        capacity_bits: of every control period; empty without a link.
        frames: (control period, data URI) of the film; empty where none was shot.
    """

    scene: Scene
    success: bool = False
    periods: int = 0
    queries: list[Query] = field(default_factory=list)
    snr_db: list[float] = field(default_factory=list)
    capacity_bits: list[float] = field(default_factory=list)
    frames: list[tuple[int, str]] = field(default_factory=list)


def run_episode(
    world: World,
    client: ComVLAClient,
    scene: Scene,
    *,
    link: EnforcedLink | None = None,
    camera: FilmCamera | None = None,
    on_period: Callable[[Episode], None] = lambda episode: None,
) -> Episode:
    """Lets the robot obey one instruction.

    Args:
        world: is reset here.
        client: at the beginning of an episode.
        scene: what to do where.
        link: the transport of ``client`` where it is a simulated link; one period passes with each
            action. None is a link without limit.
        camera: shoots the film.
        on_period: called after every control period and every query.
    """
    observation, _ = world.reset(seed=scene.layout_seed, options={"task": scene.task.name})
    episode = Episode(scene)
    if camera is not None:
        episode.frames.append((0, camera.shoot()))
    while not episode.success and episode.periods < world.max_episode_steps:
        requests = 0 if link is None else len(link.log)
        snr_db = None if link is None else link.snr_db
        chunk = client.step(observation, scene.task.instruction, snr_db)
        record = link.log[-1] if link is not None and len(link.log) > requests else None
        episode.queries.append(Query(episode.periods, chunk.report, record))
        on_period(episode)
        # Without an answer the robot holds for one period and asks again, as ``act`` does.
        left = world.max_episode_steps - episode.periods
        for action in chunk.actions[: min(left, max(1, chunk.planned))]:
            if link is not None:
                episode.snr_db.append(link.snr_db)
                episode.capacity_bits.append(link.capacity_bits)
                link.advance()
            world.advance(action)
            episode.periods += 1
            episode.success = world.successes()[scene.task.name]
            on_period(episode)
            due = episode.success or episode.periods % FRAME_EVERY == 0
            if camera is not None and due:
                episode.frames.append((episode.periods, camera.shoot()))
            if episode.success:
                break
        observation = world.observe()
    return episode
