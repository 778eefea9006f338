"""``comvla-sim demo`` with a real server process and the real simulator, cut short."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from comvla_sim import cli
from comvla_sim.demo import server_process
from comvla_sim.demo.fleet import FleetOfRobots
from comvla_sim.demo.server_process import ServerProcess, ServerProcessError
from comvla_sim.worlds.tabletop import Tabletop
from comvla_vla import random_policy, save_policy
from comvla_vla.random import unit_statistics

pytestmark = pytest.mark.simulator


READY = "comvla-server ready grpc=127.0.0.1:1234 admin=http://127.0.0.1:4321 model=stand-in"


def stand_in(code: str, **options: float) -> ServerProcess:
    """A server process that runs a few lines of Python instead of a server."""
    server = ServerProcess("mini", **options)
    server._command = [sys.executable, "-c", f"import signal, sys, time\n{code}"]
    return server


def waiting(lines: str = "") -> str:
    return f"{lines}\nprint({READY!r}, flush=True)\ntime.sleep(600)"


def test_the_demo_leaves_a_page_and_no_server(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Tabletop, "max_episode_steps", 12)
    started: list[subprocess.Popen[str]] = []
    stop = ServerProcess.stop

    def remembering(self: ServerProcess) -> None:
        if self._process is not None:
            started.append(self._process)
        stop(self)

    monkeypatch.setattr(ServerProcess, "stop", remembering)
    edge, cloud = random_policy(seed=0)
    checkpoint, out = tmp_path / "policy", tmp_path / "page.html"
    statistics = unit_statistics(edge.config)
    save_policy(checkpoint, edge.net, cloud.net, edge.prompt.tokenizer, statistics)
    options = ["--episodes", "2", "--model", str(checkpoint), "--out", str(out), "--json"]
    assert cli.main(["demo", *options]) == 0
    outcome = json.loads(capsys.readouterr().out)
    assert outcome["page"] == str(out)
    assert outcome["episodes"] == len(outcome["rows"]) == 2
    assert outcome["successes"] == 0
    assert outcome["link"]["above_capacity"] == 0
    assert outcome["link"]["requests"] > 0
    for row in outcome["rows"]:
        assert row["periods"] == row["periods_with_all_tokens"] == 12
        for record in row["log"]:
            assert 8 * record["offered_bytes"] <= record["capacity_bits"]
            assert record["delivered_tokens"] == record["offered_tokens"]
    assert outcome["full"]["tokens"] == 512
    assert outcome["voted"]["tokens"] < 512
    html = out.read_text()
    assert "0 of 2 instructions obeyed" in html
    assert html.count("data:image/") == 2 * (1 + 12 // 2)
    (server,) = started
    assert server.returncode == 0


def test_a_fleet_works_until_its_time_is_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    watched: list[float | None] = []
    watch = FleetOfRobots.watch

    def shortly(self: FleetOfRobots, seconds: float | None, well: Callable[[], bool]) -> None:
        watched.append(seconds)
        assert well()
        watch(self, seconds, well)
        assert all(robot.is_alive() for robot, _ in self._robots)

    monkeypatch.setattr(FleetOfRobots, "watch", shortly)
    edge, cloud = random_policy(seed=0)
    checkpoint = tmp_path / "policy"
    statistics = unit_statistics(edge.config)
    save_policy(checkpoint, edge.net, cloud.net, edge.prompt.tokenizer, statistics)
    options = ["--fleet", "1", "--seconds", "0.5", "--model", str(checkpoint), "--json"]
    assert cli.main(["demo", *options]) == 0
    where, counts = capsys.readouterr().out.splitlines()
    assert where.startswith("1 robots, to watch at http://127.0.0.1:")
    assert json.loads(counts).keys() == {"episodes", "successes"}
    assert watched == [0.5]


def test_seconds_are_for_a_fleet_only(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "--seconds", "3"]) != 0
    assert "--fleet N" in capsys.readouterr().err


def test_a_server_that_does_not_start_leaves_its_last_words() -> None:
    broken = "print('loading', flush=True); sys.exit('no such checkpoint: /nowhere')"
    with pytest.raises(ServerProcessError, match=r"code 1 before(.|\n)*checkpoint: /nowhere"):
        stand_in(broken).__enter__()
    with pytest.raises(ServerProcessError, match="code 3 before it was ready and said nothing"):
        stand_in("sys.exit(3)").__enter__()


def test_the_command_says_so_with_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(self: ServerProcess) -> None:
        raise ServerProcessError("the server ended with code 2")

    monkeypatch.setattr(ServerProcess, "__enter__", fail)
    assert cli.main(["demo", "--out", str(tmp_path / "page.html")]) == 1
    assert "ended with code 2" in capsys.readouterr().err


def test_a_server_that_is_never_ready_is_given_up_and_ended() -> None:
    server = stand_in("time.sleep(600)", ready_within_s=0.1)
    with pytest.raises(ServerProcessError, match=r"not ready within 0\.1 s"):
        server.__enter__()
    assert not server.running


def test_other_lines_do_not_make_a_server_ready_and_never_block_it() -> None:
    """More output than a pipe holds, before and after the line that counts."""
    noise = "print('x' * 1000 + '\\n' * 200_000, flush=True)"
    with stand_in(f"{noise}\nprint({READY!r})\n{noise}\nsys.exit(0)") as server:
        assert (server.target, server.admin_url) == ("127.0.0.1:1234", "http://127.0.0.1:4321")
        assert server._process is not None
        assert server._process.wait(60) == 0


def test_a_server_that_dies_in_between_is_noticed() -> None:
    with stand_in(waiting()) as server:
        server.require_running()
        assert server._process is not None
        server._process.kill()
        server._process.wait()
        with pytest.raises(ServerProcessError, match="mid-episode"):
            server.require_running()
    server.stop()


def test_a_server_that_does_not_listen_to_sigterm_is_killed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(server_process, "_DRAIN_WITHIN_S", 0.1)
    with stand_in(waiting("signal.signal(signal.SIGTERM, signal.SIG_IGN)")) as server:
        process = server._process
        assert process is not None
    assert process.returncode == -signal.SIGKILL


def test_a_page_that_cannot_be_written_is_refused_before_the_server_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["demo", "--out", str(tmp_path)]) == 2
    assert "--out" in capsys.readouterr().err


def test_a_terminated_demo_takes_its_server_with_it(tmp_path: Path) -> None:
    """SIGTERM right after the server said that it is ready."""
    script = tmp_path / "demo.py"
    script.write_text(
        f"""
import sys
from comvla_sim import cli
from comvla_sim.demo import command, server_process

def play(args, server):
    print(server._process.pid, flush=True)
    sys.stdin.read()

def stand_in(model, make=server_process.ServerProcess):
    server = make(model)
    server._command = [sys.executable, "-c", "import time\\n" + {waiting()!r}]
    return server

server_process.ServerProcess = stand_in
command._play = play
cli.main(["demo", "--out", {str(tmp_path / "page.html")!r}])
"""
    )
    demo = subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert demo.stdout is not None
    server = int(demo.stdout.readline())
    os.kill(server, 0)  # it is there
    demo.terminate()
    assert demo.wait(60) == 128 + signal.SIGTERM
    demo.communicate()
    with pytest.raises(ProcessLookupError):
        os.kill(server, 0)


@pytest.mark.parametrize(
    ("option", "value"), [("--mean-snr-db", "nan"), ("--seed", "-1"), ("--episodes", "0")]
)
def test_senseless_options_are_refused_before_the_server_starts(
    option: str, value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(self: ServerProcess) -> None:
        raise AssertionError("the server was started")

    monkeypatch.setattr(ServerProcess, "__enter__", start)
    try:
        status = cli.main(["demo", "--out", str(tmp_path / "page.html"), option, value])
    except SystemExit as ending:  # an option that the parser itself refuses
        status = ending.code
    assert status == 2
