"""One run: a link, a server, a robot that asks every period, and a packet capture that judges."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from typing import Any

from comvla import codec
from comvla.errors import LinkError
from comvla_client.budget import LinkProfile, token_budget
from comvla_sim.bench import environment
from comvla_sim.bench.processes import connected
from comvla_sim.netlink import account, robot
from comvla_sim.netlink.capture import capturing
from comvla_sim.netlink.cloud import SYNTHETIC, cloud_server
from comvla_sim.netlink.link import LinkSettings, NamespaceLink
from comvla_sim.netlink.robot import RobotSettings

TCP_IP_HEADER_BYTES = 52
_LEAD_S = 1.0


@dataclass(frozen=True)
class Scale:
    """A policy and a link of its size.

    Attributes:
        model: what runs on both sides.
        bandwidth_hz: of the link.
        token_dim: D.
        num_tokens: N.
    """

    model: str
    bandwidth_hz: float
    token_dim: int
    num_tokens: int


SCALES = {
    "paper": Scale(SYNTHETIC, 20e6, 2176, 512),
    "mini": Scale("mini", 0.88e6, 96, 512),
}
"""The paper's sizes with synthetic content, and the shipped policy on a link scaled to its tokens."""


@dataclass(frozen=True)
class RunSettings:
    """One run.

    Attributes:
        scale: a name of :data:`SCALES`.
        sending: policy of sending, by name.
        minutes: how long.
        every: periods from one query to the next.
        csi_delay: age of the reported SNR, in periods.
        budget: how the client counts; None: ``paper`` for the policy ``paper``, else ``framed``.
        reserve_s: kept of the period for what is not sending; None: nothing for the policy
            ``paper``, whose formula has none, and what was measured for the others.
        mean_snr_db: of the channel, for the size of the queries that measure the reserve.
        bandwidth_hz: of the link; None is the scale's own.
        period_s: T.
        efficiency: η.
        delay_s: one-way delay.
        mtu_bytes: largest IP packet.
        congestion_control: of both ends.
        sysctls: of both ends.
        realtime: robot and server run before ordinary processes, on a machine that is shared.
    """

    scale: str = "paper"
    sending: str = "paper"
    minutes: float = 5.0
    every: int = 1
    csi_delay: int = 0
    budget: str | None = None
    reserve_s: float | None = None
    mean_snr_db: float = 10.0
    bandwidth_hz: float | None = None
    period_s: float = 0.05
    efficiency: float = 0.38
    delay_s: float = 0.0
    mtu_bytes: int = 1500
    congestion_control: str | None = "cubic"
    sysctls: tuple[tuple[str, str | int], ...] = (("tcp_slow_start_after_idle", 0),)
    realtime: bool = False

    def __post_init__(self) -> None:
        if self.scale not in SCALES:
            raise LinkError(f"expected a scale among {', '.join(SCALES)}, got {self.scale!r}")
        if not (self.minutes > 0 and self.every >= 1 and self.csi_delay >= 0):
            raise LinkError(
                "expected minutes > 0, every >= 1 and csi_delay >= 0, got "
                f"{self.minutes!r}, {self.every!r} and {self.csi_delay!r}"
            )

    @property
    def profile(self) -> LinkProfile:
        """The radio."""
        bandwidth_hz = self.bandwidth_hz or SCALES[self.scale].bandwidth_hz
        return LinkProfile(bandwidth_hz, self.period_s, self.efficiency)

    @property
    def queries(self) -> int:
        """How many queries the run has."""
        return max(1, round(60.0 * self.minutes / self.period_s / self.every))


def run(
    settings: RunSettings,
    channel: Iterable[float],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Runs, and gives the account.

    Args:
        settings: what runs.
        channel: SNR in dB of each period; picklable, the same from the start every time.
        on_progress: told of queries done, and of how many.

    Returns:
        ``settings``, ``environment``, ``summary`` and ``queries`` (one object each), JSON-able.

    Raises:
        LinkError: without root, or where the robot ended early.
    """
    where = environment.describe()
    profile = settings.profile
    link_settings = LinkSettings(
        profile=profile,
        delay_s=settings.delay_s,
        mtu_bytes=settings.mtu_bytes,
        congestion_control=settings.congestion_control,
        sysctls=dict(settings.sysctls),
    )
    own = robot_settings(settings)
    with (
        NamespaceLink(link_settings) as link,
        cloud_server(link.cloud, own.model, realtime=settings.realtime) as target,
        capturing(link.robot_end) as capture,
        connected(robot.serve, link.robot, target, own, channel, settings.queries) as (
            asking,
            measured,
        ),
    ):
        start = link.follow(channel, lead_s=_LEAD_S)
        capture.count_periods(start, profile.period_s)
        asking.send_bytes(str(start).encode())
        records = _records(asking, settings.queries, on_progress)
        kept = link.punctuality()
        captured = capture.result()
        described = link.describe()
    where["load_average_at_end"] = os.getloadavg()[0]
    queries = account.join(records, captured.calls, profile.period_s, kept.stolen_periods)
    return {
        "settings": {
            **asdict(settings),
            "sysctls": dict(settings.sysctls),
            "budget": own.budget,
            "channel": repr_channel(channel),
        },
        "link": described,
        "environment": where,
        "measured_before": json.loads(measured),
        "summary": account.summarise(queries, captured, profile, channel, settings.mtu_bytes),
        "change_lateness": kept.late,
        "queries": queries,
    }


def robot_settings(settings: RunSettings) -> RobotSettings:
    """What the robot is told.

    Its own budgets count up to HTTP/2. All but the paper's formula are told of a link from which
    TCP's and IP's headers are taken off.
    """
    scale, profile = SCALES[settings.scale], settings.profile
    budget = settings.budget or ("paper" if settings.sending == "paper" else "framed")
    share = 1.0
    if budget == "framed":
        share = (settings.mtu_bytes - TCP_IP_HEADER_BYTES) / settings.mtu_bytes
    bits = scale.token_dim * codec.bits_per_value("int8")
    typical = token_budget(settings.mean_snr_db, profile, bits)
    return RobotSettings(
        model=scale.model,
        link=LinkProfile(profile.bandwidth_hz, profile.period_s, share * profile.efficiency),
        sending=settings.sending,
        budget=budget,
        every=settings.every,
        csi_delay=settings.csi_delay,
        reserve_s=0.0 if settings.reserve_s is None and budget == "paper" else settings.reserve_s,
        typical_tokens=max(1, min(typical, scale.num_tokens)),
        realtime=settings.realtime,
    )


def repr_channel(channel: object) -> dict[str, Any]:
    """A channel's kind and numbers, for the record."""
    plain = {
        name.lstrip("_"): value
        for name, value in vars(channel).items()
        if isinstance(value, int | float | str)
    }
    return {"kind": type(channel).__name__, **plain}


def _records(
    asking: Connection, total: int, on_progress: Callable[[int, int], None]
) -> list[dict[str, Any]]:
    while True:
        try:
            message = json.loads(asking.recv_bytes())
        except EOFError:
            raise LinkError("the robot ended early; its own message is above") from None
        if "records" in message:
            records: list[dict[str, Any]] = message["records"]
            on_progress(total, total)
            return records
        on_progress(message["done"], total)
