"""The demo's page and figures, from episodes made by hand."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import numpy as np
import pytest

from comvla.model_info import ModelInfo
from comvla_client import LinkProfile, StepReport
from comvla_sim.channel import ConstantChannel
from comvla_sim.demo.episode import Episode, Query
from comvla_sim.demo.figures import air_time_s, figures_of, link_use
from comvla_sim.demo.page import render
from comvla_sim.demo.scenario import Scene, scenes
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.link import LinkRecord
from comvla_sim.worlds import Task

INFO = ModelInfo(
    name="comvla-mini",
    fingerprint="f" * 32,
    num_tokens=512,
    token_dim=96,
    tower_dims=(96,),
    grid=(2, 16, 16),
    image_size=(128, 128),
    action_horizon=8,
    action_dim=4,
    proprio_dim=4,
    max_prompt_tokens=32,
    delta_actions=(True, True, True, False),
)
LINK = LinkProfile(bandwidth_hz=0.88e6)
TASKS = [
    Task(f"{fixture}-{verb}", f"{verb} the {fixture}", (), fixture)
    for fixture in ("drawer", "button", "faucet", "lever", "window")
    for verb in ("open", "shut")
]


def query(period: int, *, tokens: int = 40, offered: int = 4000, capacity: int = 5000) -> Query:
    report = StepReport(
        session="robot",
        step=period // 8,
        source="cloud",
        tokens=tokens,
        token_budget=tokens,
        positions=np.arange(tokens, dtype=np.int32),
        payload_bytes=96 * tokens,
        framed_bytes=offered - 56,
        timings_s={"total": 0.02},
        edge_flops=1e8,
        cloud_flops=2e8,
    )
    record = LinkRecord(
        period=period,
        snr_db=9.0,
        capacity_bits=8.0 * capacity,
        available_bits=8.0 * capacity,
        offered_bytes=offered,
        delivered_bytes=min(offered, capacity),
        offered_tokens=tokens,
        delivered_tokens=tokens,
        airtime_s=0.05 * min(1.0, offered / capacity),
    )
    return Query(period, report, record)


def held(period: int) -> Query:
    return Query(period, StepReport(session="robot", step=0, fallback_reason="no_link"), None)


def episode(number: int = 0, instruction: str = "open the drawer", **values: Any) -> Episode:
    task = Task("drawer-open", instruction, (), "drawer")
    made = Episode(Scene(number, task, 1_000_000 + number, number))
    made.success, made.periods = True, 10
    made.queries = [held(0), query(1), query(9, tokens=60)]
    made.snr_db = [-math.inf, *[9.0] * 9]
    made.capacity_bits = [0.0, *[40_000.0] * 9]
    made.frames = [(t, f"data:image/webp;base64,{t:04d}") for t in range(0, 11, 2)]
    for name, value in values.items():
        setattr(made, name, value)
    return made


def page(*episodes: Episode) -> str:
    return render(
        episodes,
        episodes,
        figures_of(episodes),
        figures_of(episodes, [0.4]),
        link_use(episodes),
        info=INFO,
        link=LINK,
        mean_snr_db=10.0,
        seed=0,
        command="comvla-sim demo",
    )


def embedded(html: str) -> dict[str, Any]:
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', html, re.S)
    assert match
    data: dict[str, Any] = json.loads(match.group(1))
    return data


def test_the_page_names_no_other_place() -> None:
    html = page(episode())
    # The one address is the name of SVG's vocabulary, which nobody fetches.
    assert set(re.findall(r"\w+://[^\s\"'<>)]+", html)) == {"http://www.w3.org/2000/svg"}
    assert not re.search(r"<(link|iframe|object|embed|base)\b|@import|url\(", html)
    assert not re.search(r"\b(src|href)=\"(?!data:)", html)
    assert "default-src 'none'" in html
    assert "<!--" not in html


def test_the_page_holds_films_tokens_and_curves() -> None:
    data = embedded(page(episode(), episode(1)))
    assert data["grid"] == [2, 16, 16]
    first = data["episodes"][0]
    assert [t for t, _ in first["frames"]] == [0, 2, 4, 6, 8, 10]
    assert [q["tokens"] for q in first["queries"]] == [0, 40, 60]
    assert first["queries"][0]["reason"] == "no_link"
    assert first["queries"][2]["positions"] == list(range(60))
    assert len(first["snr"]) == len(first["capacity"]) == 10
    assert all(math.isfinite(v) for v in first["snr"])


def test_text_on_the_page_cannot_become_code() -> None:
    hostile = '</script><script>alert("x")</script><!--DATA-->'
    html = page(episode(instruction=hostile))
    assert "<script>alert" not in html
    assert len(embedded(html)["episodes"]) == 1


def test_the_headline_counts_successes() -> None:
    html = page(episode(), episode(1, success=False))
    assert "<h1>1 of 2 instructions obeyed</h1>" in html
    assert html.count("badge good") == 1
    assert html.count("badge bad") == 1


def test_every_episode_stands_beside_its_reference() -> None:
    html = page(episode(), episode(1, instruction="lower the lever", success=False))
    (row,) = re.findall(r'<tr><th scope="row">lower the lever</th>(.*?)</tr>', html)
    assert re.findall(r"<td[^>]*>(.*?)</td>", row) == 2 * ["not done", "10", "7.7 KiB"]


def test_figures_are_means_over_requests_and_sums_over_episodes() -> None:
    figures = figures_of([episode(), episode(1, success=False)])
    assert (figures.episodes, figures.successes) == (2, 1)
    assert (figures.queries, figures.holds) == (4, 2)
    assert (figures.tokens, figures.tokens_min, figures.tokens_max) == (50, 40, 60)
    assert figures.wire_bytes == 3944
    assert figures.episode_bytes == 2 * 3944
    assert figures.air_s == pytest.approx(0.04)


def test_an_episode_without_any_answer_has_figures_too() -> None:
    silent = episode(queries=[held(0)], success=False)
    figures = figures_of([silent])
    assert (figures.queries, figures.tokens, figures.air_s) == (0, 0, None)
    assert "0 of 1 instructions obeyed" in page(silent)


def test_link_use_notices_a_request_above_capacity() -> None:
    assert link_use([episode()]).above_capacity == 0
    assert link_use([episode()]).largest_share == 0.8
    greedy = episode(queries=[query(0, offered=5001)])
    use = link_use([greedy])
    assert (use.requests, use.above_capacity) == (1, 1)
    assert use.largest_share > 1


def test_time_on_the_air_spans_periods() -> None:
    assert air_time_s(100, [200], 0.05) == pytest.approx(0.025)
    assert air_time_s(300, [200, 0, 400], 0.05) == pytest.approx(0.1125)
    assert air_time_s(0, [], 0.05) == math.inf
    assert air_time_s(0, [0.0], 0.05) == 0.0
    assert air_time_s(1, [0.0, 0.5], 0.05) == math.inf


def test_four_scenes_name_four_fixtures_on_four_tables() -> None:
    for seed in range(20):
        program = scenes(TASKS, seed=seed, episodes=4)
        assert len({scene.task.fixture for scene in program}) == 4
        assert len({scene.layout_seed for scene in program}) == 4
        assert program == scenes(TASKS, seed=seed, episodes=4)
        assert all(scene.layout_seed >= 1_000_000 for scene in program)
    assert len({s.task.fixture for s in scenes(TASKS, seed=0, episodes=7)}) == 5
    for seed, episodes in ((-1, 4), (0, 0)):
        with pytest.raises(EvaluationError):
            scenes(TASKS, seed=seed, episodes=episodes)


def test_a_scene_has_a_channel_of_its_own() -> None:
    first, second = scenes(TASKS, seed=0, episodes=2)
    assert first.channel(10.0).snr_db(50).tolist() == first.channel(10.0).snr_db(50).tolist()
    assert first.channel(10.0).snr_db(50).tolist() != second.channel(10.0).snr_db(50).tolist()
    assert first.channel(10.0).snr_db(1) != ConstantChannel(10.0).snr_db(1)
