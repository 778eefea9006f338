"""Links of network namespaces: real devices, real packets, and nothing left behind."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import comvla_sim.cli
from comvla.errors import ComVLAError, DependencyError, LinkError
from comvla_client.budget import LinkProfile
from comvla_sim.channel import ConstantChannel
from comvla_sim.netlink import namespaces, wires
from comvla_sim.netlink.capture import capturing
from comvla_sim.netlink.flaps import FlapParameters
from comvla_sim.netlink.link import LinkSettings, NamespaceLink
from comvla_sim.netlink.namespaces import LinkName
from comvla_sim.netlink.run import RunSettings

THIN = LinkProfile(bandwidth_hz=2e6)
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def root() -> None:
    """Skips where this machine does not let us make a link."""
    try:
        namespaces.check_privileges()
    except ComVLAError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def link(root: None) -> Iterator[NamespaceLink]:
    """A thin link with 5 ms each way."""
    with NamespaceLink(LinkSettings(profile=THIN, delay_s=0.005)) as up:
        yield up


def eventually(true: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + PATIENCE_S
    while not true():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def connected(link: NamespaceLink) -> tuple[socket.socket, socket.socket]:
    """A TCP connection from the robot to the cloud: both ends."""
    with namespaces.entered(link.cloud):
        listener = socket.create_server((wires.CLOUD_ADDRESS, 0))
    with listener, namespaces.entered(link.robot):
        robot = socket.create_connection(listener.getsockname(), timeout=PATIENCE_S)
        cloud, _ = listener.accept()
    cloud.settimeout(PATIENCE_S)
    for end in (robot, cloud):
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return robot, cloud


def test_a_packet_takes_the_delay_each_way(link: NamespaceLink) -> None:
    robot, cloud = connected(link)
    with robot, cloud:
        shortest_s = PATIENCE_S
        for _ in range(10):
            began = time.perf_counter()
            robot.sendall(b"x")
            cloud.sendall(cloud.recv(1))
            robot.recv(1)
            shortest_s = min(shortest_s, time.perf_counter() - began)
    assert shortest_s >= 0.010


def test_a_link_that_is_cut_loses_packets_and_one_that_returns_carries_them(
    link: NamespaceLink,
) -> None:
    with capturing(link.robot_end) as capture:
        robot, cloud = connected(link)
        with robot, cloud:
            link.set_up_down(False)
            try:
                robot.sendall(b"x")
                # Nobody acknowledged it.
                assert eventually(lambda: capture.counts()[0].repeated_bytes > 0)
            finally:
                link.set_up_down(True)
            assert cloud.recv(1) == b"x"


def test_no_period_passes_more_than_its_capacity(link: NamespaceLink) -> None:
    robot, cloud = connected(link)
    periods = 20
    with robot, cloud, capturing(link.robot_end) as capture:
        start = link.follow(ConstantChannel(10.0))
        capture.count_periods(start, THIN.period_s)
        capacity = THIN.capacity_bits(10.0) / 8
        robot.setblocking(False)
        received = 0
        while received < periods * capacity:
            try:
                robot.send(bytes(1 << 16))
            except BlockingIOError:
                received += len(cloud.recv(1 << 16))
        seen = capture.result()
    assert seen.lost == 0
    assert len(seen.period_bytes) >= periods - 2
    # A packet that began in one period may end in the next.
    assert max(seen.period_bytes) <= capacity + wires.ETHERNET_HEADER_BYTES + 1500
    assert link.punctuality().late["periods"] > 0
    with pytest.raises(LinkError, match="follows a channel already"):
        link.follow(ConstantChannel(10.0))


def test_both_ends_have_the_settings_that_were_asked_for(root: None) -> None:
    settings = LinkSettings(
        congestion_control="reno", initcwnd=40, sysctls={"tcp_slow_start_after_idle": 0}
    )
    with NamespaceLink(settings) as link:
        for end in (link.robot, link.cloud):
            with namespaces.entered(end):
                path = Path("/proc/sys/net/ipv4/tcp_slow_start_after_idle")
                assert path.read_text(encoding="ascii").strip() == "0"
        with namespaces.routes_in(link.robot) as routes:
            [route] = [r for r in routes.get_routes() if r.get_attr("RTA_METRICS")]
        metrics = route.get_attr("RTA_METRICS")
        assert metrics.get_attr("RTAX_CC_ALGO") == "reno"
        assert metrics.get_attr("RTAX_INITCWND") == 40
        assert link.describe()["initcwnd"] == 40


def names_of(link: NamespaceLink) -> set[str]:
    return {link.name.namespace(role) for role in namespaces.ROLES}


def there() -> set[str]:
    return set(os.listdir(namespaces.NAMESPACE_FOLDER))


def test_an_exception_takes_the_link_down(root: None) -> None:
    class Broken(Exception):
        pass

    link, seen = NamespaceLink(), set[str]()

    def work() -> None:
        with link:
            seen.update(there())
            raise Broken

    with pytest.raises(Broken):
        work()
    assert names_of(link) <= seen
    assert not names_of(link) & there()


@pytest.mark.parametrize(
    "settings",
    [LinkSettings(sysctls={"no_such_setting": 1}), LinkSettings(congestion_control="nonesuch")],
)
def test_a_link_that_cannot_be_made_leaves_nothing(root: None, settings: LinkSettings) -> None:
    link = NamespaceLink(settings)
    with pytest.raises(LinkError), link:
        pass
    # Only its own: other links come and go, of tests that run beside this one.
    assert not names_of(link) & there()


def test_the_link_of_a_killed_process_goes_too(root: None) -> None:
    program = (
        "import sys, time\n"
        "from comvla_sim.netlink.link import NamespaceLink\n"
        "with NamespaceLink() as link:\n"
        "    print(link.robot, flush=True)\n"
        "    time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        name = process.stdout.readline().decode().strip()
        assert name in there()
        process.kill()
    assert eventually(lambda: name not in there())


def test_leftovers_of_the_dead_are_found_and_those_of_the_living_stay(
    root: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A folder of its own: whoever makes a link removes all leftovers that are in the common one.
    monkeypatch.setattr(namespaces, "NAMESPACE_FOLDER", tmp_path)
    with subprocess.Popen(["true"]) as process:
        process.wait()
    dead, alive = LinkName(process.pid, 1, 1), LinkName.of_this_process()
    try:
        for link in (dead, alive):
            namespaces.create(link.namespace("robot"))
        assert set(namespaces.links()) == {dead, alive}
        assert namespaces.remove_leftovers() == [dead]
        assert namespaces.links() == [alive]
    finally:
        for link in (dead, alive):
            namespaces.remove_link(link)


def test_a_device_that_vanishes_is_told(root: None) -> None:
    with NamespaceLink(LinkSettings(profile=THIN)) as link:
        link.follow(ConstantChannel(10.0), lead_s=0.0)
        with namespaces.routes_in(link.robot) as routes:
            routes.link("del", index=routes.link_lookup(ifname=wires.DEVICE)[0])
        assert eventually(lambda: _has_ended(link))


def _has_ended(link: NamespaceLink) -> bool:
    try:
        link.punctuality()
    except LinkError as error:
        return "was the link taken down" in str(error)
    return False


def test_up_status_and_down_from_the_command_line(
    root: None, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [sys.executable, "-m", "comvla_sim.cli", "link", "up", "--delay-ms", "3", "--json"]
    # Both pipes end with the command, though the link stays.
    made = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    up = json.loads(made.stdout)
    assert {up["robot"], up["cloud"]} <= there()
    assert up["settings"]["delay_s"] == 0.003
    assert comvla_sim.cli.main(["link", "status", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)["links"]
    assert [row["alive"] for row in shown if row["name"] == up["name"]] == [True]
    assert comvla_sim.cli.main(["link", "down", up["name"]]) == 0
    assert up["name"] in capsys.readouterr().out
    assert not {up["robot"], up["cloud"]} & there()
    assert comvla_sim.cli.main(["link", "down", up["name"]]) == 2
    assert "there is no link" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_run_that_is_stopped_takes_its_link_down(root: None, number: signal.Signals) -> None:
    command = [sys.executable, "-m", "comvla_sim.cli", "link", "run", "--minutes", "5"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        mine = f"comvla-{process.pid}-"
        assert eventually(lambda: any(name.startswith(mine) for name in there()))
        process.send_signal(number)
        _, words = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert "the link is down" in words
    assert not any(name.startswith(mine) for name in there())


def test_without_root_the_error_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(LinkError, match=r"needs root.*sudo"):
        namespaces.check_privileges()


def test_on_other_systems_the_error_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(LinkError, match="needs Linux"):
        namespaces.check_privileges()


def test_without_pyroute2_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setitem(sys.modules, "pyroute2", None)
    with pytest.raises(DependencyError, match=r"comvla\[sim\]"):
        namespaces.check_privileges()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="namespaces are Linux's")
def test_a_namespace_that_is_not_there_is_told() -> None:
    with pytest.raises(LinkError, match="link status"):
        namespaces.enter("comvla-1-1-1-robot")


@pytest.mark.parametrize(
    "make",
    [
        lambda: LinkSettings(delay_s=-0.1),
        lambda: LinkSettings(delay_s=float("nan")),
        lambda: LinkSettings(mtu_bytes=100),
        lambda: RunSettings(scale="huge"),
        lambda: RunSettings(minutes=0.0),
        lambda: RunSettings(csi_delay=-1),
        lambda: FlapParameters(count=0),
        lambda: FlapParameters(shortest_s=1.0, longest_s=0.5),
    ],
)
def test_numbers_out_of_range_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(LinkError, match="expected"):
        make()


def test_a_mistake_on_the_command_line_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert comvla_sim.cli.main(["link", "run", "--channel", "trace"]) == 2
    assert "--trace FILE" in capsys.readouterr().err
