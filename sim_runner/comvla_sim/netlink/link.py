"""The link as a whole: up while a ``with`` block lasts, gone after it, whatever ended it."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Literal

from comvla.errors import LinkError
from comvla_client.budget import PAPER_LINK, LinkProfile
from comvla_sim.bench.processes import connected
from comvla_sim.netlink import driver, namespaces, relay, wires
from comvla_sim.netlink.guardian import guarding
from comvla_sim.netlink.namespaces import LinkName
from comvla_sim.netlink.shaper import Shaper
from comvla_sim.netlink.wires import Side

ANSWER_TIMEOUT_S = 30.0
"""Longest that the process which follows the channel may be silent."""

_ROBOT_PORT, _CLOUD_PORT = "robot-port", "cloud-port"


@dataclass(frozen=True)
class LinkSettings:
    """What a link is like.

    Attributes:
        profile: bandwidth, period and efficiency of the radio; gives capacity by Eq. (1).
        delay_s: one-way propagation delay, seconds.
        mtu_bytes: largest IP packet.
        congestion_control: of both ends, e.g. ``cubic``; None takes the machine's default.
        initcwnd: packets that the robot's connection may send before the first answer; None leaves 10.
        sysctls: ``net.ipv4`` settings of both ends, e.g. ``{"tcp_slow_start_after_idle": 0}``.

    Raises:
        LinkError: a delay or MTU out of range.
    """

    profile: LinkProfile = PAPER_LINK
    delay_s: float = 0.0
    mtu_bytes: int = 1500
    congestion_control: str | None = "cubic"
    initcwnd: int | None = None
    sysctls: dict[str, str | int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.delay_s) and 0.0 <= self.delay_s <= 10.0):
            raise LinkError(f"expected a delay of 0 to 10 s each way, got {self.delay_s!r}")
        if not 576 <= self.mtu_bytes <= 9000:
            raise LinkError(f"expected an MTU of 576 to 9000 bytes, got {self.mtu_bytes!r}")


@dataclass(frozen=True)
class Punctuality:
    """How well the changes of capacity kept time.

    Attributes:
        late: periods, median_s, p99_s and max_s of their lateness in seconds; negative is early.
        stolen_periods: periods in which the host of a virtual machine took time from it.
    """

    late: dict[str, float]
    stolen_periods: list[int]


class NamespaceLink:
    """Two namespaces and the radio between them. A context manager.

    ``robot`` and ``cloud`` are names of network namespaces: processes enter them by
    :func:`comvla_sim.netlink.namespaces.enter`, people by ``ip netns exec``. A server in ``cloud``
    listens on :data:`comvla_sim.netlink.wires.CLOUD_ADDRESS`. What leaves the robot is shaped, by
    :meth:`shape` or by :meth:`follow`; the way back is not.

    Args:
        settings: what the link is like.

    Raises:
        LinkError: on entering, without root or where the kernel lacks what it takes.
        DependencyError: on entering, without pyroute2.
    """

    def __init__(self, settings: LinkSettings | None = None) -> None:
        self.settings = settings or LinkSettings()
        self.name = LinkName.of_this_process()
        self._stack = ExitStack()
        self._driver: Connection | None = None

    @property
    def robot(self) -> str:
        """The robot's namespace."""
        return self.name.namespace("robot")

    @property
    def cloud(self) -> str:
        """The cloud's namespace."""
        return self.name.namespace("cloud")

    def __enter__(self) -> NamespaceLink:
        namespaces.check_privileges()
        namespaces.remove_leftovers()
        with self._stack:
            self._set_up()
            self._stack = self._stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._driver = None
        self._stack.close()

    def shape(self, bytes_per_s: float) -> None:
        """Holds one rate for what leaves the robot, in bytes of IP packets per second."""
        with Shaper(
            self.robot_end,
            mtu_bytes=self.settings.mtu_bytes,
            period_s=self.settings.profile.period_s,
        ) as shaper:
            shaper.set_rate(bytes_per_s)

    def follow(self, channel: Iterable[float], *, lead_s: float = 0.2) -> float:
        """Lets a process of its own set the capacity of every control period from now on.

        Args:
            channel: SNR in dB of each period.
            lead_s: time until period 0 begins, in seconds.

        Returns:
            When period 0 begins, on ``time.monotonic``.
        """
        if self._driver is not None:
            raise LinkError("this link follows a channel already: make another link for another")
        settings = self.settings
        arguments = (self.robot_end, settings.mtu_bytes, settings.profile, channel)
        self._driver, _ = self._stack.enter_context(connected(driver.serve, *arguments))
        start = time.monotonic() + lead_s
        self._driver.send_bytes(str(start).encode())
        return start

    def punctuality(self) -> Punctuality:
        """How well the process that follows the channel kept time so far.

        Raises:
            LinkError: that process has ended, e.g. because its device vanished, or does not answer.
        """
        assert self._driver is not None, "only a link that follows a channel has a driver"
        try:
            self._driver.send_bytes(b"?")
            if not self._driver.poll(ANSWER_TIMEOUT_S):
                raise LinkError(
                    "the process that follows the channel did not answer within "
                    f"{ANSWER_TIMEOUT_S:.0f} s: was this machine suspended, or is it too busy?"
                )
            answer = json.loads(self._driver.recv_bytes())
        except (OSError, EOFError) as error:
            raise LinkError(
                "the process that follows the channel has ended (its message is above): was the "
                "link taken down meanwhile?"
            ) from error
        return Punctuality(answer["late"], answer["stolen_periods"])

    def set_up_down(self, up: bool, *, at: Literal["robot", "cloud"] = "cloud") -> None:
        """Cuts the link or restores it.

        Args:
            up: whether packets pass.
            at: ``"cloud"`` loses packets silently, as a radio in a fade; ``"robot"`` takes the
                carrier from the robot's device, as a modem that reports the loss.
        """
        port = _CLOUD_PORT if at == "cloud" else _ROBOT_PORT
        wires.set_carrier(Side(self.name.namespace("air"), port), up)

    def describe(self) -> dict[str, Any]:
        """The settings as plain values."""
        settings = self.settings
        return {
            "bandwidth_hz": settings.profile.bandwidth_hz,
            "period_s": settings.profile.period_s,
            "efficiency": settings.profile.efficiency,
            "delay_s": settings.delay_s,
            "mtu_bytes": settings.mtu_bytes,
            "congestion_control": settings.congestion_control,
            "initcwnd": settings.initcwnd,
            "sysctls": dict(settings.sysctls),
        }

    @property
    def robot_end(self) -> Side:
        """The robot's end of the cable, where what leaves it can be captured."""
        return Side(self.robot, wires.DEVICE, wires.ROBOT_MAC)

    @property
    def cloud_end(self) -> Side:
        """The cloud's end of the cable."""
        return Side(self.cloud, wires.DEVICE, wires.CLOUD_MAC)

    def _set_up(self) -> None:
        settings, air = self.settings, self.name.namespace("air")
        self._stack.enter_context(guarding(self.name))
        for role in namespaces.ROLES:
            namespaces.create(self.name.namespace(role))
        robot, cloud = self.robot_end, self.cloud_end
        ports = Side(air, _ROBOT_PORT), Side(air, _CLOUD_PORT)
        wires.join(robot, ports[0], mtu_bytes=settings.mtu_bytes)
        wires.join(cloud, ports[1], mtu_bytes=settings.mtu_bytes)
        wires.address(robot, wires.ROBOT_ADDRESS, wires.CLOUD_ADDRESS, wires.CLOUD_MAC)
        wires.address(cloud, wires.CLOUD_ADDRESS, wires.ROBOT_ADDRESS, wires.ROBOT_MAC)
        for end in (robot, cloud):
            wires.tune(end.namespace, settings.sysctls)
        congestion_control = settings.congestion_control
        wires.steer(
            robot,
            wires.CLOUD_ADDRESS,
            congestion_control=congestion_control,
            initcwnd=settings.initcwnd,
        )
        wires.steer(cloud, wires.ROBOT_ADDRESS, congestion_control=congestion_control)
        if settings.delay_s:
            arguments = (air, _ROBOT_PORT, _CLOUD_PORT, settings.delay_s)
            self._stack.enter_context(connected(relay.serve, *arguments))
        else:
            wires.bridge(air, ports)
