"""The benches of a server under load run, count every request, and judge what they measured."""

from __future__ import annotations

import json
from typing import Any

import pytest

from comvla_sim.bench import command, overload, soak
from comvla_sim.bench.fleet import jain_index
from comvla_sim.bench.report import describe
from comvla_sim.bench.server_account import ServerAccount


def small(**changes: Any) -> overload.OverloadParameters:
    values: dict[str, Any] = {
        "robots": 8,
        "loads": (3.0,),
        "max_batch": 4,
        "seconds": 0.6,
        "settle_s": 0.3,
        "capacity_s": 0.5,
        "cases": ("admission off", "back-off"),
    }
    return overload.OverloadParameters(**{**values, **changes})


def test_overload_accounts_for_every_request_of_every_case() -> None:
    told: list[str] = []
    result = overload.run(small(), told.append)
    assert [row["name"] for row in result["rows"]] == ["admission off", "back-off"]
    assert told == [f"{name}: {what}" for name in small().cases for what in ("capacity", "load 3")]
    for row in result["rows"]:
        shares = ("served", "shed", "superseded", "late", "paused")
        assert sum(row[f"{name}_share"] for name in shares) == pytest.approx(1.0)
        assert row["failed"] == 0
        assert row["capacity_per_s"] > 0
        assert 0.0 <= row["in_time_share"] <= 1.0
        # A machine that stalls for as long as the load lasts leaves everybody without an answer.
        assert 1 / 8 <= row["jain"] <= 1.0 or row["served_share"] == row["jain"] == 0.0
        assert row["period_s"] == pytest.approx(8 / (3.0 * row["capacity_per_s"]))
        assert row["generator_cpu"] > 0
    assert result["rows"][0]["shed_share"] == result["rows"][0]["paused_share"] == 0
    assert "model stub (a stub:" in describe(json.loads(json.dumps(result)))


def test_a_case_that_does_not_exist_is_told_with_those_that_do() -> None:
    with pytest.raises(overload.OverloadError, match="admission off, admission, advised K"):
        overload.run(small(cases=("off",)))


def test_jain_is_1_where_all_have_the_same_and_1_over_n_where_one_has_everything() -> None:
    assert jain_index([3, 3, 3, 3]) == 1.0
    assert jain_index([5, 0, 0, 0, 0]) == pytest.approx(0.2)
    assert jain_index([0, 0]) == 1.0


def test_soak_prints_a_verdict_on_memory_and_descriptors(
    capsys: pytest.CaptureFixture[str],
) -> None:
    import argparse

    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers(required=True))
    options = "--minutes 0.03 --load 0.5 --model stub --robots 4 --capacity-s 0.5 --json"
    args = parser.parse_args(["bench", "soak", *options.split()])
    code = args.run(args)
    result = json.loads(capsys.readouterr().out)
    assert code == (0 if result["passed"] else 1)
    assert result["failed"] == 0
    # Of two seconds of load a machine may lose one, and what was due in it.
    assert result["answered_share"] > 0
    assert len(result["rows"]) == 10
    assert min(row["resident_mib"] for row in result["rows"]) > 10
    verdict = describe(result)
    assert verdict.endswith(("passed", "FAILED"))


def account(resident: float, descriptors: float = 30) -> ServerAccount:
    return ServerAccount(resident, descriptors, 1.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("end", "passed"),
    [(account(101), True), (account(103), False), (account(100, 40), False), (account(90), True)],
    ids=["steady", "memory grows", "descriptors leak", "memory shrinks"],
)
def test_the_verdict_is_on_growth_after_the_first_sixth(end: ServerAccount, passed: bool) -> None:
    verdict = soak.judge([account(100)] * 3, [end] * 3)
    assert verdict["passed"] is passed
