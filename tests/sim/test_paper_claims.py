"""Verdicts on the paper's claims follow from the numbers: other numbers, another verdict."""

from __future__ import annotations

from typing import Any

import pytest
from paper_stubs import results, rows

from comvla_sim.paper import analytic, cost_claims, link_claims, success_claims
from comvla_sim.paper.cells import Cell
from comvla_sim.paper.verdicts import AGREES, DIFFERS, UNTESTED, Kind


def test_bytes_agree_as_calculated_and_differ_where_tokens_are_larger(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = results({("tabletop", Cell("full")): rows(Cell("full"), 1, 1)})

    def verdict() -> str:
        claim = cost_claims.size(made)
        assert claim is not None
        return claim[2].text

    assert verdict() == "agrees"
    for name, factor, text in (
        ("TOKEN_DIM", 2, "differs by +1.1e+03 KiB"),
        ("payload_kib", 1.25, "differs by -3.2 times"),
        ("wire_kib", 1.25, "differs by -3.2 times"),
    ):
        exact: Any = getattr(analytic, name)
        with monkeypatch.context() as patch:
            if isinstance(exact, int):
                patch.setattr(analytic, name, factor * exact)
            else:
                patch.setattr(
                    analytic, name, lambda k, q, f=factor, e=exact: e(k, q) * (f if k == 32 else 1)
                )
            assert verdict() == text, name


def test_operations_agree_within_the_prompts_range_and_differ_outside_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, here, verdict = cost_claims.operations()
    assert "3.7 to 3.9 times or by 73 to 75 %" in here
    assert verdict.text == "agrees within the prompts' range"
    with monkeypatch.context() as patch:
        patch.setattr(analytic, "vision_tflops", lambda: 2.0)
        verdict = cost_claims.operations()[2]
    assert verdict.kind == DIFFERS
    assert "times" in verdict.detail


@pytest.mark.parametrize(
    ("most", "fewest", "kind", "detail"),
    [
        (15, 2, AGREES, "in direction"),  # successes of random tokens at K = 128 and K = 8, of 20
        (2, 2, DIFFERS, "no growth of the lead"),
        (2, 15, DIFFERS, "no growth of the lead"),
        (20, 2, DIFFERS, "no difference"),
    ],
)
def test_votes_beat_random_tokens_the_more_so_the_fewer_only_if_their_lead_grows(
    most: int, fewest: int, kind: Kind, detail: str
) -> None:
    cells = [Cell(method, k) for k in (128, 8) for method in ("hard_voting", "random")]
    counts = zip(cells, (20, most, 20, fewest), strict=True)
    made = results({("tabletop", cell): rows(cell, count, 20) for cell, count in counts})
    claim = success_claims.against_random(made)
    assert claim is not None
    words, here, verdict = claim
    assert words.endswith("the more so the fewer tokens")
    assert "larger at K = 8 than at K = 128" in here
    assert verdict.kind == kind
    assert detail in verdict.detail


def test_one_k_alone_says_nothing_about_fewer_tokens() -> None:
    cells = {Cell("hard_voting", 32): 20, Cell("random", 32): 2}
    made = results({("tabletop", cell): rows(cell, count, 20) for cell, count in cells.items()})
    claim = success_claims.against_random(made)
    assert claim is not None
    assert claim[0] == "Hard voting beats random tokens at equal K"
    assert claim[2].kind == AGREES


@pytest.mark.parametrize(
    ("overlap", "action", "kind"),
    [
        (0.97, 0.25, DIFFERS),
        (0.23, 0.25, DIFFERS),  # actions are measured with the order intact
        (0.23, 0.006, AGREES),
        (0.97, 0.006, UNTESTED),
    ],
)
def test_why_int4_fails_is_decided_by_what_it_spoils(
    overlap: float, action: float, kind: Kind
) -> None:
    made = results({("tabletop", Cell("full")): rows(Cell("full"), 1, 1)})
    layers = [{"layer": name, "error": 0.1} for name in ("tokens as sent", "projected tokens")]
    harmless = {"layers": layers, "action_error": 0.005, "order_overlap": 0.97}
    spoilt = {"layers": layers, "action_error": action, "order_overlap": overlap}
    made.data["layers"] = {"massive": 50, "formats": {"int4": harmless, "int4 massive": spoilt}}
    claim = success_claims.int4_reason(made)
    assert claim is not None
    assert claim[2].kind == kind


@pytest.mark.parametrize(("soft", "leads"), [(20, False), (5, True)])
def test_an_interval_that_holds_the_papers_lead_and_none_is_said_to_show_none(
    soft: int, leads: bool
) -> None:
    cells = {Cell("hard_voting", 32): 20, Cell("soft_voting", 32): soft}
    made = results({("tabletop", cell): rows(cell, count, 20) for cell, count in cells.items()})
    claim = success_claims.against_soft(made)
    assert claim is not None
    assert ("which shows no lead" in claim[1]) != leads
    assert (claim[2].kind == UNTESTED) != leads


def swept(**lines: dict[float, int]) -> list[dict[str, Any]]:
    """Points of a sweep: successes of 100 by what is on its axis."""
    return [
        {
            "series": name,
            "axes": {"channel": "rician", "mean_snr_db": at, "csi_delay": at},
            "successes": successes,
            "episodes": 100,
            "answered": 0.5,
        }
        for name, points in lines.items()
        for at, successes in points.items()
    ]


@pytest.mark.parametrize(
    ("old", "kind", "detail"),
    [
        (99, AGREES, "as simulated"),
        (97, AGREES, "but the interval allows more"),
        (80, DIFFERS, "by -19.0 points"),
    ],
)
def test_stale_reports_are_compared_with_fresh_ones_of_the_same_link(
    old: int, kind: Kind, detail: str
) -> None:
    made = results({("tabletop", Cell("full")): rows(Cell("full"), 1, 1)})
    ages = {1: old, 2: old, 3: old, 4: old}
    lines = swept(unenforced={0: 99, **ages}, drop={0: 90, 1: 80, 2: 80, 3: 80, 4: 80})
    made.data["csi-delay"] = {"points": lines}
    claim = link_claims.stale(made)
    assert claim is not None
    assert "late payloads are lost -10.0 points" in claim[1], "enforced against enforced"
    assert (claim[2].kind, detail in claim[2].detail) == (kind, True)


def test_four_ages_of_the_same_layouts_are_no_more_evidence_than_one() -> None:
    made = results({("tabletop", Cell("full")): rows(Cell("full"), 1, 1)})
    said = []
    for ages in ({1: 90}, {1: 90, 2: 90, 3: 90, 4: 90}):
        made.data["csi-delay"] = {"points": swept(unenforced={0: 99, **ages})}
        claim = link_claims.stale(made)
        assert claim is not None
        said.append(claim[1])
    assert said[0] == said[1]


@pytest.mark.parametrize(("random", "kind"), [(20, AGREES), (96, DIFFERS)])
def test_under_fading_votes_must_be_ahead_of_random_tokens(random: int, kind: Kind) -> None:
    made = results({("tabletop", Cell("full")): rows(Cell("full"), 1, 1)})
    lines = swept(unenforced={0: 80, 5: 97, 20: 99}, random={0: 10, 5: random, 20: 25})
    made.data["fading"] = {"points": lines}
    claim = link_claims.fading(made)
    assert claim is not None
    assert claim[2].kind == kind
    if kind == AGREES:
        assert "votes lose 19 points, and random tokens 15" in claim[1]
