"""Published checkpoints load and split whatever their files look like, and every tensor is accounted for."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from published_folder import HEADER, random_tensors, tiny_config, write_published
from reference_data import GOLDEN, needs_golden
from safetensors.torch import load_file, save_file

from comvla.errors import CheckpointError, DependencyError
from comvla_vla import (
    PolicyRequest,
    Recipe,
    check_split,
    load_cloud,
    load_edge,
    split_checkpoint,
)
from comvla_vla.checkpoints import hub, memory, splitting
from comvla_vla.checkpoints.accounting import half_shapes, half_size, unused_shapes
from comvla_vla.checkpoints.published import published_config
from comvla_vla.checkpoints.tensors import TensorEntry, check_shapes

REQUEST = PolicyRequest(
    np.linspace(-1, 1, 100, dtype=np.float32).reshape(5, 20),
    np.array([7, 0, 3, 4, 1]),
    "pick up the plate",
    np.zeros(8, np.float32),
)
PICTURES = [np.arange(28 * 28 * 3, dtype=np.uint8).reshape(28, 28, 3)] * 2


@pytest.fixture(scope="module")
def tensors():
    return random_tensors()


@pytest.fixture(scope="module")
def published(tensors, tmp_path_factory):
    """Never written to: tests that damage a folder copy it."""
    return write_published(tmp_path_factory.mktemp("published") / "oft", tensors, shards=3)


@pytest.fixture
def folder(published, tmp_path):
    shutil.copytree(published, tmp_path / "oft")
    return tmp_path / "oft"


def actions(source, **options) -> np.ndarray:
    return load_cloud(source, **options).predict([REQUEST])[0]


def test_one_file_or_shards_with_or_without_module_make_no_difference(published, tensors, tmp_path):
    single = write_published(tmp_path / "single", tensors, prefix="")
    np.testing.assert_array_equal(actions(single), actions(published))
    assert torch.equal(load_edge(single).encode(PICTURES), load_edge(published).encode(PICTURES))


def test_halves_loaded_from_one_published_folder_belong_together(published, tmp_path):
    edge, cloud = load_edge(published), load_cloud(published)
    assert edge.info == cloud.info
    other = write_published(tmp_path / "other", random_tensors(seed=1))
    assert load_edge(other).info.fingerprint != edge.info.fingerprint


def test_split_halves_act_like_the_published_whole(published, tmp_path):
    report = split_checkpoint(published, tmp_path / "split")
    assert check_split(published, tmp_path / "split") == report
    edge, cloud = load_edge(tmp_path / "split/edge"), load_cloud(tmp_path / "split/cloud")
    assert edge.info == cloud.info
    np.testing.assert_array_equal(cloud.predict([REQUEST])[0], actions(published))
    assert torch.equal(edge.encode(PICTURES), load_edge(published).encode(PICTURES))
    expected = half_shapes("edge", tiny_config())
    assert set(load_file(tmp_path / "split/edge/model.safetensors")) == set(expected)
    assert report.tensors == {
        "edge": len(expected),
        "cloud": len(half_shapes("cloud", tiny_config())),
    }
    assert sorted(p.name for p in tmp_path.iterdir()) == ["split"]


def test_stored_number_formats_survive_the_split(folder, tmp_path):
    path = folder / "proprio_projector--latest_checkpoint.pt"
    torch.save({n: t.float() for n, t in torch.load(path).items()}, path)
    split_checkpoint(folder, tmp_path / "split")
    written = load_file(tmp_path / "split/cloud/model.safetensors")
    assert written["proprio_projector.fc1.weight"].dtype == torch.float32
    assert written["projector.fc1.weight"].dtype == torch.bfloat16


def test_a_recipe_is_part_of_the_split(published, tmp_path):
    recipe = Recipe(name="lightvla", first_slot=1, edge_pruners=())
    split_checkpoint(published, tmp_path / "split", recipe=recipe)
    cloud = load_cloud(tmp_path / "split/cloud")
    assert (cloud.info.name, cloud.config.action.first_slot) == ("lightvla", 1)
    assert "proprio_projector.fc1.weight" not in load_file(
        tmp_path / "split/edge/model.safetensors"
    )
    assert np.abs(cloud.predict([REQUEST])[0] - actions(published)).max() > 1e-4
    with pytest.raises(CheckpointError, match="another config"):
        check_split(published, tmp_path / "split")


def test_a_changed_weight_is_found(published, tmp_path):
    split_checkpoint(published, tmp_path / "split")
    path = tmp_path / "split/edge/model.safetensors"
    written = load_file(path)
    written["projector.fc2.bias"][3] += 1
    save_file(written, path)
    with pytest.raises(CheckpointError, match=r"tensor projector\.fc2\.bias differs"):
        check_split(published, tmp_path / "split")


def test_statistics_fall_back_to_those_in_the_configuration(folder):
    table = json.loads((folder / "dataset_statistics.json").read_text())
    (folder / "dataset_statistics.json").unlink()
    with pytest.raises(CheckpointError, match=r"neither dataset_statistics\.json nor norm_stats"):
        load_cloud(folder)
    header = HEADER | {"norm_stats": table | {"bridge": table["libero_spatial_no_noops"]}}
    (folder / "config.json").write_text(json.dumps(header))
    with pytest.raises(CheckpointError, match=r"several statistics \['bridge', 'libero_spatial"):
        load_cloud(folder)
    assert load_cloud(folder, statistics_key="bridge").statistics.key == "bridge"


def test_defaults_of_the_language_model_are_written_out():
    """The configuration file stores only what differed from the defaults of its day."""
    config = published_config(HEADER | {"text_config": {"model_type": "llama"}}, {}, Recipe())
    backbone = config.backbone
    assert (backbone.hidden, backbone.layers, backbone.heads) == (4096, 32, 32)
    assert (backbone.intermediate, backbone.vocab, backbone.max_positions) == (11008, 32064, 2048)
    assert backbone.rms_eps == 1e-6
    assert backbone.rope_theta == 10_000


@needs_golden
def test_all_tensors_of_the_full_size_model_are_accounted_for():
    """982 names and shapes: each is read by the edge half, the cloud half or both, or listed as unused."""
    header = json.loads((GOLDEN / "real_config_as_written.json").read_text())
    published = {
        n: tuple(s) for n, s in json.loads((GOLDEN / "real_tensor_shapes.json").read_text()).items()
    }
    config = published_config(header, {}, Recipe())
    edge, cloud, unused = (
        half_shapes("edge", config),
        half_shapes("cloud", config),
        unused_shapes(config),
    )
    side = {n for n in edge | cloud if n.startswith(("action_head.", "proprio_projector."))}
    assert len(published) == 982
    assert {n: s for n, s in (edge | cloud | unused).items() if n not in side} == published
    assert not (set(edge) | set(cloud)) & set(unused)
    assert {n for n in unused if "attn_pool" not in n and "blocks" not in n} == {
        "language_model.lm_head.weight",
        *(
            f"vision_backbone.{t}.norm.{p}"
            for t in ("featurizer", "fused_featurizer")
            for p in ("weight", "bias")
        ),
    }


def test_sizes_of_the_full_size_halves():
    config = published_config(
        {k: v for k, v in HEADER.items() if k != "x_vit_overrides"}
        | {"text_config": {"model_type": "llama"}, "image_sizes": [224, 224]},
        {},
        Recipe(),
    )
    edge, cloud = half_size("edge", config), half_size("cloud", config)
    assert edge.parameters / 1e6 == pytest.approx(950, abs=10)
    assert cloud.parameters / 1e6 == pytest.approx(6607.6 + 71.4 + 151.1 + 16.8, abs=1)
    assert cloud.nbytes(torch.bfloat16) / 1e9 == pytest.approx(13.7, abs=0.05)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda t: t.pop("vision_backbone.featurizer.blocks.1.ls1.scale_factor"),
            r"lacks .* \S+blocks\.1\.ls1",
        ),
        (
            lambda t: t.pop("language_model.lm_head.weight"),
            r"lacks .* language_model\.lm_head\.weight",
        ),
        (
            lambda t: t.update(
                {"language_model.model.layers.3.mlp.up_proj.weight": torch.zeros(2)}
            ),
            "layers.3",
        ),
        (
            lambda t: t.update({"projector.fc2.bias": torch.zeros(17)}),
            r"projector.fc2.bias has shape \(17,\)",
        ),
        (
            lambda t: t.update({"action_head.model.fc3.bias": torch.zeros(7)}),
            "action_head.model.fc3.bias",
        ),
        (
            lambda t: t.update({"noisy_action_projector.fc1.weight": torch.zeros(4, 1)}),
            "noisy_action_projector",
        ),
    ],
)
def test_missing_extra_and_misshapen_tensors_are_named(tensors, tmp_path, change, words):
    changed = dict(tensors)
    change(changed)
    source = write_published(tmp_path / "changed", changed)
    for load in (load_edge, load_cloud):
        with pytest.raises(CheckpointError, match=words):
            load(source)
    with pytest.raises(CheckpointError, match=words):
        split_checkpoint(source, tmp_path / "split")
    assert not (tmp_path / "split").exists()


class _Bomb:
    def __reduce__(self):
        return os.system, ("touch exploded",)


def _edit_index(folder, change):
    path = folder / "model.safetensors.index.json"
    index = json.loads(path.read_text())
    change(index["weight_map"])
    path.write_text(json.dumps(index))


def _as_torchscript(path):
    """What torch.jit.save leaves: the same archive, with code and constants beside the tensors."""
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("archive/code/__torch__.py", "class Module: ...")
        archive.writestr("archive/constants.pkl", b"")


def _point_at(folder, place):
    _edit_index(folder, lambda places: places.update({"projector.fc1.bias": place}))


DAMAGE = [
    (lambda f: os.truncate(f / "model-00002-of-00003.safetensors", 20_000), "truncated"),
    (lambda f: os.truncate(f / "model-00001-of-00003.safetensors", 4), "cannot read the weights"),
    (lambda f: (f / "model-00003-of-00003.safetensors").unlink(), "names the shard model-00003"),
    (lambda f: _point_at(f, "../other.safetensors"), "outside of its folder"),
    (lambda f: _point_at(f, "/etc/passwd"), "outside of its folder"),
    (
        lambda f: _point_at(f, "model-00002-of-00003.safetensors"),
        "disagree about the tensor projector.fc1",
    ),
    (lambda f: _edit_index(f, lambda places: places.pop("projector.fc1.bias")), "disagree about"),
    (lambda f: (f / "model.safetensors.index.json").write_text("[]"), "cannot read the index"),
    (
        lambda f: torch.save({"a": _Bomb()}, f / "action_head--latest_checkpoint.pt"),
        "more than tensors",
    ),
    (
        lambda f: torch.save({"a": 3}, f / "action_head--latest_checkpoint.pt"),
        "mapping of names to tensors",
    ),
    (lambda f: torch.save([1], f / "proprio_projector--latest_checkpoint.pt"), "mapping of names"),
    (lambda f: _as_torchscript(f / "action_head--latest_checkpoint.pt"), "a TorchScript archive"),
    (lambda f: (f / "action_head--latest_checkpoint.pt").write_bytes(b"PK"), "cannot read"),
    (lambda f: os.truncate(f / "action_head--latest_checkpoint.pt", 900), "cannot read"),
    (lambda f: (f / "action_head--latest_checkpoint.pt").unlink(), "lacks action_head--"),
    (
        lambda f: shutil.copy(
            f / "action_head--latest_checkpoint.pt", f / "action_head--50000_checkpoint.pt"
        ),
        "2 files for action_head",
    ),
    (lambda f: (f / "config.json").write_text('{"model_type": "pi0"}'), "'pi0'"),
    (
        lambda f: (f / "config.json").write_text(json.dumps(HEADER | {"arch_specifier": "linear"})),
        "another family",
    ),
    (
        lambda f: (f / "config.json").write_text(
            json.dumps(HEADER | {"timm_model_ids": ["resnet50", "resnet50"]})
        ),
        "only .* are implemented",
    ),
    (
        lambda f: (f / "config.json").write_text(
            json.dumps(HEADER | {"text_config": {"model_type": "qwen2"}})
        ),
        "qwen2",
    ),
    (lambda f: (f / "dataset_statistics.json").write_text("{}"), "no data-set statistics"),
    (lambda f: (f / "tokenizer.json").unlink(), "holds no tokenizer.json: copy"),
    (lambda f: (f / "tokenizer.json").rename(f / "tokenizer.model"), "convert it once"),
    (lambda f: (f / "tokenizer.json").write_text("{}"), "cannot read the tokenizer"),
]


@pytest.mark.parametrize(("damage", "words"), DAMAGE)
def test_damage_is_named_and_nothing_half_written(folder, tmp_path, monkeypatch, damage, words):
    monkeypatch.chdir(tmp_path)
    damage(folder)
    with pytest.raises(CheckpointError, match=words):
        split_checkpoint(folder, tmp_path / "split")
    with pytest.raises(CheckpointError, match=words):
        load_cloud(folder)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["oft"], (
        "no output, and nothing was executed"
    )


def test_a_shard_that_fails_while_it_is_copied_leaves_nothing(folder, tmp_path, monkeypatch):
    def truncated(entries):
        raise OSError("No space left on device")

    monkeypatch.setattr(splitting, "tensor_digest", truncated)
    with pytest.raises(CheckpointError, match="No space left"):
        split_checkpoint(folder, tmp_path / "split")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["oft"]


def test_too_little_disk_or_memory_is_said_beforehand(published, tmp_path, monkeypatch):
    class Usage:
        free = 1_000_000

    monkeypatch.setattr(memory.shutil, "disk_usage", lambda folder: Usage)
    with pytest.raises(CheckpointError, match=r"need 0\.\d+ GB on the disk .* 0\.001 GB are free"):
        split_checkpoint(published, tmp_path / "split")
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(memory, "available_bytes", lambda: 1_000_000)
    with pytest.raises(CheckpointError, match=r"cloud half .* needs 0\.00\d+ GB of memory"):
        load_cloud(published)
    monkeypatch.setattr(memory, "available_bytes", lambda: None)
    load_cloud(published)


def test_splitting_needs_far_less_memory_than_the_checkpoint(published, tmp_path):
    """One tensor at a time: a process that splits a large folder hardly grows."""
    text = HEADER["text_config"] | {
        "hidden_size": 128,
        "intermediate_size": 8192,
        "num_hidden_layers": 20,
    }
    header = HEADER | {"text_config": text}
    config = published_config(header, {}, Recipe())
    shapes = half_shapes("edge", config) | half_shapes("cloud", config) | unused_shapes(config)
    tensors = {name: torch.zeros(shape, dtype=torch.bfloat16) for name, shape in shapes.items()}
    large = write_published(tmp_path / "large", tensors)
    (large / "config.json").write_text(json.dumps(header))
    script = (
        "import sys\n"
        "from resource import RUSAGE_SELF, getrusage\n"
        "from comvla_vla import split_checkpoint\n"
        "split_checkpoint(sys.argv[1], sys.argv[3] + '/small_split')\n"
        "before = getrusage(RUSAGE_SELF).ru_maxrss\n"
        "split_checkpoint(sys.argv[2], sys.argv[3] + '/large_split')\n"
        "print(getrusage(RUSAGE_SELF).ru_maxrss - before)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(published), str(large), str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
    )
    grown_bytes = int(done.stdout) * 1024
    whole_bytes = (large / "model.safetensors").stat().st_size
    assert whole_bytes > 140e6
    assert grown_bytes < whole_bytes / 4


def test_hub_repositories_come_from_the_cache_with_only_one_halfs_files(published, tmp_path):
    """huggingface_hub itself, offline: a cache that holds what a robot needs, and no more."""
    snapshot = tmp_path / "cache/models--moojink--tiny/snapshots/abc"
    shutil.copytree(published, snapshot)
    (snapshot.parents[1] / "refs").mkdir()
    (snapshot.parents[1] / "refs/main").write_text("abc")
    (snapshot / "action_head--latest_checkpoint.pt").unlink()
    script = (
        "from comvla_vla import load_cloud, load_edge\n"
        "from comvla.errors import CheckpointError\n"
        "print(load_edge('hf://moojink/tiny').info.fingerprint)\n"
        "for source in ('hf://moojink/tiny', 'hf://moojink/never-fetched', 'hf://moojink/tiny@v9'):\n"
        "    try:\n"
        "        load_cloud(source)\n"
        "    except CheckpointError as error:\n"
        "        print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=os.environ | {"HF_HUB_OFFLINE": "1", "HF_HUB_CACHE": str(tmp_path / "cache")},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    digest, incomplete, absent, no_revision = done.stdout.splitlines()
    assert digest == load_edge(published).info.fingerprint
    assert "lacks action_head--" in incomplete
    assert "cannot get hf://moojink/never-fetched from the hub" in absent
    assert "HF_HUB_OFFLINE" in absent
    assert "cannot get hf://moojink/tiny@v9 from the hub" in no_revision


def test_only_the_files_that_a_half_needs_are_asked_for(published, monkeypatch):
    asked = []

    def download(repo_id, revision, allow_patterns):
        assert (repo_id, revision) == ("moojink/tiny", "v2")
        asked.append(set(allow_patterns))
        return str(published)

    import huggingface_hub

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    index = json.loads((published / "model.safetensors.index.json").read_text())["weight_map"]
    tiny = hub.named("hf://moojink/tiny@v2")
    hub.fetch(tiny, lambda name: name == "projector.fc1.bias", ["proprio_projector--*"])
    weights = {pattern for pattern in asked[-1] if pattern.endswith(".safetensors")}
    assert weights == {index["projector.fc1.bias"]}
    assert "proprio_projector--*" in asked[-1]


def test_without_huggingface_hub_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(DependencyError, match="pip install huggingface_hub"):
        load_edge("hf://moojink/openvla-7b-oft-finetuned-libero-spatial")


def test_only_what_is_marked_as_a_repository_is_looked_up_on_the_hub(monkeypatch):
    """A mistyped path may look like owner/name: nobody's machine asks the hub for that."""
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for source in ("/nowhere/at/all", "owner/name", Path("owner/name"), "hf/owner"):
        with pytest.raises(CheckpointError, match="is not a checkpoint folder"):
            load_edge(source)
    with pytest.raises(CheckpointError, match="write hf://owner/name"):
        load_edge("owner/name")
    for source in (
        "hf://",
        "hf://name",
        "hf://owner/name/model",
        "hf://owner/../name",
        "hf://-a/b",
    ):
        with pytest.raises(CheckpointError, match="write hf://owner/name"):
            load_edge(source)
    assert hub.named(str(Path("hf://owner/name"))) == hub.Repository("owner/name")


def test_the_folder_of_a_split_gives_each_side_its_half(published, tmp_path):
    split_checkpoint(published, tmp_path / "split")
    edge, cloud = load_edge(tmp_path / "split"), load_cloud(tmp_path / "split")
    assert edge.info == cloud.info
    with pytest.raises(CheckpointError, match=r"holds halves of a split: name .*edge"):
        split_checkpoint(tmp_path / "split", tmp_path / "again")


def test_shapes_are_compared_without_reading(tmp_path):
    def never():
        raise AssertionError("read")

    entry = TensorEntry((2, 3), torch.float32, tmp_path, never)
    check_shapes({"a": entry}, {"a": (2, 3)}, "here", exhaustive=True)
    with pytest.raises(CheckpointError, match=r"here: tensor a has shape \(2, 3\)"):
        check_shapes({"a": entry}, {"a": (3, 2)}, "here", exhaustive=True)
