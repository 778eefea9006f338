"""A configuration from anywhere gives a model or a CheckpointError, never a traceback and never a long wait."""

from __future__ import annotations

import contextlib
import copy
import json
import re
from dataclasses import fields
from typing import get_type_hints

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from comvla.errors import CheckpointError
from comvla_vla import load_cloud, load_edge, random_policy, save_policy
from comvla_vla.checkpoints.accounting import half_shapes
from comvla_vla.checkpoints.published import Recipe, published_config
from comvla_vla.config import (
    ActionConfig,
    BackboneConfig,
    ModelConfig,
    ProjectorConfig,
    PromptConfig,
    TowerConfig,
)
from comvla_vla.config_checks import BOUNDS
from comvla_vla.presets import MINI_WORDS, mini, openvla_oft
from comvla_vla.prompt import word_tokenizer
from comvla_vla.random import unit_statistics

HOSTILE = st.one_of(
    st.sampled_from(
        [0, -1, 1, 2, 3, 7, 10**9, 10**400, float("nan"), float("inf"), -float("inf"), 0.5, 1e-300]
    ),
    st.sampled_from([None, True, "", "many", "\0", "x" * 10_000, [], {}, [0], [[1]], {"a": 1}]),
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.text(max_size=20),
)


def json_of(config: ModelConfig) -> dict:
    return json.loads(json.dumps(config.to_dict()))


def places(value: object, path: tuple = ()) -> list[tuple]:
    """Ways to every value of a nested mapping, inner ones included."""
    inner = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    return [*([path] if path else []), *(p for k, v in inner for p in places(v, (*path, k)))]


def put(table: dict, path: tuple, value: object) -> dict:
    table = copy.deepcopy(table)
    inner = table
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return table


MINI, FULL = json_of(mini()), json_of(openvla_oft())
PUBLISHED = {
    "model_type": "openvla",
    "arch_specifier": "no-align+fused-gelu-mlp",
    "use_fused_vision_backbone": True,
    "image_resize_strategy": "resize-naive",
    "image_sizes": [224, 224],
    "timm_model_ids": [
        "vit_large_patch14_reg4_dinov2.lvd142m",
        "vit_so400m_patch14_siglip_224",
    ],
    "timm_override_act_layers": [None, None],
    "x_vit_overrides": [
        {"embed_dim": 64, "depth": 3, "num_heads": 4, "mlp_ratio": 4.0},
        {"embed_dim": 48, "depth": 3, "num_heads": 4, "mlp_ratio": 4.0, "patch_size": 14},
    ],
    "text_config": {
        "model_type": "llama",
        "hidden_size": 64,
        "intermediate_size": 128,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "vocab_size": 32064,
        "rms_norm_eps": 1e-6,
        "rope_theta": 10000.0,
        "max_position_embeddings": 2048,
        "rope_scaling": None,
    },
}


def test_every_number_of_a_configuration_has_bounds():
    kinds = (TowerConfig, ProjectorConfig, BackboneConfig, ActionConfig, PromptConfig, ModelConfig)
    numbers = set()
    for kind in kinds:
        hints = get_type_hints(kind)
        for field in fields(kind):
            hint = hints[field.name]
            words = str(hint)
            if "Literal" not in words and "Config" not in words and re.search("int|float", words):
                numbers.add(field.name)
    assert numbers == set(BOUNDS)


@pytest.mark.parametrize("whole", [MINI, FULL], ids=["mini", "openvla"])
def test_a_configuration_survives_the_way_to_the_disk(whole):
    assert json_of(ModelConfig.from_dict(whole)) == whole


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("backbone", "heads"), 0, "does not split into 0 heads"),
        (("towers", 0, "patch_size"), 0, r"towers\[0\].patch_size = 0, expected a whole number"),
        (("towers", 0, "patch_size"), 12, "do not split into patches of 12"),
        (("backbone", "layers"), -1, "backbone.layers = -1"),
        (("backbone", "layers"), 10**12, "backbone.layers"),
        (("backbone", "layers"), 3.0, "expected a whole number"),
        (("backbone", "rope_theta"), float("nan"), "backbone.rope_theta = nan"),
        (("control_period_s",), float("inf"), "control_period_s = inf"),
        (("views",), True, "views = True"),
        (("towers", 0, "std", 1), 0.0, r"towers\[0\].std\[1\]"),
        (("prompt", "template"), "{instruction.__class__}", "prompt template"),
        (("prompt", "template"), "no words at all", "prompt template"),
        (("prompt", "bos_id"), 28, "outside of a vocabulary"),
        (("action", "head"), "guess", "one of"),
        (("edge_pruners",), ["telepathy"], "no such edge pruners"),
    ],
)
def test_the_value_and_what_it_should_be_are_named(path, value, words):
    with pytest.raises(CheckpointError, match=words):
        ModelConfig.from_dict(put(MINI, path, value))


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_any_value_anywhere_in_a_configuration_is_read_or_refused(data):
    whole = data.draw(st.sampled_from([MINI, FULL]))
    path = data.draw(st.sampled_from(places(whole)))
    table = put(whole, path, data.draw(HOSTILE))
    try:
        config = ModelConfig.from_dict(table)
    except CheckpointError:
        return
    for half in ("edge", "cloud"):
        assert half_shapes(half, config)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_any_value_anywhere_in_a_published_configuration_is_read_or_refused(data):
    path = data.draw(st.sampled_from(places(PUBLISHED)))
    table = put(PUBLISHED, path, data.draw(HOSTILE))
    try:
        config = published_config(table, {}, Recipe())
    except CheckpointError:
        return
    for half in ("edge", "cloud"):
        assert half_shapes(half, config)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_a_folder_with_any_configuration_loads_or_is_refused(old_folder, data):
    header = json.loads((old_folder / "config.json.sound").read_text())
    path = data.draw(st.sampled_from(places(header)))
    (old_folder / "config.json").write_text(json.dumps(put(header, path, data.draw(HOSTILE))))
    for load in (load_edge, load_cloud):
        with contextlib.suppress(CheckpointError):
            load(old_folder)


@pytest.fixture(scope="module")
def old_folder(tmp_path_factory):
    """A checkpoint without digests, which would notice any change before it is looked at."""
    edge, cloud = random_policy(seed=3)
    folder = tmp_path_factory.mktemp("config") / "policy"
    words = word_tokenizer(list(MINI_WORDS))
    save_policy(folder, edge.net, cloud.net, words, unit_statistics(cloud.config))
    header = json.loads((folder / "config.json").read_text())
    del header["content_sha256"]
    (folder / "config.json.sound").write_text(json.dumps(header))
    return folder
