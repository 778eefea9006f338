"""What silence does to a connection: a slow start after it, or no connection any more."""

from __future__ import annotations

import statistics
import threading
import time
from types import TracebackType

import grpc

from comvla_client import channel
from comvla_client.access import Access
from comvla_client.diagnosis.finding import Allowance, Finding, out_of_time
from comvla_client.diagnosis.goodput import Goodput
from comvla_client.diagnosis.probes import upload_request, upload_s
from comvla_client.errors import TransportError
from comvla_client.transport_protocol import Transport

SILENCE_S = 1.2
"""Longer than TCP's retransmission timeout, after which it forgets a connection's speed."""

ENOUGH_BYTES = 64 << 10
"""More than TCP sends unasked on a new connection, as a few dozen tokens are."""

PING_PERIOD_S = dict(channel.CHANNEL_OPTIONS)["grpc.keepalive_time_ms"] / 1e3


def idle_restart(
    transport: Transport, round_trip_s: float, seen: Goodput | None, allowance: Allowance
) -> tuple[Finding, bool]:
    """Compares an upload after a silence with the same upload back to back.

    Args:
        transport: to the server.
        round_trip_s: of a small call.
        seen: the goodput, which keeps the upload below half a second.
        allowance: what is left must hold the silence and two uploads.

    Returns:
        The finding, and whether silence costs something.
    """
    rate = 1e6 if seen is None else seen.bits_per_s
    size = int(min(ENOUGH_BYTES, max(4096.0, 0.5 * rate / 8.0)))
    about_s = round_trip_s + 8.0 * size / rate
    if allowance.left_s() < SILENCE_S + 4 * about_s:
        return out_of_time("idle", allowance), False
    request = upload_request(size)
    try:
        steady = [upload_s(transport, request, allowance.left_s()) for _ in range(4)][1:]
        rested: list[float] = []
        while not rested or (
            len(rested) < 3 and allowance.left_s() > 0.4 * allowance.seconds + SILENCE_S
        ):
            time.sleep(SILENCE_S)
            rested.append(upload_s(transport, request, max(allowance.left_s(), 0.5)))
            upload_s(transport, request, max(allowance.left_s(), 0.5))
    except TransportError as error:
        if error.code not in ("DEADLINE_EXCEEDED", "UNAVAILABLE"):
            return Finding("idle", "skip", f"the server did not read an upload ({error})"), False
        return Finding(
            "idle",
            "fail",
            f"an upload of {size / 1024:.0f} KiB was lost ({error})",
            "the link is unsteady: look at the radio, and at the server's log",
        ), True
    steady_s, rested_s = statistics.median(steady), statistics.median(rested)
    penalty_s = rested_s - steady_s
    # What the timing scatters by itself proves nothing.
    limit_s = max(0.15 * round_trip_s + 2e-3, max(steady) - min(steady))
    values = {
        "upload_bytes": size,
        "back_to_back_s": steady_s,
        "after_silence_s": rested_s,
        "penalty_s": penalty_s,
    }
    found = (
        f"{size / 1024:.0f} KiB take {1e3 * steady_s:.1f} ms back to back, {1e3 * rested_s:.1f} ms "
        f"after {SILENCE_S:g} s of silence"
    )
    if penalty_s <= limit_s:
        return Finding("idle", "ok", found, values=values), False
    return Finding(
        "idle",
        "fail",
        found,
        "a robot that executes chunks is silent between queries; TCP may start slowly after that "
        "(tcp_slow_start_after_idle, below), or the radio fall asleep: Wi-Fi by power saving, a modem "
        "within seconds (ask the operator for a longer inactivity timer)",
        values,
    ), True


class SilentConnection:
    """A second connection that says nothing while the other checks run.

    Args:
        access: how to reach the server.
        timeout_s: longest to wait until it stands.
    """

    def __init__(self, access: Access, timeout_s: float) -> None:
        self._lost: str | None = None
        self._ready_s: float | None = None
        self._lost_after_s = 0.0
        self._changed = threading.Event()
        self._channel = access.channel()
        ready = grpc.channel_ready_future(self._channel)
        try:
            ready.result(timeout=timeout_s)
        except grpc.FutureTimeoutError:
            ready.cancel()
            return
        self._ready_s = time.monotonic()
        self._channel.subscribe(self._watch)

    def __enter__(self) -> SilentConnection:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._channel.unsubscribe(self._watch)
        self._channel.close()

    def finding(self, allowance: Allowance) -> Finding:
        """Whether the connection still stands, after one ping if there is time to wait for it."""
        if self._ready_s is None:
            return Finding("keep-alive", "skip", "no second connection could be opened")
        watched_s = time.monotonic() - self._ready_s
        wait_s = PING_PERIOD_S + 1.0 - watched_s
        if 0.0 < wait_s <= allowance.left_s():
            self._changed.wait(wait_s)
        watched_s = time.monotonic() - self._ready_s
        values = {"silence_s": watched_s, "pings_due": int(watched_s / PING_PERIOD_S)}
        if self._lost is not None:
            return Finding(
                "keep-alive",
                "fail",
                f"a silent connection was lost after {self._lost_after_s:.1f} s ({self._lost})",
                "something between robot and server forgets silent connections, or the server "
                "forbids pings: lengthen the timeout of the firewall or proxy, or let comvla-server "
                "allow pings (ServerSettings.min_ping_interval_s)",
                values,
            )
        if values["pings_due"] == 0:
            return Finding(
                "keep-alive",
                "ok",
                f"a connection stood {watched_s:.1f} s of silence; no ping was due yet (one each "
                f"{PING_PERIOD_S:g} s, --seconds {PING_PERIOD_S + 5:g} waits for it)",
                values=values,
            )
        return Finding(
            "keep-alive",
            "ok",
            f"a connection stood {watched_s:.1f} s of silence and its ping",
            values=values,
        )

    def _watch(self, state: grpc.ChannelConnectivity) -> None:
        if state is not grpc.ChannelConnectivity.READY and self._lost is None:
            assert self._ready_s is not None
            self._lost_after_s = time.monotonic() - self._ready_s
            self._lost = state.name
            self._changed.set()
