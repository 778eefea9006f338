"""Policies of sending: what each makes of an SNR, its age, and what became of earlier payloads."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from client_stubs import (
    INFO,
    NARROW,
    WORDS,
    AsyncStubTransport,
    StubEdge,
    StubTransport,
    fault,
    observation,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from comvla.errors import LinkError
from comvla_client import (
    AsyncComVLAClient,
    ComVLAClient,
    LinkProfile,
    SnrReading,
    framed_token_budget,
    token_budget,
)
from comvla_client.fading import snr_quantiles_db
from comvla_client.sending import (
    POLICIES,
    Fading,
    Floor,
    Margin,
    Outcome,
    Paper,
    Progressive,
    Situation,
    make_policy,
)
from comvla_sim.channel import ConstantChannel, RicianChannel
from comvla_sim.link import EnforcedLink

OBS = observation()
BITS = 12 * 8  # of a token of the stub at INT8
RICIAN = Fading(10.0, 3.0, 10.0)
# About 18 tokens of the stub at 10 dB by Eq. (4); wide enough that framing is not all there is.
WIDE = LinkProfile(bandwidth_hz=60e3, period_s=0.05, efficiency=1.0)


def situation(reading: SnrReading | None = None, **changes: Any) -> Situation:
    """N = 32 tokens of 96 bits each."""
    values: dict[str, Any] = {
        "reading": reading,
        "link": NARROW,
        "num_tokens": 32,
        "most_tokens": 32,
        "min_tokens": 1,
        "tokens_in": lambda bits, progressive, least: int(bits // BITS),
        "needs_snr": True,
    }
    return Situation(**{**values, **changes})


def client_over(link: Any, /, **options: Any) -> ComVLAClient:
    return ComVLAClient(link, **{"edge": StubEdge(), "deadline_s": 60.0, "link": WIDE, **options})


# ---- Names ------------------------------------------------------------------------------------


def test_every_name_makes_a_new_policy_that_a_client_takes() -> None:
    for name in POLICIES:
        assert make_policy(name) is not make_policy(name)
        link = EnforcedLink(StubTransport(), ConstantChannel(25.0), WIDE)
        with client_over(link, sending=name) as client:
            report = client.step(OBS, WORDS, link.reading()).report
        assert report.policy == name
        assert report.source == "cloud"
        assert report.to_dict()["policy"] == name
    own = Margin(0.2)
    assert make_policy(own) is own


def test_an_unknown_name_is_refused_with_those_there_are() -> None:
    with pytest.raises(ValueError, match="progressive"):
        client_over(StubTransport(), sending="hope")


@pytest.mark.parametrize(
    "make",
    [
        lambda: Margin(0.0),
        lambda: Margin(0.6),
        lambda: Progressive(0.3),
        lambda: Progressive(headroom=0.5),
        lambda: Floor(tokens=0),
        lambda: Floor(periods=0),
        lambda: Floor(patience=0),
    ],
)
def test_numbers_out_of_range_are_refused(make: Any) -> None:
    with pytest.raises(LinkError, match="expected"):
        make()


# ---- Paper ------------------------------------------------------------------------------------


@settings(deadline=None)
@given(snr_db=st.floats(-30, 40), age_s=st.floats(0, 10))
def test_paper_takes_any_report_at_its_word(snr_db: float, age_s: float) -> None:
    plan = Paper().plan(situation(SnrReading(snr_db, age_s)))
    assert plan.budget == token_budget(snr_db, NARROW, BITS)
    assert plan.count == min(plan.budget, 32)


def test_the_report_names_both_budgets_the_window_and_the_capacity() -> None:
    link = EnforcedLink(StubTransport(), ConstantChannel(12.0), WIDE)
    for budget in ("paper", "framed", 7):
        with client_over(link, budget=budget, session_id="arm") as client:
            report = client.step(OBS, WORDS, 12.0).report
        link.advance()
        assert report.paper_budget == token_budget(12.0, WIDE, BITS)
        assert report.framed_budget == framed_token_budget(
            12.0,
            WIDE,
            token_dim=12,
            quantization="int8",
            num_towers=2,
            session_id=report.session,
            instruction=WORDS,
            proprio_dim=3,
            model_fingerprint=INFO.fingerprint,
        )
        assert report.framed_budget < report.paper_budget
        wanted = {"paper": report.paper_budget, "framed": report.framed_budget, 7: 7}[budget]
        assert report.token_budget == wanted
        assert report.capacity_bits == WIDE.capacity_bits(12.0)
        assert report.window_s == 0.05


def test_a_reserve_leaves_less_to_send() -> None:
    half = replace(WIDE, reserve_s=0.025)
    assert half.window_bits(10.0) == pytest.approx(WIDE.capacity_bits(10.0) / 2)
    assert half.window_bits(10.0, periods=3) == pytest.approx(2.5 * WIDE.capacity_bits(10.0))
    assert half.capacity_bits(10.0) == WIDE.capacity_bits(10.0) == WIDE.window_bits(10.0)
    assert token_budget(10.0, half, BITS) == token_budget(10.0, WIDE, 2 * BITS)
    link = EnforcedLink(StubTransport(), ConstantChannel(20.0), half)
    with client_over(link, budget="framed", link=half) as client:
        report = client.step(OBS, WORDS, 20.0).report
    assert report.window_s == 0.025
    assert report.capacity_bits == half.window_bits(20.0)
    assert report.tokens == report.tokens_used > 0
    for wrong in (-0.01, 0.05, math.nan):
        with pytest.raises(LinkError, match="reserve_s"):
            replace(WIDE, reserve_s=wrong)


def test_paper_without_an_snr_says_what_else_there_is() -> None:
    with pytest.raises(LinkError, match="sending='progressive'"):
        Paper().plan(situation())
    assert Paper().plan(situation(needs_snr=False, most_tokens=9)).count == 9


# ---- Margin -----------------------------------------------------------------------------------


@settings(deadline=None)
@given(snr_db=st.floats(-10, 30), age_s=st.floats(0.001, 1.0), outage=st.floats(0.01, 0.5))
def test_margin_sizes_by_the_quantile_of_what_the_link_is_now(
    snr_db: float, age_s: float, outage: float
) -> None:
    reading = SnrReading(snr_db, age_s)
    [low_db] = snr_quantiles_db(reading, RICIAN, outage)
    plan = Margin(outage, RICIAN).plan(situation(reading))
    assert plan.budget == token_budget(low_db, NARROW, BITS)
    assert plan.count == min(plan.budget, 32)


def test_margin_takes_a_report_of_now_at_its_word() -> None:
    assert Margin(0.01, RICIAN).plan(situation(SnrReading(9.0))).budget == (
        Paper().plan(situation(SnrReading(9.0))).budget
    )


def losses(sending: Any, delay: int, *, queries: int = 250, mode: Any = "drop") -> float:
    """Share of payloads that the link lost, Rician κ = 3 at 10 dB."""
    channel = RicianChannel(10.0, 10.0, WIDE.period_s, seed=11, rician_k=3.0)
    thin = replace(WIDE, bandwidth_hz=30e3)  # on which all N tokens hardly ever fit
    link = EnforcedLink(StubTransport(), channel, thin, mode=mode)
    if callable(sending):
        sending = sending(lambda: link.time_s)
    with client_over(
        link, link=thin, sending=sending, budget="framed", selector="random"
    ) as client:
        for _ in range(queries):
            client.step(OBS, WORDS, link.reading(delay))
            link.advance()
    sent = [record for record in link.log if record.offered_tokens]
    assert len(sent) > queries / 3
    return float(np.mean([record.delivered_tokens == 0 for record in sent]))


def test_stale_reports_make_the_papers_payloads_too_large_and_margins_not() -> None:
    assert losses("paper", delay=0) == 0.0
    assert 0.4 < losses("paper", delay=1) < 0.6
    for outage in (0.05, 0.2):
        assert losses(Margin(outage, RICIAN), delay=1) < outage + 0.04
    # The same from what it learns, where the first payloads are still guesses.
    assert losses(lambda clock: Margin(0.05, clock=clock), delay=1) < 0.1
    # In the deepest fades not even a head and one token fit.
    assert losses("progressive", delay=1) < 0.1


# ---- Progressive ------------------------------------------------------------------------------


def test_progressive_offers_more_than_it_counts_on() -> None:
    plan = Progressive(0.95, fading=RICIAN).plan(situation(SnrReading(6.0, 0.05)))
    assert plan.progressive
    assert plan.expected < plan.count
    assert plan.cap_bits is not None
    assert plan.budget == int(plan.cap_bits // BITS)
    fresh = Progressive(fading=RICIAN, headroom=1.0).plan(situation(SnrReading(6.0)))
    assert fresh.expected == fresh.count == token_budget(6.0, NARROW, BITS)


def test_progressive_needs_no_snr_and_learns_the_goodput() -> None:
    policy, now = Progressive(headroom=1.0), situation()
    assert policy.plan(now).count == 32
    assert policy.plan(now).cap_bits is None
    for _ in range(8):
        policy.learn(Outcome(32, 6, 6 * BITS, answered=True))
    assert policy.plan(now).count == policy.plan(now).expected == 6
    policy.learn(Outcome(6, 6, 6 * BITS, answered=True))
    assert policy.plan(now).count == 12, "more was possible"
    for _ in range(8):
        policy.learn(Outcome(12, 0, 0.0, answered=False))
    little = policy.plan(now)
    assert little.count <= 3
    for _ in range(12):  # nothing sent: nobody else would find out that the link is back
        policy.learn(Outcome(0, 0, 0.0, answered=False))
    assert policy.plan(now).count >= 24


def test_progressive_is_never_silent_for_ever() -> None:
    link = EnforcedLink(
        StubTransport(), [25.0] * 20 + [-40.0] * 40 + [25.0] * 400, WIDE, mode="queue"
    )
    sources = []
    with client_over(link, sending="progressive+floor", selector="random") as client:
        for _ in range(200):
            sources.append(client.step(OBS, WORDS).source)
            link.advance()
    assert sources[:10] == ["cloud"] * 10
    assert sources[-50:] == ["cloud"] * 50


@pytest.mark.parametrize("mode", ["prefix", "drop", "queue"])
def test_progressive_gets_through_what_the_link_carries(mode: Any) -> None:
    link = EnforcedLink(StubTransport(), ConstantChannel(10.0), WIDE, mode=mode)
    with client_over(link, sending="progressive", selector="random") as client:
        reports = []
        for _ in range(20):
            # Told far too much: the cap does not help.
            reports.append(client.step(OBS, WORDS, 60.0).report)
            link.advance()
    for report, record in zip(reports, link.log, strict=True):
        assert report.tokens_used == record.delivered_tokens
        assert report.tokens_used <= report.tokens <= 32
    assert reports[0].tokens_used > 0
    with client_over(StubTransport(), budget="framed") as client:
        alone = client.step(OBS, WORDS, 10.0).report.tokens
    assert abs(reports[0].tokens_used - alone) <= 4, "but for what pieces cost"


# ---- Floor ------------------------------------------------------------------------------------


def test_floor_sends_nothing_useless_then_takes_two_periods_then_holds() -> None:
    policy = Floor(tokens=12, periods=2, patience=3)
    eight = SnrReading(10 * math.log10(2 ** (8.2 * BITS / 500) - 1))
    assert Paper().plan(situation(eight)).count == 8
    first = policy.plan(situation(eight))
    assert (first.count, first.hold) == (0, False)
    policy.learn(Outcome(0, 0, 0.0, answered=False))
    second = policy.plan(situation(eight))
    assert (second.count, second.periods) == (16, 2)
    policy.learn(Outcome(16, 16, 16 * BITS, answered=True))
    assert policy.plan(situation(eight)).count == 0, "one period again"
    two = SnrReading(10 * math.log10(2 ** (2.2 * BITS / 500) - 1))
    holds = []
    for _ in range(5):
        plan = policy.plan(situation(two))
        holds.append(plan.hold)
        assert plan.count == 0
        policy.learn(Outcome(0, 0, 0.0, answered=False))
    assert holds == [False, False, False, True, True]
    assert "holding" in plan.detail
    assert "5 in a row" in plan.detail
    policy.reset()
    assert not policy.plan(situation(two)).hold


def test_floor_asks_for_no_more_than_a_fixed_budget_has() -> None:
    fixed = situation(needs_snr=False, most_tokens=5, tokens_in=lambda bits, progressive, least: 5)
    assert Floor(tokens=20).plan(fixed).count == 5


def test_a_robot_below_the_floor_finishes_its_chunk_then_holds_then_recovers() -> None:
    link = EnforcedLink(StubTransport(), ConstantChannel(25.0), WIDE)
    with client_over(link, sending=Floor(tokens=20, patience=2), execute=2) as client:
        sources = [client.step(OBS, WORDS, 25.0).source]
        sources += [client.step(OBS, WORDS, -20.0).source for _ in range(4)]
        link.advance()
        sources.append(client.step(OBS, WORDS, 25.0).source)
    assert sources == ["cloud", "rest", "rest", "hold", "hold", "cloud"]
    assert len(link.log) == 2, "nothing useless crossed"


def test_a_payload_of_two_periods_crosses_a_link_that_knows_of_it() -> None:
    thin = ConstantChannel(-1.0)
    for sending in ("floor", "progressive+floor"):
        link = EnforcedLink(StubTransport(), thin, WIDE)
        policy = make_policy(sending)
        with client_over(link, sending=policy, budget="framed", min_tokens=1) as client:
            policy.tokens = 9  # type: ignore[attr-defined]
            reports, asked = [], []
            for _ in range(2):
                asked.append(link.period)
                reports.append(client.step(OBS, WORDS, -1.0).report)
                asked.append(link.period)
                link.advance()
        assert reports[0].tokens == 0
        assert "fewer than 9 tokens in 1 periods" in reports[0].detail
        assert reports[1].window_s == pytest.approx(0.1)
        assert reports[1].tokens_used >= 9
        assert asked[1] == asked[0]
        assert asked[3] == asked[2] + 1, "the robot held for one period"
        assert link.log[0].waited_periods == 1


# ---- Both clients -----------------------------------------------------------------------------


async def test_the_asyncio_client_plans_the_same() -> None:
    script = (None, fault("UNAVAILABLE"), None)
    readings = [SnrReading(20.0, 0.05), SnrReading(12.0, 0.1), SnrReading(-30.0), SnrReading(15.0)]
    options: dict[str, Any] = {"edge": StubEdge(), "link": NARROW, "deadline_s": 60.0}
    with ComVLAClient(
        StubTransport(*script), sending=Floor(Margin(0.1, RICIAN), 3), **options
    ) as client:
        expected = [client.step(OBS, WORDS, reading).report for reading in readings]
        hold = client.hold_action
    async with AsyncComVLAClient(
        AsyncStubTransport(*script), sending=Floor(Margin(0.1, RICIAN), 3), **options
    ) as aio:
        came = [(await aio.step(OBS, WORDS, reading)).report for reading in readings]
        np.testing.assert_array_equal(aio.hold_action, hold)
    for one, other in zip(came, expected, strict=True):
        same: dict[str, Any] = {"session": "", "timings_s": {}}
        assert replace(one, **same).to_dict() == replace(other, **same).to_dict()
    assert expected[0].policy == "margin+floor"
