"""The model bench measures real halves, and its full-size figures need no full-size memory to be checked."""

from __future__ import annotations

import json

import pytest
import torch

from comvla.errors import CheckpointError
from comvla_sim import cli
from comvla_sim.bench import model, random_weights
from comvla_sim.bench.model_edge import count_vision_flops
from comvla_sim.bench.report import describe
from comvla_vla.checkpoints import memory
from comvla_vla.presets import mini, openvla_oft


def test_cloud_half(capsys):
    arguments = ["--size", "mini", "--k", "512,32", "--repetitions", "1", "--json"]
    assert cli.main(["bench", "model", *arguments]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [(row["tokens"], row["sequence"]) for row in result["rows"]] == [(512, 576), (32, 96)]
    assert result["flops_512_over_32"] == pytest.approx(
        result["rows"][0]["backbone_flops"] / result["rows"][1]["backbone_flops"]
    )
    for row in result["rows"]:
        assert row["ratio_to_products"] == pytest.approx(row["median_s"] / row["products_s"])
    text = describe(result)
    assert "K = 512 over K = 32" in text
    assert "x products" in text


def test_fewer_layers_and_processor_time(capsys):
    arguments = ["--size", "mini", "--layers", "1", "--k", "32", "--repetitions", "3"]
    arguments += ["--cpu-time", "--threads", "1"]
    assert cli.main(["bench", "model", *arguments]) == 0
    assert "seconds of processor time" in capsys.readouterr().out
    whole = model.ModelParameters(size="mini").config.backbone.layers
    assert model.ModelParameters(size="mini", layers=1).config.backbone.layers == 1 < whole


def test_edge_half():
    result = model.run(model.ModelParameters(half="edge", dtype="float32", repetitions=2))
    phases = [row["name"] for row in result["rows"]]
    assert phases == ["preprocess", "encode", "project", "vote", "select", "step"]
    assert result["vision_flops_counted"] == pytest.approx(result["vision_flops"])
    assert "by torch's counter" in describe(result)


def test_vision_flops_of_the_full_size_towers():
    """The paper says 0.83; the towers as they are run here come to 0.737."""
    assert count_vision_flops(openvla_oft()) / 1e12 == pytest.approx(0.737, abs=0.003)


def test_too_little_memory_is_said_before_anything_is_allocated(monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: 4 * 10**9)
    with pytest.raises(CheckpointError, match=r"needs 14 GB of memory \(13\.7 GB for weights\)"):
        random_weights.random_half("cloud", openvla_oft(), "cpu", torch.bfloat16, 0)


def test_weights_repeat_from_run_to_run():
    one, two = (
        random_weights.random_half("cloud", mini(), "cpu", torch.float32, 5) for _ in range(2)
    )
    weights = one.net.backbone.layers[2].mlp.down_proj.weight
    assert torch.equal(weights, two.net.backbone.layers[2].mlp.down_proj.weight)
    assert float(weights.std()) == pytest.approx(320**-0.5, rel=0.05)
