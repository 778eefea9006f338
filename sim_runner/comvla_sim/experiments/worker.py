"""One process's world and policy, in which one episode after another is run."""

from __future__ import annotations

import functools
import sys
import time
from typing import TYPE_CHECKING, Any

from comvla_sim.experiments.errors import EvaluationError, UnansweredError
from comvla_sim.experiments.methods import Method, find_method
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.experiments.policy import load_edge_half, load_policy

if TYPE_CHECKING:
    from comvla_client.edge import EdgeModel
    from comvla_client.transport_protocol import Transport
    from comvla_sim.experiments.rollout import OnQuery
    from comvla_sim.worlds.base import World
    from comvla_vla import CloudModel

Measured = tuple[EpisodeSpec, dict[str, Any]]

MOST_TRIES = 3
"""Of an episode, where somebody's server leaves one of its queries without an answer."""

PAUSE_S = 2.0
"""Before it does, in seconds."""


class Worker:
    """One world and one policy, made once and used for episode after episode.

    Args:
        settings: of the evaluation.

    Attributes:
        world: drawn for the model's pictures.
        edge: the robot's half.
        cloud: the other half; None where a server has it.
    """

    def __init__(self, settings: EvalSettings) -> None:
        from comvla_sim.worlds import make

        self._settings = settings
        self.edge: EdgeModel
        self.cloud: CloudModel | None = None
        self._targets: dict[str, Transport] = {}
        if settings.target is None:
            self.edge, self.cloud = load_policy(settings.model)
        else:
            self.edge = load_edge_half(settings.model)
        height, width = self.edge.info.image_size
        if height != width:
            raise EvaluationError(
                f"the worlds draw square pictures, the model sees {height}×{width}"
            )
        # Where the model resizes pictures itself, it gets them in the world's own size.
        resizes = bool(getattr(self.edge, "any_image_size", False))
        self.world: World = make(settings.world, image_size=None if resizes else height)

    def run(self, spec: EpisodeSpec, on_query: OnQuery | None = None) -> Measured:
        """One episode; ``on_query`` as for :func:`comvla_sim.experiments.rollout.run_episode`.

        A server that others use, too, may turn a query away. Only the answers make an episode, so it
        starts again, a few times.

        Raises:
            UnansweredError: it went so each time.
            EvaluationError: a method of one's own has another source here; and as ``run_episode``.
            ObservationError, InstructionError, HandshakeError: as ``run_episode``.
        """
        from comvla_sim.experiments.rollout import run_episode

        heard = () if on_query is None else (on_query,)
        method = find_method(spec.method)
        if spec.source_sha256 != method.source_sha256:
            raise EvaluationError(
                f"{spec.method} has another source here than where the evaluation began: it was edited meanwhile, or "
                "this node has another version of it; see that it is the same, then run the same command again"
            )
        target = self.target(method)
        # What was told of queries cannot be taken back.
        tries = MOST_TRIES if isinstance(target, str) and on_query is None else 1
        while True:
            try:
                return spec, run_episode(
                    self.world, self.edge, target, spec, self._settings, *heard
                )
            except UnansweredError as error:
                tries -= 1
                if not tries:
                    raise
                print(f"{error}; the episode starts again", file=sys.stderr, flush=True)
                time.sleep(PAUSE_S)

    def target(self, method: Method) -> Transport | str:
        """Where a method's requests go: the user's server, or the cloud half here, run as the method needs."""
        from comvla_server.vision import VisionHalf
        from comvla_sim.experiments.in_process import InProcessTransport

        if self._settings.target is not None:
            return self._settings.target
        cloud = self.cloud
        assert cloud is not None, "without a server both halves are here"
        key = method.server_option
        if key not in self._targets:
            if method.in_cloud is not None:
                cloud = cloud.with_options(method.in_cloud(cloud.config.backbone.layers))
            vision = VisionHalf(self.edge)  # type: ignore[arg-type]
            self._targets[key] = InProcessTransport(cloud, vision)
        return self._targets[key]

    @property
    def fingerprint(self) -> str:
        """Of the model that is loaded."""
        return self.edge.info.fingerprint

    def close(self) -> None:
        """Frees the world."""
        self.world.close()


@functools.lru_cache(maxsize=1)
def worker_of_this_process(settings: EvalSettings) -> Worker:
    """Made with the first episode, not when the process starts: an error then reaches the user."""
    return Worker(settings)
