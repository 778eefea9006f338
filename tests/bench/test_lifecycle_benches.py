"""Benches of a server's life: short versions, with real servers that are really killed and swapped."""

from __future__ import annotations

import argparse
import importlib.util
import json
from typing import Any

import pytest

from comvla_sim.bench import command, kills, replicas, swaps
from comvla_sim.bench.report import describe


def bench(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers(required=True))
    args = parser.parse_args(["bench", *arguments])
    code: int = args.run(args)
    return code


def test_swapping_under_load_fails_no_call() -> None:
    result = swaps.run(swaps.SwapParameters(swaps=2, clients=2, between_s=0.5, deadline_s=30.0))
    assert result["failed"] == 0, result["failures"]
    assert result["distinct_answers"] == 2, "both models answered"
    assert [swap["robots"] for swap in result["swaps"]] == ["compatible", "compatible"]
    assert result["freed"] == 2
    assert result["calls"] > 0
    text = describe(result)
    assert "0 of " in text
    assert "during swaps" in text
    json.dumps(result)


@pytest.mark.slow
@pytest.mark.simulator
def test_a_killed_server_costs_no_exception() -> None:
    result = kills.run(kills.KillParameters(kills=1, episodes=1, deadline_s=1.0))
    undisturbed, disturbed = result["rows"]
    assert (undisturbed["kills"], disturbed["kills"]) == (0, 1)
    assert result["exceptions"] == []
    (outage,) = result["outages"]
    assert outage["down_s"] > 0
    assert outage["held_periods"] > 0
    # How many there are without a kill is not compared: a machine that stalls has some of its own.
    assert disturbed["fallbacks"] > 0
    assert "recovery after the server was back" in describe(result)
    json.dumps(result)


@pytest.mark.slow
def test_a_plain_server_of_two_that_dies_costs_no_step(
    capsys: pytest.CaptureFixture[str],
) -> None:
    load = ("--seconds", "1", "--clients", "2", "--deadline-s", "30", "--only", "plain")
    assert bench("replicas", *load, "--json") == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in result["rows"]] == [
        "plain, one, one robot",
        "plain, one",
        "plain, two",
        "plain, two, one killed",
    ]
    assert result["plain"]["lost_steps"] == 0, result["plain"]["failures"]
    assert all(row["failed"] == 0 for row in result["rows"])
    assert "two give" in describe(result)


def test_what_is_not_installed_is_left_out_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    result = replicas.run(replicas.ReplicaParameters(only="ray"))
    assert result["rows"] == []
    assert "comvla[ray]" in result["left_out"][0]
