"""The paper's claims about what a query costs: bytes, operations, time."""

from __future__ import annotations

from comvla_sim.paper import analytic
from comvla_sim.paper.cells import Cell
from comvla_sim.paper.claim import Claim, worst
from comvla_sim.paper.published import TABLE_K
from comvla_sim.paper.results import Results
from comvla_sim.paper.table1 import FULL
from comvla_sim.paper.verdicts import AGREES, UNTESTED, Verdict, compare_number

_HARD = Cell("hard_voting", TABLE_K)


def size(results: Results) -> Claim | None:
    """Bytes of 32 tokens against all of them."""
    full, hard = results.find(FULL), results.find(_HARD)
    kib = [analytic.payload_kib(k, "int8") for k in (512, TABLE_K)]
    calculated = kib[0] / kib[1]
    framed = analytic.wire_kib(512, "int8") / analytic.wire_kib(TABLE_K, "int8")
    measured = ""
    if full and hard:
        measured = (
            f"; measured on the wire here {full['wire_bytes'] / hard['wire_bytes']:.1f} times"
        )
    return (
        "16 times fewer bytes, 1088 KB to 68 KB",
        f"{calculated:.3g} times by K·D·B, {kib[0]:.0f} to {kib[1]:.0f} KiB, {framed:.1f} times with all framing at "
        f"the paper's size{measured}",
        worst(
            [
                *(compare_number(16, x, x, step=1, unit="times") for x in (calculated, framed)),
                compare_number(1088, kib[0], kib[0], step=1, unit="KiB"),
                compare_number(68, kib[1], kib[1], step=1, unit="KiB"),
            ]
        ),
    )


def operations() -> Claim:
    """Operations with 32 tokens against all of them."""
    vision = analytic.vision_tflops()
    spans = [analytic.vlm_tflops(k) + vision for k in (512, 32)]
    ratio = sorted((spans[0].low / spans[1].low, spans[0].high / spans[1].high))
    saved = [100 * (1 - 1 / times) for times in ratio]
    here = (
        f"{spans[0].text(1)} to {spans[1].text(1)} TFLOPs, {ratio[0]:.1f} to {ratio[1]:.1f} times or by "
        f"{saved[0]:.0f} to {saved[1]:.0f} %, depending on the prompt; the figure includes the robot's vision"
    )
    verdict = worst(
        [
            compare_number(3.8, ratio[0], ratio[1], step=0.1, unit="times"),
            compare_number(74, saved[0], saved[1], step=1, unit="points"),
        ]
    )
    if verdict.kind == AGREES:
        verdict = Verdict(AGREES, "within the prompts' range")
    return "Compute falls 3.8 times, by 74 %", here, verdict


def latency() -> Claim:
    """Time of a query."""
    why = "needs an H100 and the 7.5 G model; docs/openvla-oft.md has both halves on a CPU"
    return "Inference latency falls by 22 %", "–", Verdict(UNTESTED, why)
