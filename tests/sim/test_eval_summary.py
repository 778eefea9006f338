"""Counts, intervals and pairings of made-up episodes are what one counts by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from eval_stubs import made_up_row

from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.experiments.statistics import wilson_interval
from comvla_sim.experiments.summary import summarise


def test_rows_and_aggregate_count_successes() -> None:
    rows = [
        made_up_row(task=task, episode=e, success=e < wins)
        for task, wins in (("drawer-open", 4), ("lever-down", 1))
        for e in range(4)
    ]
    summary = summarise(rows)
    by_task = {line["task"]: line for line in summary["rows"]}
    assert by_task["drawer-open"]["successes"] == 4
    assert by_task["lever-down"]["instruction"] == "please lever-down"
    for line in summary["rows"]:
        expected = wilson_interval(line["successes"], 4)
        assert (line["low"], line["high"]) == pytest.approx(expected, abs=1e-4)
        assert (line["method"], line["k"], line["episodes"]) == ("hard_voting", 16, 4)
    (total,) = summary["aggregate"]
    assert (total["episodes"], total["successes"], total["success_rate"]) == (8, 5, 0.625)
    assert (total["worst_task"], total["worst_task_rate"]) == ("lever-down", 0.25)
    assert total["payload_bytes_per_query"] == 96 * 16
    assert total["mean_steps_of_successes"] == 80
    assert total["other"] is None
    assert total["selection"] == {
        "frames": 80,
        "distinct_votes": 9.0,
        "overlap_with_other_instruction": 0.25,
        "object_hit_rate": 0.9,
        "object_hit_rate_by_view": [0.9, 0.75],
    }


def test_pairs_are_episodes_of_the_same_table_and_task_whatever_the_order() -> None:
    first = [made_up_row(method="hard_voting", episode=e, success=e != 0) for e in range(6)]
    second = [made_up_row(method="random", episode=e, success=e > 2) for e in range(1, 8)]
    (test,) = summarise([*first, *reversed(second)])["comparisons"]
    assert test["first"]["method"] == "hard_voting"
    assert (test["pairs"], test["only_first"], test["only_second"]) == (5, 2, 0)
    assert test["p_value"] == 0.5


def test_seeds_are_not_paired_with_each_other() -> None:
    rows = [
        made_up_row(method=method, seed=seed, success=(method, seed) != ("random", 4))
        for method in ("hard_voting", "random")
        for seed in (3, 4)
    ]
    (test,) = summarise(rows)["comparisons"]
    assert (test["pairs"], test["only_first"]) == (2, 1)


def test_what_is_compared_is_what_differs_in_one_thing() -> None:
    rows = [
        made_up_row(method="full", k=512),
        *(made_up_row(method=m, k=k) for m in ("hard_voting", "random") for k in (32, 16)),
        made_up_row(condition="wrong_selection", k=16),
    ]
    pairs = {
        tuple((e["condition"], e["method"], e["k"]) for e in (test["first"], test["second"]))
        for test in summarise(rows)["comparisons"]
    }
    full = ("normal", "full", 512)
    voting = {k: ("normal", "hard_voting", k) for k in (32, 16)}
    random = {k: ("normal", "random", k) for k in (32, 16)}
    assert pairs == {
        *((full, other) for other in (*voting.values(), *random.values())),
        *((voting[k], random[k]) for k in (32, 16)),
        (voting[16], ("wrong_selection", "hard_voting", 16)),
    }


LINK = LinkCase("rician", 5.0, enforce="drop")


def test_links_are_told_apart_and_their_uses_compared() -> None:
    links = {
        "late": replace(LINK, csi_delay=1),
        "now": LINK,
        "cut": replace(LINK, enforce="prefix"),
        "both": replace(LINK, enforce="prefix", csi_delay=1),
        "good": replace(LINK, mean_snr_db=20.0),
    }
    rows = [
        made_up_row(method=method, k=None, link=link, success=name != "late")
        for name, link in links.items()
        for method in ("hard_voting", "random")
    ]
    summary = summarise([*rows, made_up_row(method="full", k=512)])
    names = {link: name for name, link in links.items()}

    def name(entry: dict[str, Any]) -> str:
        return names[LinkCase.from_dict(entry["link"])] if entry["link"] else "ideal"

    assert sorted(name(line) for line in summary["aggregate"]) == sorted([*links, *links, "ideal"])
    compared = {
        tuple(sorted((name(test["first"]), name(test["second"]))))
        for test in summary["comparisons"]
        if test["first"]["method"] == test["second"]["method"]
    }
    # One thing differs in how the link is used; another mean SNR is another link.
    assert compared == {("late", "now"), ("cut", "now"), ("both", "cut"), ("both", "late")}
    methods = [t for t in summary["comparisons"] if t["first"]["method"] != t["second"]["method"]]
    assert {name(test["first"]) for test in methods} == set(links)
    assert all(test["first"]["link"] == test["second"]["link"] for test in methods)


def test_what_a_link_did_is_summed_and_its_overruns_have_percentiles() -> None:
    rows = [
        made_up_row(k=None, link=LINK, episode=0, overruns=(0.5, 0.9, 1.0)),
        made_up_row(k=None, link=LINK, episode=1, overruns=(1.1, 3.0, 7.0, 0.2)),
    ]
    (line,) = summarise(rows)["aggregate"]
    use = line["link_use"]
    assert (use["sent"], use["answered"], use["lost"], use["no_link"]) == (7, 4, 3, 4)
    assert use["answered_share"] == pytest.approx(4 / 11, abs=1e-4)
    over = use["overruns"]
    assert (over["requests"], over["above_capacity"]) == (7, 3)
    assert (over["p50"], over["p90"], over["p99"]) == (1.0, 7.0, 7.0)
    assert (over["low"], over["high"]) == pytest.approx(wilson_interval(3, 7), abs=1e-6)
    assert use["payload_overruns"]["above_capacity"] == 2
    (ideal,) = summarise([made_up_row()])["aggregate"]
    assert ideal["link_use"] is None


def test_a_link_that_sent_nothing_has_no_shares() -> None:
    (line,) = summarise([made_up_row(k=None, link=LINK, overruns=())])["aggregate"]
    assert line["link_use"]["overruns"]["share"] is None
    assert line["link_use"]["overruns"]["p90"] is None
    assert line["link_use"]["answered_share"] == 0.0


def test_a_wrong_instruction_counts_both_tasks() -> None:
    rows = [
        made_up_row(condition="wrong_instruction", episode=e, success=False, other_success=e > 0)
        for e in range(4)
    ]
    summary = summarise(rows)
    for line in (*summary["rows"], *summary["aggregate"]):
        assert line["successes"] == 0
        assert line["other"]["successes"] == 3
    assert summary["aggregate"][0]["mean_steps_of_successes"] is None


def test_what_was_not_looked_at_is_none_and_not_zero() -> None:
    row = made_up_row(method="random")
    row["selection"].update(
        distinct_votes=None,
        overlap=None,
        object_frames=0,
        object_hits=0,
        object_frames_by_view=[0, 0],
        object_hits_by_view=[0, 0],
    )
    selection = summarise([row])["aggregate"][0]["selection"]
    assert selection["distinct_votes"] is None
    assert selection["overlap_with_other_instruction"] is None
    assert selection["object_hit_rate"] is None
    assert selection["object_hit_rate_by_view"] == [None, None]
