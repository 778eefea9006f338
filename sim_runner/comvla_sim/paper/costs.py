"""Table I: what a query costs by every method, in bytes, operations and time."""

from __future__ import annotations

from comvla_sim.paper import analytic
from comvla_sim.paper.cells import PAPER_CELLS, Cell
from comvla_sim.paper.published import PaperLine
from comvla_sim.paper.results import Results
from comvla_sim.paper.table1 import DASH, FULL, OTHER_MACHINE, OTHER_WEIGHTS, lines, shown
from comvla_sim.paper.verdicts import AGREES, OURS, Verdict, compare_number
from comvla_sim.report.tables import Table


def tables(results: Results) -> list[Table]:
    """Bytes, operations, latency."""
    return [_bytes(results), _operations(results), _latency(results)]


def _bytes(results: Results) -> Table:
    rows = []
    for cell, paper in lines(results):
        calculated, verdict = _calculated_kib(results, cell, paper)
        found = results.find(cell)
        tokens = FULL.method if cell == FULL else cell.k
        k = analytic.NUM_TOKENS if tokens == FULL.method else cell.k
        framed = (
            DASH if k is None or cell.pictures else f"{analytic.wire_kib(k, cell.quantization):.1f}"
        )
        rows.append(
            (
                cell.method,
                shown(cell),
                DASH if paper is None else f"{paper.kib:.1f}",
                calculated,
                framed,
                verdict.text,
                *(
                    DASH if found is None else f"{found[key] / analytic.KIB:.2f}"
                    for key in ("payload_bytes", "wire_bytes")
                ),
            )
        )
    return Table(
        "Bytes per query",
        "KiB (the paper's KB). Calculated: K · D · B / 8 at D = 2176 and INT8, codecs by the latents of their "
        "published "
        "architectures, JPEG, WebP and AVIF measured on 224² pictures of this world. Framed: everything that the "
        "socket sends (positions, scales, protobuf, gRPC, HTTP/2). Here: "
        "measured with this world's model, whose tokens have 96 values and whose pictures 128² pixels.",
        (
            "method",
            "K",
            "paper",
            "calculated",
            "framed",
            "verdict",
            "here, payload",
            "here, on the wire",
        ),
        tuple(rows),
    )


def _calculated_kib(results: Results, cell: Cell, paper: PaperLine | None) -> tuple[str, Verdict]:
    method = cell.method.partition("-")[0]
    if method in analytic.PICTURE_SIDE:
        value = analytic.codec_kib(method)
    elif cell == FULL:
        value = analytic.payload_kib(analytic.NUM_TOKENS, "int8")
    elif cell.k is not None:
        value = analytic.payload_kib(cell.k, cell.quantization)
    elif paper is not None:
        return f"{analytic.implied_tokens(paper):.1f} tokens", OTHER_WEIGHTS
    elif method == "fastv":
        value = analytic.payload_kib(analytic.NUM_TOKENS, "int8")
    else:
        kib = results.data.get("pictures", {}).get("kib", {}).get(cell.method)
        return DASH if kib is None else f"{kib:.1f} at 224²", Verdict(OURS)
    if paper is None:
        return f"{value:.1f}", Verdict(OURS)
    return f"{value:.1f}", compare_number(paper.kib, value, value, step=0.1, unit="KiB")


def _operations(results: Results) -> Table:
    rows = []
    for cell, paper in lines(results):
        found = results.find(cell)
        if found is None and paper is None:
            continue
        k = analytic.NUM_TOKENS if cell == FULL else cell.k
        theirs, calculated, verdict = DASH, DASH, Verdict(OURS)
        if paper is not None:
            span = analytic.as_counted_by_the_paper(*PAPER_CELLS[cell])
            theirs, calculated = f"{paper.tflops:.1f}", span.text()
            verdict = compare_number(paper.tflops, span.low, span.high, step=0.1, unit="TFLOPs")
            if cell.method in ("lightvla", "vla_adp") and verdict.kind == AGREES:
                verdict = Verdict(AGREES, "with its own bytes")
        rows.append(
            (
                cell.method,
                shown(cell),
                theirs,
                calculated,
                verdict.text,
                DASH if k is None or cell.pictures else analytic.whole_tflops(k).text(),
                *(
                    DASH if found is None else f"{found[key] / 1e6:.0f}"
                    for key in ("edge_flops", "cloud_flops")
                ),
            )
        )
    return Table(
        "Operations per query",
        "TFLOPs of both sides. Calculated as the paper does: its 0.83 for vision, Eq. (5) over 32 layers for K tokens "
        "and "
        "those beside them, from LIBERO's shortest prompt to its longest. All products: every matrix product that this "
        "repository runs at OpenVLA-OFT's size, voting included. Here: MFLOPs of comvla-mini.",
        (
            "method",
            "K",
            "paper",
            "calculated",
            "verdict",
            "all products",
            "here, robot",
            "here, cloud",
        ),
        tuple(rows),
    )


def _latency(results: Results) -> Table:
    rows = []
    for cell, paper in lines(results):
        found = results.latency(cell)
        if paper is None and found is None:
            continue
        rows.append(
            (
                cell.method,
                shown(cell),
                DASH if paper is None else f"{paper.latency_ms:.1f}",
                *(
                    DASH if found is None else f"{found[key]:.1f}"
                    for key in ("edge_ms", "cloud_ms", "total_ms")
                ),
                (Verdict(OURS) if paper is None else OTHER_MACHINE).text,
            )
        )
    story = results.data.get("latency", {})
    measured = (
        f"Here: comvla-mini, medians of {story['repetitions']} queries on one core of {story['processor']}, both "
        "halves in "
        "one process, without a network."
        if story
        else "Not measured here yet."
    )
    return Table(
        "Latency of one query",
        f"Milliseconds of computing. The paper's are OpenVLA-OFT on an H100. {measured}",
        ("method", "K", "paper", "here, robot", "here, cloud", "here, both", "verdict"),
        tuple(rows),
    )
