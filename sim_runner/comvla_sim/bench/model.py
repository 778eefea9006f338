"""One half of the policy at full size: time and memory, next to what bare matrix products take in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from comvla_sim.bench import environment, resident
from comvla_sim.bench.hf_layer import hf_layer
from comvla_sim.bench.random_weights import random_half, weight_bytes
from comvla_sim.bench.timing import Clock, Timing, durations, paired_ratio
from comvla_vla import CloudModel, CloudOptions, PolicyRequest
from comvla_vla.backbone import Layer, rotary_tables
from comvla_vla.config import ModelConfig
from comvla_vla.flops import backbone_flops, non_visual_tokens
from comvla_vla.linear import cpu_multiplies_bfloat16
from comvla_vla.presets import mini, openvla_oft

SIZES: dict[str, Callable[[], ModelConfig]] = {"7b": openvla_oft, "mini": mini}


@dataclass(frozen=True)
class ModelParameters:
    """What is measured.

    Attributes:
        size: ``"7b"`` (OpenVLA-OFT) or ``"mini"``. half: which one.
        device, dtype: where and in which number format. compile: through torch.compile (cloud half).
        token_budgets: K, visual tokens of a request (cloud half).
        prompt_tokens: length of the prompt, begin-of-sequence included; LIBERO's have 20 to 38.
        layers: of the backbone, 0 for all: a few take little memory and give the same ratios.
        threads: of torch, 0 for its own choice.
        cpu_time: seconds of processor time instead of wall time, where others share the machine; with one thread,
            because threads that wait for one another count as busy.
        repetitions: timed calls. warm_up: calls before them. seed: of weights and tokens.
    """

    size: str = "mini"
    half: Literal["cloud", "edge"] = "cloud"
    device: str = "cpu"
    dtype: str = "bfloat16"
    compile: bool = False
    token_budgets: tuple[int, ...] = (512, 128, 64, 32, 16)
    prompt_tokens: int = 30
    layers: int = 0
    threads: int = 0
    cpu_time: bool = False
    repetitions: int = 3
    warm_up: int = 1
    seed: int = 0

    @property
    def config(self) -> ModelConfig:
        """Sizes of the model."""
        config = SIZES[self.size]()
        layers = self.layers or config.backbone.layers
        return replace(config, backbone=replace(config.backbone, layers=layers))

    @property
    def clock(self) -> Clock:
        """What tells seconds."""
        return time.process_time if self.cpu_time else time.perf_counter


def run(parameters: ModelParameters) -> dict[str, Any]:
    """Measures one half; see :func:`run_cloud` and :mod:`comvla_sim.bench.model_edge`.

    Raises:
        CheckpointError: too little memory.
    """
    if parameters.threads:
        torch.set_num_threads(parameters.threads)
    if parameters.half == "edge":
        from comvla_sim.bench.model_edge import run_edge

        return run_edge(parameters, parameters.config)
    return run_cloud(parameters, parameters.config)


@torch.inference_mode()
def run_cloud(parameters: ModelParameters, config: ModelConfig) -> dict[str, Any]:
    """The whole cloud half, resident: seconds and peak memory for each K.

    Limits, measured in turns with the model: its own matrix products and nothing else, on the same weights with the
    same numbers of rows; and one layer of Hugging Face transformers (eager), where that is installed.

    Returns:
        An object with ``environment``, ``parameters``, ``rows`` and ratios, JSON-able.
    """
    dtype = getattr(torch, parameters.dtype)
    options = CloudOptions(compile=parameters.compile)
    before = resident.now_bytes()
    resident.forget_peak()
    model = random_half("cloud", config, parameters.device, dtype, parameters.seed, options)
    assert isinstance(model, CloudModel)
    weights = weight_bytes(model.net, dtype)
    rows = [_cloud_row(model, parameters, k) for k in parameters.token_budgets]
    theirs = hf_layer(config.backbone, parameters.device, dtype, parameters.seed)
    if theirs is not None:
        for row in rows:
            row |= _against(theirs, model, row["sequence"], parameters)
    by_tokens = {row["tokens"]: row for row in rows}
    result = {
        "bench": "model",
        "environment": environment.describe(),
        "threads": torch.get_num_threads(),
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "cpu_multiplies_bfloat16": cpu_multiplies_bfloat16(),
        "parameters": asdict(parameters),
        "weight_bytes": weights,
        "resident_before_bytes": before,
        "peak_bytes": max(row["peak_bytes"] for row in rows),
        "peak_ratio": max(row["peak_bytes"] for row in rows) / weights,
        "transformers": "eager Llama layer, same sizes"
        if theirs
        else "not installed, not compared",
        "rows": rows,
    }
    if {512, 32} <= set(by_tokens):
        long, short = by_tokens[512], by_tokens[32]
        result["time_512_over_32"] = long["median_s"] / short["median_s"]
        result["flops_512_over_32"] = long["backbone_flops"] / short["backbone_flops"]
    return result


def _cloud_row(model: CloudModel, parameters: ModelParameters, k: int) -> dict[str, Any]:
    config = model.config
    rng = np.random.default_rng((parameters.seed, k))
    request = PolicyRequest(
        rng.standard_normal((k, config.token_dim), np.float32),
        rng.permutation(config.num_tokens)[:k],
        [1] * parameters.prompt_tokens,
        np.zeros(config.action.proprio_dim, np.float32),
    )
    length = k + non_visual_tokens(config, parameters.prompt_tokens)
    resident.forget_peak()
    model.predict([request])
    peak = resident.peak_bytes()
    found = durations(
        {
            "model": lambda: model.predict([request]),
            "products": _bare_products(model.net, k, length),
        },
        repetitions=parameters.repetitions,
        warm_up=parameters.warm_up,
        clock=parameters.clock,
    )
    mine, products = Timing.of(found["model"]), Timing.of(found["products"])
    flops = model.flops(k, [1] * parameters.prompt_tokens)
    return {
        "name": f"K = {k}",
        "tokens": k,
        "sequence": length,
        **asdict(mine),
        "products_s": products.median_s,
        "ratio_to_products": paired_ratio(found["model"], found["products"]),
        "flops": flops,
        "backbone_flops": backbone_flops(config.backbone, length),
        "tflops_per_s": flops / mine.median_s / 1e12,
        "peak_bytes": peak,
    }


def _bare_products(net: nn.Module, visual: int, length: int) -> Callable[[], None]:
    """Every linear layer of the cloud half once, with as many rows as it really gets, and nothing in between.

    The product is the quickest that there is here, see :mod:`comvla_vla.linear`.
    """
    calls: list[tuple[nn.Linear, Tensor]] = []
    for name, module in net.named_modules():
        if isinstance(module, nn.Linear):
            count = length
            if name.startswith("projector."):
                count = visual
            elif not name.startswith("backbone."):
                count = 8 if name.startswith("action_head") else 1
            rows = torch.randn(count, module.in_features).to(module.weight)
            calls.append((module, rows))

    def products() -> None:
        for linear, rows in calls:
            linear(rows)

    return products


def _against(
    theirs: Callable[[Tensor], Tensor], model: CloudModel, length: int, parameters: ModelParameters
) -> dict[str, float]:
    """One layer of ours and of theirs on the same rows, in turns."""
    config = model.config.backbone
    layer = model.net.backbone.layers[0]
    assert isinstance(layer, Layer)
    rows = torch.randn(length, config.hidden).to(model.device, model.dtype)
    cos, sin = rotary_tables(torch.arange(length, device=model.device), config, model.dtype)
    began = time.perf_counter()
    theirs(rows)
    quick = int(5 / (time.perf_counter() - began))
    found = durations(
        {"ours": lambda: layer(rows, cos, sin, [length]), "theirs": lambda: theirs(rows)},
        repetitions=max(min(10, quick), parameters.repetitions),
        warm_up=1,
        clock=parameters.clock,
    )
    ours, other = Timing.of(found["ours"]).median_s, Timing.of(found["theirs"]).median_s
    return {
        "layer_s": ours,
        "hf_layer_s": other,
        "layer_over_hf": paired_ratio(found["ours"], found["theirs"]),
    }
