"""What the server remembers of its robots for people who watch: true, bounded, and nobody else's."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from server_stubs import STUB_INFO

from comvla.v1 import policy_pb2
from comvla_server import fleet_page
from comvla_server.calls import CallRecord
from comvla_server.fleet import (
    FORGOTTEN_AFTER_S,
    KEPT_SECONDS,
    Fleet,
    WatchedRobot,
    robot_of,
    since,
)
from comvla_server.fleet_seconds import COLUMNS
from comvla_server.identity import ANYBODY, Identity, set_caller
from comvla_server.refusals import Reason


class Clock:
    """Seconds that pass when told."""

    now_s = 1000.25

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def fleet(clock: Clock) -> Iterator[Fleet]:
    yield Fleet(clock, most_robots=8)
    set_caller(ANYBODY)


def request(
    session: str = "arm.0", step: int = 0, snr_db: float | None = 12.5
) -> policy_pb2.InferRequest:
    made = policy_pb2.InferRequest(session_id=session, step=step, instruction="open it")
    if snr_db is not None:
        made.snr_db = snr_db
    return made


def call(k: int = 3) -> CallRecord:
    positions = np.arange(k, dtype=np.int32)
    return CallRecord(200, 100, "int8", positions, STUB_INFO)


def answer(tokens: int = 3, total_s: float = 0.01) -> policy_pb2.InferResponse:
    timings = policy_pb2.ServerTimings(queue_s=0.001, predict_s=0.008, total_s=total_s)
    return policy_pb2.InferResponse(tokens_used=tokens, timings=timings)


def answered(fleet: Fleet, session: str = "arm.0", step: int = 0, tokens: int = 3) -> None:
    fleet.note(request(session, step), call(tokens), "ok", answer(tokens))


def names(fleet: Fleet) -> list[str]:
    return [robot.name for robot in fleet]


def row(second: object) -> dict[str, float | None]:
    return dict(zip(COLUMNS, second.row(), strict=True))  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("session", "expected"),
    [
        ("arm-1.0a1b2c3d.7", ("arm-1.0a1b2c3d", 7)),
        ("arm", ("arm", -1)),
        ("7", ("7", -1)),
        (".7", (".7", -1)),
        ("arm.", ("arm.", -1)),
        ("arm.x7", ("arm.x7", -1)),
        ("arm." + "9" * 80, ("arm." + "9" * 80, -1)),
    ],
)
def test_a_robot_is_its_session_without_the_episode(
    session: str, expected: tuple[str, int]
) -> None:
    assert robot_of(session) == expected


def test_a_second_holds_means_extremes_and_sums(fleet: Fleet, clock: Clock) -> None:
    fleet.note(request(snr_db=10.0), call(), "ok", answer(4, 0.010))
    fleet.note(request(step=1, snr_db=14.0), call(), "ok", answer(8, 0.030))
    fleet.note(request(step=2, snr_db=None), call(), Reason.OVERLOAD.value, None)
    (second,) = fleet.seconds
    (robot,) = fleet
    assert second.row() == robot.seconds[0].row()
    shown = row(second)
    assert (shown["at_s"], shown["answered"], shown["refused"]) == (1000, 2, 1)
    assert (shown["snr_db"], shown["snr_db_low"], shown["snr_db_high"]) == (12.0, 10.0, 14.0)
    assert (shown["tokens"], shown["tokens_low"], shown["tokens_high"]) == (6.0, 4, 8)
    assert (shown["payload_bytes"], shown["wire_bytes"]) == (300, 600)
    assert (shown["queue_ms"], shown["predict_ms"]) == (1.0, 8.0)
    assert (shown["total_ms"], shown["slowest_ms"]) == (20.0, 30.0)
    clock.now_s += 1
    fleet.note(request(step=3, snr_db=None), CallRecord(), Reason.INVALID.value, None)
    assert [row(s)["tokens"] for s in fleet.seconds] == [6.0, None]
    assert [s.at_s for s in since(fleet.seconds, 1001)] == [1001]


def test_steps_without_an_answer_are_counted_when_the_next_one_comes(fleet: Fleet) -> None:
    for session, step in (("arm.0", 5), ("arm.0", 6), ("arm.0", 9), ("arm.1", 4), ("arm.1", 5)):
        answered(fleet, session, step)
    (robot,) = fleet
    assert (robot.episode, robot.step, robot.total.bridged) == (1, 5, 2)
    answered(fleet, "arm.1", 2**64 - 1)
    assert fleet.total.bridged <= 2 + 10_000  # nobody makes up a number that spoils the picture


def test_values_that_were_made_up_are_not_repeated(fleet: Fleet) -> None:
    answered(fleet)
    bad = request(step=1)
    bad.snr_db, bad.snr_age_s = math.nan, math.inf
    fleet.note(bad, CallRecord(), Reason.INVALID.value, None)
    (robot,) = fleet
    assert (robot.snr_db, robot.snr_age_s) == (None, None)
    assert row(fleet.seconds[0])["snr_db"] == 12.5


@pytest.mark.parametrize(
    ("outcome", "seen"),
    [
        ("ok", True),
        ("overload", True),
        ("deadline", True),
        ("predicted_late", True),
        ("congested", True),
        ("fair_share", True),
        ("unknown_model", True),
        ("invalid", False),
        ("mismatch", False),
        ("not_owner", False),
        ("malformed", False),
    ],
)
def test_only_who_could_have_been_answered_gets_a_row(
    fleet: Fleet, outcome: str, seen: bool
) -> None:
    fleet.note(request(), call(), outcome, answer() if outcome == "ok" else None)
    assert len(fleet) == seen
    assert fleet.total.answered + fleet.total.refused == 1


def test_the_page_has_words_for_every_reason() -> None:
    script = (Path(fleet_page.__file__).parent / "page" / "format.js").read_text("utf-8")
    table = script.partition("const REASONS = {")[2].partition("};")[0]
    assert set(re.findall(r"(\w+): \"", table)) == {r.value for r in Reason} | {"ok", "repeat"}


def test_names_that_no_session_has_get_no_row(fleet: Fleet) -> None:
    for name in ("", "<b>", "a b", "ж", "a" * 129, "\x00"):
        fleet.note(request(name), call(), Reason.OVERLOAD.value, None)
    assert names(fleet) == []


def test_the_quietest_robot_makes_room(fleet: Fleet) -> None:
    for number in range(8):
        answered(fleet, f"arm-{number}")
    answered(fleet, "arm-0", 1)
    answered(fleet, "arm-8")
    assert len(fleet) == 8
    assert "arm-1" not in names(fleet)
    assert "arm-0" in names(fleet)


def test_an_identity_with_many_sessions_crowds_out_its_own_only(fleet: Fleet) -> None:
    set_caller(Identity("quiet"))
    answered(fleet, "arm.0")
    set_caller(Identity("loud"))
    for number in range(100):
        answered(fleet, f"arm-{number}.0")
    owners = [robot.owner for robot in fleet]
    assert owners.count("quiet") == 1
    assert owners.count("loud") == 7


def test_a_stranger_with_the_same_name_is_another_robot(fleet: Fleet) -> None:
    set_caller(Identity("one"))
    answered(fleet)
    set_caller(Identity("two"))
    fleet.note(request(step=9), call(), Reason.NOT_OWNER.value, None)
    (robot,) = fleet
    assert (robot.owner, robot.step, robot.total.refused) == ("one", 0, 0)


def test_robots_that_leave_disappear(fleet: Fleet, clock: Clock) -> None:
    answered(fleet, "gone")
    clock.now_s += FORGOTTEN_AFTER_S / 2
    answered(fleet, "here")
    clock.now_s += FORGOTTEN_AFTER_S / 2 + 1
    assert fleet.forget() == [1]
    assert names(fleet) == ["here"]
    assert fleet.robot(1) is None
    answered(fleet, "gone")
    assert [robot.number for robot in fleet] == [2, 3]  # rows are never used again


def test_history_is_bounded(fleet: Fleet, clock: Clock) -> None:
    for _ in range(2 * KEPT_SECONDS):
        clock.now_s += 1
        answered(fleet)
    (robot,) = fleet
    assert len(fleet.seconds) == len(robot.seconds) == KEPT_SECONDS
    assert fleet.total.answered == 2 * KEPT_SECONDS


def test_whoever_listens_hears_of_every_call(fleet: Fleet) -> None:
    heard: list[WatchedRobot | None] = []
    fleet.on_change = heard.append
    answered(fleet)
    fleet.note(policy_pb2.InferRequest(), CallRecord(), Reason.MALFORMED.value, None)
    assert [robot and robot.name for robot in heard] == ["arm", None]
