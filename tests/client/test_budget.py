"""K* is Eq. (4) at every point, and with framing it is the most that really fits."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from comvla import codec
from comvla.errors import LinkError
from comvla_client import LinkProfile, framed_token_budget, token_budget

links = st.builds(
    LinkProfile,
    bandwidth_hz=st.floats(1e3, 1e9),
    period_s=st.floats(1e-3, 1.0),
    efficiency=st.floats(0.01, 1.0),
)
snrs_db = st.floats(-60.0, 120.0)


def equation_4(snr_db: float, link: LinkProfile, bits_per_token: float) -> float:
    """Eq. (4) before the floor, as the paper writes it."""
    snr = 10.0 ** (snr_db / 10.0)
    return (
        link.efficiency * link.bandwidth_hz * link.period_s * math.log2(1.0 + snr) / bits_per_token
    )


@settings(max_examples=500)
@given(snrs_db, links, st.integers(1, 10**6))
def test_token_budget_is_equation_4(snr_db: float, link: LinkProfile, bits_per_token: int) -> None:
    exact = equation_4(snr_db, link, bits_per_token)
    # At an integer boundary the last bit of a double decides; everywhere else the floor is one.
    slack = 1e-12 * max(1.0, exact)
    allowed = {math.floor(exact - slack), math.floor(exact), math.floor(exact + slack)}
    assert token_budget(snr_db, link, bits_per_token) in allowed


@settings(max_examples=500)
@given(snrs_db, links, st.integers(1, 10**6))
def test_token_budget_is_the_most_that_fits(
    snr_db: float, link: LinkProfile, bits_per_token: int
) -> None:
    k, capacity = token_budget(snr_db, link, bits_per_token), link.capacity_bits(snr_db)
    assert k * bits_per_token <= Fraction(capacity) < (k + 1) * bits_per_token


@given(st.integers(1, 99), st.integers(1, 2000), st.integers(1, 200))
def test_capacities_that_are_whole_in_decimals_lose_no_token(
    percent: int, bandwidth_hz: int, milliseconds: int
) -> None:
    """At 0 dB log2(1 + SNR) is 1, so C = eta W T, and 0.29 * 100 must not become 28.99…96."""
    link = LinkProfile(bandwidth_hz, milliseconds / 1000, percent / 100)
    exact = Fraction(percent * bandwidth_hz * milliseconds, 100_000)
    assert Fraction(link.capacity_bits(0.0)) == Fraction(float(exact))
    if exact.denominator == 1:
        assert token_budget(0.0, link, 1) == exact


def test_the_classical_rounding_trap() -> None:
    assert int(0.29 * 100) == 28
    assert token_budget(0.0, LinkProfile(100, 1.0, 0.29), 1) == 29


@pytest.mark.parametrize(
    ("snr_db", "expected"),
    [(-10.0, 3), (0.0, 21), (5.0, 44), (10.0, 75), (15.0, 109), (20.0, 145)],
)
def test_the_papers_link(snr_db: float, expected: int) -> None:
    assert token_budget(snr_db, LinkProfile(), 2176 * 8) == expected


def test_one_bit_per_second_and_hertz_is_57_tokens_on_the_papers_link() -> None:
    assert LinkProfile(efficiency=1.0).capacity_bits(0.0) / (2176 * 8) == pytest.approx(
        57.445, abs=1e-3
    )


def test_no_link_carries_nothing() -> None:
    assert LinkProfile().capacity_bits(-math.inf) == 0.0
    assert token_budget(-math.inf, LinkProfile(), 8) == 0
    assert framed_token_budget(-math.inf, LinkProfile(), token_dim=8, quantization="int8") == 0


@given(st.floats(280.0, 1e300))
def test_absurdly_strong_links_do_not_overflow(snr_db: float) -> None:
    expected = snr_db / 10.0 * math.log2(10.0)
    assert LinkProfile(1.0, 1.0, 1.0).capacity_bits(snr_db) == pytest.approx(expected)


@pytest.mark.parametrize("snr_db", [math.nan, math.inf, None, "strong"])
def test_an_snr_that_no_link_has_is_refused(snr_db: float) -> None:
    with pytest.raises(LinkError, match="expected an SNR in dB"):
        LinkProfile().capacity_bits(snr_db)
    with pytest.raises(LinkError):
        token_budget(snr_db, LinkProfile(), 8)
    with pytest.raises(LinkError):
        framed_token_budget(snr_db, LinkProfile(), token_dim=8, quantization="int8")


@pytest.mark.parametrize("field", ["bandwidth_hz", "period_s", "efficiency"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, None])
def test_links_that_cannot_be_are_refused(field: str, value: float) -> None:
    with pytest.raises(LinkError, match=field):
        LinkProfile(**{field: value})


def test_efficiency_ends_at_one() -> None:
    assert LinkProfile(efficiency=1.0).efficiency == 1.0
    with pytest.raises(LinkError, match=r"\(0, 1\]"):
        LinkProfile(efficiency=1.0000001)


@pytest.mark.parametrize("bits", [0, -8, math.nan])
def test_tokens_have_bits(bits: float) -> None:
    with pytest.raises(LinkError, match="bits_per_token"):
        token_budget(10.0, LinkProfile(), bits)


@settings(max_examples=200)
@given(
    st.floats(-20.0, 40.0),
    st.sampled_from(codec.QUANTIZATIONS),
    st.sampled_from([(96, 1), (2176, 2)]),
    st.sampled_from([0.0, 0.05, 0.5]),
    st.booleans(),
)
@example(10.0, "int8", (2176, 2), 0.0, False)
def test_framed_budget_is_the_most_whose_bytes_fit(
    snr_db: float, quantization: str, size: tuple[int, int], margin: float, tcp_ip: bool
) -> None:
    link = LinkProfile()
    sizes = {"token_dim": size[0], "quantization": quantization, "num_towers": size[1]}
    fields = {"session_id": "robot", "step": 300, "instruction": "open it", "proprio_dim": 8}
    k = framed_token_budget(snr_db, link, **sizes, **fields, margin=margin, tcp_ip=tcp_ip)
    room_bytes = (1.0 - margin) * link.capacity_bits(snr_db) / 8

    def wire(tokens: int) -> int:
        return codec.request_wire_bytes(tokens, **sizes, **fields, tcp_ip=tcp_ip)

    assert k == 0 or wire(k) <= room_bytes
    assert wire(k + 1) > room_bytes
    assert k <= token_budget(snr_db, link, size[0] * codec.bits_per_value(quantization))


@pytest.mark.parametrize("margin", [-0.1, 1.0, math.nan])
def test_a_margin_is_a_share(margin: float) -> None:
    with pytest.raises(LinkError, match="margin"):
        framed_token_budget(10.0, LinkProfile(), token_dim=8, quantization="int8", margin=margin)


@pytest.mark.parametrize(
    ("tokens", "kib"),
    [(512, 1088.0), (128, 272.0), (64, 136.0), (48, 102.0), (32, 68.0), (16, 34.0)],
)
def test_the_budget_that_the_paper_calls_k_costs_its_kilobytes(tokens: int, kib: float) -> None:
    bits_per_token = 2176 * 8
    link = LinkProfile(bandwidth_hz=tokens * bits_per_token, period_s=1.0, efficiency=1.0)
    assert token_budget(0.0, link, bits_per_token) == tokens
    assert codec.payload_bytes(tokens, 2176, "int8") / 1024 == kib
