"""What it all means: the paper's claims, and what came out here, each in a few words that follow from the numbers."""

from __future__ import annotations

from comvla_sim.paper import analytic
from comvla_sim.paper.cells import BUDGETS, Cell
from comvla_sim.paper.published import FIG4_OBJECT_5DB_RICIAN, FIG5_CLAIM, TABLE_K
from comvla_sim.paper.results import Json, Results
from comvla_sim.paper.table1 import FULL, change_text
from comvla_sim.paper.verdicts import AGREES, DIFFERS, OURS, UNTESTED, Rate, Verdict, contrast
from comvla_sim.report.tables import Table

_HARD, _SOFT, _RANDOM = (Cell(m, TABLE_K) for m in ("hard_voting", "soft_voting", "random"))

Claim = tuple[str, str, Verdict]
"""What the paper says, what came out here, the verdict."""

_NO_PICTURES = "(The paper has no coded pictures among its baselines)"

NEGLIGIBLE = 0.03
"""Points of success, as a share, within which a change counts as small: twice the paper's own 1.5."""


def table(results: Results) -> Table:
    """All claims with a verdict each."""
    return Table(
        "The paper's claims",
        "In its words or close to them, with what came out here. “Agrees” is about this world and this policy: it "
        "says that "
        "the mechanism works here, not that the paper's numbers were reproduced.",
        ("claim", "here", "verdict"),
        tuple((claim, here, verdict.text) for claim, here, verdict in claims(results)),
    )


def claims(results: Results) -> list[Claim]:
    """Those that the measured parts say something about."""
    made = (
        _cheap(results),
        _bytes(results),
        _operations(),
        _against_random(results),
        _against_soft(results),
        _int8(results),
        _int4(results),
        _int4_reason(results),
        _fading(results),
        _stale(results),
        _latency(),
        _codecs(results),
        _jpeg(results),
    )
    return [claim for claim in made if claim is not None]


def _gap(first: Rate, second: Rate) -> str:
    value, low, high = (100 * x for x in contrast([(1, first), (-1, second)]))
    return f"{change_text(value)} points ({low:+.1f} to {high:+.1f})"


def _small_loss(first: Rate, second: Rate) -> Verdict:
    value, low, _ = contrast([(1, first), (-1, second)])
    if low >= -NEGLIGIBLE:
        return Verdict(AGREES)
    if value >= -NEGLIGIBLE:
        return Verdict(AGREES, "but the interval allows more")
    return Verdict(DIFFERS, f"by {100 * value:+.1f} points")


def _ahead(first: Rate, second: Rate) -> Verdict:
    value, low, high = contrast([(1, first), (-1, second)])
    if low > 0:
        return Verdict(AGREES)
    return Verdict(
        DIFFERS, "in that no difference was found" if high >= 0 else f"by {100 * value:+.1f} points"
    )


def _cheap(results: Results) -> Claim | None:
    full, hard = results.rate(FULL), results.rate(_HARD)
    if full is None or hard is None:
        return None
    here = f"{_gap(hard, full)} with 32 of 512 tokens, {hard.episodes} episodes"
    return "32 instead of 512 tokens cost 1.5 points of success", here, _small_loss(hard, full)


def _bytes(results: Results) -> Claim | None:
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


def _operations() -> Claim:
    vision = analytic.vision_tflops()
    spans = [analytic.vlm_tflops(k) + vision for k in (512, 32)]
    ratio = [a / b for a, b in ((spans[0].low, spans[1].low), (spans[0].high, spans[1].high))]
    here = (
        f"{spans[0].text(1)} to {spans[1].text(1)} TFLOPs, {min(ratio):.1f} to {max(ratio):.1f} times, depending on "
        "the "
        "prompt; the figure includes the robot's vision"
    )
    return "Compute falls 3.8 times, by 74 %", here, Verdict(AGREES, "within the prompts' range")


def _against_random(results: Results) -> Claim | None:
    found, worst = [], None
    for k in BUDGETS:
        hard, lot = results.rate(Cell("hard_voting", k)), results.rate(Cell("random", k))
        if hard is None or lot is None:
            continue
        value = contrast([(1, hard), (-1, lot)])[0]
        found.append(f"{100 * value:.0f} at K = {k}")
        verdict = _ahead(hard, lot)
        worst = verdict if worst is None or verdict.kind != AGREES else worst
    if worst is None:
        return None
    here = (
        f"points ahead: {', '.join(found)}. But this policy never saw random tokens in training; one that was trained "
        "on "
        "half of them loses far less (its model card)"
    )
    return "Hard voting beats random tokens at equal K, the more so the fewer tokens", here, worst


def _against_soft(results: Results) -> Claim | None:
    hard, soft = results.rate(_HARD), results.rate(_SOFT)
    if hard is None or soft is None:
        return None
    here = (
        f"{_gap(hard, soft)} at K = {TABLE_K}; this policy's attention is concentrated by training"
    )
    return "Hard votes beat soft votes by 1.7 points", here, _ahead(hard, soft)


def _int8(results: Results) -> Claim | None:
    half, eight = (
        results.rate(Cell("hard_voting", TABLE_K, "float16")),
        results.rate(_HARD),
    )
    if half is None or eight is None:
        return None
    return "INT8 costs nothing against FP16", _gap(eight, half), _small_loss(eight, half)


def _int4(results: Results) -> Claim | None:
    half, four = (results.rate(Cell("hard_voting", TABLE_K, q)) for q in ("float16", "int4"))
    if half is None or four is None:
        return None
    value, _, high = contrast([(1, four), (-1, half)])
    verdict = (
        Verdict(AGREES)
        if high < -0.1
        else Verdict(DIFFERS, f"in that it costs {max(0.0, -100 * value):.1f} points here")
    )
    return "INT4 costs 28 points", _gap(four, half), verdict


def _int4_reason(results: Results) -> Claim | None:
    found: Json | None = results.data.get("layers")
    if found is None:
        return None
    plain, massive = found["formats"]["int4"], found["formats"]["int4 massive"]
    here = (
        "the order does not pass through the number format, because robots vote first; votes on INT4 tokens would "
        "still "
        f"name {100 * plain['order_overlap']:.0f} % of the same. INT4 spoils values: {_first(plain)} here, "
        f"{_first(massive)} once one channel is {found['massive']:g} times as large"
    )
    return (
        "INT4 fails because it corrupts the importance ordering",
        here,
        Verdict(
            DIFFERS, "in the reason: one scale for a whole token is spent on its largest channel"
        ),
    )


def _first(line: Json) -> str:
    return (
        f"an error of {100 * line['layers'][1]['error']:.0f} % behind the projector and {line['action_error']:.2g} in "
        "an "
        "action"
    )


def _points(results: Results, figure: str, series: str, **axes: object) -> list[Json]:
    return [
        point
        for point in results.data.get(figure, {}).get("points", ())
        if point["series"] == series and all(point["axes"][k] == v for k, v in axes.items())
    ]


def _pool(points: list[Json]) -> Rate | None:
    episodes = sum(point["episodes"] for point in points)
    return Rate(sum(point["successes"] for point in points), episodes) if episodes else None


def _fading(results: Results) -> Claim | None:
    hard, lot = (
        _pool(_points(results, "fading", name, mean_snr_db=5.0, channel="rician"))
        for name in ("unenforced", "random")
    )
    if hard is None or lot is None:
        return None
    theirs = FIG4_OBJECT_5DB_RICIAN
    return (
        "Under fading it degrades more gracefully than random tokens (Object, Rician, 5 dB: "
        f"{theirs['hard_voting']:.1f} "
        f"against {theirs['random']:.1f} %)",
        f"{100 * hard.value:.0f} against {100 * lot.value:.0f} % at 5 dB, Rician, not enforced, {hard.episodes} "
        "episodes",
        _ahead(hard, lot),
    )


def _stale(results: Results) -> Claim | None:
    fresh, old = (
        _pool(
            [
                point
                for point in _points(results, "csi-delay", "unenforced")
                if (point["axes"]["csi_delay"] == 0) == is_fresh
            ]
        )
        for is_fresh in (True, False)
    )
    lost = [p for p in _points(results, "csi-delay", "drop") if p["axes"]["csi_delay"] > 0]
    if fresh is None or old is None:
        return None
    here = f"{_gap(old, fresh)} where nothing is enforced"
    enforced = _pool(lost)
    if enforced is not None:
        answered = [p["answered"] for p in lost if p["answered"] is not None]
        here += (
            f"; where the link keeps to its capacity and late payloads are lost {_gap(enforced, fresh)}, and "
            f"{100 * sum(answered) / len(answered):.0f} % of queries are answered"
        )
    verdict = _small_loss(old, fresh)
    if verdict.kind == AGREES:
        verdict = Verdict(
            AGREES, "as simulated; not on a link that keeps to its capacity (fading.md)"
        )
    return f"Stale channel state {FIG5_CLAIM}", here, verdict


def _latency() -> Claim:
    why = "needs an H100 and the 7.5 G model; docs/openvla-oft.md has both halves on a CPU"
    return "Inference latency falls by 22 %", "–", Verdict(UNTESTED, why)


def _codecs(results: Results) -> Claim | None:
    full = results.rate(FULL)
    found = [(name, results.rate(Cell(f"{name}-10"))) for name in ("deepjscc", "witt")]
    known = [(name, rate) for name, rate in found if rate is not None]
    if full is None or not known:
        return None
    here = "; ".join(f"{name} {_gap(rate, full)}" for name, rate in known)
    worst = min((_small_loss(rate, full) for _, rate in known), key=lambda v: v.kind == AGREES)
    here += ", at 10 dB; both are trained here for an hour of a CPU, WITT at a sixtieth of its size (codecs.md)"
    return "DeepJSCC and WITT stay competitive on success", here, worst


def _jpeg(results: Results) -> Claim | None:
    hard, full = results.find(_HARD), results.rate(FULL)
    found = [
        (results.find(cell), results.rate(cell), cell.method)
        for cell in results.cells
        if cell.pictures and cell.method.partition("-")[0] not in ("deepjscc", "witt")
    ]
    if hard is None or full is None or not found:
        return None
    good = [
        (c["wire_bytes"], name, rate)
        for c, rate, name in found
        if c and rate and contrast([(1, rate), (-1, full)])[0] >= -NEGLIGIBLE
    ]
    ours = hard["wire_bytes"] / 1024
    if not good:
        here = "no coded picture keeps success within 3 points of all tokens"
        return _NO_PICTURES, here, Verdict(OURS)
    least, name, rate = min(good)
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
