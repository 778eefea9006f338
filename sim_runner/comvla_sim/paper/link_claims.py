"""The paper's claims about success over a fading link."""

from __future__ import annotations

from comvla_sim.paper.claim import NEGLIGIBLE, Claim, ahead, gap
from comvla_sim.paper.published import FIG4_OBJECT_5DB_RICIAN, FIG5_CLAIM
from comvla_sim.paper.results import Json, Results
from comvla_sim.paper.verdicts import AGREES, DIFFERS, Rate, Verdict, contrast


def fading(results: Results) -> Claim | None:
    """Votes against random tokens under fading."""
    lines = [
        _points(results, "fading", name, mean_snr_db=5.0, channel="rician")
        for name in ("unenforced", "random")
    ]
    hard, lot = (_pool(points) for points in lines)
    if hard is None or lot is None:
        return None
    theirs = FIG4_OBJECT_5DB_RICIAN
    here = (
        f"{100 * hard.value:.0f} against {100 * lot.value:.0f} % at 5 dB, Rician, not enforced, {hard.episodes} "
        f"episodes{_unequal([*lines[0], *lines[1]])}"
    )
    verdict = ahead(hard, lot)
    votes, others = (_fall(results, name) for name in ("unenforced", "random"))
    if verdict.kind == AGREES:
        if votes is not None and others is not None:
            here += (
                f"; from the best link to the worst votes lose {100 * votes:.0f} points, and random tokens "
                f"{100 * others:.0f} of the few that they have"
            )
        verdict = Verdict(AGREES, "in that it is far ahead; how the two fall cannot be compared")
    return (
        "Under fading it degrades more gracefully than random tokens (Object, Rician, 5 dB: "
        f"{theirs['hard_voting']:.1f} "
        f"against {theirs['random']:.1f} %)",
        here,
        verdict,
    )


def _fall(results: Results, series: str) -> float | None:
    """Success that a line loses over Rician fading from the highest mean SNR to the lowest."""
    points = _points(results, "fading", series, channel="rician")
    if len(points) < 2:
        return None
    ends = sorted(points, key=lambda point: float(point["axes"]["mean_snr_db"]))
    low, high = (Rate(point["successes"], point["episodes"]) for point in (ends[0], ends[-1]))
    return high.value - low.value


def stale(results: Results) -> Claim | None:
    """Old reports against fresh ones."""
    fresh, old = (
        _mean(
            [
                point
                for point in _points(results, "csi-delay", "unenforced")
                if (point["axes"]["csi_delay"] == 0) == is_fresh
            ]
        )
        for is_fresh in (True, False)
    )
    lost = [p for p in _points(results, "csi-delay", "drop") if p["axes"]["csi_delay"] > 0]
    kept = [p for p in _points(results, "csi-delay", "drop") if p["axes"]["csi_delay"] == 0]
    if fresh is None or old is None:
        return None
    here = f"{gap(old, fresh)} where nothing is enforced"
    enforced, level = _mean(lost), _mean(kept)
    if enforced is not None and level is not None:
        answered = [p["answered"] for p in lost if p["answered"] is not None]
        here += (
            f"; where the link keeps to its capacity and late payloads are lost {gap(enforced, level)}, and "
            f"{100 * sum(answered) / len(answered):.0f} % of queries are answered"
        )
    here += _unequal([*_points(results, "csi-delay", "unenforced"), *lost])
    verdict = _small_loss(old, fresh)
    if verdict.kind == AGREES:
        doubt = f", {verdict.detail}" if verdict.detail else ""
        verdict = Verdict(
            AGREES, f"as simulated{doubt}; not on a link that keeps to its capacity (fading.md)"
        )
    return f"Stale channel state {FIG5_CLAIM}", here, verdict


def _small_loss(first: Rate, second: Rate) -> Verdict:
    value, low, _ = contrast([(1, first), (-1, second)])
    if low >= -NEGLIGIBLE:
        return Verdict(AGREES)
    if value >= -NEGLIGIBLE:
        return Verdict(AGREES, "but the interval allows more")
    return Verdict(DIFFERS, f"by {100 * value:+.1f} points")


def _points(results: Results, figure: str, series: str, **axes: object) -> list[Json]:
    return [
        point
        for point in results.data.get(figure, {}).get("points", ())
        if point["series"] == series and all(point["axes"][k] == v for k, v in axes.items())
    ]


def _pool(points: list[Json]) -> Rate | None:
    episodes = sum(point["episodes"] for point in points)
    return Rate(sum(point["successes"] for point in points), episodes) if episodes else None


def _mean(points: list[Json]) -> Rate | None:
    """The mean of points on the same layouts: they add no layouts to each other, so it counts as one of them."""
    pooled, fewest = _pool(points), min((point["episodes"] for point in points), default=0)
    return None if pooled is None else Rate(pooled.value * fewest, fewest)


def _unequal(points: list[Json]) -> str:
    """Said where points are compared that have not all the same episodes: of figures only counts are kept."""
    counts = [point["episodes"] for point in points]
    if min(counts) == max(counts):
        return ""
    return (
        f"; points have {min(counts)} to {max(counts)} episodes, so not all are on the same layouts"
    )
