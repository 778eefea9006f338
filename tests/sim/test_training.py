"""Training: what the policy is asked to learn, and that a run can stop and go on as if it had not."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from comvla_client.scoring import Importance, attention, hard_votes
from comvla_client.selection import select
from comvla_sim import cli
from comvla_sim.training.batches import Sampler
from comvla_sim.training.command import data_statistics
from comvla_sim.training.demonstrations import Demonstrations
from comvla_sim.training.grounding import (
    FIXTURE,
    GOAL,
    HAND,
    OBJECT,
    grounding_targets,
    query_targets,
)
from comvla_sim.training.objective import score, voted
from comvla_sim.training.trainer import Recipe, Trainer, TrainingError, learning_rate
from comvla_sim.worlds.tabletop import Tabletop
from comvla_vla import load_cloud, load_edge
from comvla_vla.presets import MINI_WORDS, mini
from comvla_vla.prompt import Prompt, word_tokenizer
from comvla_vla.statistics import pick_statistics

TINY = Recipe(steps=3, batch_size=4, token_counts=(32, 16), token_shares=(0.5, 0.5), bfloat16=False)


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """One table, three steps: the whole command."""
    out = tmp_path_factory.mktemp("run")
    options = ["--layouts", "1", "--validation-layouts", "1", "--steps", "3", "--workers", "1"]
    assert cli.main(["train", "--out", str(out), *options, "--json"]) == 0
    return out


@pytest.fixture(scope="module")
def sampler(run_folder):
    data = Demonstrations(run_folder / "demonstrations" / "train")
    prompt = Prompt(mini().prompt, word_tokenizer(list(MINI_WORDS)))
    bounds = pick_statistics({"tabletop": data_statistics(data)}, None, where="test")
    return Sampler(data, Tabletop.tasks, prompt, bounds, seed=0)


@pytest.mark.simulator
def test_the_command_leaves_a_policy_that_both_halves_load(run_folder):
    summary = json.loads((run_folder / "summary.json").read_text())
    edge, cloud = load_edge(run_folder / "policy"), load_cloud(run_folder / "policy")
    assert edge.info == cloud.info
    assert edge.info.fingerprint == summary["fingerprint"]
    assert summary["frames"] > 50
    assert set(summary["validation_action_l1"]) >= {"full", "votes:16", "random:16"}


@pytest.mark.simulator
def test_a_finished_command_is_quick_and_says_the_same(run_folder, capsys):
    before = (run_folder / "summary.json").read_text()
    options = ["--layouts", "1", "--validation-layouts", "1", "--steps", "3", "--workers", "1"]
    assert cli.main(["train", "--out", str(run_folder), *options]) == 0
    assert json.loads((run_folder / "summary.json").read_text()) == json.loads(before)
    assert capsys.readouterr().out.startswith("policy written to")


@pytest.mark.simulator
def test_a_run_does_not_go_on_with_other_demonstrations(sampler, run_folder, tmp_path):
    data = Demonstrations(run_folder / "demonstrations" / "train")
    other = Demonstrations(run_folder / "demonstrations" / "validation")
    assert data.digest() == Demonstrations(data.path).digest() != other.digest()
    Trainer(mini(), TINY, tmp_path, data.digest()).save()
    assert Trainer(mini(), TINY, tmp_path, data.digest()).resume()
    with pytest.raises(TrainingError, match="a run on other data"):
        Trainer(mini(), TINY, tmp_path, other.digest()).resume()


@pytest.mark.simulator
def test_an_interrupted_run_ends_where_an_uninterrupted_one_does(sampler, tmp_path):
    whole = Trainer(mini(), TINY, tmp_path / "whole")
    whole.run(sampler, lambda _: None)

    class StopError(Exception):
        pass

    def stop(progress):
        if progress.step == 2:
            raise StopError

    first = Trainer(mini(), TINY, tmp_path / "parts")
    with pytest.raises(StopError):
        first.run(sampler, stop, report_every=1, save_every=1)
    second = Trainer(mini(), TINY, tmp_path / "parts")
    assert second.resume()
    assert second.step == 1  # the report came before the checkpoint of step 2
    second.run(sampler, lambda _: None)
    for name, value in whole.learner.state_dict().items():
        assert torch.equal(value, second.learner.state_dict()[name]), name


@pytest.mark.simulator
def test_a_run_is_not_taken_up_with_another_recipe(sampler, tmp_path):
    Trainer(mini(), TINY, tmp_path).run(sampler, lambda _: None)
    with pytest.raises(TrainingError, match="another learning_rate"):
        Trainer(mini(), replace(TINY, learning_rate=1e-4), tmp_path).resume()


@pytest.mark.simulator
def test_learning_lowers_the_loss_on_one_batch(sampler, tmp_path):
    recipe = replace(TINY, steps=12, warmup_steps=1, token_counts=(64,), token_shares=(1.0,))
    trainer = Trainer(mini(), recipe, tmp_path)
    frames = np.arange(4)
    before = trainer.losses(sampler, frames, 64, "votes")
    one_batch = type(sampler).__new__(type(sampler))
    one_batch.__dict__ |= sampler.__dict__
    one_batch.batch = lambda step, size: sampler.of(frames, np.random.default_rng(0))
    trainer.run(one_batch, lambda _: None)
    after = trainer.losses(sampler, frames, 64, "votes")
    assert after["action"] < 0.9 * before["action"]
    assert after["attention"] < before["attention"]


@pytest.mark.simulator
def test_a_batch_depends_on_seed_and_step_only(sampler):
    one, two = sampler.batch(5, 8), sampler.batch(5, 8)
    assert all(
        torch.equal(getattr(one, n), getattr(two, n)) for n in ("images", "prompts", "chunks")
    )
    assert not torch.equal(one.images, sampler.batch(6, 8).images)


@pytest.mark.simulator
def test_one_picture_under_two_instructions_has_two_chunks(sampler):
    batch = sampler.batch(0, 16)
    pairs = batch.chunks.view(16, 2, 8, 4)
    assert not torch.equal(batch.prompts[0::2], batch.prompts[1::2])
    assert (pairs[:, 0] - pairs[:, 1]).abs().amax((1, 2)).gt(0.01).float().mean() > 0.9


def test_voting_in_training_is_the_clients_voting():
    generator = torch.Generator().manual_seed(0)
    queries, tokens = (
        torch.randn(3, 20, 24, generator=generator),
        torch.randn(3, 50, 24, generator=generator),
    )
    voters = torch.ones(3, 20, dtype=torch.bool)
    voters[1, 12:] = False
    kept = voted(*score(queries, tokens), voters, 16)
    for i in range(3):
        q, v = queries[i][voters[i]], tokens[i]
        want = select(Importance(hard_votes(q, v), attention(q, v).sum(0)), 16)
        assert kept[i].tolist() == want.tolist()


def test_each_query_looks_for_its_own_kind_of_point():
    assert query_targets(["the"]) == [(HAND, 0), (HAND, 1), (HAND, 0), (HAND, 1)]
    assert {kind for kind, _ in query_targets(["drawer"])} == {OBJECT, FIXTURE}
    assert {kind for kind, _ in query_targets(["open"])} == {GOAL, OBJECT}
    assert len(query_targets(["pull", "the", "green", "drawer", "open"])) == 20


def test_every_word_of_every_instruction_has_a_role():
    for task in Tabletop.tasks:
        for text in (task.instruction, *task.paraphrases):
            assert set(text.split()) <= set(MINI_WORDS)
            query_targets(text.split())


def test_targets_peak_on_the_token_under_the_point():
    uv = torch.zeros(1, 2, 4, 2)
    uv[0, 1, OBJECT] = torch.tensor([0.5 / 16 + 3 / 16, 0.5 / 16 + 7 / 16])
    wanted = torch.tensor([[[OBJECT, 1]]])
    target = grounding_targets(uv, wanted, (2, 16, 16))[0, 0]
    assert target.argmax() == 256 + 7 * 16 + 3
    assert target.sum() == pytest.approx(1, abs=1e-5)
    assert target[:256].sum() == 0


def test_learning_rate_warms_up_and_cools_down():
    recipe = Recipe(steps=1000)
    rates = [learning_rate(recipe, step) for step in range(1000)]
    assert max(rates) <= recipe.learning_rate
    assert rates[0] < rates[25] < rates[49]
    assert rates[-1] == pytest.approx(recipe.final_share * recipe.learning_rate, rel=0.01)


@pytest.mark.parametrize(
    "options", [["--layouts", "0"], ["--steps", "0"], ["--random-share", "1.5"]]
)
def test_senseless_options_are_refused(options, tmp_path, capsys):
    assert cli.main(["train", "--out", str(tmp_path / "r"), *options]) == 2
    assert "expected" in capsys.readouterr().err
    assert not (tmp_path / "r").exists()
