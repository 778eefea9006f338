"""bfloat16 on a processor without instructions for it: the same numbers, and the same answers of a model."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from comvla_vla import PolicyRequest, linear
from comvla_vla.linear import Linear, widened_linear
from comvla_vla.random import random_policy


@settings(max_examples=30, deadline=None)
@given(
    rows=st.lists(st.integers(1, 5), max_size=2),
    width=st.integers(1, 70),
    out=st.sampled_from([1, 511, 512, 513, 1100]),
    bias=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_rounded_once_from_the_exact_product(rows, width, out, bias, seed):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(*rows, width, generator=generator).bfloat16()
    weight = torch.randn(out, width, generator=generator).bfloat16()
    offset = torch.randn(out, generator=generator).bfloat16() if bias else None
    exact = x.double() @ weight.double().T + (0 if offset is None else offset.double())
    ours = widened_linear(x, weight, offset)
    assert ours.shape == exact.shape
    assert ours.dtype == torch.bfloat16
    # Half a step of eight significant bits, and what float32 loses on the way.
    bound = exact.abs() * 2**-8 + 1e-5 * width
    assert ((ours.double() - exact).abs() <= bound).all()


@pytest.mark.parametrize("native", [False, True])
def test_a_layer_takes_the_way_that_the_processor_is_quick_at(monkeypatch, native):
    monkeypatch.setattr(linear, "cpu_multiplies_bfloat16", lambda: native)
    ways = []
    monkeypatch.setattr(linear, "widened_linear", lambda x, w, b: ways.append("wide") or x @ w.T)
    layer = Linear(8, 4)
    layer(torch.ones(2, 8))
    assert ways == [], "float32 needs no help"
    layer.bfloat16()(torch.ones(2, 8).bfloat16())
    assert ways == ([] if native else ["wide"])


def test_both_ways_answer_alike(monkeypatch):
    request = PolicyRequest(
        np.random.default_rng(1).standard_normal((40, 96), np.float32),
        np.arange(40),
        "press the button",
        np.zeros(4, np.float32),
    )
    answers = []
    for native in (False, True):
        for module in ("comvla_vla.linear", "comvla_vla.attention"):
            monkeypatch.setattr(f"{module}.cpu_multiplies_bfloat16", lambda native=native: native)
        cloud = random_policy(seed=2)[1]
        cloud.net.bfloat16()
        cloud.dtype = torch.bfloat16
        answers.append(cloud.predict([request])[0])
    np.testing.assert_allclose(answers[0], answers[1], atol=5e-2)
    assert not np.array_equal(*answers), "the two ways were both taken"
