"""Tables II to IV: parts of one query, hard against soft votes, and number formats."""

from __future__ import annotations

from comvla_sim.experiments.statistics import p_text
from comvla_sim.paper import analytic
from comvla_sim.paper.cells import Cell
from comvla_sim.paper.changes import (
    ALL_EPISODES,
    SOME_SUITES,
    STAND_IN,
    change,
    change_text,
    change_verdict,
    gap_text,
    lead_verdict,
)
from comvla_sim.paper.published import (
    EPISODES_PER_SUITE,
    SUITE_NAMES,
    SUITES,
    TABLE2,
    TABLE3,
    TABLE4,
    TABLE_K,
)
from comvla_sim.paper.results import Json, Results
from comvla_sim.paper.table1 import DASH, FULL, OTHER_MACHINE, rate_text
from comvla_sim.paper.verdicts import (
    OURS,
    UNTESTED,
    Rate,
    Verdict,
    compare_number,
    compare_rates,
)
from comvla_sim.report.tables import Table

_VOTED = Cell("hard_voting", TABLE_K)
_NOT_YET = Verdict(UNTESTED, "not measured yet")


def table2(results: Results) -> list[Table]:
    """Operations and latency of the parts of a query."""
    vision, projector = analytic.vision_tflops(), analytic.projector_tflops()
    rows = []
    for name, k, cell in (("OpenVLA-OFT", analytic.NUM_TOKENS, FULL), ("ComVLA", TABLE_K, _VOTED)):
        paper, vlm = TABLE2[name], analytic.vlm_tflops(k)
        found = results.latency(cell)
        for part, span, key in (
            ("vision", analytic.Span(vision, vision), "edge_ms"),
            ("vlm", vlm, "cloud_ms"),
            ("total", vlm + vision, "total_ms"),
        ):
            tflops, latency_ms = paper[part]
            verdict = compare_number(tflops, span.low, span.high, step=0.01, unit="TFLOPs")
            rows.append(
                (
                    f"{name}, {part if part != 'vlm' else 'language model'}",
                    f"{tflops:.2f}",
                    span.text(3),
                    verdict.text,
                    f"{latency_ms:.1f}",
                    DASH if found is None else f"{found[key]:.1f}",
                    OTHER_MACHINE.text,
                )
            )
    note = (
        "TFLOPs and milliseconds. Calculated at OpenVLA-OFT's size over LIBERO's prompts: the towers without their "
        "last "
        f"blocks, and Eq. (5). The projector on all tokens, which the robot runs to score, adds {projector:.3f} "
        "TFLOPs to "
        "vision and is in no line of the paper. Latency here: comvla-mini on one core; vision is everything on the "
        "robot, "
        "the language model everything in the cloud."
    )
    return [
        Table(
            "Parts of one query",
            note,
            (
                "part",
                "paper, TFLOPs",
                "calculated",
                "verdict",
                "paper, ms",
                "here, ms",
                "verdict on latency",
            ),
            tuple(rows),
        )
    ]


def table3(results: Results) -> list[Table]:
    """Hard against soft voting."""
    rows = []
    for k in (TABLE_K, 16, 8, 4):
        hard, soft = Cell("hard_voting", k), Cell("soft_voting", k)
        ours, test = results.shared(hard, soft), results.pair(soft, hard)
        if ours is None or test is None:
            continue
        gap, verdict = DASH, Verdict(OURS)
        if k == TABLE_K:
            printed = TABLE3["hard_voting"][1], TABLE3["soft_voting"][1]
            gap = change_text(printed[0] - printed[1])
            verdict = lead_verdict(results, (hard, soft), printed)
        rows.append(
            (
                f"K = {k}",
                rate_text(results.rate(hard)),
                rate_text(results.rate(soft)),
                gap,
                gap_text(ours),
                str(test["pairs"]),
                f"{test['only_second']} : {test['only_first']}",
                p_text(test["p_value"], 1),
                verdict.text,
            )
        )
    by_suite = [
        _by_suite(results, suite, name, Cell(name, TABLE_K), TABLE3[name][0])
        for suite in results.suites
        if suite in SUITES
        for name in TABLE3
    ]
    voting = Table(
        "Hard against soft voting",
        "Percent of episodes with Wilson's 95 % intervals; points by which hard voting is ahead on the layouts that "
        "both were run on; how many pairs that are, and in how many only hard or only soft voting "
        "succeeded (exact McNemar test).",
        (
            "",
            "hard",
            "soft",
            "hard ahead, paper",
            "here",
            "pairs",
            "only hard : only soft",
            "p",
            "verdict",
        ),
        tuple(rows),
    )
    return [voting, *_suites_table(by_suite)]


def _by_suite(
    results: Results, suite: str, name: str, cell: Cell, printed: tuple[float, ...]
) -> tuple[str, ...]:
    ours, paper = results.rate(cell, suite), printed[SUITES.index(suite)]
    verdict = _NOT_YET
    if ours is not None:
        theirs = Rate.of_percent(paper, EPISODES_PER_SUITE)
        verdict = STAND_IN if results.stand_in else compare_rates(theirs, ours)
    return f"{SUITE_NAMES[suite]}, {name}", f"{paper:.1f}", rate_text(ours), verdict.text


def _suites_table(rows: list[tuple[str, ...]]) -> list[Table]:
    if not rows:
        return []
    return [Table("By suite", "Percent.", ("", "paper", "here", "verdict"), tuple(rows))]


def table4(results: Results) -> list[Table]:
    """Number formats of the tokens, and where each does its damage."""
    rows = []
    reference = Cell("hard_voting", TABLE_K, "float16")
    for quantization, (kib, _, average) in TABLE4.items():
        cell = Cell("hard_voting", TABLE_K, quantization)
        ours, calculated = results.rate(cell), analytic.payload_kib(TABLE_K, quantization)
        found, test = results.find(cell), results.pair(cell, _VOTED)
        moved = change(results, cell, reference) if ours and results.rate(reference) else None
        rows.append(
            (
                quantization,
                f"{kib:.0f}",
                f"{calculated:.1f}, {compare_number(kib, calculated, calculated, step=1, unit='KiB').text}",
                f"{average:.1f}",
                change_text(average - TABLE4["float16"][2]),
                rate_text(ours),
                DASH if moved is None else change_text(moved),
                _format_verdict(results, cell, reference, ours),
                DASH if ours is None else str(ours.episodes),
                DASH if test is None else p_text(test["p_value"], 1),
                DASH if found is None else f"{found['wire_bytes'] / analytic.KIB:.2f}",
            )
        )
    by_suite = [
        _by_suite(results, suite, q, Cell("hard_voting", TABLE_K, q), TABLE4[q][1])
        for suite in results.suites
        if suite in SUITES
        for q in TABLE4
    ]
    formats = Table(
        f"Number formats at K = {TABLE_K}",
        "KiB as in Table I; percent of episodes with Wilson's 95 % intervals; change in points from float16, on the "
        "layouts that both were run on; p of the paired test against int8.",
        (
            "format",
            "paper, KiB",
            "calculated",
            "paper, %",
            "change",
            "here, %",
            "change",
            "verdict",
            "episodes",
            "p",
            "here, KiB on the wire",
        ),
        tuple(rows),
    )
    return [formats, *_suites_table(by_suite), *_layers(results.data.get("layers"))]


def _format_verdict(results: Results, cell: Cell, reference: Cell, ours: Rate | None) -> str:
    if ours is None or results.rate(reference) is None:
        return _NOT_YET.text
    if results.stand_in:
        return STAND_IN.text
    if results.some_suites:
        return SOME_SUITES.text
    average = TABLE4[cell.quantization][2]
    if results.libero:
        return compare_rates(Rate.of_percent(average, ALL_EPISODES), ours).text
    if cell == reference:
        return Verdict(UNTESTED, "the level that the others are compared with").text
    printed = average, TABLE4[reference.quantization][2]
    return change_verdict(results, (cell, reference), printed).text


def _layers(found: Json | None) -> list[Table]:
    if found is None:
        return []
    formats = found["formats"]
    names = [line["layer"] for line in next(iter(formats.values()))["layers"]]
    head = tuple(name.replace(" massive", f", a channel ×{found['massive']:g}") for name in formats)
    rows = [
        (name, *(f"{100 * formats[q]['layers'][number]['error']:.2g} %" for q in formats))
        for number, name in enumerate(names)
    ]
    rows.append(("actions, mean change", *(f"{formats[q]['action_error']:.2g}" for q in formats)))
    rows.append(
        (
            "order of votes kept",
            *(f"{100 * formats[q]['order_overlap']:.1f} %" for q in formats),
        )
    )
    return [
        Table(
            "What a number format leaves behind each layer",
            f"Mean of ‖x_q − x‖ / ‖x‖ over {found['frames']} queries of experts' episodes, x the rows that enter the "
            "layer "
            f"with float32 tokens; K = {found['k']}. Actions: mean absolute change, of values in [−1, 1]. Order: the "
            "share "
            "of the K tokens that votes on quantised tokens would name again (robots vote before they quantise). In "
            "the "
            f"right half one channel of every token is {found['massive']:g} times as large before it is quantised and "
            "as "
            "it was behind: a massive channel, as DINOv2 and SigLIP have them, which changes nothing but the scale.",
            ("", *head),
            tuple(rows),
        )
    ]
