"""Episodes of an evaluation in the real simulator: what each condition changes, and only that."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from eval_stubs import ExpertCloud, ListeningTransport

from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.in_process import InProcessTransport
from comvla_sim.experiments.observing import ObservedEdge, token_at
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.experiments.rollout import cast, expert_pictures, run_episode
from comvla_sim.worlds import World
from comvla_vla import CloudModel, EdgeModel

pytestmark = pytest.mark.simulator

SETTINGS = EvalSettings(model="random", seed=7)
SPEC = EpisodeSpec("normal", "hard_voting", 16, "drawer-open", 0)


@pytest.fixture
def world(long_world: World, monkeypatch: pytest.MonkeyPatch) -> World:
    """Episodes of two queries."""
    monkeypatch.setattr(long_world, "max_episode_steps", 16)
    return long_world


def run(
    world: World, policy: tuple[EdgeModel, CloudModel], spec: EpisodeSpec
) -> tuple[dict[str, Any], ListeningTransport]:
    transport = ListeningTransport(InProcessTransport(policy[1]))
    return run_episode(world, policy[0], transport, spec, SETTINGS), transport


def test_equal_specs_give_equal_episodes(
    world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    for method in ("hard_voting", "random"):
        spec = replace(SPEC, method=method)
        first, sent_first = run(world, policy, spec)
        run(world, policy, replace(SPEC, task="window-open", episode=1))
        again, sent_again = run(world, policy, spec)
        del first["wall_s"], again["wall_s"]
        assert first == again
        payloads = [[r.payload for r in sent.requests] for sent in (sent_first, sent_again)]
        assert payloads[0] == payloads[1]


def test_an_episode_accounts_for_what_it_did(
    world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    row, sent = run(world, policy, SPEC)
    assert (row["steps"], row["queries"], len(sent.requests)) == (16, 2, 2)
    assert row["layout_seed"] == 1_070_000
    assert row["payload_bytes"] == 2 * 16 * 96
    assert row["encoded_bytes"] == sum(len(r.payload) for r in sent.requests)
    assert row["encoded_bytes"] < row["framed_bytes"]
    assert row["fallbacks"] == 0
    assert row["edge_flops"] == 2 * policy[0].flops(4 * len(SPEC_WORDS))
    assert row["cloud_flops"] == 2 * policy[1].flops(16, row["instruction"])
    assert row["selection"]["frames"] == 2


SPEC_WORDS = ["pull", "the", "green", "drawer", "open"]


def test_full_sends_every_token_and_selects_nothing(
    world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    row, sent = run(world, policy, replace(SPEC, method="full", k=512))
    assert sent.positions(0) == list(range(512))
    assert row["selection"]["distinct_votes"] is None
    assert row["selection"]["object_hits"] == row["selection"]["object_frames"] == 2


def test_a_wrong_instruction_is_that_of_another_fixture_on_the_table(
    world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    row, sent = run(world, policy, replace(SPEC, condition="wrong_instruction"))
    named = next(task for task in world.tasks if task.name == row["other_task"])
    assert named in world.possible_tasks()
    assert named.fixture != "drawer"
    assert {r.instruction for r in sent.requests} == {row["spoken"]} == {named.instruction}
    assert row["instruction"] == "pull the green drawer open"


def test_a_wrong_selection_keeps_the_text_and_changes_the_tokens(
    world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    right, sent_right = run(world, policy, SPEC)
    _, sent_named = run(world, policy, replace(SPEC, condition="wrong_instruction"))
    wrong, sent_wrong = run(world, policy, replace(SPEC, condition="wrong_selection"))
    assert sent_wrong.requests[0].instruction == sent_right.requests[0].instruction
    assert wrong["heard"] == sent_named.requests[0].instruction
    # The first picture is the same in all three.
    assert sent_wrong.positions(0) == sent_named.positions(0)
    assert sent_wrong.positions(0) != sent_right.positions(0)
    assert wrong["selection"]["overlap"] is None
    assert right["selection"]["overlap"] >= 0


def test_the_reported_overlap_is_that_with_the_other_instruction(
    world: World, policy: tuple[EdgeModel, CloudModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(world, "max_episode_steps", 8)
    row, sent = run(world, policy, SPEC)
    _, other = run(world, policy, replace(SPEC, condition="wrong_selection"))
    shared = set(sent.positions(0)) & set(other.positions(0))
    assert row["selection"]["overlap"] == pytest.approx(len(shared) / 16)


def test_the_blind_see_an_expert_elsewhere_and_feel_themselves(
    world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    seen: list[Any] = []

    class Eyes(ObservedEdge):
        def encode(self, images: Any) -> Any:
            seen.append(np.stack(images))
            return super().encode(images)

    transport = ListeningTransport(InProcessTransport(policy[1]))
    spec = replace(SPEC, condition="blind")
    row = run_episode(world, Eyes(policy[0]), transport, spec, SETTINGS)
    film = expert_pictures(world, "drawer-open", 1_075_000, 8)
    assert np.array_equal(seen[0], film[0])
    assert np.array_equal(seen[1], film[1])
    observation, _ = world.reset(seed=1_070_000, options={"task": "drawer-open"})
    assert not np.array_equal(seen[0], observation["images"])
    assert list(transport.requests[0].proprio) == observation["proprio"].tolist()
    assert row["selection"]["object_frames"] == 0


def test_the_experts_film_ends_with_its_success(long_world: World) -> None:
    film = expert_pictures(long_world, "button-press", 1_070_003, 8)
    assert long_world.successes()["button-press"]
    assert np.array_equal(film[-1], long_world.observe()["images"])
    assert len(film) > 3


def test_success_ends_the_episode_and_the_named_task_ends_a_misled_one(
    long_world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    expert = InProcessTransport(ExpertCloud(policy[0].info, long_world))
    spec = replace(SPEC, method="random", k=4)
    row = run_episode(long_world, policy[0], expert, spec, SETTINGS)
    assert row["success"]
    assert 20 < row["steps"] < 160
    assert row["queries"] == -(-row["steps"] // 8)
    misled = replace(spec, condition="wrong_instruction")
    row = run_episode(long_world, policy[0], expert, misled, SETTINGS)
    assert not row["success"]
    assert row["other_success"]
    assert row["steps"] < 160
    assert long_world.successes()[row["other_task"]]


def test_a_table_with_one_fixture_cannot_be_named_wrongly(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.reset(seed=1_070_000, options={"task": "drawer-open"})
    drawers = [task for task in world.possible_tasks() if task.fixture == "drawer"]
    monkeypatch.setattr(world, "possible_tasks", lambda: drawers)
    for condition in ("wrong_instruction", "wrong_selection"):
        with pytest.raises(EvaluationError, match="another fixture"):
            cast(world, replace(SPEC, condition=condition), 1_070_000)
    assert cast(world, SPEC, 1_070_000).other is None


def test_a_silent_policy_is_an_error_and_no_failed_episode(
    world: World, policy: tuple[EdgeModel, CloudModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    from comvla_client import TransportError

    transport = InProcessTransport(policy[1])

    def refuse(*_: object) -> None:
        raise TransportError("UNAVAILABLE", "the server is draining")

    monkeypatch.setattr(transport, "infer", refuse)
    with pytest.raises(EvaluationError, match="draining"):
        run_episode(world, policy[0], transport, SPEC, SETTINGS)


@pytest.mark.parametrize(
    ("uv", "tokens"),
    [
        ([[0.0, 0.0], [0.999, 0.999]], [0, 511]),
        ([[0.5, 0.0], [0.0, 0.5]], [8, 256 + 128]),
        ([[1.0, 0.5], [0.2, -0.01]], [None, None]),
    ],
)
def test_a_point_is_in_the_token_that_covers_it(
    uv: list[list[float]], tokens: list[int | None]
) -> None:
    assert token_at(np.array(uv), (2, 16, 16)) == tokens


@pytest.mark.parametrize(("method", "k"), [("random", 16), ("random", 256), ("token_norm", 100)])
def test_hits_count_the_named_objects_token(
    world: World,
    policy: tuple[EdgeModel, CloudModel],
    monkeypatch: pytest.MonkeyPatch,
    method: str,
    k: int,
) -> None:
    monkeypatch.setattr(world, "max_episode_steps", 8)  # one query
    world.reset(seed=1_070_000, options={"task": "drawer-open"})
    handle = world.points_of_interest("drawer-open")[1][None]
    tokens = token_at(world.project(handle)[:, 0], (2, 16, 16))
    assert None not in tokens
    row, sent = run(world, policy, replace(SPEC, method=method, k=k))
    kept = [int(token in sent.positions(0)) for token in tokens]
    assert row["selection"]["object_hits_by_view"] == kept
    assert row["selection"]["object_hits"] == max(kept)
    assert row["selection"]["object_frames_by_view"] == [1, 1]
