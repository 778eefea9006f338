"""What an operator may choose about a server."""

from __future__ import annotations

import math
from dataclasses import dataclass

from comvla.errors import ComVLAError


class SettingsError(ComVLAError, ValueError):
    """A server setting that makes no sense; the message names the range and the remedy."""


@dataclass(frozen=True)
class ServerSettings:
    """Settings of one :class:`comvla_server.server.Server`, checked when they are made.

    Attributes:
        host: address to listen on. Only this machine can connect unless told otherwise.
        port: gRPC port; 0 takes a free one.
        admin_port: HTTP port of the admin surface; 0 takes a free one.
        max_batch: most requests in one forward pass.
        max_queue: most sessions that may wait; one more is answered RESOURCE_EXHAUSTED.
        max_sessions: most sessions whose last answer is remembered; the least recently seen leaves.
        session_ttl_s: seconds after which a silent session is forgotten and may count from 0 again.
        default_deadline_s: deadline of a call that brought none, seconds.
        max_request_bytes: largest InferRequest that is read, bytes. The default holds 512 float32
            tokens of width 2176 (4.5 MB).
        max_bytes_in_flight: most bytes that all open calls may hold together, as messages and as
            decoded tokens; one more is answered RESOURCE_EXHAUSTED.
        max_concurrent_calls: most calls open at once, health watchers included.
        grace_s: seconds that calls in flight may still take when the server stops.
        min_ping_interval_s: a client whose keepalive pings come faster than this loses its
            connection. Clients of this project ping every 10 s.
    """

    host: str = "127.0.0.1"
    port: int = 0
    admin_port: int = 0
    max_batch: int = 8
    max_queue: int = 64
    max_sessions: int = 1024
    session_ttl_s: float = 600.0
    default_deadline_s: float = 5.0
    max_request_bytes: int = 8 * 2**20
    max_bytes_in_flight: int = 512 * 2**20
    max_concurrent_calls: int = 1024
    grace_s: float = 10.0
    min_ping_interval_s: float = 5.0

    def __post_init__(self) -> None:
        """Refuses what cannot work.

        Raises:
            SettingsError: a value out of its range.
        """
        if not self.host or any(c.isspace() or not c.isprintable() for c in self.host):
            raise SettingsError(
                f"host must be an address such as 127.0.0.1 or ::1, got {self.host!r}"
            )
        for name in ("port", "admin_port"):
            self._whole(name, 0, 65535, "0 takes a free port")
        if self.port and self.port == self.admin_port:
            raise SettingsError(
                f"port and admin_port are both {self.port}: gRPC and HTTP need one each"
            )
        self._whole("max_batch", 1, 1024, "1 turns batching off")
        self._whole("max_queue", 1, 100_000, "64 suits some tens of robots")
        least = self.max_queue + self.max_batch
        self._whole("max_sessions", least, 10_000_000, "it covers max_queue + max_batch")
        self._whole("max_request_bytes", 1024, 2**30, "8388608 holds 512 float32 tokens of 2176")
        least = 2 * self.max_request_bytes
        self._whole("max_bytes_in_flight", least, 2**40, "it holds one request and its tokens")
        self._whole("max_concurrent_calls", 1, 1_000_000, "1024 suits most")
        for name in ("session_ttl_s", "default_deadline_s", "min_ping_interval_s"):
            self._seconds(name, zero=False)
        self._seconds("grace_s", zero=True)

    def _whole(self, name: str, low: int, high: int, hint: str) -> None:
        value = getattr(self, name)
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise SettingsError(
                f"{name} must be a whole number from {low} to {high}, got {value!r}: {hint}"
            )

    def _seconds(self, name: str, zero: bool) -> None:
        value = getattr(self, name)
        if not math.isfinite(value) or value < 0 or (value == 0 and not zero):
            least = "at least 0" if zero else "above 0"
            raise SettingsError(f"{name} must be a finite number of seconds {least}, got {value!r}")
