"""Policies survive the disk, each half reads only what it needs, and damage is named."""

from __future__ import annotations

import json
import os
import stat

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from comvla.errors import CheckpointError
from comvla_vla import (
    PolicyRequest,
    load_cloud,
    load_edge,
    random_policy,
    save_policy,
    split_checkpoint,
)
from comvla_vla.checkpoints import open_checkpoint
from comvla_vla.presets import MINI_WORDS
from comvla_vla.prompt import word_tokenizer
from comvla_vla.random import unit_statistics

REQUEST = PolicyRequest(
    np.ones((5, 96), np.float32), np.arange(5), "press the button", np.zeros(4, np.float32)
)


@pytest.fixture(scope="module")
def policy():
    return random_policy(seed=7)


@pytest.fixture
def folder(policy, tmp_path):
    edge, cloud = policy
    save_policy(
        tmp_path / "p",
        edge.net,
        cloud.net,
        word_tokenizer(list(MINI_WORDS)),
        unit_statistics(cloud.config),
    )
    return tmp_path / "p"


def test_what_is_read_is_what_was_written(policy, folder):
    edge, cloud = load_edge(folder), load_cloud(folder)
    images = [np.full((128, 128, 3), 90, np.uint8)] * 2
    assert edge.info == cloud.info == policy[0].info
    assert torch.equal(edge.encode(images), policy[0].encode(images))
    np.testing.assert_array_equal(cloud.predict([REQUEST])[0], policy[1].predict([REQUEST])[0])
    assert os.stat(folder / "model.safetensors").st_mode & stat.S_IROTH


def test_split_halves_act_like_the_whole_and_hold_no_more_than_they_need(policy, folder, tmp_path):
    split_checkpoint(folder, tmp_path / "split")
    edge, cloud = load_edge(tmp_path / "split" / "edge"), load_cloud(tmp_path / "split" / "cloud")
    assert edge.info == cloud.info
    np.testing.assert_array_equal(cloud.predict([REQUEST])[0], policy[1].predict([REQUEST])[0])
    with safe_open(tmp_path / "split" / "edge" / "model.safetensors", "pt") as archive:
        names = set(archive.keys())
    assert {n.split(".")[0] for n in names} == {"vision_backbone", "projector", "language_model"}
    assert not any("layers" in n for n in names)
    with safe_open(tmp_path / "split" / "cloud" / "model.safetensors", "pt") as archive:
        assert not any(n.startswith("vision_backbone") for n in archive.keys())  # noqa: SIM118


def test_a_half_is_not_the_other_half(folder, tmp_path):
    split_checkpoint(folder, tmp_path / "split")
    with pytest.raises(CheckpointError, match="holds the edge half, the cloud half was asked for"):
        load_cloud(tmp_path / "split" / "edge")
    with pytest.raises(CheckpointError, match="split needs the whole policy"):
        split_checkpoint(tmp_path / "split" / "cloud", tmp_path / "again")
    with pytest.raises(CheckpointError, match="exists already"):
        split_checkpoint(folder, tmp_path / "split")
    assert not list(tmp_path.glob("*.partial"))


def test_tensor_names_are_the_published_ones(folder):
    names = set(load_file(folder / "model.safetensors"))
    assert {
        "language_model.model.embed_tokens.weight",
        "language_model.model.layers.0.self_attn.q_proj.weight",
        "language_model.model.layers.2.mlp.gate_proj.weight",
        "language_model.model.norm.weight",
        "projector.fc1.weight",
        "action_head.model.mlp_resnet_blocks.1.ffn.1.weight",
        "proprio_projector.fc2.bias",
    } <= names


def test_other_weights_have_another_fingerprint(policy):
    other = random_policy(seed=8)
    assert other[0].info.fingerprint == other[1].info.fingerprint != policy[0].info.fingerprint
    assert random_policy(seed=7)[0].info.fingerprint == policy[0].info.fingerprint


def test_building_a_policy_leaves_the_callers_random_numbers_alone(folder):
    torch.manual_seed(5)
    want = torch.rand(1)
    torch.manual_seed(5)
    random_policy(seed=1)
    load_edge(folder)
    assert torch.equal(torch.rand(1), want)


def _drop(folder, name):
    tensors = load_file(folder / "model.safetensors")
    del tensors[name]
    save_file(tensors, folder / "model.safetensors")


def _reshape(folder, name):
    tensors = load_file(folder / "model.safetensors")
    tensors[name] = tensors[name][:-1].contiguous()
    save_file(tensors, folder / "model.safetensors")


def _flip(file, at):
    content = bytearray(file.read_bytes())
    content[at] ^= 1
    file.write_bytes(content)


def _edit(folder, **changes):
    header = json.loads((folder / "config.json").read_text())
    header.update(changes)
    (folder / "config.json").write_text(json.dumps(header))


def _edit_model(folder, **changes):
    header = json.loads((folder / "config.json").read_text())
    header["model"].update(changes)
    (folder / "config.json").write_text(json.dumps(header))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (
            lambda f: _drop(f, "projector.fc1.bias"),
            "lacks 1 tensors, the first is projector.fc1.bias",
        ),
        (lambda f: _reshape(f, "projector.fc1.bias"), r"projector.fc1.bias has shape \(191,\)"),
        (
            lambda f: (f / "model.safetensors").write_bytes(b"\x08" + b"\0" * 7 + b"garbage!"),
            "cannot read the weights",
        ),
        (lambda f: (f / "model.safetensors").unlink(), "cannot read the weights"),
        (lambda f: os.truncate(f / "model.safetensors", 100_000), "cannot read the weights"),
        (lambda f: (f / "config.json").write_text("{"), "cannot read .*config.json"),
        (lambda f: (f / "config.json").unlink(), "is not a checkpoint folder"),
        (lambda f: (f / "config.json").write_text('{"model_type": "bert"}'), "'bert'"),
        (lambda f: (f / "config.json").write_text("[]"), "no mapping"),
        (lambda f: (f / "config.json").write_text('{"format": "comvla-1"}'), "lacks"),
        (lambda f: _edit_model(f, towers=[]), "at least one vision tower"),
        (lambda f: _edit_model(f, views="many"), "views = 'many', expected a whole number"),
        (lambda f: _edit_model(f, prompt={"temperature": 1}), "does not know"),
        (lambda f: _edit_model(f, control_period_s=0.06), "are not what was written"),
        (lambda f: _edit(f, fingerprint="0" * 32), "are not what was written"),
        (lambda f: (f / "digests.json").unlink(), "cannot read the digests"),
        (lambda f: (f / "digests.json").write_text("{}"), "are not what was written"),
        (lambda f: (f / "config.json").write_text("[" * 100_000), "cannot read the configuration"),
        (lambda f: (f / "tokenizer.json").write_text("{}"), "cannot read the tokenizer"),
        (lambda f: (f / "dataset_statistics.json").write_text("{}"), "no data-set statistics"),
        (
            lambda f: (f / "dataset_statistics.json").write_text("nonsense"),
            "cannot read the data-set statistics",
        ),
        (
            lambda f: (f / "dataset_statistics.json").write_text('{"a": {}, "b": {}}'),
            "several statistics",
        ),
        (lambda f: (f / "dataset_statistics.json").write_text('{"a": {}}'), "lack 'action'"),
    ],
)
def test_damage_is_a_checkpoint_error_that_names_it(folder, damage, words):
    damage(folder)
    with pytest.raises(CheckpointError, match=words):
        load_cloud(folder)


def test_one_changed_number_anywhere_is_noticed(folder, tmp_path):
    """A bit that flips on a disk or on the way changes actions and raises nothing by itself."""
    split_checkpoint(folder, tmp_path / "split")
    _flip(tmp_path / "split/edge/model.safetensors", -4)
    _flip(tmp_path / "split/cloud/model.safetensors", -40_000)
    for load, half in ((load_edge, "edge"), (load_cloud, "cloud")):
        with pytest.raises(CheckpointError, match=r"tensor .* the weights are damaged"):
            load(tmp_path / "split" / half)
        assert load(tmp_path / "split" / half, verify=False).info.fingerprint
    _flip(folder / "model.safetensors", -4)
    with pytest.raises(CheckpointError, match=r"tensor .* the weights are damaged"):
        split_checkpoint(folder, tmp_path / "again")
    assert not list(tmp_path.glob("again*"))


def test_statistics_that_were_edited_are_noticed(folder):
    table = json.loads((folder / "dataset_statistics.json").read_text())
    side = next(iter(table.values()))["action"]
    bound = next(values for values in side.values() if isinstance(values[0], float))
    bound[0] += 1e-3
    (folder / "dataset_statistics.json").write_text(json.dumps(table))
    with pytest.raises(CheckpointError, match="are not what was written"):
        load_edge(folder)


def test_a_checkpoint_without_digests_is_read_as_it_is(folder):
    header = json.loads((folder / "config.json").read_text())
    del header["content_sha256"]
    (folder / "config.json").write_text(json.dumps(header))
    (folder / "digests.json").unlink()
    assert load_edge(folder).info.fingerprint == header["fingerprint"]


def test_the_shipped_policy_carries_its_digests():
    checkpoint = open_checkpoint("mini", "whole")
    assert set(checkpoint.digests) == set(checkpoint.tensors)
    checkpoint.check_content()


def test_a_tokenizer_of_a_larger_vocabulary_is_refused(folder):
    words = [f"word{chr(97 + i)}{chr(97 + j)}" for i in range(8) for j in range(8)]
    (folder / "tokenizer.json").write_text(word_tokenizer(words).to_str())
    with pytest.raises(CheckpointError, match="it belongs to another checkpoint"):
        load_cloud(folder)


def test_statistics_of_another_robot_are_refused(folder):
    table = {
        "other": {"action": {"q01": [0] * 7, "q99": [1] * 7}, "proprio": {"q01": [], "q99": []}}
    }
    (folder / "dataset_statistics.json").write_text(json.dumps(table))
    with pytest.raises(CheckpointError, match="belong to another data set"):
        load_edge(folder)
    with pytest.raises(CheckpointError, match=r"has no statistics 'libero', it holds \['other'\]"):
        load_cloud(folder, statistics_key="libero")


def test_bounds_may_be_percentiles_or_extremes(folder):
    _ = folder
    from comvla_vla.statistics import pick_statistics

    side = {"q01": [0.0], "q99": [2.0], "min": [-1.0], "max": [3.0]}
    percentiles = pick_statistics({"a": {"action": side, "proprio": side}}, None, "x")
    extremes = pick_statistics(
        {"a": {"normalization": "bounds", "action": side, "proprio": side}}, None, "x"
    )
    np.testing.assert_allclose(
        percentiles.unnormalise_actions(np.array([-1.0, 0.0, 1.0])[:, None])[:, 0], [0, 1, 2]
    )
    np.testing.assert_allclose(
        extremes.unnormalise_actions(np.array([-1.0, 0.0, 1.0])[:, None])[:, 0], [-1, 1, 3]
    )
    np.testing.assert_allclose(
        percentiles.normalise_proprio(np.array([[9.0], [1.0]])), [[1.0], [0.0]], atol=1e-6
    )
