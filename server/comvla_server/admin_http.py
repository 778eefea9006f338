"""HTTP for the admin surface: uvicorn, with an end to everything that strangers could drag out."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Iterator
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from comvla_server.admin_auth import Asgi
from comvla_server.settings import ServerSettings

MOST_CONNECTIONS = 256
"""Connections to the admin surface; one more is closed at once."""

_SHUTDOWN_S = 1


class AdminHttp:
    """The admin surface on a socket that listens already.

    Args:
        app: the application.
        listener: where to answer.
        settings: how long a request may take to arrive.
        tls: encrypts, None for plain HTTP.
    """

    def __init__(
        self,
        app: Asgi,
        listener: socket.socket,
        settings: ServerSettings,
        tls: ssl.SSLContext | None,
    ) -> None:
        config = uvicorn.Config(
            app,
            http=_protocol(settings.request_timeout_s),
            log_config=None,
            access_log=False,
            lifespan="off",
            ws="none",
            timeout_graceful_shutdown=_SHUTDOWN_S,
        )
        self._server = _Uvicorn(config, listener, tls, settings.handshake_timeout_s)
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Answers from now on; needs a running event loop."""
        self._task = asyncio.get_running_loop().create_task(self._server.serve())

    async def stop(self) -> None:
        """Closes the socket and every connection."""
        self._server.should_exit = True
        if self._task is not None:
            await self._task


class _Uvicorn(uvicorn.Server):
    """uvicorn without its signal handlers (one place decides when this process stops), and with a
    limit to TLS handshakes, for which it has no setting."""

    def __init__(
        self,
        config: uvicorn.Config,
        listener: socket.socket,
        tls: ssl.SSLContext | None,
        handshake_timeout_s: float,
    ) -> None:
        super().__init__(config)
        self._listener = listener
        self._tls = tls
        self._handshake_timeout_s = handshake_timeout_s

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=[])
        config = self.config

        def protocol() -> asyncio.Protocol:
            made: Any = config.http_protocol_class
            return made(  # type: ignore[no-any-return]
                config=config, server_state=self.server_state, app_state=self.lifespan.state
            )

        timeout_s = None if self._tls is None else self._handshake_timeout_s
        self.servers.append(
            await asyncio.get_running_loop().create_server(
                protocol,
                sock=self._listener,
                ssl=self._tls,
                ssl_handshake_timeout=timeout_s,
                backlog=128,
            )
        )

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def _protocol(request_timeout_s: float) -> type[asyncio.Protocol]:
    """An HTTP protocol on a bounded number of connections. Requests have to arrive in time, and who
    takes no more of an answer for so long is cut off."""

    class BoundedHttp(H11Protocol):
        _waiting: asyncio.TimerHandle | None = None
        _stalled: asyncio.TimerHandle | None = None

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            if len(self.connections) > MOST_CONNECTIONS:
                transport.abort()
                return
            self._wait()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            if not self._arriving():
                self._done()

        def on_response_complete(self) -> None:
            super().on_response_complete()
            if self._arriving() and not self.transport.is_closing():
                self._wait()

        def pause_writing(self) -> None:
            super().pause_writing()
            self._stalled = self.loop.call_later(request_timeout_s, self._give_up)

        def resume_writing(self) -> None:
            super().resume_writing()
            self._flowing()

        def connection_lost(self, exc: Exception | None) -> None:
            self._done()
            self._flowing()
            super().connection_lost(exc)

        def _arriving(self) -> bool:
            """Whether a request is awaited, or the rest of one: of its head, or of its body."""
            return self.conn.their_state in (h11.IDLE, h11.SEND_BODY)

        def _flowing(self) -> None:
            if self._stalled is not None:
                self._stalled.cancel()
                self._stalled = None

        def _wait(self) -> None:
            self._done()
            self._waiting = self.loop.call_later(request_timeout_s, self._give_up)

        def _done(self) -> None:
            if self._waiting is not None:
                self._waiting.cancel()
                self._waiting = None

        def _give_up(self) -> None:
            self.transport.abort()

    return BoundedHttp
