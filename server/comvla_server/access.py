"""Who may reach a server, and how: everything that its settings ask for, ready to be used."""

from __future__ import annotations

import logging
import ssl

import grpc

from comvla_server.admin_auth import AdminAuth, Asgi, HostCheck
from comvla_server.auth import Authenticator
from comvla_server.door import Door
from comvla_server.fleet_page import assets
from comvla_server.metrics import Metrics
from comvla_server.ports import is_loopback
from comvla_server.rate_limits import RateLimits
from comvla_server.secret_files import Reloadable, Watcher, warn_if_exposed
from comvla_server.settings import ServerSettings
from comvla_server.tls import ServerTls
from comvla_server.tokens import TokenFile

_log = logging.getLogger(__name__)


class Access:
    """Certificates, tokens and limits of one server. Made before anything listens.

    Args:
        settings: which files, which limits.
        metrics: where refusals, reloads and the end of certificates are published.

    Attributes:
        door: what every gRPC call comes through.

    Raises:
        SettingsError: a certificate, key or tokens file cannot be used.
    """

    def __init__(self, settings: ServerSettings, metrics: Metrics) -> None:
        self._settings = settings
        self._tls = ServerTls.of(settings, metrics)
        self._tokens = _tokens(settings, "tokens_file")
        self._admin_tokens = _tokens(settings, "admin_tokens_file")
        self.door = Door(
            Authenticator(self._tokens, certificates=settings.tls_client_ca is not None),
            RateLimits(settings),
            settings,
            metrics,
        )
        files: dict[str, Reloadable | None] = {
            "certificate": self._tls,
            "tokens": self._tokens,
            "admin_tokens": self._admin_tokens,
        }
        watched = {name: item for name, item in files.items() if item is not None}
        for name in watched:
            metrics.reload_failures.labels(name)
        self._watcher = Watcher(
            watched,
            settings.reload_interval_s,
            lambda name: metrics.reload_failures.labels(name).inc(),
        )
        self._warn()

    def grpc_credentials(self) -> grpc.ServerCredentials | None:
        """For the gRPC port; None in the clear."""
        return None if self._tls is None else self._tls.grpc_credentials()

    def https_context(self) -> ssl.SSLContext | None:
        """For the admin port; None in the clear."""
        return None if self._tls is None else self._tls.https_context()

    def guard(self, app: Asgi) -> Asgi:
        """The admin surface, behind its tokens where there are any."""
        if self._admin_tokens is None:
            address = self._settings.admin_address
            return HostCheck(app, address) if is_loopback(address) else app
        # The page itself is no secret: it asks for a token, and then for everything else.
        open_paths = [*assets(), *(["/metrics"] if self._settings.open_metrics else [])]
        return AdminAuth(app, self._admin_tokens, open_paths)

    def look(self) -> None:
        """Reloads the files that have changed."""
        self._watcher.look()

    async def watch(self) -> None:
        """Does so again and again, until it is cancelled."""
        await self._watcher.run()

    def _warn(self) -> None:
        settings = self._settings
        if not is_loopback(settings.host):
            if not settings.authenticates:
                _log.warning(
                    "listening beyond this machine on %s without authentication: whoever reaches "
                    "it can use it; give --tokens-file or --tls-client-ca",
                    settings.host,
                )
            if not settings.tls:
                _log.warning(
                    "listening beyond this machine on %s without encryption: keep it in a trusted "
                    "network",
                    settings.host,
                )
        if not is_loopback(settings.admin_address) and settings.admin_tokens_file is None:
            _log.warning(
                "the admin surface on %s is open to whoever reaches it: give --admin-tokens-file, "
                "or --admin-host 127.0.0.1",
                settings.admin_address,
            )


def _tokens(settings: ServerSettings, option: str) -> TokenFile | None:
    path = getattr(settings, option)
    if path is None:
        return None
    warn_if_exposed(path, option)
    return TokenFile(path, option)
