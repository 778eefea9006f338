"""The robot's half at full size: seconds of each phase, peak memory, and operations counted by torch."""

from __future__ import annotations

from dataclasses import asdict
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from comvla_client.scoring import hard_importance
from comvla_client.selection import select
from comvla_sim.bench import environment, resident
from comvla_sim.bench.random_weights import random_half, weight_bytes
from comvla_sim.bench.timing import Clock, Timing
from comvla_vla import EdgeModel
from comvla_vla.checkpoints.accounting import empty_half
from comvla_vla.config import ModelConfig
from comvla_vla.flops import edge_flops, vision_flops
from comvla_vla.nets import EdgeNet

if TYPE_CHECKING:
    from comvla_sim.bench.model import ModelParameters

PHASES = ("preprocess", "encode", "project", "vote", "select")
PAPER_VISION_TFLOPS = 0.83
_TOKEN_BUDGET = 32
_CAMERA_SIDE = 256


@torch.inference_mode()
def run_edge(parameters: ModelParameters, config: ModelConfig) -> dict[str, Any]:
    """Encode, project, vote and select on random pictures.

    Returns:
        An object with ``environment``, ``parameters``, ``rows`` (one per phase) and FLOPs, JSON-able.

    Raises:
        CheckpointError: too little memory.
    """
    dtype = getattr(torch, parameters.dtype)
    before = resident.now_bytes()
    resident.forget_peak()
    model = random_half("edge", config, parameters.device, dtype, parameters.seed)
    assert isinstance(model, EdgeModel)
    rng = np.random.default_rng(parameters.seed)
    side = _CAMERA_SIDE if model.any_image_size else config.towers[0].image_size
    pictures = [rng.integers(0, 256, (side, side, 3), dtype=np.uint8) for _ in range(config.views)]
    ids = torch.arange(parameters.prompt_tokens - 1) % config.backbone.vocab
    durations_s: dict[str, list[float]] = {phase: [] for phase in PHASES}
    for repetition in range(parameters.warm_up + parameters.repetitions):
        laps = _one_step(model, pictures, ids, parameters.clock)
        if repetition >= parameters.warm_up:
            for phase, seconds in zip(PHASES, laps, strict=True):
                durations_s[phase].append(seconds)
    weights = weight_bytes(model.net, dtype)
    peak = resident.peak_bytes()
    timings = {phase: Timing.of(values) for phase, values in durations_s.items()}
    timings["step"] = Timing.of(np.sum(list(durations_s.values()), axis=0))
    return {
        "bench": "model",
        "environment": environment.describe(),
        "threads": torch.get_num_threads(),
        "parameters": asdict(parameters),
        "weight_bytes": weights,
        "resident_before_bytes": before,
        "peak_bytes": peak,
        "peak_ratio": peak / weights,
        "vision_flops": vision_flops(config),
        "vision_flops_counted": count_vision_flops(config),
        "paper_vision_tflops": PAPER_VISION_TFLOPS if parameters.size == "7b" else None,
        "edge_flops": edge_flops(config, len(ids)),
        "rows": [{"name": phase, **asdict(timing)} for phase, timing in timings.items()],
    }


def count_vision_flops(config: ModelConfig) -> int:
    """What torch's own counter sees in the towers, all views; nothing is computed (meta device)."""
    net = empty_half("edge", config)
    assert isinstance(net, EdgeNet)
    side = config.towers[0].image_size
    pixels = torch.empty(1, config.views, 3 * len(config.towers), side, side, device="meta")
    # The counter does not know the fused attention kernel of CPUs.
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        net.vision_backbone(pixels)
    return int(counter.get_total_flops())


def _one_step(
    model: EdgeModel, pictures: list[Any], ids: torch.Tensor, clock: Clock
) -> list[float]:
    """Seconds of each phase."""
    marks = [clock()]
    pixels = model.preprocess(pictures)
    marks.append(clock())
    tokens = model.vision(pixels)
    marks.append(clock())
    projected = model.project(tokens)
    marks.append(clock())
    queries = model.net.queries(ids.to(model.device)).float().cpu()
    importance = hard_importance(queries, projected)
    marks.append(clock())
    select(importance, _TOKEN_BUDGET)
    marks.append(clock())
    return [after - before for before, after in pairwise(marks)]
