"""``comvla-sim bench fuzz``: what it counts, and that nothing which ends a server hides the rest."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import grpc
import pytest

from comvla_sim.fuzz import connections, over_socket
from comvla_sim.fuzz.cases import KINDS, Case
from comvla_sim.fuzz.in_process import run_one
from comvla_sim.fuzz.outcome import Tally
from comvla_sim.fuzz.watch import Watch

FRAMES = [case for case in (Case(0, number) for number in range(2000)) if case.kind == "frames"]


class FragileServer:
    """Stands in for a process: ends at certain cases, and counts its starts."""

    target = "nowhere:1"

    def __init__(self, raised: str, ends_at: set[int]) -> None:
        self.raised, self.ends_at, self.starts, self.alive = raised, ends_at, 1, True

    def restart(self) -> None:
        self.starts, self.alive = self.starts + 1, True

    async def end(self) -> str | None:
        return None if self.alive else self.raised

    async def connection(self, case: Case, target: str) -> str:
        if not self.alive:
            return "refused"
        self.alive = case.number not in self.ends_at
        return "echoed"

    async def unwell(self, target: str) -> str:
        return "" if self.alive else "no answer"


@pytest.fixture
def fragile(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, set[int]], FragileServer]:
    def make(raised: str, ends_at: set[int]) -> FragileServer:
        server = FragileServer(raised, ends_at)
        monkeypatch.setattr(connections, "_connection", server.connection)
        monkeypatch.setattr(connections, "_unwell", server.unwell)
        return server

    return make


def after_frames(server: Any) -> Tally:
    tally, told = Tally(), []
    asyncio.run(connections.run(FRAMES, server, tally, told.append))
    assert told[-1] == len(FRAMES)
    assert tally.kinds["frames"] == len(FRAMES)
    return tally


def test_the_connections_that_end_a_server_are_found_and_the_rest_goes_on(fragile: Any) -> None:
    fatal = {FRAMES[3].number, FRAMES[5].number, FRAMES[-1].number}
    server = fragile("RuntimeError", fatal)
    tally = after_frames(server)
    assert {failure["case"] for failure in tally.failures} == {f"0:{number}" for number in fatal}
    assert tally.failed == 3
    assert tally.statuses["frames"] == {"ended the server": 3, "echoed": len(FRAMES) - 3}
    assert server.starts == 6  # one for each of two batches, one for each connection


def test_a_known_end_is_counted_and_is_no_failure(fragile: Any) -> None:
    tally = after_frames(fragile("UnicodeDecodeError", {FRAMES[7].number}))
    assert tally.failed == 0
    assert tally.statuses["frames"][connections.KNOWN_END] == 1
    assert "refused" not in tally.statuses["frames"]


def test_an_end_that_no_single_connection_repeats_is_a_failure(fragile: Any) -> None:
    server = fragile("RuntimeError", {FRAMES[0].number})
    restart = server.restart

    def restart_in_better_health() -> None:
        server.ends_at = set()
        restart()

    server.restart = restart_in_better_health
    tally = after_frames(server)
    assert tally.failed == 1
    assert "outlived the same connections" in tally.failures[0]["what"]


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="memory is read from Linux's /proc")
def test_a_process_that_has_ended_is_not_measured() -> None:
    alive = Watch("this one", os.getpid())
    for share in (0.0, 0.5, 1.0):
        alive.look(share)
    verdict = alive.verdict()
    assert verdict["measured"]
    assert verdict["end_bytes"] > 2**20
    with subprocess.Popen([sys.executable, "-c", ""]) as child:
        os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)  # ended, and still in the table
        ended = Watch("ended", child.pid)
        for share in (0.5, 1.0):
            ended.look(share)
    assert ended.samples == []
    assert ended.verdict() == {"name": "ended", "measured": False, "grew": False}


@pytest.mark.parametrize("kind", list(dict.fromkeys(KINDS)))
def test_a_number_stands_for_one_kind_whatever_the_run(kind: str) -> None:
    cases = [case for case in (Case(3, number) for number in range(1000)) if case.kind == kind]
    assert len(cases) == 10 * KINDS.count(kind)
    assert [c.rng().random() for c in cases] == [Case(3, c.number).rng().random() for c in cases]


@pytest.mark.parametrize("kind", ["fields", "bytes", "streams", "valid"])
def test_single_cases_are_repeated_in_this_process(kind: str) -> None:
    case = next(case for case in (Case(0, number) for number in range(1000)) if case.kind == kind)
    tally = run_one(case)
    assert tally.kinds[kind] == 1
    assert tally.failures == []


@pytest.mark.parametrize(("rise_mib", "grew"), [(0.0, False), (100.0, True)])
def test_memory_that_only_swings_has_not_grown(rise_mib: float, grew: bool) -> None:
    watch = Watch("swings", 0)
    for i in range(101):
        swing = 40.0 if i % 2 else 0.0
        watch.samples.append((i / 100, int((400.0 + swing + rise_mib * i / 100) * 2**20), 20))
    assert watch.verdict()["grew"] is grew


@pytest.mark.parametrize(("hidden", "failed"), [(2, 0), (100, 1)])
def test_an_answer_that_grpc_hides_from_its_own_client_is_asked_for_again(
    hidden: int, failed: int
) -> None:
    answers = iter([(grpc.StatusCode.INTERNAL, "Internal error from Core")] * hidden)

    class Channel:
        def unary_unary(self, method: str) -> None:
            return None

        def stream_unary(self, method: str) -> Any:
            async def call(messages: Any, timeout: float) -> bytes:
                code, words = next(answers, (grpc.StatusCode.INVALID_ARGUMENT, "no head"))
                empty = grpc.aio.Metadata()
                raise grpc.aio.AioRpcError(code, empty, empty, details=words)

            return call

    tally = Tally()
    case = next(c for c in (Case(0, n) for n in range(2000)) if c.kind == "socket streams")
    asyncio.run(over_socket._Caller(Channel(), tally).run(case))  # type: ignore[arg-type]
    assert tally.failed == failed
    assert tally.kinds["socket streams"] == 1
