"""Which release this server is."""

from __future__ import annotations

from functools import cache
from importlib.metadata import PackageNotFoundError, version


@cache
def server_version() -> str:
    """Version of the installed distribution, ``0+source`` where it runs uninstalled."""
    try:
        return version("comvla")
    except PackageNotFoundError:
        return "0+source"
