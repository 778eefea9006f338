"""Log lines on stderr: one event each, in plain text or JSON."""

from __future__ import annotations

import json
import logging
import sys
from datetime import datetime, timezone
from typing import Any, TextIO

FORMATS = ("plain", "json")

_STANDARD = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


def configure(log_format: str, level: str, stream: TextIO | None = None) -> None:
    """Sends the process's logs to one stream. Called by the command line only, never at import.

    Args:
        log_format: ``plain`` or ``json``.
        level: name of the lowest level shown, e.g. ``info``.
        stream: stderr where None.
    """
    handler = logging.StreamHandler(stream or sys.stderr)
    handler.setFormatter(JsonFormatter() if log_format == "json" else PlainFormatter())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    # uvicorn speaks of the admin surface at every start and stop; only its complaints matter here.
    logging.getLogger("uvicorn").setLevel(logging.WARNING)


class PlainFormatter(logging.Formatter):
    """``2026-01-01T12:00:00.000Z INFO comvla_server.server: words key=value``, on one line."""

    def format(self, record: logging.LogRecord) -> str:
        """One event, control characters escaped; a stack trace follows on lines of its own."""
        extra = "".join(f" {name}={value}" for name, value in _extras(record).items())
        head = f"{_time(record)} {record.levelname} {record.name}: {record.getMessage()}{extra}"
        line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in head)
        if record.exc_info:
            line += "\n" + self.formatException(record.exc_info)
        return line


class JsonFormatter(logging.Formatter):
    """One JSON object per line."""

    def format(self, record: logging.LogRecord) -> str:
        """One event; keys time, level, logger, message, then whatever the event added."""
        fields: dict[str, Any] = {
            "time": _time(record),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_extras(record),
        }
        if record.exc_info:
            fields["exception"] = self.formatException(record.exc_info)
        return json.dumps(fields, default=str)


def _extras(record: logging.LogRecord) -> dict[str, Any]:
    return {name: value for name, value in vars(record).items() if name not in _STANDARD}


def _time(record: logging.LogRecord) -> str:
    moment = datetime.fromtimestamp(record.created, tz=timezone.utc)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
