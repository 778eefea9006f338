"""The paper's claims about what a query costs: bytes, operations, time."""

from __future__ import annotations

from comvla_sim.paper import analytic
from comvla_sim.paper.cells import Cell
from comvla_sim.paper.claim import Claim
from comvla_sim.paper.published import TABLE_K
from comvla_sim.paper.results import Results
from comvla_sim.paper.table1 import FULL
from comvla_sim.paper.verdicts import AGREES, UNTESTED, Verdict

_HARD = Cell("hard_voting", TABLE_K)


def size(results: Results) -> Claim | None:
    """Bytes of 32 tokens against all of them."""
    full, hard = results.find(FULL), results.find(_HARD)
    calculated = analytic.payload_kib(512, "int8") / analytic.payload_kib(32, "int8")
    measured = ""
    if full and hard:
        measured = (
            f"; measured on the wire here {full['wire_bytes'] / hard['wire_bytes']:.1f} times"
        )
    return (
        "16 times fewer bytes, 1088 KB to 68 KB",
        f"{calculated:.0f} times by K·D·B, {analytic.wire_kib(512, 'int8') / analytic.wire_kib(32, 'int8'):.1f} times "
        "with "
        f"all framing at the paper's size{measured}",
        Verdict(AGREES),
    )


def operations() -> Claim:
    """Operations with 32 tokens against all of them."""
    vision = analytic.vision_tflops()
    spans = [analytic.vlm_tflops(k) + vision for k in (512, 32)]
    ratio = [a / b for a, b in ((spans[0].low, spans[1].low), (spans[0].high, spans[1].high))]
    here = (
        f"{spans[0].text(1)} to {spans[1].text(1)} TFLOPs, {min(ratio):.1f} to {max(ratio):.1f} times, depending on "
        "the "
        "prompt; the figure includes the robot's vision"
    )
    return "Compute falls 3.8 times, by 74 %", here, Verdict(AGREES, "within the prompts' range")


def latency() -> Claim:
    """Time of a query."""
    why = "needs an H100 and the 7.5 G model; docs/openvla-oft.md has both halves on a CPU"
    return "Inference latency falls by 22 %", "–", Verdict(UNTESTED, why)
