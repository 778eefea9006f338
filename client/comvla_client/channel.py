"""How a robot's gRPC channel is set up, and what its status codes are called here."""

from __future__ import annotations

import time

import grpc

from comvla import codec
from comvla.errors import HandshakeError
from comvla.load_hints import LoadHints
from comvla_client.errors import TransportError
from comvla_client.locked_out import locked_out

MAX_MESSAGE_BYTES = 16 * 2**20
"""Largest message either way: 512 float32 tokens of width 2176 are 4.3 MiB."""

CHANNEL_OPTIONS: tuple[tuple[str, int], ...] = (
    *codec.GRPC_OPTIONS,
    ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
    ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
    # A peer that vanished without a goodbye is noticed while the robot executes a chunk, not
    # when it needs the next one.
    ("grpc.keepalive_time_ms", 10_000),
    ("grpc.keepalive_timeout_ms", 5_000),
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.max_pings_without_data", 0),
    # gRPC's own pause between attempts grows to two minutes, in which a robot would stand still.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 1_000),
    ("grpc.max_reconnect_backoff_ms", 1_000),
    # A new channel must open a new connection, not share one that is waiting out a pause.
    ("grpc.use_local_subchannel_pool", 1),
    # Retries are counted in bytes and belong inside the deadline: this package makes them itself.
    ("grpc.enable_retries", 0),
    # An address on the robot's own network is never meant for a web proxy in the environment.
    ("grpc.enable_http_proxy", 0),
)


_LOST_REPLICA = ("ActorDiedError", "ActorUnavailableError", "RayActorError", "The actor died")


def check_target(target: str) -> str:
    """The address of a server, ``host:port``.

    Raises:
        HandshakeError: a web address, or no port.
    """
    host, _, port = target.rpartition(":")
    if "://" in target or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise HandshakeError(
            f"expected a target host:port such as 127.0.0.1:50051, got {target!r}: give the gRPC "
            "address that comvla-server prints when it is ready, without http://"
        )
    return target


def target_of(transport: object) -> str:
    """The address that a transport calls, or at least what it is."""
    return str(getattr(transport, "target", type(transport).__name__))


class Attempts:
    """The attempts of one call: when to try again, and which failure to tell in the end.

    Only UNAVAILABLE is tried again, within the deadline, and only because the server answers a
    repeated (session, step) from its record.

    Args:
        timeout_s: longest that all attempts together may take, in seconds.
    """

    FIRST_PAUSE_S = 0.005
    # A robot's control period is 50 ms: a server that comes back is found within half of one.
    LONGEST_PAUSE_S = 0.02

    def __init__(self, timeout_s: float) -> None:
        self._deadline = time.monotonic() + timeout_s
        self._pause_s = self.FIRST_PAUSE_S
        self._unavailable: TransportError | None = None

    def remaining_s(self) -> float:
        """Seconds left for the next attempt."""
        return self._deadline - time.monotonic()

    def pause_s(self, error: TransportError) -> float:
        """Seconds to wait after a failed attempt before the next.

        Raises:
            TransportError: there is no next one, and this is why the call failed.
        """
        if error.code == "DEADLINE_EXCEEDED" and self._unavailable is not None:
            # The clock only cut short the last of several attempts to reach a server that is gone.
            raise self._unavailable
        pause_s = self._pause_s
        if error.code != "UNAVAILABLE" or _hopeless(error) or self.remaining_s() <= pause_s:
            raise error
        self._unavailable = error
        self._pause_s = min(2 * pause_s, self.LONGEST_PAUSE_S)
        return pause_s


def transport_error(error: grpc.RpcError) -> TransportError:
    """A failed call in this package's words."""
    code, details = error.code().name, error.details() or "no details"
    # Ray's proxy calls it INTERNAL when the replica that it had chosen dies. Another one will answer.
    if code == "INTERNAL" and any(words in details for words in _LOST_REPLICA):
        code = "UNAVAILABLE"
    return TransportError(code, details, LoadHints.from_metadata(error.trailing_metadata()))


def is_silence(error: TransportError) -> bool:
    """Whether nobody spoke in time. A server that says so itself is there, and late."""
    return error.code == "DEADLINE_EXCEEDED" and error.message.startswith("Deadline Exceeded")


def unanswered(timeout_s: float) -> TransportError:
    """The error of a call that the robot stopped waiting for."""
    return TransportError("DEADLINE_EXCEEDED", f"no answer within {timeout_s:.3f} s")


def no_server(target: str, error: TransportError, budget_s: float) -> HandshakeError:
    """Why a client could not be made, with host, budget and remedy."""
    distrust = locked_out(error)
    if distrust is not None:
        return HandshakeError(
            f"found a server at {target}, but {distrust} `comvla doctor` looks closer "
            f"({error.code}: {error.message})"
        )
    if error.code == "NOT_FOUND":
        return HandshakeError(f"found a server at {target}, but no such model: {error.message}")
    if error.code == "UNIMPLEMENTED":
        found = "a gRPC server answered that offers no comvla.v1.PolicyService."
    elif _speaks_no_http2(error):
        found = "what answered does not speak gRPC: a web server, or the admin surface?"
    elif error.code == "DEADLINE_EXCEEDED":
        found = "nothing spoke gRPC in time."
    elif "Socket closed" in error.message or "Connection reset" in error.message:
        found = "it hung up at once: it may ask for TLS, or for a certificate of this robot."
    else:
        found = "no server was ready."
    return HandshakeError(
        f"expected a ComVLA server at {target} within {budget_s:g} s, but {found} "
        "Start one there with `comvla-server serve`, correct the address, or allow more with "
        f"connect_timeout_s; `comvla doctor` looks closer ({error.code}: {error.message})"
    )


def _hopeless(error: TransportError) -> bool:
    # What answered will not turn into a trusted gRPC server by waiting.
    return _speaks_no_http2(error) or locked_out(error) is not None


def _speaks_no_http2(error: TransportError) -> bool:
    return "parsing HTTP/2" in error.message
