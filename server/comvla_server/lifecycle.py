"""Where a server stands between start and stop."""

from __future__ import annotations

from enum import Enum

from comvla_server.refusals import Reason, Refusal


class Phase(str, Enum):
    """One after the other, never back."""

    LOADING = "loading"
    WARMING = "warming"
    SERVING = "serving"
    DRAINING = "draining"
    STOPPED = "stopped"


class Lifecycle:
    """The one place that knows whether calls are welcome."""

    def __init__(self) -> None:
        self.phase = Phase.LOADING

    @property
    def ready(self) -> bool:
        """True while calls are answered."""
        return self.phase is Phase.SERVING

    def enter(self, phase: Phase) -> None:
        """Goes on to a later phase; earlier ones are ignored: a stop while loading stays one."""
        order = list(Phase)
        if order.index(phase) > order.index(self.phase):
            self.phase = phase

    def require_ready(self) -> None:
        """Lets a call through, or says why not.

        Raises:
            Refusal: the server loads, warms up, drains or has stopped.
        """
        if self.ready:
            return
        if self.phase in (Phase.LOADING, Phase.WARMING):
            raise Refusal(
                Reason.LOADING,
                f"the server is {self.phase.value} the model and not ready yet: "
                "retry when its health check says SERVING",
            )
        raise Refusal(
            Reason.DRAINING,
            "the server is draining and takes no new calls: connect to another replica, "
            "or retry when it is back",
        )
