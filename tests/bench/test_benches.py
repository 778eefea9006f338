"""Benchmarks say what they measured, of how many calls, and against which limit. Never how fast."""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np
import pytest

from comvla_sim.bench import batching, command, edge, transport, websocket_msgpack
from comvla_sim.bench.processes import announce, serving, wait_for_end
from comvla_sim.bench.timing import Timing, measure


def bench(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers(required=True))
    args = parser.parse_args(["bench", *arguments])
    code: int = args.run(args)
    return code


def assert_row_is_plausible(row: dict[str, Any], repetitions: int) -> None:
    assert row["repetitions"] == repetitions
    assert 0 < row["median_s"] <= row["p99_s"]


def test_transport_compares_the_whole_call_with_tcp_and_a_websocket_in_one_run() -> None:
    result = transport.run(transport.TransportParameters(repetitions=4, warm_up=1))
    rows = {row["name"]: row for row in result["rows"]}
    assert {"raw TCP", "gRPC, bytes only", "websocket + msgpack", "ComVLA Infer"} <= set(rows)
    for row in rows.values():
        assert_row_is_plausible(row, 4)
    assert rows["raw TCP"]["ratio_to_tcp"] == 1.0
    assert rows["websocket + msgpack"]["ratio_to_websocket"] == 1.0
    assert rows["ComVLA Infer"]["ratio_to_tcp"] == pytest.approx(
        rows["ComVLA Infer"]["median_s"] / rows["raw TCP"]["median_s"]
    )
    assert result["parameters"]["payload_bytes"] == 68 * 1024
    assert result["parameters"]["response_bytes"] == 1024
    json.dumps(result)


def test_edge_measures_its_own_limit_and_votes_alike_in_numpy_and_torch() -> None:
    result = edge.run(
        edge.EdgeParameters(
            queries=3,
            num_tokens=24,
            language_dim=32,
            token_budget=8,
            tower_dims=(16, 24),
            square=64,
            repetitions=3,
            warm_up=1,
        )
    )
    names = [row["name"] for row in result["rows"]]
    assert {"vote, numpy", "vote, torch", "select", "quantise and pack"} <= set(names)
    for row in result["rows"]:
        assert_row_is_plausible(row, 3)
        assert row["ratio_to_vote_limit"] == pytest.approx(row["median_s"] / result["vote_limit_s"])
    flops = result["parameters"]["vote_flops"]
    assert flops == 3 * 2 * 3 * 24 * 32
    assert result["vote_limit_s"] == pytest.approx(flops / result["matrix_rate_flops_per_s"])
    assert result["payload_bytes"] == 8 * 40 < result["encoded_bytes"]
    assert result["numpy_and_torch_agree"]
    json.dumps(result)


def test_edge_tells_why_its_process_failed() -> None:
    with pytest.raises(RuntimeError, match="tower"):
        edge.run(edge.EdgeParameters(tower_dims=(0, 4), num_tokens=8, repetitions=1, square=8))


def test_batching_answers_every_robot_whatever_its_k() -> None:
    parameters = batching.BatchingParameters(model="random", repetitions=2, warm_up=1, threads=1)
    result = batching.run(parameters)
    alone, together = result["rows"]
    assert (alone["max_batch"], together["max_batch"]) == (1, 8)
    for row in result["rows"]:
        assert row["answered"] == 16 * 2
        assert_row_is_plausible(row, 16 * 2)
    assert alone["mean_batch"] == 1.0
    assert 1.0 <= together["mean_batch"] <= 8.0
    assert len(set(result["parameters"]["budgets"])) > 1
    assert result["throughput_ratio"] == pytest.approx(
        together["requests_per_s"] / alone["requests_per_s"]
    )
    json.dumps(result)


def test_command_prints_one_json_object_with_the_environment(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert bench("edge", "--json", "--repetitions", "1", "--warm-up", "0", "--threads", "2") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["parameters"]["threads"] == 2
    assert result["environment"]["cores"] >= 1
    assert result["environment"]["versions"]["numpy"] == np.__version__


def test_command_prints_a_table_that_names_machine_and_limit(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert bench("transport", "--repetitions", "1", "--warm-up", "0", "--k", "4") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("transport on ")
    assert any(line.startswith("ComVLA Infer") for line in lines)


@pytest.mark.parametrize("value", ["0", "-3", "many"])
def test_command_refuses_counts_that_measure_nothing(
    value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        bench("transport", "--repetitions", value)
    assert "expected a whole number >= 1" in capsys.readouterr().err


def test_warm_up_is_not_counted_and_contenders_take_turns() -> None:
    calls: list[str] = []
    timings = measure(
        {"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, repetitions=60, warm_up=2
    )
    assert timings["a"].repetitions == timings["b"].repetitions == 60
    assert calls.count("a") == calls.count("b") == 62
    timed = "".join(calls[4:])
    assert "ab" in timed
    assert "ba" in timed


def test_summaries_are_medians_and_percentiles() -> None:
    timing = Timing.of([float(i) for i in range(1, 102)])
    assert (timing.median_s, timing.p99_s, timing.repetitions) == (51.0, 100.0, 101)
    with pytest.raises(ValueError, match="at least one"):
        Timing.of([])
    with pytest.raises(ValueError, match="repetitions >= 1"):
        measure({}, repetitions=0, warm_up=0)


def test_websocket_messages_keep_arrays_as_they_were() -> None:
    message = {"tokens": np.arange(6, dtype=np.uint8).reshape(2, 3), "prompt": "go", "k": 3}
    copy = websocket_msgpack.unpack(websocket_msgpack.pack(message))
    assert copy["tokens"].dtype == np.uint8
    np.testing.assert_array_equal(copy.pop("tokens"), message.pop("tokens"))
    assert copy == message
    with pytest.raises(TypeError, match="object"):
        websocket_msgpack.pack(object())


def _serve_text(lifeline: Any, text: str) -> None:
    announce(lifeline, text)
    wait_for_end(lifeline)


def _serve_nothing(lifeline: Any) -> None:
    lifeline.close()


def test_a_server_process_lives_as_long_as_its_block() -> None:
    with serving(_serve_text, "here") as address:
        assert address == "here"


def test_a_server_process_that_ends_early_is_an_error() -> None:
    with pytest.raises(RuntimeError, match="ended before it served"), serving(_serve_nothing):
        pass
