"""Where a coarse number format does its damage: the error that quantised tokens leave behind each layer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from comvla import codec
from comvla_client.selection import HardVoting, ScoringContext
from comvla_sim.experiments.layouts import evaluation_layout
from comvla_sim.experiments.rollout import expert_pictures
from comvla_sim.experiments.worker import Worker
from comvla_sim.figures.measuring import Study

FORMATS = ("float16", "int8", "int4")

MASSIVE = 50.0
"""Times by which one channel of every token is made larger before it is quantised, and smaller again behind: to the
policy nothing changes, to the number format it is a massive channel, as DINOv2's and SigLIP's features have them."""

LAYOUTS = 3
QUERIES_PER_LAYOUT = 3

_DRAWN = 0
"""Seed of the context's generator; hard voting draws nothing."""


@dataclass(frozen=True)
class Frame:
    """One query: what the robot saw and was told."""

    tokens: Any
    instruction: str
    proprio: npt.NDArray[np.float32]
    positions: npt.NDArray[np.int64]


def measure_errors(study: Study, k: int, formats: Sequence[str] = FORMATS) -> dict[str, Any]:
    """What becomes of K voted tokens in each number format, layer by layer.

    The error of a layer is ‖x_q − x‖ / ‖x‖ over all rows that enter it, x being the same with float32 tokens; the
    first is that of the tokens themselves. Frames come from experts' episodes, every instruction on some tables.

    Returns:
        ``frames``; for each format ``layers`` (name, mean relative error), ``action_error`` (mean absolute difference
        of the un-normalised actions), and ``order_overlap``: the share of the K tokens that would be chosen again by
        votes on quantised tokens, which nobody casts, because robots vote before they quantise.
    """
    worker = Worker(study.settings)
    try:
        frames = _frames(worker, study, k)
        return {
            "frames": len(frames),
            "k": k,
            "massive": MASSIVE,
            "formats": {
                name + suffix: _errors(worker, frames, name, massive)
                for suffix, massive in (("", 1.0), (" massive", MASSIVE))
                for name in formats
            },
        }
    finally:
        worker.close()


def _frames(worker: Worker, study: Study, k: int) -> list[Frame]:
    edge, world = worker.edge, worker.world
    frames = []
    for name in study.tasks:
        task = world.find_task(name)
        for episode in range(min(LAYOUTS, study.episodes)):
            layout = evaluation_layout(study.settings.seed, episode)
            film = expert_pictures(world, name, layout, edge.info.action_horizon)
            picked = np.linspace(0, len(film) - 1, QUERIES_PER_LAYOUT).astype(int)
            for pictures in (film[i] for i in dict.fromkeys(picked.tolist())):
                tokens = edge.encode(list(pictures))
                frames.append(
                    Frame(
                        tokens,
                        task.instruction,
                        world.proprio(),
                        _voted(worker, tokens, task.instruction, k),
                    )
                )
    return frames


def _errors(
    worker: Worker, frames: Sequence[Frame], quantization: str, massive: float
) -> dict[str, Any]:
    errors: dict[str, list[float]] = {}
    actions, overlaps = [], []
    for frame in frames:
        exact, plain = _run(worker, frame, "float32", 1.0)
        coarse, theirs = _run(worker, frame, quantization, massive)
        for name, value in exact.items():
            off = float(np.linalg.norm(coarse[name] - value) / np.linalg.norm(value))
            errors.setdefault(name, []).append(off)
        actions.append(float(np.abs(plain - theirs).mean()))
        overlaps.append(_order_overlap(worker, frame, quantization, massive))
    return {
        "layers": [
            {"layer": name, "error": round(float(np.mean(values)), 6)}
            for name, values in errors.items()
        ],
        "action_error": round(float(np.mean(actions)), 6),
        "order_overlap": round(float(np.mean(overlaps)), 4),
    }


def _through(
    tokens: npt.NDArray[np.float32], positions: Any, quantization: str, massive: float
) -> npt.NDArray[np.float32]:
    """Tokens (K, D) as they come out of the codec."""
    larger = np.ones(tokens.shape[1], np.float32)
    larger[np.abs(tokens).mean(axis=0).argmax()] = massive
    payload = codec.encode(
        np.ascontiguousarray(tokens * larger, np.float32), positions, quantization
    )
    decoded: npt.NDArray[np.float32] = codec.decode(payload)[0] / larger
    return decoded


def _run(
    worker: Worker, frame: Frame, quantization: str, massive: float
) -> tuple[dict[str, npt.NDArray[np.float32]], npt.NDArray[np.float32]]:
    """Rows that enter each layer, by its name, and the actions."""
    from comvla_vla import PolicyRequest

    cloud = worker.cloud
    assert cloud is not None, "both halves are here"
    sent = np.asarray(frame.tokens)[frame.positions]
    tokens = _through(sent, frame.positions.astype(np.int32), quantization, massive)
    seen: dict[str, npt.NDArray[np.float32]] = {"tokens as sent": tokens}

    def note(name: str, value: Any) -> None:
        seen[name] = value.detach().float().cpu().numpy()

    net = cloud.net
    layers: list[Any] = list(net.backbone.layers)
    hooks = [
        net.projector.register_forward_hook(lambda m, i, out: note("projected tokens", out)),
        *(
            layer.input_layernorm.register_forward_pre_hook(
                lambda m, given, n=number: note(f"into layer {n}", given[0]) if n > 1 else None
            )
            for number, layer in enumerate(layers, start=1)
        ),
        net.backbone.norm.register_forward_pre_hook(
            lambda m, given: note(f"out of layer {len(layers)}", given[0])
        ),
    ]
    try:
        (actions,) = cloud.predict(
            [PolicyRequest(tokens, frame.positions, frame.instruction, frame.proprio)]
        )
    finally:
        for hook in hooks:
            hook.remove()
    return seen, actions


def _order_overlap(worker: Worker, frame: Frame, quantization: str, massive: float) -> float:
    """How many of the K tokens votes would name again if they were cast on quantised tokens."""
    import torch

    everywhere = np.arange(len(frame.tokens), dtype=np.int32)
    values = _through(np.asarray(frame.tokens), everywhere, quantization, massive)
    coarse = torch.from_numpy(values)
    again = _voted(worker, coarse, frame.instruction, len(frame.positions))
    return len(np.intersect1d(frame.positions, again)) / len(frame.positions)


def _voted(worker: Worker, tokens: Any, instruction: str, k: int) -> npt.NDArray[np.int64]:
    """Positions of the K tokens (N, D) with most votes."""
    edge = worker.edge
    context = ScoringContext(
        tokens,
        edge.project(tokens),
        edge.text_queries(instruction),
        edge.info.grid,
        np.random.default_rng(_DRAWN),
    )
    return np.asarray(HardVoting().rank(context))[:k].astype(np.int64)
