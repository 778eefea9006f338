"""Bytes and operations at the paper's scale, calculated from the model's sizes and LIBERO's real prompts.

Nothing is fitted: the sizes are OpenVLA-OFT's, the prompts are those of all forty tasks. Where the paper's numbers
contradict this or one another, :func:`inconsistencies` says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from comvla import codec
from comvla_sim.paper.published import SUITES, TABLE1, TABLE2, TABLE3, TABLE4, PaperLine
from comvla_vla.flops import (
    backbone_flops,
    cloud_flops,
    edge_flops,
    non_visual_tokens,
    projector_flops,
    vision_flops,
)
from comvla_vla.presets import openvla_oft

PROMPT_TOKENS = {
    "libero_spatial": (30, 32.2, 36),
    "libero_object": (25, 27.4, 30),
    "libero_goal": (20, 23.7, 26),
    "libero_10": (25, 30.8, 38),
}
"""Fewest, mean and most tokens of a suite's prompts, begin-of-sequence and trailing space included (Llama's tokenizer
on "In: What action should the robot take to {instruction}?\\nOut:", all ten tasks of each suite)."""

PAPER_VISION_TFLOPS = 0.83
TERA = 1e12
KIB = 1024

_CONFIG = openvla_oft()
TOKEN_DIM, NUM_TOKENS = _CONFIG.token_dim, _CONFIG.num_tokens

PICTURE_SIDE = {"deepjscc": 224, "witt": 256}
"""Pixels of a view at which the codecs' bytes are the paper's; WITT's windows do not divide 224."""


def prompt_range() -> tuple[int, int]:
    """Fewest and most tokens of any prompt."""
    low = min(fewest for fewest, _, _ in PROMPT_TOKENS.values())
    return low, max(most for _, _, most in PROMPT_TOKENS.values())


@dataclass(frozen=True)
class Span:
    """A number that depends on the length of the prompt.

    Attributes:
        low: with LIBERO's shortest prompt.
        high: with its longest.
    """

    low: float
    high: float

    def text(self, digits: int = 2) -> str:
        """For a table: one number where both ends look alike."""
        low, high = f"{self.low:.{digits}f}", f"{self.high:.{digits}f}"
        return low if low == high else f"{low}–{high}"

    def __add__(self, other: float) -> Span:
        return Span(self.low + other, self.high + other)


def vlm_tflops(k: float) -> Span:
    """Eq. (5) over 32 layers for K visual tokens and all that stands beside them."""
    return Span(
        *(backbone_flops(_CONFIG.backbone, round(k + _others(n))) / TERA for n in prompt_range())
    )


def whole_tflops(k: int) -> Span:
    """Every matrix product of both sides for K tokens selected on the robot, as this repository counts it."""
    return Span(
        *((edge_flops(_CONFIG, n - 1) + cloud_flops(_CONFIG, k, n)) / TERA for n in prompt_range())
    )


def vision_tflops() -> float:
    """Both towers over both views, without their last blocks, whose output nothing reads."""
    return vision_flops(_CONFIG) / TERA


def projector_tflops(tokens: int = NUM_TOKENS) -> float:
    """The projector, which the robot runs on all tokens to score them."""
    return projector_flops(_CONFIG, tokens) / TERA


def _others(prompt_tokens: int) -> int:
    return non_visual_tokens(_CONFIG, prompt_tokens)


def payload_kib(k: int, quantization: str) -> float:
    """The paper's K·D·B/8."""
    return codec.payload_bytes(k, TOKEN_DIM, quantization) / KIB


def wire_kib(k: int, quantization: str) -> float:
    """Everything that a robot's socket sends for K tokens: positions, scales, protobuf, gRPC, HTTP/2."""
    return (
        codec.request_wire_bytes(
            k,
            TOKEN_DIM,
            quantization,
            num_towers=2,
            session_id="x" * 20,
            instruction="pick up the black bowl between the plate and the ramekin and place it on the plate",
            proprio_dim=8,
            model_fingerprint="x" * 32,
        )
        / KIB
    )


def codec_kib(name: str) -> float:
    """The whole latent of two views in float32, of the published architecture."""
    from comvla_vla.codecs import CODECS, rate

    side = PICTURE_SIDE[name]
    return 2 * rate(CODECS[name](), side, side).latent_bytes / KIB


def codec_tflops(name: str) -> float:
    """Encoder and decoder of the published architecture for two views."""
    from comvla_vla.codecs import CODECS
    from comvla_vla.codecs.image_codec import codec_flops

    side = PICTURE_SIDE[name]
    return 2 * sum(codec_flops(CODECS[name](), side, side)) / TERA


def implied_tokens(line: PaperLine) -> float:
    """Tokens that a line's bytes stand for, at one byte a value."""
    return line.kib * KIB / TOKEN_DIM


def as_counted_by_the_paper(method: str, k: int | None) -> Span:
    """TFLOPs of a line of Table I by the paper's own method: its 0.83 for vision, Eq. (5) for the language model."""
    line = TABLE1[method, k]
    if method in PICTURE_SIDE:
        return vlm_tflops(NUM_TOKENS) + (PAPER_VISION_TFLOPS + codec_tflops(method))
    return vlm_tflops(implied_tokens(line)) + PAPER_VISION_TFLOPS


def inconsistencies() -> list[str]:
    """What does not fit together in the paper, one sentence or two each."""
    low, high = (_others(n) for n in prompt_range())
    at_512, at_32 = TABLE2["OpenVLA-OFT"]["vlm"][0], TABLE2["ComVLA"]["vlm"][0]
    n_512, n_32 = (_needed(value, k) for value, k in ((at_512, 512), (at_32, 32)))
    k128 = as_counted_by_the_paper("hard_voting", 128)
    averages = [
        f"{label} ({sum(success) / 4:.2f} printed as {average})"
        for label, success, average in _averages()
        if abs(sum(success) / 4 - average) > 0.0501
    ]
    found = [
        f"Eq. (5) needs the number of tokens beside the visual ones. LIBERO's prompts make it {low} to {high} "
        f"(prompt, proprioception, 56 action placeholders, stop). {at_512} TFLOPs at 512 tokens need {n_512:.1f}, "
        f"{at_32} at 32 need {n_32:.1f}: each lies in the range, no one number gives both.",
        f"Table I has 2.9 TFLOPs at K = 128, for ComVLA and for Random Prune. Its own Eq. (5) gives {k128.text(1)}; "
        f"2.9 would leave {_needed(2.9 - PAPER_VISION_TFLOPS, 128):.0f} tokens beside the visual ones, fewer than "
        "the 56 action placeholders alone. 2.9 is what LightVLA's line has.",
        f"Vision is 0.83 TFLOPs in the paper. Both towers over two views are {vision_tflops():.3f} "
        "(0.767 with their last blocks, which nothing reads); with the projector on all 512 tokens, which the robot "
        f"runs to score, {vision_tflops() + projector_tflops():.3f}.",
        "Table III's line of hard voting equals Table IV's FP16 line, Table I's K = 32 line equals its INT8 line: "
        "Table III was measured at FP16, Table I at INT8.",
        "The “cloud compute” that falls from 8.8 to 2.3 TFLOPs (3.8 times) includes the vision towers, which run on "
        f"the robot. The cloud's own part falls from {at_512} to {at_32}, {at_512 / at_32:.1f} times.",
        "“Cloud-side latency is dominated by autoregressive action generation”: OpenVLA-OFT decodes all 56 action "
        "values in one parallel pass. At batch size 1 a short sequence is limited by reading 13.4 GB of weights, "
        "which is why latency does not depend on K.",
        "INT4 is said to corrupt “the importance ordering”. Algorithm 1 ranks before anything is quantised, so the "
        "ordering is the same at every precision; what INT4 corrupts are the values (see Table IV below).",
        "The paper names no η, so no SNR gives its budgets. OpenVLA-OFT executes chunks of 8 actions and asks once in "
        "8 control periods, so “KB/step” is KB per query, an eighth of it per step.",
    ]
    if averages:
        found.append(
            "Averages that are not the mean of their four suites: " + "; ".join(averages) + "."
        )
    return found


def _averages() -> list[tuple[str, tuple[float, ...], float]]:
    lines: list[tuple[str, tuple[float, ...], float]] = [
        (f"{x.label} {x.config}", x.success, x.average) for x in TABLE1.values()
    ]
    lines += [(f"Table III {name}", success, mean) for name, (success, mean) in TABLE3.items()]
    return lines + [(f"Table IV {q}", success, mean) for q, (_, success, mean) in TABLE4.items()]


def _needed(tflops: float, k: int) -> float:
    """Tokens beside K visual ones at which Eq. (5) gives ``tflops``."""
    low, high = -float(k), 4096.0
    while high - low > 1e-3:
        middle = (low + high) / 2
        s, b = k + middle, _CONFIG.backbone
        value = b.layers * (
            8 * s * b.hidden**2 + 4 * s * s * b.hidden + 6 * s * b.hidden * b.intermediate
        )
        low, high = (middle, high) if value < tflops * TERA else (low, middle)
    return low


def as_dict() -> dict[str, Any]:
    """Calculated columns as plain JSON values."""
    return {
        "prompt_tokens": {suite: PROMPT_TOKENS[suite] for suite in SUITES},
        "vision_tflops": round(vision_tflops(), 4),
        "inconsistencies": inconsistencies(),
    }
