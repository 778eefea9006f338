"""gRPC for robots and HTTP for operators: one process, one event loop, one inference thread."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable

import grpc

from comvla import codec
from comvla.model_info import ModelInfo
from comvla_server.access import Access
from comvla_server.admin import create_app
from comvla_server.admin_http import AdminHttp
from comvla_server.batcher import Batcher
from comvla_server.decoding import Decoding
from comvla_server.engine import Engine
from comvla_server.fleet_feed import FleetFeed
from comvla_server.grpc_adapter import HealthReporter, add_policy_service, make_grpc_server
from comvla_server.grpc_port import start_watched
from comvla_server.inference_thread import InferenceThread
from comvla_server.lifecycle import Lifecycle, Phase
from comvla_server.load_policy import LoadPolicy
from comvla_server.metrics import Metrics
from comvla_server.ports import add_grpc_port, authority, listen
from comvla_server.server_state import server_state
from comvla_server.service import PolicyService, Runtime
from comvla_server.settings import ServerSettings, SettingsError
from comvla_server.validation import Validator
from comvla_server.version import server_version

__all__ = ["Server", "ServerSettings"]

_log = logging.getLogger(__name__)

# Time for responses already written to leave the sockets, and for health watchers to be cut.
_FLUSH_S = 1.0
# Envelope of a request around its payload: identifiers, instruction, proprioception.
_ENVELOPE_BYTES = 16 * 1024


class Server:
    """A policy server. Lives on one event loop, from :meth:`start` to :meth:`stop`, once.

    Args:
        engine: the model, or a function that loads it; a function runs in the inference thread
            after the ports are taken, so that probes see a server that loads.
        settings: see :class:`ServerSettings`.

    Attributes:
        lifecycle: where the server stands.
        metrics: its counters.
        port: gRPC port, known after :meth:`bind`.
        admin_port: HTTP port, known after :meth:`bind`.
        port_lost: set when gRPC has stopped taking calls by itself: the process should end.
    """

    def __init__(
        self, engine: Engine | Callable[[], Engine], settings: ServerSettings | None = None
    ) -> None:
        self.settings = settings or ServerSettings()
        self.lifecycle = Lifecycle()
        self.metrics = Metrics()
        self.port = 0
        self.admin_port = 0
        self.port_lost = asyncio.Event()
        self._engine = engine
        self._health = HealthReporter()
        self._service: PolicyService | None = None
        self._grpc: grpc.aio.Server | None = None
        self._admin: AdminHttp | None = None
        self._feed: FleetFeed | None = None
        self._access: Access | None = None
        self._watching: list[asyncio.Task[None]] = []
        self._thread: InferenceThread | None = None
        self._decode_thread: InferenceThread | None = None

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
        server = make_grpc_server(settings, [access.door])
        service = PolicyService(self.lifecycle, self.metrics, settings)
        access.door.glance = service.glance
        access.door.on_lost = lambda: service.loop_watch.note(died=True)
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
        app = access.guard(create_app(self.lifecycle, self.metrics, service, settings, feed))
        self._admin = AdminHttp(app, admin_socket, settings, access.https_context())
        self._admin.start()
        await start_watched(server, self._lose_port)
        self._access = access
        self._watching = [
            asyncio.create_task(access.watch()),
            asyncio.create_task(service.loop_watch.run()),
        ]

    async def make_ready(self) -> ModelInfo:
        """Loads and warms up in the inference thread, then says SERVING.

        Returns:
            Description of the model.

        Raises:
            SettingsError: max_request_bytes cannot hold an unpruned observation of this model.
            Exception: whatever loading or the first forward passes raise.
        """
        assert self._service is not None, "bind() comes first"
        self._thread = thread = InferenceThread()
        load = self._engine
        engine = load if isinstance(load, Engine) else await thread.run(load)
        self._check_message_cap(engine)
        self.lifecycle.enter(Phase.WARMING)
        await thread.run(engine.warm_up, self.settings.max_batch)
        if self.lifecycle.phase is not Phase.WARMING:
            return engine.info  # stopped meanwhile
        settings = self.settings
        batcher = Batcher(
            engine,
            max_batch=settings.max_batch,
            max_queue=settings.max_queue,
            max_sessions=settings.max_sessions,
            session_ttl_s=settings.session_ttl_s,
            load=LoadPolicy.of(settings),
            metrics=self.metrics,
            thread=thread,
        )
        batcher.start()
        self.metrics.describe_model(engine.info, server_version())
        self.metrics.watch(
            queue_depth=lambda: batcher.queue_depth,
            utilization=lambda: batcher.utilization,
            sessions=lambda: len(batcher.sessions),
            offered_load=lambda: batcher.offered_load,
            suggested_tokens=lambda: batcher.suggested_tokens,
        )
        validator = Validator(engine, settings.max_request_bytes)
        self._decode_thread = InferenceThread("comvla-decode")
        decoding = Decoding(self._decode_thread, settings.max_queue)
        self._service.runtime = Runtime(engine, batcher, validator, decoding)
        self.lifecycle.enter(Phase.SERVING)
        await self._health.serving()
        _log.info("serving %s", engine.info.name, extra={"grpc": self.target})
        return engine.info

    def _lose_port(self) -> None:
        """Robots are not answered any more, and will not be: /healthz and /readyz say so."""
        self.lifecycle.enter(Phase.STOPPED)
        self.port_lost.set()

    def reload(self) -> None:
        """Looks now for certificates and tokens that have changed, instead of a little later."""
        if self._access is not None:
            self._access.look()

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
        if self._grpc is not None:
            # A server whose loop has ended raises what ended it.
            with contextlib.suppress(UnicodeDecodeError):
                await self._grpc.stop(_FLUSH_S)
        if self._feed is not None:
            await self._feed.close()
        if self._admin is not None:
            await self._admin.stop()
        for task in self._watching:
            task.cancel()
        if self._thread is not None:
            self._thread.close(timeout_s=1.0 if finished else 0.0)
        if self._decode_thread is not None:
            self._decode_thread.close(timeout_s=1.0 if finished else 0.0)
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
        if self._service.runtime is not None:
            await self._service.runtime.batcher.close()
        return finished

    def _check_message_cap(self, engine: Engine) -> None:
        info = engine.info
        payload_bytes = codec.encoded_bytes(
            info.num_tokens, info.token_dim, "float32", num_towers=len(info.tower_dims)
        )
        needed = payload_bytes + _ENVELOPE_BYTES
        if needed > self.settings.max_request_bytes:
            raise SettingsError(
                f"max_request_bytes is {self.settings.max_request_bytes}, an unpruned float32 "
                f"observation of {info.name} needs {needed}: raise --max-request-bytes"
            )
