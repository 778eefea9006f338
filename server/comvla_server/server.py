"""gRPC for robots and HTTP for operators: one process, one event loop, one inference thread."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Mapping

import grpc

from comvla.model_info import ModelInfo
from comvla_server.access import Access
from comvla_server.admin import create_app
from comvla_server.admin_http import AdminHttp
from comvla_server.admin_models import add_model_routes
from comvla_server.bring_up import EngineSource, bring_up
from comvla_server.fleet_feed import FleetFeed
from comvla_server.grpc_adapter import HealthReporter, add_policy_service, make_grpc_server
from comvla_server.grpc_port import start_watched
from comvla_server.lifecycle import Lifecycle, Phase
from comvla_server.metrics import Metrics
from comvla_server.model_loading import CheckpointLoader, Loader
from comvla_server.model_names import UNNAMED
from comvla_server.ports import add_grpc_port, authority, listen
from comvla_server.runtimes import Runtimes
from comvla_server.server_state import server_state
from comvla_server.service import PolicyService
from comvla_server.settings import ServerSettings
from comvla_server.swapping import Swapper
from comvla_server.tracing import Tracing

__all__ = ["Server", "ServerSettings"]

_log = logging.getLogger(__name__)

# Time for responses already written to leave the sockets, and for health watchers to be cut.
_FLUSH_S = 1.0


class Server:
    """A policy server. Lives on one event loop, from :meth:`start` to :meth:`stop`, once.

    Args:
        engine: the model, or a function that loads it; a function runs in the inference thread
            after the ports are taken, so that probes see a server that loads. Several models by
            the names under which robots ask for them, the default first.
        settings: see :class:`ServerSettings`.
        sources: the checkpoint behind each name, where it is known; for swaps.
        loader: finds and loads the checkpoints of swaps; as the settings say where None.
        tracing: makes traces of calls; as the settings say where None.

    Attributes:
        lifecycle: where the server stands.
        metrics: its counters.
        port: gRPC port, known after :meth:`bind`.
        admin_port: HTTP port, known after :meth:`bind`.
        port_lost: set when gRPC has stopped taking calls by itself: the process should end.
        port_lost_by: what gRPC raised then.
    """

    def __init__(
        self,
        engine: EngineSource | Mapping[str, EngineSource],
        settings: ServerSettings | None = None,
        *,
        sources: Mapping[str, str] | None = None,
        loader: Loader | None = None,
        tracing: Tracing | None = None,
    ) -> None:
        self.settings = settings or ServerSettings()
        self.lifecycle = Lifecycle()
        self.metrics = Metrics()
        self.port = 0
        self.admin_port = 0
        self.port_lost = asyncio.Event()
        self.port_lost_by: BaseException | None = None
        self._sources = dict(engine) if isinstance(engine, Mapping) else {UNNAMED: engine}
        self._checkpoints = dict(sources or {})
        self._loader = loader or CheckpointLoader(self.settings)
        self._swapper: Swapper | None = None
        self._tracing = tracing
        self._health = HealthReporter()
        self._service: PolicyService | None = None
        self._grpc: grpc.aio.Server | None = None
        self._admin: AdminHttp | None = None
        self._feed: FleetFeed | None = None
        self._access: Access | None = None
        self._watching: list[asyncio.Task[None]] = []
        self._runtimes: Runtimes | None = None

    @property
    def target(self) -> str:
        """Where robots connect, ``host:port``."""
        return authority(self.settings.host, self.port)

    @property
    def admin_url(self) -> str:
        """Root of the admin surface."""
        scheme = "https" if self.settings.tls else "http"
        return f"{scheme}://{authority(self.settings.admin_address, self.admin_port)}"

    async def start(self) -> None:
        """Binds, loads, warms up; returns when calls are answered.

        Raises:
            BindError: a port is taken; nothing was started.
            ComVLAError: the model cannot be loaded; everything is stopped again.
        """
        await self.bind()
        try:
            await self.make_ready()
        except BaseException:
            await self.stop(grace_s=0)
            raise

    async def bind(self) -> None:
        """Takes both ports or none and answers there: not ready yet.

        Raises:
            BindError: a port is taken.
            SettingsError: a certificate, key or tokens file cannot be used.
        """
        settings = self.settings
        access = Access(settings, self.metrics)
        if self._tracing is None:
            self._tracing = Tracing.of(settings)
        server = make_grpc_server(settings, [access.door])
        service = PolicyService(self.lifecycle, self.metrics, settings, tracing=self._tracing)
        access.door.glance = service.screening.glance
        access.door.on_lost = service.screening.note_lost
        add_policy_service(server, service)
        await self._health.register(server)
        admin_socket = listen(settings.admin_address, settings.admin_port, "--admin-port")
        try:
            self.port = add_grpc_port(
                server, settings.host, settings.port, access.grpc_credentials()
            )
        except BaseException:
            admin_socket.close()
            raise
        self.admin_port = admin_socket.getsockname()[1]
        self._service, self._grpc = service, server
        self.metrics.watch_ready(lambda: self.lifecycle.ready)
        state = server_state(self.lifecycle, self.metrics, service)
        self._feed = feed = FleetFeed(service.fleet, state)
        app = create_app(self.lifecycle, self.metrics, service, settings, feed)
        add_model_routes(app, service.models, lambda: self._swapper, settings)
        self._admin = AdminHttp(access.guard(app), admin_socket, settings, access.https_context())
        self._admin.start()
        await start_watched(server, self._lose_port)
        self._access = access
        self._watching = [
            asyncio.create_task(access.watch()),
            asyncio.create_task(service.screening.loop_watch.run()),
        ]

    async def make_ready(self, before: Callable[[], object] | None = None) -> ModelInfo:
        """Loads and warms up in the inference thread, then says SERVING.

        Args:
            before: called once everything is loaded and warm, before the first call is answered.

        Returns:
            Description of the default model.

        Raises:
            SettingsError: max_request_bytes cannot hold an unpruned observation of this model.
            Exception: whatever loading or the first forward passes raise.
        """
        assert self._service is not None, "bind() comes first"
        self._runtimes = runtimes = Runtimes(self.settings, self.metrics)
        sources, self._sources = self._sources, {}  # a model that is replaced must not be held here
        models = self._service.models
        info = await bring_up(
            sources,
            models,
            runtimes,
            lifecycle=self.lifecycle,
            metrics=self.metrics,
            settings=self.settings,
        )
        del sources
        if self.lifecycle.phase is not Phase.WARMING:
            return info  # stopped meanwhile
        self._swapper = Swapper(
            models,
            runtimes,
            self._loader,
            self.lifecycle,
            self.metrics,
            self.settings,
            self._checkpoints,
        )
        if before is not None:
            before()
        # Loading kept the loop from its work; the first robot must not be turned away for that.
        self._service.screening.loop_watch.forget()
        self.lifecycle.enter(Phase.SERVING)
        await self._health.serving()
        _log.info("serving %s", info.name, extra={"grpc": self.target})
        return info

    def _lose_port(self, error: BaseException) -> None:
        """Robots are not answered any more, and will not be: /healthz and /readyz say so."""
        if self.lifecycle.phase in (Phase.DRAINING, Phase.STOPPED):
            return
        _log.critical("gRPC stopped taking calls: %s", ascii(error)[:200])
        self.port_lost_by = error
        self.lifecycle.enter(Phase.STOPPED)
        self.port_lost.set()

    def reload(self) -> None:
        """Looks now for certificates and tokens that have changed, instead of a little later."""
        if self._access is not None:
            self._access.look()

    @property
    def swapper(self) -> Swapper:
        """Replaces models; there once the server is ready."""
        assert self._swapper is not None, "make_ready() comes first"
        return self._swapper

    async def stop(self, grace_s: float | None = None) -> bool:
        """Drains and stops: refuses new calls, lets those in flight finish, then closes the ports.

        Args:
            grace_s: seconds that calls in flight may take, the setting where None.

        Returns:
            True when every call in flight was answered.
        """
        self.lifecycle.enter(Phase.DRAINING)
        await self._health.draining()
        finished = await self._drain(self.settings.grace_s if grace_s is None else grace_s)
        if self._swapper is not None:
            await self._swapper.close()
        if self._tracing is not None:
            await asyncio.to_thread(self._tracing.close)
        if self._grpc is not None:
            try:
                await self._grpc.stop(_FLUSH_S)
            except Exception as error:  # a server whose loop has ended raises what ended it
                if error is not self.port_lost_by:
                    raise
        if self._feed is not None:
            await self._feed.close()
        if self._admin is not None:
            await self._admin.stop()
        for task in self._watching:
            task.cancel()
        if self._runtimes is not None:
            self._runtimes.close(timeout_s=1.0 if finished else 0.0)
        self.lifecycle.enter(Phase.STOPPED)
        return finished

    async def _drain(self, grace_s: float) -> bool:
        if self._service is None:
            return True
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._service.idle.wait(), grace_s)
        finished = self._service.idle.is_set()
        if not finished:
            _log.warning("calls in flight were cut off after %.1f s of grace", grace_s)
        for runtime in self._service.models:
            await runtime.batcher.close()
        return finished
