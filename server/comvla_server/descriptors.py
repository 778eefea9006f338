"""As many open files as connections may come."""

from __future__ import annotations

import logging

from comvla_server.admin_http import MOST_CONNECTIONS
from comvla_server.settings import ServerSettings

_log = logging.getLogger(__name__)

# What the process itself opens: libraries, the model, logs, listening sockets.
_OWN = 128


def allow_descriptors(settings: ServerSettings) -> None:
    """Raises this process's limit of open files to what the settings may need, where it may.

    Without a descriptor for it a connection is neither served nor refused. Called by the command
    line only.
    """
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    needed = settings.max_connections + MOST_CONNECTIONS + _OWN
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return
    allowed = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
    if allowed < needed:
        _log.warning(
            "max_connections is %d, and this process may open %d files: raise the limit (ulimit -n "
            "%d), or lower --max-connections",
            settings.max_connections,
            allowed,
            needed,
        )
