"""Low-rank adapters are merged: W + (alpha / r) B A."""

from __future__ import annotations

import json
import shutil

import pytest
import torch
from published_folder import SIDE_MODULES, random_tensors, write_published
from safetensors.torch import save_file

from comvla.errors import CheckpointError
from comvla_vla import load_cloud, load_edge
from comvla_vla.checkpoints import open_checkpoint

LAYER = "language_model.model.layers.1.self_attn.q_proj"
CONFIG = {"peft_type": "LORA", "r": 4, "lora_alpha": 2, "target_modules": "all-linear"}


@pytest.fixture(scope="module")
def tensors():
    return random_tensors()


@pytest.fixture
def factors():
    generator = torch.Generator().manual_seed(3)
    return (
        torch.randn(4, 16, generator=generator),
        torch.randn(16, 4, generator=generator),
    )


def write_adapter(folder, factors, **changes):
    folder.mkdir(parents=True)
    (folder / "adapter_config.json").write_text(json.dumps(CONFIG | changes))
    a, b = factors
    names = {
        f"base_model.model.{LAYER}.lora_A.weight": a,
        f"base_model.model.{LAYER}.lora_B.weight": b,
    }
    save_file(names, folder / "adapter_model.safetensors")


def adapted_folder(tmp_path, tensors, factors, **changes):
    """A base checkpoint, and a folder of side files with an adapter that was never merged."""
    base = write_published(tmp_path / "base", tensors)
    tuned = tmp_path / "tuned"
    write_adapter(tuned / "lora_adapter", factors, **changes)
    for module in SIDE_MODULES[:2]:
        name = f"{module}--latest_checkpoint.pt"
        shutil.move(base / name, tuned / name)
    shutil.copy(base / "dataset_statistics.json", tuned)
    return base, tuned


def merged(tensors, factors, scale):
    a, b = factors
    return (tensors[f"{LAYER}.weight"].float() + scale * b @ a).to(torch.bfloat16)


def test_an_unmerged_adapter_is_merged_into_its_base(tensors, factors, tmp_path):
    base, tuned = adapted_folder(tmp_path, tensors, factors)
    entries = open_checkpoint(tuned, "whole", base=base).tensors
    assert torch.equal(entries[f"{LAYER}.weight"].read(), merged(tensors, factors, 2 / 4))
    untouched = "language_model.model.layers.1.self_attn.k_proj.weight"
    assert torch.equal(entries[untouched].read(), tensors[untouched])
    row = load_cloud(tuned, base=base).net.backbone.layers[1].self_attn.qkv_proj.weight[:16]
    assert torch.equal(row, merged(tensors, factors, 2 / 4).float())


def test_the_base_may_be_named_by_the_adapter(tensors, factors, tmp_path):
    base, tuned = adapted_folder(
        tmp_path, tensors, factors, base_model_name_or_path=str(tmp_path / "base")
    )
    assert load_edge(tuned).info == load_edge(tuned, base=base).info


def test_an_adapter_beside_merged_weights_is_not_merged_again(tensors, factors, tmp_path):
    """OpenVLA-OFT publishes the merged weights and leaves the adapter in the folder."""
    source = write_published(tmp_path / "oft", tensors)
    write_adapter(source / "lora_adapter", factors)
    entries = open_checkpoint(source, "whole").tensors
    assert torch.equal(entries[f"{LAYER}.weight"].read(), tensors[f"{LAYER}.weight"])


def film_file(tensors, *, wrapped: bool, generator: torch.Generator):
    """A FiLM vision file, with one layer still wrapped by its adapter."""
    table, added = {}, {}
    for name, value in tensors.items():
        if name.startswith("vision_backbone."):
            parts = name.split(".")
            if parts[2] == "blocks":
                name = ".".join([*parts[:4], "block", *parts[4:]])
            table[name] = value
    for tower, dim in (("featurizer", 8), ("fused_featurizer", 12)):
        for block in range(3):
            for part in ("scale", "shift"):
                prefix = f"vision_backbone.{tower}.blocks.{block}.{part}"
                table[f"{prefix}.weight"] = torch.randn(dim, 16, generator=generator)
                table[f"{prefix}.bias"] = torch.randn(dim, generator=generator)
    layer = "vision_backbone.featurizer.blocks.0.block.attn.proj"
    a, b = torch.randn(32, 8, generator=generator), torch.randn(8, 32, generator=generator)
    base = table.pop(f"{layer}.weight")
    bias = table.pop(f"{layer}.bias")
    if wrapped:
        added = {
            f"{layer}.base_layer.weight": base,
            f"{layer}.base_layer.bias": bias,
            f"{layer}.lora_A.default.weight": a,
            f"{layer}.lora_B.default.weight": b,
        }
    else:
        # r = 32 and alpha = min(r, 16), as OpenVLA-OFT trains.
        added = {
            f"{layer}.weight": (base.float() + 0.5 * b @ a).to(base.dtype),
            f"{layer}.bias": bias,
        }
    return table | added


def test_a_film_file_with_wrapped_layers_equals_the_merged_one(tensors, tmp_path):
    halves = []
    for wrapped in (True, False):
        source = write_published(tmp_path / f"film{wrapped}", tensors)
        generator = torch.Generator().manual_seed(1)
        table = film_file(tensors, wrapped=wrapped, generator=generator)
        torch.save(table, source / "vision_backbone--latest_checkpoint.pt")
        halves.append(load_edge(source))
    pixels = torch.randn(2, 6, 28, 28)
    assert halves[0].sees_instruction
    one, other = (edge.vision(pixels, "push the plate") for edge in halves)
    assert torch.equal(one, other)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"peft_type": "LOHA"}, "only plain LoRA"),
        ({"use_dora": True}, "use_dora"),
        ({"r": 0}, "odd values"),
        ({"lora_alpha": None}, "cannot read the adapter"),
    ],
)
def test_variants_that_a_plain_merge_gets_wrong_are_refused(
    tensors, factors, tmp_path, changes, words
):
    base, tuned = adapted_folder(tmp_path, tensors, factors, **changes)
    with pytest.raises(CheckpointError, match=words):
        open_checkpoint(tuned, "whole", base=base)


def test_an_adapter_that_does_not_fit_is_refused(tensors, factors, tmp_path):
    a, b = factors
    base, tuned = adapted_folder(tmp_path / "1", tensors, (a[:, :8].contiguous(), b))
    with pytest.raises(CheckpointError, match="belongs to another checkpoint"):
        open_checkpoint(tuned, "whole", base=base)
    base, tuned = adapted_folder(tmp_path / "2", tensors, factors)
    path = tuned / "lora_adapter/adapter_model.safetensors"
    save_file({f"base_model.model.{LAYER}.lora_A.weight": a}, path)
    with pytest.raises(CheckpointError, match=r"incomplete, found \['A', 'base'\]"):
        open_checkpoint(tuned, "whole", base=base)
    save_file({"base_model.model.lm_head.weight": a}, path)
    with pytest.raises(CheckpointError, match="not a low-rank factor"):
        open_checkpoint(tuned, "whole", base=base)
    with pytest.raises(CheckpointError, match="name their checkpoint"):
        open_checkpoint(tuned, "whole")
