"""Episodes over a radio link: what the robot is told, what crosses, and what the rows say of it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_stubs import ListeningTransport
from hypothesis import given
from hypothesis import strategies as st

from comvla.errors import LinkError
from comvla_client import TransportError
from comvla_client.sending import POLICIES
from comvla_server.vision import VisionHalf
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.in_process import InProcessTransport
from comvla_sim.experiments.link_case import (
    CHANNELS,
    ENFORCEMENTS,
    LEAD_IN,
    LinkCase,
    channel_seed,
    scaled_bandwidth_hz,
)
from comvla_sim.experiments.over_link import EpisodeLink
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.experiments.rollout import run_episode
from comvla_sim.worlds import World
from comvla_vla import CloudModel, EdgeModel

SETTINGS = EvalSettings(model="random", seed=7)
LINK = LinkCase("rician", 5.0, 1, "drop", bandwidth_hz=0.18e6)
SPEC = EpisodeSpec("normal", "hard_voting", None, "drawer-open", 0, LINK)
STEPS = 40


@pytest.fixture
def world(long_world: World, monkeypatch: pytest.MonkeyPatch) -> World:
    """Episodes of five chunks."""
    monkeypatch.setattr(long_world, "max_episode_steps", STEPS)
    return long_world


class Run:
    """One episode, its row, and all that was told about its queries."""

    def __init__(
        self, world: World, policy: tuple[EdgeModel, CloudModel], spec: EpisodeSpec
    ) -> None:
        self.transport = ListeningTransport(InProcessTransport(policy[1]))
        self.queries: list[Any] = []
        self.row = run_episode(
            world, policy[0], self.transport, spec, SETTINGS, lambda *q: self.queries.append(q)
        )
        self.use = self.row["link_use"]


def over(**changes: Any) -> EpisodeSpec:
    return replace(SPEC, link=replace(LINK, **changes))


pytestmark = pytest.mark.simulator


def test_a_link_that_carries_enough_changes_nothing(
    world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    ideal = Run(world, policy, replace(SPEC, k=16, link=None))
    good = Run(world, policy, replace(over(channel="constant", mean_snr_db=30.0), k=16))
    assert ideal.row["link_use"] is None
    assert good.use["answered"] == good.row["queries"] == 5
    assert good.use["held_periods"] == 0
    for key in ("steps", "queries", "payload_bytes", "selection", "success", "cloud_flops"):
        assert good.row[key] == ideal.row[key], key
    payloads = [[r.payload for r in run.transport.requests] for run in (ideal, good)]
    assert payloads[0] == payloads[1]


def test_a_dead_link_lets_the_robot_hold_and_raises_nothing(
    world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    run = Run(world, policy, over(channel="constant", mean_snr_db=-60.0))
    assert not run.transport.requests
    assert run.row["queries"] == run.use["no_link"] == run.use["held_periods"] == STEPS
    assert run.row["selection"]["frames"] == 0
    assert not run.row["success"]


@pytest.mark.parametrize(
    ("enforce", "sending"),
    [
        *((e, "paper") for e in ENFORCEMENTS),
        *(("prefix", s) for s in POLICIES if s != "paper"),
        ("queue", "margin+floor"),
        ("none", "progressive"),
    ],
)
def test_accounts_add_up_and_equal_specs_give_equal_rows(
    world: World, policy: tuple[EdgeModel, CloudModel], enforce: str, sending: str
) -> None:
    spec = over(enforce=enforce, sending=sending, useful_tokens=3, mean_snr_db=8.0)
    run, again = Run(world, policy, spec), Run(world, policy, spec)
    use, row = run.use, run.row
    assert use["sent"] == use["answered"] + use["lost"] == len(use["overruns"])
    assert row["queries"] == use["sent"] + use["no_link"] == len(run.queries)
    assert use["answered"] == len(run.transport.requests) == row["selection"]["frames"]
    assert use["delivered_bytes"] <= use["offered_bytes"]
    assert use["held_periods"] >= use["waited_periods"] >= 0
    assert (use["waited_periods"] > 0) <= (enforce == "queue" or "floor" in sending)
    assert row["steps"] == STEPS
    if enforce == "none":
        assert use["lost"] == 0
        assert use["delivered_tokens"] == use["offered_tokens"]
    del row["wall_s"], again.row["wall_s"]
    assert row == again.row


def test_what_does_not_fit_is_lost_cut_or_late(
    world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    runs = {e: Run(world, policy, over(enforce=e)) for e in ENFORCEMENTS}
    first = [run.queries[0][1] for run in runs.values()]
    assert len({report.tokens for report in first}) == 1  # the same report, the same payload
    assert runs["drop"].use["lost"] > 0
    assert any(0 < report.tokens_used < report.tokens for _, report, _ in runs["prefix"].queries)
    assert all(report.tokens_used == report.tokens for _, report, _ in runs["none"].queries)
    late = [record for _, _, record in runs["queue"].queries if record and record.waited_periods]
    assert late
    # What comes late costs periods in which the robot holds.
    assert runs["queue"].use["held_periods"] >= sum(r.waited_periods for r in late)
    # The violations are there whether anything enforces the capacity or not.
    over_capacity = [ratio for ratio in runs["none"].use["overruns"] if ratio > 1]
    assert len(over_capacity) > 0


def test_methods_delays_and_policies_meet_the_same_fading(
    world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    variants = [
        SPEC,
        replace(SPEC, method="random"),
        over(csi_delay=4),
        over(enforce="none", sending="progressive"),
        over(channel="rayleigh", mean_snr_db=20.0),
    ]
    runs = [Run(world, policy, spec) for spec in variants]
    assert len({run.row["channel_seed"] for run in runs}) == 1
    truth = LINK.make_channel(runs[0].row["channel_seed"]).snr_db(LEAD_IN + STEPS)[LEAD_IN:]
    for run, delay in zip(runs[:4], (1, 1, 4, 1), strict=True):
        for period, report, record in run.queries:
            assert report.snr_age_s == pytest.approx(0.05 * delay)
            if record is not None:
                assert record.snr_db == truth[period]
            if period >= delay:
                assert report.snr_db == truth[period - delay]
    other = Run(world, policy, replace(SPEC, task="window-open"))
    assert other.row["channel_seed"] != runs[0].row["channel_seed"]


def test_a_server_that_falls_silent_is_not_the_links_doing(
    world: World, policy: tuple[EdgeModel, CloudModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    transport = InProcessTransport(policy[1])

    def refuse(*_: object) -> None:
        raise TransportError("UNAVAILABLE", "the server is draining")

    monkeypatch.setattr(transport, "infer", refuse)
    with pytest.raises(EvaluationError, match="draining"):
        run_episode(world, policy[0], transport, over(enforce="none"), SETTINGS)


def test_pictures_over_a_link_are_of_the_moment_and_as_good_as_fits(
    world: World, policy: tuple[EdgeModel, CloudModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("simplejpeg")
    looked: list[int] = []
    observe = world.observe

    def counted() -> Any:
        looked.append(1)
        return observe()

    monkeypatch.setattr(world, "observe", counted)
    spec = replace(over(bandwidth_hz=0.88e6, enforce="drop"), method="jpeg", k=512)
    transport = InProcessTransport(policy[1], VisionHalf(policy[0]))
    row = run_episode(world, policy[0], transport, spec, SETTINGS)
    use = row["link_use"]
    assert 0 < use["answered"] < use["sent"]
    assert len(looked) == row["queries"]  # the first picture is that of the reset
    assert max(use["overruns"]) > 1  # sized by an old report
    assert use["offered_tokens"] == 0


class Nobody:
    """A transport that is never used."""

    def close(self) -> None:
        """Nothing to close."""


@given(delay=st.integers(0, 100), steps=st.integers(0, 12), seed=st.integers(0, 2**32 - 1))
def test_reports_are_of_d_periods_ago_from_the_first_period_on(
    delay: int, steps: int, seed: int
) -> None:
    case = replace(LINK, csi_delay=delay)
    link = EpisodeLink(case, seed, 20, Nobody())  # type: ignore[arg-type]
    for _ in range(steps):
        link.advance()
    values = case.make_channel(seed).snr_db(LEAD_IN + 20)
    assert link.reading().snr_db == values[LEAD_IN + steps - delay]
    assert link.reading().age_s == pytest.approx(0.05 * delay)
    assert link.transport.snr_db == values[LEAD_IN + steps]


def test_a_policy_has_listened_before_the_robot_moves() -> None:
    case = LinkCase("rician", 6.0, 2, "drop", "margin")
    sending = EpisodeLink(case, 5, 20, Nobody()).sending()  # type: ignore[arg-type]
    fading = sending.estimator.estimate()  # type: ignore[attr-defined]
    assert fading.mean_snr_db == pytest.approx(6.0, abs=1.0)
    assert fading.rician_k == pytest.approx(3.0, abs=1.5)


def test_seeds_of_fading_differ_by_table_and_task_and_stay_for_ever() -> None:
    seeds = {channel_seed(1_000_000 + e, t) for e in range(100) for t in range(8)}
    assert len(seeds) == 800
    assert channel_seed(1_000_000, 0) == 441_693_451
    assert all(0 <= seed < 2**32 for seed in seeds)


def test_the_bandwidth_follows_the_width_of_the_tokens() -> None:
    assert scaled_bandwidth_hz(2176) == 20e6
    assert scaled_bandwidth_hz(96) == 0.88e6


@pytest.mark.parametrize("name", CHANNELS)
def test_every_channel_by_name_is_made_and_comes_back_from_json(name: str) -> None:
    case = LinkCase(channel=name, csi_delay=2, sending="margin")
    case.check()
    assert LinkCase.from_dict(case.to_dict()) == case
    assert len(case.make_channel(3).snr_db(10)) == 10


def test_a_trace_is_known_by_its_content(tmp_path: Path) -> None:
    path = tmp_path / "roof.csv"
    path.write_text("1\n2\n3\n")
    case = LinkCase(channel=f"trace:{path}")
    assert case.make_channel(4).snr_db(3).tolist() == [2.0, 3.0, 1.0]
    assert LinkCase.from_dict(case.to_dict()) == case
    path.write_text("1\n2\n4\n")
    with pytest.raises(EvaluationError, match="has changed"):
        case.make_channel(0)
    with pytest.raises(LinkError, match="cannot read"):
        LinkCase(channel=f"trace:{tmp_path / 'missing.csv'}")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"channel": "fog"}, "--channel 'fog'.*rician"),
        ({"enforce": "gently"}, "--enforce 'gently'.*prefix"),
        ({"sending": "pigeon"}, "--sending 'pigeon'.*progressive"),
        ({"budget": "rough"}, "--link-budget 'rough'.*framed"),
        ({"csi_delay": -1}, "--csi-delay.*got -1"),
        ({"csi_delay": 101}, "--csi-delay.*got 101"),
        ({"useful_tokens": 0}, "--useful-tokens"),
        ({"bandwidth_hz": -1.0}, "bandwidth_hz"),
        ({"period_s": 0.0}, "period_s"),
        ({"efficiency": 1.5}, "efficiency"),
        ({"rician_k": -0.5}, "rician_k"),
        ({"doppler_hz": math.nan}, "doppler_hz"),
        ({"mean_snr_db": math.inf}, "mean_snr_db"),
    ],
)
def test_a_link_that_cannot_be_is_refused_by_name(changes: dict[str, Any], message: str) -> None:
    with pytest.raises((EvaluationError, LinkError), match=message):
        replace(LINK, **changes).check()


def test_a_robot_that_holds_looks_at_nothing(
    world: World, policy: tuple[EdgeModel, CloudModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[int] = []
    observe = world.observe

    def counted() -> Any:
        looked.append(1)
        return observe()

    monkeypatch.setattr(world, "observe", counted)
    run = Run(world, policy, over(enforce="drop"))
    assert len(looked) == 1 + run.use["sent"]  # one for the reset
    assert run.use["sent"] < run.row["queries"] or run.use["no_link"] == 0


def test_pictures_are_of_the_moment_of_the_query(
    world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    seen: list[np.ndarray[Any, Any]] = []

    class Eyes:
        def __init__(self, edge: EdgeModel) -> None:
            self._edge = edge

        def __getattr__(self, name: str) -> Any:
            return getattr(self._edge, name)

        def encode(self, images: Any) -> Any:
            seen.append(np.stack(images))
            assert np.array_equal(seen[-1], world.observe()["images"])
            return self._edge.encode(images)

    transport = InProcessTransport(policy[1])
    run_episode(world, Eyes(policy[0]), transport, SPEC, SETTINGS)  # type: ignore[arg-type]
    assert len(seen) > 3
    assert not np.array_equal(seen[0], seen[-1])
