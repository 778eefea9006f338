"""The simulated radio channels have the statistics that their formulas promise."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from comvla.errors import LinkError
from comvla_sim.channel import (
    BLOCK_PERIODS,
    ConstantChannel,
    RayleighChannel,
    RicianChannel,
    TraceChannel,
    bessel_j0,
)

PERIOD_S = 0.05
REALISATIONS = 2000
# Kolmogorov's critical value for a sample of REALISATIONS at p = 0.001.
CRITICAL_KS = 1.95 / math.sqrt(REALISATIONS)


def kolmogorov_smirnov(sample: NDArray[np.float64], cdf: NDArray[np.float64]) -> float:
    """Largest distance of the empirical distribution from ``cdf`` at the sorted sample."""
    steps = np.arange(len(sample) + 1) / len(sample)
    return float(max(np.abs(cdf - steps[1:]).max(), np.abs(cdf - steps[:-1]).max()))


def rician_power_cdf(power: NDArray[np.float64], kappa: float) -> NDArray[np.float64]:
    """P(|h|² <= power): a noncentral chi-square of 2 degrees, as a Poisson mixture of Erlangs."""
    x = (kappa + 1) * power
    erlang_tail = np.zeros_like(x)
    term_x = np.exp(-x)
    weight = math.exp(-kappa)
    cdf = np.zeros_like(x)
    for j in range(80):
        erlang_tail += term_x
        cdf += weight * (1 - erlang_tail)
        term_x = term_x * x / (j + 1)
        weight *= kappa / (j + 1)
    return cdf


# From tables (Abramowitz and Stegun 9.1), and the first three zeros.
@pytest.mark.parametrize(
    ("x", "expected"),
    [
        (0.0, 1.0),
        (1.0, 0.7651976865579666),
        (math.pi, -0.3042421776440938),
        (-5.0, -0.1775967713143383),
        (20.0, 0.1670246643405832),
        (2.404825557695773, 0.0),
        (5.520078110286311, 0.0),
        (8.653727912911012, 0.0),
    ],
)
def test_bessel_function_has_its_tabulated_values(x: float, expected: float) -> None:
    assert bessel_j0(x) == pytest.approx(expected, abs=1e-13)


def test_bessel_function_solves_its_differential_equation_far_out() -> None:
    """x² y'' + x y' + x² y = 0, with differences of fourth order."""
    step = 1e-2
    for x in (37.3, 412.9, 1607.1):
        y = bessel_j0(x + step * np.arange(-2, 3))
        first = (y[0] - 8 * y[1] + 8 * y[3] - y[4]) / (12 * step)
        second = (-y[0] + 16 * y[1] - 30 * y[2] + 16 * y[3] - y[4]) / (12 * step**2)
        assert second + first / x + y[2] == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize(
    ("kappa", "period"), [(0.0, 100), (3.0, 0), (3.0, BLOCK_PERIODS + 5), (12.0, 7)]
)
def test_independent_realisations_follow_the_closed_form(kappa: float, period: int) -> None:
    channels = (
        RicianChannel(7.0, 10.0, PERIOD_S, seed, rician_k=kappa, los_doppler_hz=2.0)
        for seed in range(REALISATIONS)
    )
    snr_db = np.array([next(itertools.islice(c, period, None)) for c in channels])
    power = np.sort(10 ** ((snr_db - 7.0) / 10))
    distance = kolmogorov_smirnov(power, rician_power_cdf(power, kappa))
    assert distance < CRITICAL_KS


def test_rayleigh_is_exponential_and_not_anything_like_it() -> None:
    """The same test tells Rayleigh from a Rician channel with a weak line of sight."""
    channels = (RayleighChannel(0.0, 10.0, PERIOD_S, seed) for seed in range(REALISATIONS))
    power = np.sort([10 ** (next(iter(c)) / 10) for c in channels])
    assert kolmogorov_smirnov(power, -np.expm1(-power)) < CRITICAL_KS
    assert kolmogorov_smirnov(power, rician_power_cdf(power, 1.5)) > CRITICAL_KS


@pytest.mark.parametrize("doppler_hz", [0.2, 10.0, 37.0])
def test_gains_are_correlated_like_j0_within_and_across_blocks(doppler_hz: float) -> None:
    gains = np.stack(
        [
            RayleighChannel(0.0, doppler_hz, PERIOD_S, seed).gains(2 * BLOCK_PERIODS)
            for seed in range(REALISATIONS)
        ]
    )
    error = 4 / math.sqrt(REALISATIONS)  # four standard deviations of an estimated correlation
    for start in (0, 100, BLOCK_PERIODS - 3, BLOCK_PERIODS + 20):
        for lag in (0, 1, 2, 3, 4, 5, 50):
            estimate = np.mean(gains[:, start + lag] * gains[:, start].conj())
            expected = bessel_j0(2 * np.pi * doppler_hz * lag * PERIOD_S)
            assert abs(estimate - expected) < error


def test_scattered_gains_have_the_kurtosis_of_a_complex_gaussian() -> None:
    gains = np.concatenate(
        [RayleighChannel(0.0, 10.0, PERIOD_S, s).gains(1000) for s in range(200)]
    )
    power = np.abs(gains) ** 2
    assert power.mean() == pytest.approx(1.0, abs=0.01)
    assert (power**2).mean() == pytest.approx(2.0, rel=0.03)


@pytest.mark.parametrize("threshold", [0.3, 1.0])
def test_level_crossings_and_fade_durations_of_a_long_run(threshold: float) -> None:
    """Sampled at 2 kHz over a thousand blocks: N = √(2π) f_d ρ exp(-ρ²), AFD = P(fade) / N."""
    doppler_hz, period_s = 10.0, 0.0005
    envelope = np.abs(RayleighChannel(0.0, doppler_hz, period_s, 3).gains(1000 * BLOCK_PERIODS))
    below = envelope < threshold
    crossings = np.count_nonzero(below[:-1] & ~below[1:])
    rate_hz = crossings / (len(envelope) * period_s)
    expected_hz = math.sqrt(2 * math.pi) * doppler_hz * threshold * math.exp(-(threshold**2))
    assert rate_hz == pytest.approx(expected_hz, rel=0.08)
    expected_fade_s = (1 - math.exp(-(threshold**2))) / expected_hz
    assert below.mean() / rate_hz == pytest.approx(expected_fade_s, rel=0.08)


def test_snr_autocorrelation_of_a_rician_channel_with_a_moving_line_of_sight() -> None:
    kappa, doppler_hz, los_hz, lag = 3.0, 10.0, 4.0, 1
    power = np.stack(
        [
            np.abs(RicianChannel(0.0, doppler_hz, PERIOD_S, s, kappa, los_hz).gains(2)) ** 2
            for s in range(4000)
        ]
    )
    rho = float(bessel_j0(2 * np.pi * doppler_hz * lag * PERIOD_S))
    swing = math.cos(2 * math.pi * los_hz * lag * PERIOD_S)
    expected = (rho**2 + 2 * kappa * rho * swing) / (1 + 2 * kappa)
    assert np.corrcoef(power.T)[0, 1] == pytest.approx(expected, abs=4 / math.sqrt(4000))


def test_the_same_seed_is_the_same_channel_and_iterating_again_starts_again() -> None:
    channel = RicianChannel(10.0, 10.0, PERIOD_S, seed=5, rician_k=3.0)
    again = RicianChannel(10.0, 10.0, PERIOD_S, seed=5, rician_k=3.0)
    other = RicianChannel(10.0, 10.0, PERIOD_S, seed=6, rician_k=3.0)
    values = channel.snr_db(600)
    assert np.array_equal(values, channel.snr_db(600))
    assert np.array_equal(values, again.snr_db(600))
    assert not np.isclose(values, other.snr_db(600)).any()
    assert np.allclose(values, 10.0 + 20 * np.log10(np.abs(channel.gains(600))))


def test_without_doppler_the_gain_never_changes() -> None:
    values = RayleighChannel(3.0, 0.0, PERIOD_S, seed=1).snr_db(3 * BLOCK_PERIODS)
    assert np.ptp(values) < 1e-3


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("mean_snr_db", math.nan),
        ("mean_snr_db", math.inf),
        ("mean_snr_db", -math.inf),
        ("mean_snr_db", "loud"),
        ("doppler_hz", -1.0),
        ("doppler_hz", math.inf),
        ("period_s", 0.0),
        ("period_s", -0.05),
        ("period_s", math.nan),
        ("seed", -1),
        ("seed", 2**32),
        ("seed", 0.5),
        ("rician_k", -0.1),
        ("rician_k", math.inf),
        ("los_doppler_hz", math.nan),
    ],
)
def test_senseless_parameters_are_refused_by_name(argument: str, value: object) -> None:
    arguments: dict[str, object] = {
        "mean_snr_db": 10.0,
        "doppler_hz": 10.0,
        "period_s": PERIOD_S,
        "seed": 0,
        "rician_k": 3.0,
        "los_doppler_hz": 0.0,
    }
    arguments[argument] = value
    with pytest.raises(LinkError, match=argument):
        RicianChannel(**arguments)  # type: ignore[arg-type]


def test_a_constant_channel_is_constant_and_may_be_down() -> None:
    assert list(itertools.islice(ConstantChannel(4.5), 3)) == [4.5, 4.5, 4.5]
    assert next(iter(ConstantChannel(-math.inf))) == -math.inf
    for value in (math.nan, math.inf):
        with pytest.raises(LinkError, match="snr_db"):
            ConstantChannel(value)


snr_values = st.floats(-60, 60, allow_nan=False) | st.just(-math.inf)


@given(values=st.lists(snr_values, min_size=1, max_size=20), with_header=st.booleans())
def test_a_trace_gives_back_what_the_file_holds_and_repeats(
    tmp_path_factory: pytest.TempPathFactory, values: list[float], with_header: bool
) -> None:
    path = tmp_path_factory.mktemp("trace") / "trace.csv"
    if with_header:
        text = "time_s,snr_db\n" + "".join(f"{i * 0.05},{v!r}\n" for i, v in enumerate(values))
    else:
        text = "# measured on the roof\n\n" + "".join(f"{v!r}\n" for v in values)
    path.write_text(text)
    channel = TraceChannel(path)
    assert len(channel) == len(values)
    assert channel.snr_db(2 * len(values)).tolist() == values + values


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no values"),
        ("# nothing\n", "no values"),
        ("3.0\nloud\n", "line 2"),
        ("3.0\nnan\n", "line 2"),
        ("inf\n", "line 1"),
        ("time_s,snr_db\n0.0,3.0\n0.05\n", "line 3"),
    ],
)
def test_a_trace_that_is_none_names_the_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "trace.txt"
    path.write_text(text)
    with pytest.raises(LinkError, match=message):
        TraceChannel(path)


def timed_trace(path: Path, times: list[float | str], values: list[float]) -> Path:
    rows = zip(times, values, strict=True)
    path.write_text("time_s,snr_db\n" + "".join(f"{t},{v}\n" for t, v in rows))
    return path


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.0, 0.05, 0.04, 0.15], r"line 4.*backwards.*0.05 s and then 0.04 s"),
        ([0.0, 0.05, 0.05, 0.15], r"line 4.*stands still"),
        ([0.0, 0.05, 0.1, 0.25], r"line 5.*gap of 0.15 s.*max_gap_s"),
        ([0.0, "nan", 0.1, 0.15], r"line 3.*time in seconds"),
        ([0.0, "soon", 0.1, 0.15], r"line 3.*time in seconds"),
        ([0.0, 0.05, "inf", 0.15], r"line 4.*time in seconds"),
    ],
)
def test_times_that_leave_something_out_are_refused_by_line(
    tmp_path: Path, times: list[float | str], message: str
) -> None:
    path = timed_trace(tmp_path / "t.csv", times, [1.0, 2.0, 3.0, 4.0])
    for period_s in (None, 0.05):
        with pytest.raises(LinkError, match=message):
            TraceChannel(path, period_s=period_s)


def test_a_gap_that_is_allowed_is_bridged_by_the_last_value(tmp_path: Path) -> None:
    path = timed_trace(tmp_path / "t.csv", [0.0, 0.05, 0.1, 0.25, 0.3], [1.0, 2.0, 3.0, 4.0, 5.0])
    channel = TraceChannel(path, period_s=0.05, max_gap_s=0.2)
    assert channel.snr_db(len(channel)).tolist() == [1.0, 2.0, 3.0, 3.0, 3.0, 4.0, 5.0]
    with pytest.raises(LinkError, match="max_gap_s"):
        TraceChannel(path, max_gap_s=math.nan)


@given(
    step_s=st.sampled_from([0.01, 0.02, 0.05, 0.1, 0.25, 1.0]),
    period_s=st.sampled_from([0.02, 0.05, 0.1]),
    count=st.integers(2, 60),
    begin_s=st.sampled_from([0.0, 17.3, -5.0]),
)
def test_a_period_has_the_latest_value_measured_before_it(
    tmp_path_factory: pytest.TempPathFactory,
    step_s: float,
    period_s: float,
    count: int,
    begin_s: float,
) -> None:
    values = [float(i) for i in range(count)]
    times = [round(begin_s + i * step_s, 6) for i in range(count)]
    path = timed_trace(tmp_path_factory.mktemp("trace") / "t.csv", list(times), values)
    channel = TraceChannel(path, period_s=period_s)
    assert len(channel) == max(1, round(count * step_s / period_s * 1e6) // 1_000_000)
    ratio = period_s / step_s
    expected = [math.floor(t * ratio + 1e-6) for t in range(len(channel))]
    assert channel.snr_db(len(channel)).tolist() == expected


def test_a_trace_may_begin_anywhere_and_comes_round(tmp_path: Path) -> None:
    path = tmp_path / "trace.txt"
    path.write_text("1\n2\n3\n")
    assert TraceChannel(path, start=2).snr_db(4).tolist() == [3.0, 1.0, 2.0, 3.0]
    assert TraceChannel(path, start=7).snr_db(2).tolist() == [2.0, 3.0]


def test_one_timed_value_is_a_trace(tmp_path: Path) -> None:
    path = timed_trace(tmp_path / "t.csv", [3.0], [-math.inf])
    assert TraceChannel(path, period_s=0.05).snr_db(2).tolist() == [-math.inf, -math.inf]


def test_a_missing_trace_is_a_link_error(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="cannot read"):
        TraceChannel(tmp_path / "missing.txt")
