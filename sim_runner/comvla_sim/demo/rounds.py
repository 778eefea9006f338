"""The two rounds of the demo: voted tokens over the fading link, then all tokens without a limit."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from comvla_client import ComVLAClient
from comvla_client.edge import EdgeModel
from comvla_client.transport import GrpcTransport
from comvla_sim.demo.episode import Episode, run_episode
from comvla_sim.demo.figures import air_time_s
from comvla_sim.demo.film import FilmCamera
from comvla_sim.demo.scenario import DEADLINE_S, LINK, MIN_TOKENS, Scene
from comvla_sim.demo.server_process import ServerProcess
from comvla_sim.link import EnforcedLink
from comvla_sim.worlds.base import World

OnPeriod = Callable[[Episode], None]


@dataclass(frozen=True)
class Stage:
    """What all episodes share.

    Attributes:
        server: runs the cloud half.
        world: the simulator.
        edge: the robot's half.
        mean_snr_db: of the fading link.
    """

    server: ServerProcess
    world: World
    edge: EdgeModel
    mean_snr_db: float

    def over_link(self, scene: Scene, on_period: OnPeriod) -> Episode:
        """An episode whose payloads are sized by, and held to, the link; with a film.

        Raises:
            ServerProcessError: the server is gone.
        """
        self.server.require_running()
        channel = scene.channel(self.mean_snr_db)
        link = EnforcedLink(GrpcTransport(self.server.target), channel, LINK)
        client = ComVLAClient(
            link,
            edge=self.edge,
            link=LINK,
            budget="framed",
            min_tokens=MIN_TOKENS,
            deadline_s=DEADLINE_S,
            seed=scene.number,
        )
        camera = FilmCamera(self.world)
        with client, contextlib.closing(camera):
            episode = run_episode(
                self.world, client, scene, link=link, camera=camera, on_period=on_period
            )
        # A server that died would look like a link that failed.
        self.server.require_running()
        return episode

    def without_limit(self, scene: Scene, on_period: OnPeriod) -> Episode:
        """The same instruction on the same table with every token, whatever the link.

        Raises:
            ServerProcessError: the server is gone.
        """
        self.server.require_running()
        with ComVLAClient(
            self.server.target,
            edge=self.edge,
            selector="full",
            deadline_s=DEADLINE_S,
            seed=scene.number,
        ) as client:
            episode = run_episode(self.world, client, scene, on_period=on_period)
        self.server.require_running()
        return episode


def full_air_s(
    limited: Sequence[Episode], unlimited: Sequence[Episode], mean_snr_db: float
) -> Iterator[float]:
    """How long a request with all tokens would have been on the air, in seconds.

    One value for each request of the first round, from the period in which it was sent, over the
    same fading.

    Args:
        limited: episodes over the link.
        unlimited: the same with all tokens.
        mean_snr_db: of the link.
    """
    for episode, reference in zip(limited, unlimited, strict=True):
        full_bits = 8 * max(query.report.framed_bytes for query in reference.queries)
        for query in episode.queries:
            rest = itertools.islice(episode.scene.channel(mean_snr_db), query.period, None)
            yield air_time_s(full_bits, map(LINK.capacity_bits, rest), LINK.period_s)
