"""FastV inside the packed backbone against a plain eager transformer that masks nothing and packs nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from comvla_vla import CloudModel, CloudOptions, FastV, PolicyRequest, random_policy
from comvla_vla.flops import backbone_flops, cloud_flops


def eager_layer(layer, x: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """One Llama layer written out, with the attention weights (heads, L, L)."""
    config = layer.self_attn.config
    heads, width = config.heads, config.head_dim

    def norm(rows, module):
        return rows / (rows.square().mean(-1, keepdim=True) + module.eps).sqrt() * module.weight

    angle = at[:, None] * config.rope_theta ** (-torch.arange(0, width, 2) / width)
    cos, sin = torch.cat([angle.cos()] * 2, -1), torch.cat([angle.sin()] * 2, -1)

    def turn(rows):
        swapped = torch.cat([-rows[..., width // 2 :], rows[..., : width // 2]], -1)
        return rows * cos + swapped * sin

    wq, wk, wv = layer.self_attn.qkv_proj.weight.chunk(3)
    y = norm(x, layer.input_layernorm)
    q, k, v = ((y @ w.T).view(-1, heads, width).transpose(0, 1) for w in (wq, wk, wv))
    weights = (turn(q) @ turn(k).transpose(1, 2) / math.sqrt(width)).softmax(-1)
    x = x + (weights @ v).transpose(0, 1).flatten(1) @ layer.self_attn.o_proj.weight.T
    y = norm(x, layer.post_attention_layernorm)
    gate, up = (y @ layer.mlp.gate_up_proj.weight.T).chunk(2, -1)
    return x + (torch.nn.functional.silu(gate) * up) @ layer.mlp.down_proj.weight.T, weights


def eager_fastv(backbone, x: Tensor, at: Tensor, visual: int, fastv: FastV) -> Tensor:
    """Ranks visual tokens by the attention of layer K - 1 before layer K runs."""
    weights = None
    for index, layer in enumerate(backbone.layers):
        if index == fastv.layer:
            seen = weights.mean(0)[-1, 1 : 1 + visual]
            keep = seen.topk(round(visual * (1 - fastv.drop_ratio))).indices.sort().values + 1
            rows = torch.cat([torch.tensor([0]), keep, torch.arange(1 + visual, len(x))])
            x, at = x[rows], at[rows]
        x, weights = eager_layer(layer, x, at)
    return x / (x.square().mean(-1, keepdim=True) + backbone.norm.eps).sqrt() * backbone.norm.weight


@pytest.fixture(scope="module")
def policy():
    return random_policy(seed=11)


@pytest.mark.parametrize("fastv", [FastV(1, 0.5), FastV(2, 0.75), FastV(2, 0.0)])
def test_packed_sequences_keep_what_the_eager_transformer_keeps(policy, fastv):
    backbone = policy[1].net.backbone
    generator = torch.Generator().manual_seed(0)
    sequences = [
        (torch.randn(n, 192, generator=generator), visual)
        for n, visual in ((90, 40), (90, 60), (140, 101))
    ]
    places = [
        torch.randperm(600, generator=generator)[: len(x)].sort().values for x, _ in sequences
    ]
    with torch.no_grad():
        hidden, lengths = backbone(
            torch.cat([x for x, _ in sequences]),
            torch.cat(places),
            [len(x) for x, _ in sequences],
            [visual for _, visual in sequences],
            fastv,
        )
        for ours, (x, visual), at in zip(hidden.split(lengths), sequences, places, strict=True):
            want = eager_fastv(backbone, x, at, visual, fastv)
            assert ours.shape == want.shape
            torch.testing.assert_close(ours, want, atol=5e-5, rtol=0)


def test_it_changes_actions_and_costs_less_but_needs_all_tokens(policy):
    _, cloud = policy
    pruned = CloudModel(
        cloud.net, cloud.prompt, cloud.statistics, cloud.info, CloudOptions(fastv=FastV(1, 0.75))
    )
    tokens = np.random.default_rng(0).standard_normal((512, 96)).astype(np.float32)
    request = PolicyRequest(tokens, np.arange(512), "press the button", np.zeros(4, np.float32))
    assert np.abs(pruned.predict([request])[0] - cloud.predict([request])[0]).max() > 1e-4
    full, fewer = cloud.flops(512, "press the button"), pruned.flops(512, "press the button")
    rest = cloud_flops(cloud.config, 512, 4) - backbone_flops(cloud.config.backbone, 512 + 38)
    assert fewer < 0.6 * full
    assert fewer - rest == pytest.approx(
        (full - rest) / 3 + 2 / 3 * backbone_flops(cloud.config.backbone, 128 + 38), rel=1e-9
    )


def test_switches_that_make_no_sense_are_refused():
    for arguments in ((0, 0.5), (2, 1.0), (2, -0.1)):
        with pytest.raises(ValueError, match="FastV needs"):
            FastV(*arguments)
