"""Our towers, projector, backbone and head against the reference implementation's outputs, stage by stage.

The reference data are not part of the repository; these tests are skipped where they are not at hand.
"""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from comvla_vla.config import ModelConfig
from comvla_vla.naming import load_published
from comvla_vla.nets import join
from comvla_vla.presets import openvla_oft
from comvla_vla.statistics import pick_statistics
from comvla_vla.vision import TOWER_NAMES

GOLDEN = Path(os.environ.get("COMVLA_GOLDEN", Path(__file__).parents[3] / "shared" / "golden"))
pytestmark = pytest.mark.skipif(
    not (GOLDEN / "golden_oft_fp32.npz").is_file(),
    reason="no reference data: point COMVLA_GOLDEN at the folder with golden_oft_fp32.npz",
)
TOLERANCE = 5e-5


def tiny_config() -> ModelConfig:
    """The published layout with the sizes of the reference data."""
    config = openvla_oft()
    dino, siglip = config.towers
    return replace(
        config,
        towers=(
            replace(dino, dim=32, depth=4, heads=4, mlp_dim=128),
            replace(siglip, dim=48, depth=5, heads=4, mlp_dim=179),
        ),
        backbone=replace(config.backbone, hidden=64, intermediate=172, layers=2, heads=4),
        action=replace(config.action, head_hidden=64),
    )


@pytest.fixture(scope="module")
def golden():
    return {
        k: v for f in ("inputs", "golden_oft_fp32") for k, v in np.load(GOLDEN / f"{f}.npz").items()
    }


@pytest.fixture(scope="module")
def halves():
    folder = GOLDEN / "ckpt_oft"
    tensors = load_file(folder / "model.safetensors")
    for module in ("action_head", "proprio_projector"):
        side = torch.load(folder / f"{module}--latest_checkpoint.pt", weights_only=True)
        tensors |= {
            f"{module}.{name.removeprefix('module.')}": value for name, value in side.items()
        }
    edge, cloud = join(tiny_config())
    with torch.no_grad():
        load_published(edge, tensors, "reference")
        load_published(cloud, tensors, "reference")
    return edge.eval(), cloud.eval()


def close(ours: torch.Tensor, reference: np.ndarray) -> None:
    np.testing.assert_allclose(ours.detach().numpy(), reference, atol=TOLERANCE, rtol=0)


def test_epsilons_are_the_published_ones(halves):
    """At the tolerance of these tests a wrong epsilon would pass unseen."""
    edge, cloud = halves
    assert cloud.backbone.norm.eps == cloud.backbone.layers[1].input_layernorm.eps == 1e-6
    assert all(
        edge.vision_backbone.get_submodule(n).blocks[0].norm1.eps == 1e-6 for n in TOWER_NAMES
    )
    assert cloud.action_head.layer_norm1.eps == cloud.action_head.layer_norm2.eps == 1e-5


def test_towers_and_projector(halves, golden):
    edge, _ = halves
    pixels = torch.from_numpy(golden["pixel_values"]).view(1, 2, 6, 224, 224)
    tokens = edge.vision_backbone(pixels)
    close(tokens, golden["patch_features"])
    close(edge.projector(tokens), golden["projected"])


def test_proprioception(halves, golden):
    _, cloud = halves
    table = json.loads((GOLDEN / "ckpt_oft" / "dataset_statistics.json").read_text())
    bounds = pick_statistics(table, None, "reference")
    state = bounds.normalise_proprio(golden["state_raw"])
    np.testing.assert_allclose(state, golden["proprio_normalized"], atol=1e-6)
    close(cloud.proprio_projector(torch.from_numpy(state)[None]), golden["proprio_token"])


def test_actions_from_the_whole_sequence(halves, golden):
    _, cloud = halves
    ids = torch.from_numpy(np.append(golden["prompt_ids"], 29871))
    projected = torch.from_numpy(golden["projected"])[0]
    state = torch.from_numpy(golden["proprio_in"])
    actions, _ = cloud([projected], [torch.arange(512)], [ids], state)
    close(actions[0], golden["normalized_actions"])
    table = json.loads((GOLDEN / "ckpt_oft" / "dataset_statistics.json").read_text())
    real = pick_statistics(table, None, "reference").unnormalise_actions(
        actions[0].detach().numpy()
    )
    np.testing.assert_allclose(real, golden["actions"], atol=TOLERANCE)
