"""Files with certificates, keys and tokens: read with care, and watched for changes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import stat
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from comvla.errors import ComVLAError
from comvla_server.setting_fields import SettingsError

_log = logging.getLogger(__name__)

# None of these files has a reason to be larger, and a device or a log would never end.
_MOST_BYTES = 4 * 2**20


class Reloadable(Protocol):
    """Something that was read from files."""

    @property
    def paths(self) -> Sequence[Path]:
        """The files."""
        ...

    def reload(self) -> None:
        """Reads them again; where they are no good, raises and stays as it was."""
        ...


def read_bytes(path: Path, option: str, error: type[SettingsError] = SettingsError) -> bytes:
    """The content of a file.

    Args:
        path: the file.
        option: the setting that names it, for the message.
        error: what to raise.

    Raises:
        SettingsError: no such file, not readable, or far too large.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
    except OSError as cause:
        raise error(
            f"cannot read {path} ({option}): {cause.strerror or cause}; correct the path, or let "
            "the server's user read it"
        ) from cause
    if len(content) > _MOST_BYTES:
        raise error(
            f"{path} ({option}) is larger than {_MOST_BYTES} bytes: that is no file of certificates "
            "or tokens"
        )
    return content


def read_text(path: Path, option: str, error: type[SettingsError] = SettingsError) -> str:
    """The content of a text file; see :func:`read_bytes`."""
    try:
        return read_bytes(path, option, error).decode()
    except UnicodeDecodeError as cause:
        raise error(f"{path} ({option}) is not text: is it the right file?") from cause


def warn_if_exposed(path: Path, option: str) -> None:
    """Says so where every user of this machine can read, or others can write, a secret file."""
    with contextlib.suppress(OSError):
        mode = path.stat().st_mode
        if os.name == "posix" and mode & (stat.S_IROTH | stat.S_IWGRP | stat.S_IWOTH):
            _log.warning(
                "%s (%s) can be read or written by other users (mode %o): chmod 600 it",
                path,
                option,
                stat.S_IMODE(mode),
            )


class Watcher:
    """Looks at files again and again, and reloads what was read from them when they change.

    Args:
        items: by the name that logs and metrics give them.
        interval_s: time between two looks, seconds.
        failed: called with the name when files changed and are no good.
    """

    def __init__(
        self, items: dict[str, Reloadable], interval_s: float, failed: Callable[[str], None]
    ) -> None:
        self._items = items
        self._interval_s = interval_s
        self._failed = failed
        # Nothing seen yet, so the first look reads everything once more: a file may have changed
        # between its first reading and now.
        self._seen: dict[str, list[tuple[int, ...] | None]] = {}
        # What was no good is tried at every look, since the cause may lie elsewhere (a clock, a
        # limit of open files), but told once.
        self._refused: dict[str, list[tuple[int, ...] | None]] = {}

    async def run(self) -> None:
        """Watches until it is cancelled."""
        while True:
            await asyncio.sleep(self._interval_s)
            self.look()

    def look(self) -> None:
        """Reloads what changed since the last look; what is no good leaves everything as it was."""
        for name, item in self._items.items():
            stamps, before = _stamps(item.paths), self._seen.get(name)
            if stamps == before:
                continue
            try:
                item.reload()
            except Exception as error:  # whatever it is, it must not end the watch
                if self._refused.get(name) == stamps:
                    continue
                self._refused[name] = stamps
                self._failed(name)
                told = isinstance(error, ComVLAError)
                _log.error(
                    "%s changed and cannot be used, the old one stays: %s",
                    name,
                    error,
                    exc_info=not told,
                )
            else:
                self._seen[name] = stamps
                if self._refused.pop(name, None) is not None or before is not None:
                    _log.info("%s reloaded", name)


def _stamps(paths: Sequence[Path]) -> list[tuple[int, ...] | None]:
    stamps: list[tuple[int, ...] | None] = []
    for path in paths:
        try:
            found = path.stat()
        except OSError:
            stamps.append(None)
        else:
            stamps.append((found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns))
    return stamps
