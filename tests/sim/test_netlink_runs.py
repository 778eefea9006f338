"""Robot, link and server together: bytes that were promised, flaps, silences, and a short run."""

from __future__ import annotations

import json

import pytest
from stalls import unless_stalled

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
    budgets = (1, 2, 15, 16, 59, 64, 200)

    def check() -> None:
        result = wire_bench.run(wire_bench.WireParameters(token_budgets=budgets))
        assert len(result["queries"]) == 7 * len(codec.QUANTIZATIONS)
        assert result["packets_missed_by_capture"] == 0
        for query in result["queries"]:
            captured = query["captured_bytes"]
            assert captured <= query["accounted_bytes"] <= 1.02 * captured

    # A client that hears nothing for a while looks after its connection, and a query has more bytes.
    unless_stalled(check)


def test_a_run_accounts_for_every_query() -> None:
    settings = run.RunSettings(scale="paper", sending="margin", minutes=1 / 30, every=2)
    done: list[tuple[int, int]] = []
    account = run.run(settings, ConstantChannel(10.0), lambda *seen: done.append(seen))
    summary = account["summary"]
    assert done[-1] == (settings.queries, settings.queries)
    assert len(account["queries"]) == settings.queries == 20
    sent = [query for query in account["queries"] if query["sent"]]
    assert summary["sent"]["count"] == len(sent)
    # A machine that stalls makes a robot skip periods, or leaves it no time to send; it says so.
    assert all(query["reason"] for query in account["queries"] if not query["sent"])
    assert summary["larger_than_capacity"]["count"] == 0
    # Every payload was seen on the wire, byte for byte.
    complete = [query for query in sent if query["complete_after_s"] is not None]
    for query in complete:
        assert query["passed_bytes"] == query["framed_bytes"]
    assert complete
    assert len(complete) >= len(sent) / 2
    json.dumps(account)
    assert "answer within the period" in wording.describe_run(account)


@pytest.mark.alone
@pytest.mark.timeout(600)  # it may have to be measured again
def test_a_robot_recovers_from_flaps_before_tcp_would() -> None:
    parameters = flaps.FlapParameters(count=6, longest_s=0.8, between_s=0.5, realtime=True)
    out_of_order = []

    def check() -> None:
        account = flaps.run(parameters)
        summary = account["summary"]
        out_of_order.append(summary["older_after_newer"])
        assert summary["worst_recovery_periods"] is not None, account["flaps"]
        assert summary["median_recovery_periods"] <= flaps.ALLOWED_PERIODS
        # TCP by itself waits 0.2 s at least after its last try, four periods, and often much longer.
        assert summary["worst_recovery_periods"] <= 4.0
        assert summary["longest_step_s"] < 0.5
        assert "exceptions: 0" in wording.describe_flaps(account)

    unless_stalled(check)
    assert not any(out_of_order), "no stall excuses that"


@pytest.mark.alone
@pytest.mark.timeout(600)  # it may have to be measured again
def test_a_silence_costs_round_trips_and_each_remedy_saves_them() -> None:
    cases = {case.name: case for case in idle_bench.CASES}
    chosen = [
        cases[name] for name in ("no remedy, cubic", "client's warm_up", "slow_start_after_idle=0")
    ]
    parameters = idle_bench.IdleParameters(repetitions=4, silence_s=0.8)

    def check() -> None:
        without, filler, tuned = idle_bench.run(parameters, chosen)["rows"]
        assert without["round_trips"] > 2.0
        assert filler["round_trips"] < 1.5
        assert tuned["round_trips"] < 1.5
        assert filler["bytes_per_query"] > 1.8 * tuned["bytes_per_query"]

    unless_stalled(check)


def test_the_benches_print_json_and_tables(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["bench", "wire", "--k", "4", "--quantization", "int8"]
    assert comvla_sim.cli.main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["under"] == 0
    assert comvla_sim.cli.main(arguments) == 0
    assert "captured bytes" in capsys.readouterr().out
