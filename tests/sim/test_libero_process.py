"""A simulator that dies, hangs or talks nonsense never takes its caller along."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from libero_fakes import fake_command, fake_process

from comvla_sim.worlds.libero.errors import (
    AssetsError,
    LiberoError,
    ProtocolError,
    SimulatorDiedError,
    SimulatorTimeoutError,
)
from comvla_sim.worlds.libero.process import SimulatorProcess

STEP = {"action": np.zeros(7)}
PATIENCE_S = 60.0
PARENT = """
import os, sys
from comvla_sim.worlds.libero.process import SimulatorProcess

process = SimulatorProcess(sys.argv[2:], os.environ)
print(process.pid, flush=True)
if sys.argv[1] == "wait":
    sys.stdin.read()
"""


def is_gone(pid: int, *, within_s: float = PATIENCE_S) -> bool:
    """Whether a process ends in that time. One that waits for its parent to notice counts as ended."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except FileNotFoundError:
            return True
        if state == "Z":
            return True
        time.sleep(0.02)
    return False


@pytest.fixture
def thinking(monkeypatch: pytest.MonkeyPatch) -> Callable[..., SimulatorProcess]:
    """A child that hangs on its first request, and something to do as soon as it does.

    What a caller waits for begins when the child is there, however long a busy machine takes to let
    it run.
    """

    def make(then: Callable[[], object] = lambda: None) -> SimulatorProcess:
        process = fake_process("hangs")
        send = process._send

        def send_and_wait(request: bytes, deadline: float) -> None:
            patient = time.monotonic() + PATIENCE_S
            send(request, patient)
            # Not by seek and read: the child writes at the same position of the same open file.
            while b"thinking" not in os.pread(process._stderr.fileno(), 4000, 0):
                assert time.monotonic() < patient, "the child never began to think"
                time.sleep(0.01)
            then()

        monkeypatch.setattr(process, "_send", send_and_wait)
        return process

    return make


@pytest.fixture
def good() -> Iterator[SimulatorProcess]:
    process = fake_process()
    yield process
    process.close()


def test_requests_are_answered_and_chatter_on_stdout_does_no_harm(good: SimulatorProcess) -> None:
    assert len(good.greeting.fields["tasks"]) == 10
    good.ask("reset", {"task": 0, "init_state": 0})
    moved = good.ask("step", arrays={"action": np.array([1.0, 0, 0, 0, 0, 0, 0])})
    assert moved.arrays["eef_pos"][0] == pytest.approx(-0.195)


def test_an_unknown_request_is_refused_and_the_next_one_answered(good: SimulatorProcess) -> None:
    with pytest.raises(LiberoError, match="unknown request '__class__'"):
        good.ask("__class__")
    good.ask("reset", {"task": 0, "init_state": 0})


def test_a_failure_arrives_with_its_traceback_and_the_process_lives_on() -> None:
    process = fake_process("fails")
    with pytest.raises(LiberoError, match=r"the arm fell off[\s\S]*Traceback"):
        process.ask("step", arrays=STEP)
    assert process.ask("draw").arrays["frames"].shape == (2, 16, 16, 3)
    process.close()


def test_missing_assets_are_an_error_of_their_own() -> None:
    process = fake_process("no-assets")
    with pytest.raises(AssetsError, match=r"lack scenes/table\.xml.*--download"):
        process.ask("reset", {"task": 0, "init_state": 0})
    process.close()


@pytest.mark.parametrize(
    ("behaviour", "words"),
    [
        ("dies", r"signal SIGKILL\); it wrote:\n[\s\S]*I cannot go on"),
        ("exits", r"exit code 3"),
    ],
)
def test_a_death_is_reported_with_its_cause_and_last_words(behaviour: str, words: str) -> None:
    process = fake_process(behaviour)
    with pytest.raises(SimulatorDiedError, match=words):
        process.ask("step", arrays=STEP)
    assert process.closed
    with pytest.raises(LiberoError, match="is closed"):
        process.ask("draw")


def test_no_answer_in_time_ends_the_child(thinking: Callable[..., SimulatorProcess]) -> None:
    process = thinking()
    with pytest.raises(SimulatorTimeoutError, match=r"no answer in 0.2 s.*\n[\s\S]*thinking"):
        process.ask("step", arrays=STEP, timeout_s=0.2)
    assert is_gone(process.pid)


def test_a_child_that_never_speaks_is_ended() -> None:
    with pytest.raises(SimulatorTimeoutError, match=r"no answer in 0\.5 s"):
        fake_process("silent", start_timeout_s=0.5)


def test_nonsense_on_the_pipe_ends_the_child() -> None:
    process = fake_process("garbage")
    with pytest.raises(ProtocolError, match="starting with"):
        process.ask("step", arrays=STEP)
    assert is_gone(process.pid)


def test_a_simulator_that_cannot_start_says_why() -> None:
    with pytest.raises(LiberoError, match="no simulator today"):
        fake_process("broken")
    with pytest.raises(SimulatorDiedError, match="cannot start /nonexistent/python"):
        SimulatorProcess(["/nonexistent/python"], {})
    with pytest.raises(SimulatorDiedError, match=r"exit code 1\); it wrote:\n[\s\S]*ZeroDivision"):
        SimulatorProcess([sys.executable, "-c", "1 / 0"], {})


def test_ctrl_c_in_the_middle_of_an_answer_ends_the_child(
    thinking: Callable[..., SimulatorProcess],
) -> None:
    # Set only when the child has the request: earlier, it might strike outside of `raises`.
    process = thinking(lambda: signal.setitimer(signal.ITIMER_REAL, 0.2))

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    # pytest's own limit on a test has the same timer.
    limit = signal.setitimer(signal.ITIMER_REAL, 0.0)
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            process.ask("step", arrays=STEP)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
        signal.setitimer(signal.ITIMER_REAL, *limit)
    assert is_gone(process.pid)
    assert process.closed


def test_closing_twice_is_harmless_and_leaves_nothing(good: SimulatorProcess) -> None:
    good.close()
    good.close()
    assert is_gone(good.pid)


@pytest.mark.parametrize("end", ["exit", "kill", "interrupt"])
def test_nothing_is_left_behind_however_the_parent_ends(end: str) -> None:
    mode = "leave" if end == "exit" else "wait"
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, mode, *fake_command()],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    if end != "exit":
        os.kill(parent.pid, signal.SIGKILL if end == "kill" else signal.SIGINT)
    parent.communicate(timeout=PATIENCE_S)
    assert is_gone(pid)
