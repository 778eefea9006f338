"""Goodput as evidence, and its fusion with a reported SNR."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from client_stubs import INFO, NARROW, WORDS, StubEdge, StubTransport, fault, observation
from hypothesis import given
from hypothesis import strategies as st

from comvla.errors import LinkError
from comvla_client import ComVLAClient, LinkProfile
from comvla_client.budget import PAPER_LINK
from comvla_client.report import StepReport
from comvla_client.snr import (
    Evidence,
    FusedSnr,
    GoodputSnr,
    SnrReading,
    equivalent_snr_db,
    evidence_of,
)
from comvla_client.snr.filter import Gaussian, LinkFilter, Process
from comvla_client.snr.goodput import HIGHEST_DB, LOWEST_DB
from comvla_sim.channel import ConstantChannel, RayleighChannel
from comvla_sim.link import EnforcedLink

DECIBELS = st.floats(LOWEST_DB, HIGHEST_DB)
# What may happen to a source: time passes, the modem reports, bytes arrive, bytes are lost.
EVENTS = st.lists(
    st.one_of(
        st.tuples(st.just("wait"), st.floats(0.0, 1e5)),
        st.tuples(st.just("report"), DECIBELS),
        st.tuples(st.just("arrive"), DECIBELS),
        st.tuples(st.just("lose"), DECIBELS),
    ),
    max_size=30,
)


# Wide enough that the headers of a call, some 500 bytes, are not all that fits.
WIDE = LinkProfile(bandwidth_hz=100e3, period_s=0.05, efficiency=1.0)


class World:
    """A modem, a link and a clock of their own for one source."""

    def __init__(self, **options: float) -> None:
        self.now_s = 100.0
        self.report_db, self.reported_s = 10.0, self.now_s
        self.source = FusedSnr(self._reported, PAPER_LINK, clock=lambda: self.now_s, **options)

    def _reported(self) -> SnrReading:
        return SnrReading(self.report_db, self.now_s - self.reported_s)

    def happens(self, kind: str, value: float) -> None:
        transfer = (PAPER_LINK.capacity_bits(value) / 8.0, PAPER_LINK.period_s)
        if kind == "wait":
            self.now_s += value
        elif kind == "report":
            self.report_db, self.reported_s = value, self.now_s
        elif kind == "arrive":
            self.source.observe_transfer(*transfer)
        else:
            self.source.observe_loss(*transfer)


@given(snr_db=st.floats(-60, 3000), link=st.sampled_from([PAPER_LINK, NARROW]))
def test_the_inverse_of_eq_1_is_its_inverse(snr_db: float, link: LinkProfile) -> None:
    assert link.snr_db(link.capacity_bits(snr_db)) == pytest.approx(snr_db, abs=1e-6)


def test_the_inverse_of_eq_1_refuses_what_no_link_carries() -> None:
    assert PAPER_LINK.snr_db(0.0) == -math.inf
    for bits in (-1.0, math.nan, math.inf):
        with pytest.raises(LinkError, match="capacity_bits"):
            PAPER_LINK.snr_db(bits)


@given(events=EVENTS)
def test_without_losses_the_estimate_lies_between_its_inputs(
    events: list[tuple[str, float]],
) -> None:
    world = World()
    inputs = [world.report_db]
    world.source.read()
    for kind, value in events:
        if kind == "lose":
            continue
        world.happens(kind, value)
        if kind != "wait":
            inputs.append(value)
        reading = world.source.read()
        assert min(inputs) - 1e-6 <= reading.snr_db <= max(inputs) + 1e-6


@given(events=EVENTS)
def test_whatever_happens_the_estimate_is_finite_and_unsure(
    events: list[tuple[str, float]],
) -> None:
    world = World()
    for kind, value in events:
        world.happens(kind, value)
        reading = world.source.read()
        assert LOWEST_DB - 1e-6 <= reading.snr_db <= HIGHEST_DB + 1e-6
        assert reading.std_db is not None
        assert 0.0 < reading.std_db < 40.0


@given(events=EVENTS, waits=st.lists(st.floats(1e-3, 100.0), min_size=1, max_size=5))
def test_without_news_age_and_uncertainty_only_grow(
    events: list[tuple[str, float]], waits: list[float]
) -> None:
    world = World()
    for kind, value in events:
        world.happens(kind, value)
    before = world.source.read()
    for wait_s in waits:
        world.now_s += wait_s
        after = world.source.read()
        assert after.age_s > before.age_s
        assert after.std_db is not None
        assert before.std_db is not None
        assert after.std_db >= before.std_db - 1e-9
        before = after


@given(events=EVENTS, lost_db=DECIBELS)
def test_a_loss_never_raises_the_estimate(events: list[tuple[str, float]], lost_db: float) -> None:
    world = World()
    for kind, value in events:
        world.happens(kind, value)
    before = world.source.read().snr_db
    world.happens("lose", lost_db)
    assert world.source.read().snr_db <= before + 1e-6


def test_a_fresh_report_and_old_goodput_weigh_by_what_they_know() -> None:
    world = World()
    world.happens("arrive", 0.0)
    near_goodput = world.source.read().snr_db
    world.now_s += 10.0
    world.happens("report", 20.0)
    near_report = world.source.read().snr_db
    assert near_goodput < 2.0
    assert near_report > 10.0


def test_losses_overthrow_a_modem_that_promises_too_much() -> None:
    """The uplink carries 3 dB, the modem goes on reporting 20 dB; each loss is of what was sized."""
    world = World()
    losses = 0
    for _ in range(40):
        world.now_s += 0.4
        world.happens("report", 20.0)
        estimate_db = world.source.read().snr_db
        if estimate_db > 3.0:
            losses += 1
            world.happens("lose", estimate_db)
        else:
            world.happens("arrive", 3.0)
    assert estimate_db < 8.0
    assert losses < 30
    # A single one may have had another reason, and is taken with reserve.
    calm = World()
    calm.happens("lose", -20.0)
    assert calm.source.read().snr_db > -10.0


def test_goodput_alone_finds_what_an_enforced_link_carries() -> None:
    """Bytes and airtime from the link's own log, at a capacity that is known."""
    link = EnforcedLink(StubTransport(), ConstantChannel(6.0), WIDE)
    now_s = [0.0]
    source = GoodputSnr(WIDE, initial_db=20.0, clock=lambda: now_s[0])
    with ComVLAClient(link, edge=StubEdge(), link=WIDE, budget=4, deadline_s=20.0) as robot:
        for _ in range(30):
            robot.step(observation(), WORDS, 6.0)
            record = link.log[-1]
            if record.delivered_tokens:
                source.observe_transfer(record.delivered_bytes, record.airtime_s)
            now_s[0] += 0.05
            link.advance()
    assert record.delivered_tokens
    assert source.read().snr_db == pytest.approx(6.0, abs=1.0)


def test_a_client_teaches_its_source_by_the_prefix_that_arrived() -> None:
    """The radio carries less than was sent: the tokens that arrived tell its capacity.

    A call takes no simulated time here, so only steps that were cut measure anything; with a budget
    far above the link every step is.
    """
    link = EnforcedLink(StubTransport(), ConstantChannel(1.0), WIDE)
    source = GoodputSnr(WIDE, initial_db=20.0)
    with ComVLAClient(
        link, edge=StubEdge(), link=WIDE, budget=32, snr=source, deadline_s=20.0
    ) as robot:
        for _ in range(12):
            chunk = robot.step(observation(), WORDS)
            link.advance()
    assert 0 < chunk.report.tokens_used < chunk.report.tokens
    # One token of 12 bytes and the headers of the call, which the report leaves out, are unknown.
    carried_db = WIDE.snr_db(link.log[-1].delivered_bytes * 8.0)
    assert source.read().snr_db == pytest.approx(carried_db, abs=2.5)


def test_lost_steps_lower_what_the_next_one_sends_and_silence_raises_it_again() -> None:
    now_s = [0.0]
    source = GoodputSnr(NARROW, initial_db=15.0, clock=lambda: now_s[0])
    transport = StubTransport(*[fault("DEADLINE_EXCEEDED")] * 6)
    with ComVLAClient(
        transport, edge=StubEdge(), link=NARROW, snr=source, deadline_s=20.0
    ) as robot:
        sent = []
        for _ in range(6):
            sent.append(robot.step(observation(), WORDS).report.tokens)
            now_s[0] += 0.4
    assert sent[0] > sent[-1]
    assert sent == sorted(sent, reverse=True)
    low_db = source.read().snr_db
    now_s[0] += 60.0
    assert low_db < source.read().snr_db <= 15.0


REPORT = StepReport(
    session="s",
    step=1,
    source="cloud",
    tokens=10,
    tokens_used=10,
    encoded_bytes=1000,
    framed_bytes=1200,
    timings_s={"call": 0.050},
    server_timings_s={"total": 0.020},
)


def test_an_answered_step_counts_its_bytes_over_the_time_on_the_way() -> None:
    assert evidence_of(REPORT, PAPER_LINK) == Evidence(equivalent_snr_db(1200, 0.030, PAPER_LINK))
    nearer = evidence_of(REPORT, PAPER_LINK, round_trip_s=0.010)
    assert nearer == Evidence(equivalent_snr_db(1200, 0.020, PAPER_LINK))
    # A round trip longer than the call is a mistake, and must not make the link infinitely fast.
    mistaken = evidence_of(REPORT, PAPER_LINK, round_trip_s=1.0)
    assert mistaken is not None
    assert mistaken.snr_db == pytest.approx(equivalent_snr_db(1200, 0.005, PAPER_LINK))


def test_a_cut_step_counts_what_arrived_over_the_period() -> None:
    cut = replace(REPORT, tokens_used=4)
    assert evidence_of(cut, PAPER_LINK) == Evidence(
        equivalent_snr_db(600, PAPER_LINK.period_s, PAPER_LINK)
    )
    longer = replace(cut, window_s=0.2)  # several periods' worth, or a period less its reserve
    assert evidence_of(longer, PAPER_LINK) == Evidence(equivalent_snr_db(600, 0.2, PAPER_LINK))


def test_a_lost_step_is_an_upper_bound_and_other_failures_say_nothing() -> None:
    lost = replace(REPORT, source="rest", fallback_reason="deadline", server_timings_s={})
    for waited_s, counted_s in ((0.400, 0.400), (0.001, PAPER_LINK.period_s)):
        assert evidence_of(replace(lost, timings_s={"call": waited_s}), PAPER_LINK) == Evidence(
            equivalent_snr_db(1200, counted_s, PAPER_LINK), bound=True
        )
    for reason in ("no_link", "overloaded", "rejected", "unavailable"):
        assert evidence_of(replace(lost, fallback_reason=reason), PAPER_LINK) is None
    assert evidence_of(replace(lost, framed_bytes=0), PAPER_LINK) is None
    assert evidence_of(replace(lost, timings_s={}), PAPER_LINK) is None


def test_a_report_of_no_link_stands() -> None:
    source = FusedSnr(lambda: SnrReading(-math.inf, 0.5))
    source.observe_transfer(1000, 0.01)
    source.observe_loss(1000, 0.01)
    assert source.read() == SnrReading(-math.inf, 0.5)


def test_mistakes_are_refused() -> None:
    for name, words in (
        ("coherence_s", "memory of the fading"),
        ("fading_std_db", "deviation of the fading"),
        ("reported_std_db", "deviation of the report's bias"),
        ("level_memory_s", "memory of the level"),
        ("goodput_std_db", "goodput_std_db"),
        ("noise_std_db", "noise_std_db"),
    ):
        for value in (0.0, -1.0, math.nan, math.inf):
            with pytest.raises(LinkError, match=words):
                FusedSnr(10.0, **{name: value})  # type: ignore[arg-type]
    with pytest.raises(LinkError, match="round_trip_s"):
        GoodputSnr(round_trip_s=-1.0)
    for transfer in ((0, 1.0), (100, 0.0), (100, math.nan)):
        with pytest.raises(LinkError, match="transfers that took place"):
            GoodputSnr().observe_transfer(*transfer)
    with pytest.raises(LinkError, match="deviation"):
        SnrReading(1.0, 0.0, -1.0)


def test_the_filter_is_the_exact_posterior_of_its_model() -> None:
    """Against the joint normal distribution of all measurements, inverted in one piece."""
    level, fading, bias = Process(9.0, 20.0), Process(5.57, 0.05), Process(6.0, 30.0)
    noise, first_db = 4.0, 12.0
    rng = np.random.default_rng(3)
    times_s = np.cumsum(rng.uniform(0.005, 0.3, 12))
    values = rng.normal(8.0, 6.0, 12)
    is_report = np.arange(12) % 3 == 0
    tracked = LinkFilter(first_db, level, fading, bias, 0.0)
    for time_s, value, report in zip(times_s, values, is_report, strict=True):
        seen = Gaussian(float(value), noise)
        if report:
            tracked.report(seen, 0.0, float(time_s))
        else:
            tracked.measure(seen, float(time_s))
    asked_s = float(times_s[-1] + 0.02)
    posterior = tracked.at(asked_s)
    all_s = np.append(times_s, asked_s)
    apart_s = np.abs(all_s[:, None] - all_s[None])
    both_report = np.outer(np.append(is_report, False), np.append(is_report, False))
    covariance = both_report * bias.std_db**2 * np.exp(-apart_s / bias.memory_s)
    for process in (level, fading):
        covariance += process.std_db**2 * np.exp(-apart_s / process.memory_s)
    gain = covariance[-1, :-1] @ np.linalg.inv(covariance[:-1, :-1] + noise * np.eye(12))
    assert posterior.mean == pytest.approx(first_db + float(gain @ (values - first_db)))
    assert posterior.variance == pytest.approx(
        float(covariance[-1, -1] - gain @ covariance[:-1, -1])
    )


def test_fusion_beats_each_of_its_parts_on_a_fading_link() -> None:
    """Rayleigh at 10 Hz, queries every 0.4 s; the modem reports each second, 5 dB too high."""
    period_s, steps = 0.05, 4000
    truth = RayleighChannel(10.0, 10.0, period_s, seed=1).snr_db(steps)
    now_s, reported = [0.0], [SnrReading(15.0)]
    fused = FusedSnr(lambda: reported[0], clock=lambda: now_s[0])
    errors: dict[str, list[float]] = {"report": [], "fused": []}
    measured_s = 0.0
    for step in range(steps):
        now_s[0] = step * period_s
        if step % 20 == 0:
            measured_s, report_db = now_s[0], float(truth[step]) + 5.0
        reported[0] = SnrReading(report_db, now_s[0] - measured_s)
        if step % 8 == 0 and step > 400:
            errors["report"].append(report_db - truth[step])
            errors["fused"].append(fused.read().snr_db - truth[step])
        if step % 8 == 0:
            fused.observe_transfer(PAPER_LINK.capacity_bits(float(truth[step])) / 8, period_s)
    rms = {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in errors.items()}
    assert rms["fused"] < 0.8 * rms["report"], rms
    assert INFO.control_period_s == period_s
