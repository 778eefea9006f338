"""The paper's claims about success over a link that loses nothing."""

from __future__ import annotations

from comvla_sim.paper.cells import BUDGETS, CODEC_SNR_DB, Cell
from comvla_sim.paper.changes import change_verdict, lead_verdict
from comvla_sim.paper.claim import NEGLIGIBLE, Claim, ahead, gap, worst
from comvla_sim.paper.published import TABLE1, TABLE3, TABLE4, TABLE_K
from comvla_sim.paper.results import Json, Results
from comvla_sim.paper.table1 import FULL
from comvla_sim.paper.verdicts import AGREES, DIFFERS, OURS, UNTESTED, Verdict, contrast

_HARD, _SOFT = (Cell(method, TABLE_K) for method in ("hard_voting", "soft_voting"))

HARM = 0.05
"""Mean change of an action, of values in [−1, 1], from which a number format counts as harmful."""

ORDER_LOST = 0.5
"""Share of the K tokens that votes on quantised tokens name again, below which the order counts as corrupted."""

_NO_PICTURES = "(The paper has no coded pictures among its baselines)"


def cheap(results: Results) -> Claim | None:
    """32 tokens against all of them."""
    rates = results.shared(_HARD, FULL)
    if rates is None:
        return None
    printed = TABLE1["hard_voting", TABLE_K].average, TABLE1["full", None].average
    here = f"{gap(*rates)} with 32 of 512 tokens, {rates[0].episodes} episodes of each"
    verdict = change_verdict(results, (_HARD, FULL), printed)
    return "32 instead of 512 tokens cost 1.5 points of success", here, verdict


def against_random(results: Results) -> Claim | None:
    """Votes against random tokens at each K, and whether their lead grows as K falls."""
    found = [
        (k, rates)
        for k in BUDGETS
        if (rates := results.shared(Cell("hard_voting", k), Cell("random", k))) is not None
    ]
    if not found:
        return None
    leads = ", ".join(
        f"{100 * (hard.value - lot.value):.0f} at K = {k}" for k, (hard, lot) in found
    )
    claim, here = "Hard voting beats random tokens at equal K", f"points ahead: {leads}"
    parts = [ahead(*rates) for _, rates in found]
    if len(found) > 1:
        (most, wide), (fewest, narrow) = found[0], found[-1]
        value, low, high = contrast(
            [(1, narrow[0]), (-1, narrow[1]), (-1, wide[0]), (1, wide[1])],
        )
        claim += ", the more so the fewer tokens"
        here += (
            f"; the lead is {100 * value:+.1f} points ({100 * low:+.1f} to {100 * high:+.1f}) larger at K = {fewest} "
            f"than at K = {most}"
        )
        parts.append(
            Verdict(AGREES)
            if low > 0
            else Verdict(DIFFERS, "in that no growth of the lead was found")
        )
    here += (
        ". But this policy never saw random tokens in training; one that was trained on half of them loses far less "
        "(its model card)"
    )
    verdict = worst(parts)
    if verdict.kind == AGREES:
        verdict = Verdict(AGREES, "in direction; Table I compares the sizes")
    return claim, here, verdict


def against_soft(results: Results) -> Claim | None:
    """Hard against soft votes."""
    rates = results.shared(_HARD, _SOFT)
    if rates is None:
        return None
    printed = TABLE3["hard_voting"][1], TABLE3["soft_voting"][1]
    here = (
        f"{gap(*rates)} at K = {TABLE_K}, {rates[0].episodes} episodes of each"
        f"{'' if ahead(*rates).kind == AGREES else ', which shows no lead'}; this policy's attention is concentrated "
        "by training"
    )
    verdict = lead_verdict(results, (_HARD, _SOFT), printed)
    return "Hard votes beat soft votes by 1.7 points", here, verdict


def int8(results: Results) -> Claim | None:
    """INT8 against FP16."""
    return _format(results, "int8", "INT8 costs nothing against FP16")


def int4(results: Results) -> Claim | None:
    """INT4 against FP16."""
    return _format(results, "int4", "INT4 costs 28 points")


def _format(results: Results, quantization: str, claim: str) -> Claim | None:
    cells = tuple(Cell("hard_voting", TABLE_K, q) for q in (quantization, "float16"))
    rates = results.shared(cells[0], cells[1])
    if rates is None:
        return None
    printed = TABLE4[quantization][2], TABLE4["float16"][2]
    here = f"{gap(*rates)}, {rates[0].episodes} episodes of each"
    return claim, here, change_verdict(results, (cells[0], cells[1]), printed)


def int4_reason(results: Results) -> Claim | None:
    """Whether INT4 fails by the order of the tokens or by their values."""
    found: Json | None = results.data.get("layers")
    if found is None:
        return None
    plain, massive = found["formats"]["int4"], found["formats"]["int4 massive"]
    here = (
        "the order does not pass through the number format, because robots vote first; votes on INT4 tokens would "
        "still "
        f"name {100 * plain['order_overlap']:.0f} % of the same here, and "
        f"{100 * massive['order_overlap']:.0f} % once one channel is {found['massive']:g} times as large. INT4 spoils "
        f"values: {_first(plain)} here, {_first(massive)} with that channel"
    )
    return "INT4 fails because it corrupts the importance ordering", here, _why(plain, massive)


def _why(plain: Json, massive: Json) -> Verdict:
    """Actions were measured on tokens that were chosen before they were quantised, so with their order intact."""
    action = max(plain["action_error"], massive["action_error"])
    if action >= HARM:
        return Verdict(
            DIFFERS,
            f"in the reason: with the order intact INT4 moves actions by {action:.2g}; one scale for a whole token is "
            "spent on its largest channel",
        )
    if min(plain["order_overlap"], massive["order_overlap"]) < ORDER_LOST:
        return Verdict(AGREES, "in that votes on INT4 tokens name others, and values do no harm")
    return Verdict(UNTESTED, "INT4 spoils neither the order nor the actions of this policy")


def _first(line: Json) -> str:
    return (
        f"an error of {100 * line['layers'][1]['error']:.0f} % behind the projector and {line['action_error']:.2g} in "
        "an "
        "action"
    )


def codecs(results: Results) -> Claim | None:
    """Learned codecs against all tokens."""
    said, found = [], []
    for name in ("deepjscc", "witt"):
        cell = Cell(f"{name}-{CODEC_SNR_DB}")
        rates = results.shared(cell, FULL)
        if rates is None:
            continue
        printed = TABLE1[name, None].average, TABLE1["full", None].average
        said.append(f"{name} {gap(*rates)}")
        found.append(change_verdict(results, (cell, FULL), printed))
    if not found:
        return None
    here = "; ".join(said)
    here += ", at 10 dB; both are trained for less than an hour of a CPU, WITT at a sixtieth of its size (codecs.md)"
    return "DeepJSCC and WITT stay competitive on success", here, worst(found)


def pictures(results: Results) -> Claim | None:
    """Coded pictures, which the paper does not have."""
    hard = results.find(_HARD)
    found = [
        (results.find(cell), results.shared(cell, FULL), cell.method)
        for cell in results.cells
        if cell.pictures and cell.method.partition("-")[0] not in ("deepjscc", "witt")
    ]
    if hard is None or not any(rates for _, rates, _ in found):
        return None
    good = [
        (c["wire_bytes"], name, rates[0])
        for c, rates, name in found
        if c and rates and rates[0].value - rates[1].value >= -NEGLIGIBLE
    ]
    ours = hard["wire_bytes"] / 1024
    if not good:
        here = "no coded picture keeps success within 3 points of all tokens"
        return _NO_PICTURES, here, Verdict(OURS)
    least, name, rate = min(good, key=lambda picture: picture[:2])
    here = (
        f"{name} keeps {100 * rate.value:.1f} % with {least / 1024:.1f} KiB a query; hard voting at K = {TABLE_K} "
        "takes "
        f"{ours:.1f} KiB, but its tokens have 96 values. With the paper's 2176 they are 68 KiB, and two JPEG-95 views "
        "of "
        f"224² pixels are {_reference_kib(results)}"
    )
    return _NO_PICTURES, here, Verdict(OURS)


def _reference_kib(results: Results) -> str:
    kib = results.data.get("pictures", {}).get("kib", {}).get("jpeg-95")
    return "not measured here" if kib is None else f"{kib:.0f} KiB in this world"
