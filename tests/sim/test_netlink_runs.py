"""Robot, link and server together: bytes that were promised, flaps, silences, and a short run."""

from __future__ import annotations

import json

import pytest

import comvla_sim.cli
from comvla import codec
from comvla.errors import ComVLAError
from comvla_sim.channel import ConstantChannel
from comvla_sim.netlink import flaps, idle_bench, namespaces, run, wire_bench, wording


@pytest.fixture(autouse=True, scope="module")
def root() -> None:
    """Skips where this machine does not let us make a link."""
    try:
        namespaces.check_privileges()
    except ComVLAError as error:
        pytest.skip(str(error))


def test_the_accounting_of_a_query_holds_against_a_packet_capture() -> None:
    result = wire_bench.run(wire_bench.WireParameters(token_budgets=(1, 2, 15, 16, 59, 64, 200)))
    assert len(result["queries"]) == 7 * len(codec.QUANTIZATIONS)
    assert result["packets_missed_by_capture"] == 0
    for query in result["queries"]:
        assert query["captured_bytes"] <= query["accounted_bytes"] <= 1.02 * query["captured_bytes"]


def test_a_run_accounts_for_every_query() -> None:
    settings = run.RunSettings(scale="paper", sending="margin", minutes=1 / 30, every=2)
    done: list[tuple[int, int]] = []
    account = run.run(settings, ConstantChannel(10.0), lambda *seen: done.append(seen))
    summary = account["summary"]
    assert done[-1] == (settings.queries, settings.queries)
    assert len(account["queries"]) == settings.queries == 20
    assert summary["sent"]["count"] == 20
    assert summary["larger_than_capacity"]["count"] == 0
    # Every payload was seen on the wire, byte for byte.
    for query in account["queries"]:
        if query["complete_after_s"] is not None:
            assert query["passed_bytes"] == query["framed_bytes"]
    assert sum(q["complete_after_s"] is not None for q in account["queries"]) >= 15
    json.dumps(account)
    assert "answer within the period" in wording.describe_run(account)


@pytest.mark.alone
def test_a_robot_recovers_from_flaps_before_tcp_would() -> None:
    parameters = flaps.FlapParameters(count=6, longest_s=0.8, between_s=0.5, realtime=True)
    account = flaps.run(parameters)
    summary = account["summary"]
    assert summary["older_after_newer"] == 0
    assert summary["median_recovery_periods"] <= flaps.ALLOWED_PERIODS
    # TCP by itself waits 0.2 s at least after its last try, four periods, and often much longer.
    assert summary["worst_recovery_periods"] <= 4.0
    assert summary["longest_step_s"] < 0.5
    assert "exceptions: 0" in wording.describe_flaps(account)


@pytest.mark.alone
def test_a_silence_costs_round_trips_and_each_remedy_saves_them() -> None:
    cases = {case.name: case for case in idle_bench.CASES}
    chosen = [
        cases[name] for name in ("no remedy, cubic", "client's warm_up", "slow_start_after_idle=0")
    ]
    parameters = idle_bench.IdleParameters(repetitions=4, silence_s=0.8)
    result = idle_bench.run(parameters, chosen)
    without, filler, tuned = result["rows"]
    assert without["round_trips"] > 2.0
    assert filler["round_trips"] < 1.5
    assert tuned["round_trips"] < 1.5
    assert filler["bytes_per_query"] > 1.8 * tuned["bytes_per_query"]


def test_the_benches_print_json_and_tables(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["bench", "wire", "--k", "4", "--quantization", "int8"]
    assert comvla_sim.cli.main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["under"] == 0
    assert comvla_sim.cli.main(arguments) == 0
    assert "captured bytes" in capsys.readouterr().out
