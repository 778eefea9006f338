"""Tables II to IV: parts of one query, hard against soft votes, and number formats."""

from __future__ import annotations

from comvla_sim.paper import analytic
from comvla_sim.paper.cells import Cell
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
from comvla_sim.paper.table1 import (
    DASH,
    FULL,
    OTHER_MACHINE,
    STAND_IN,
    change_text,
    rate_text,
)
from comvla_sim.paper.verdicts import (
    OURS,
    UNTESTED,
    Rate,
    Verdict,
    compare_changes,
    compare_number,
    compare_rates,
    contrast,
)
from comvla_sim.report.tables import Table

_ALL = EPISODES_PER_SUITE * len(SUITES)
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
        ours, test = (results.rate(hard), results.rate(soft)), results.pair(soft, hard)
        if ours[0] is None or ours[1] is None or test is None:
            continue
        value, low, high = (100 * x for x in contrast([(1, ours[0]), (-1, ours[1])]))
        gap, verdict = DASH, Verdict(OURS)
        if k == TABLE_K:
            printed = [TABLE3[name][1] for name in ("hard_voting", "soft_voting")]
            gap = change_text(printed[0] - printed[1])
            rates = [Rate.of_percent(value, _ALL) for value in printed]
            verdict = (
                STAND_IN
                if results.stand_in
                else compare_changes((rates[0], rates[1]), (ours[0], ours[1]))
            )
        rows.append(
            (
                f"K = {k}",
                rate_text(ours[0]),
                rate_text(ours[1]),
                gap,
                f"{change_text(value)} ({low:+.1f} to {high:+.1f})",
                str(test["pairs"]),
                f"{test['only_second']} : {test['only_first']}",
                f"{test['p_value']:.1g}",
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
        "Percent of episodes with Wilson's 95 % intervals; points by which hard voting is ahead; pairs on the same "
        "tables "
        "in which only hard or only soft voting succeeded (exact McNemar test).",
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
    base = results.rate(reference)
    for quantization, (kib, _, average) in TABLE4.items():
        cell = Cell("hard_voting", TABLE_K, quantization)
        ours, calculated = results.rate(cell), analytic.payload_kib(TABLE_K, quantization)
        found, test = results.find(cell), results.pair(cell, _VOTED)
        change = 100 * (ours.value - base.value) if ours and base else None
        rows.append(
            (
                quantization,
                f"{kib:.0f}",
                f"{calculated:.1f}, {compare_number(kib, calculated, calculated, step=1, unit='KiB').text}",
                f"{average:.1f}",
                change_text(average - TABLE4["float16"][2]),
                rate_text(ours),
                DASH if change is None else change_text(change),
                _format_verdict(results, cell, average, ours, base),
                DASH if ours is None else str(ours.episodes),
                DASH if test is None else f"{test['p_value']:.1g}",
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
        "KiB as in Table I; percent of episodes with Wilson's 95 % intervals; change in points from float16; p of the "
        "paired test against int8.",
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


def _format_verdict(
    results: Results, cell: Cell, average: float, ours: Rate | None, base: Rate | None
) -> str:
    if ours is None or base is None:
        return _NOT_YET.text
    if results.stand_in:
        return STAND_IN.text
    paper = Rate.of_percent(average, _ALL)
    if results.libero:
        return compare_rates(paper, ours).text
    if cell.quantization == "float16":
        return Verdict(UNTESTED, "the level that the others are compared with").text
    return compare_changes((paper, Rate.of_percent(TABLE4["float16"][2], _ALL)), (ours, base)).text


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
