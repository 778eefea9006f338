"""Recordings of a link: what counts as one, and how they are played."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from comvla.errors import LinkError
from comvla_client.snr import TraceSnr, read_trace
from comvla_sim.channel import TraceChannel


def trace_file(folder: Path, text: str) -> Path:
    path = folder / "trace.csv"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "text",
    [
        "5\n-inf\n8.5\n",
        "# walked down the hall\n\n5\n-inf\n\n8.5\n",
        "snr_db\n5\n-inf\n8.5\n",
        "rssi,snr_db\n-60,5\n-99,-inf\n-50,8.5\n",
    ],
)
def test_what_the_simulated_channel_reads_plays_here_too(tmp_path: Path, text: str) -> None:
    path = trace_file(tmp_path, text)
    trace = read_trace(path, period_s=0.5)
    assert list(trace.snr_db) == list(TraceChannel(path).snr_db(3)) == [5.0, -math.inf, 8.5]
    assert trace.times_s == (0.0, 0.5, 1.0)
    assert trace.length_s == 1.5


@pytest.mark.parametrize("header", ["time_s,snr_db\n", "time,snr_db\n", "T, SNR_dB\n", ""])
def test_times_come_from_their_column_and_start_at_zero(tmp_path: Path, header: str) -> None:
    trace = read_trace(trace_file(tmp_path, f"{header}100.0,5\n100.25,6\n101.0,7\n"))
    assert trace.times_s == (0.0, 0.25, 1.0)
    assert trace.snr_db == (5.0, 6.0, 7.0)


def test_it_is_played_by_the_clock_and_grows_old_in_gaps(tmp_path: Path) -> None:
    path = trace_file(tmp_path, "time_s,snr_db\n0,1\n0.5,2\n4,3\n")
    now_s = [1000.0]
    snr = TraceSnr(path, clock=lambda: now_s[0])
    now_s[0] = 2000.0  # it starts when it is first asked
    played = []
    for elapsed_s in (0.0, 0.25, 0.5, 3.5, 4.0):
        now_s[0] = 2000.0 + elapsed_s
        played.append((snr.read().snr_db, snr.read().age_s))
    assert played == [(1, 0.0), (1, 0.25), (2, 0.0), (2, 3.0), (3, 0.0)]


def test_it_starts_again_or_stays_with_the_last_value(tmp_path: Path) -> None:
    path = trace_file(tmp_path, "1\n2\n")
    now_s = [0.0]
    again = TraceSnr(path, period_s=1.0, clock=lambda: now_s[0])
    once = TraceSnr(path, period_s=1.0, repeat=False, clock=lambda: now_s[0])
    again.read(), once.read()
    now_s[0] = 2.5
    assert (again.read().snr_db, again.read().age_s) == (1.0, 0.5)
    assert (once.read().snr_db, once.read().age_s) == (2.0, 1.5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no values"),
        ("snr_db\n", "no values"),
        ("5\nnan\n", "line 2"),
        ("5\ninf\n", "line 2"),
        ("5\nfast\n", "line 2"),
        ("time_s,snr_db\n0,5\n1,\n", "line 3"),
        ("time_s,snr_db\n0,5\n1\n", "line 3"),
        ("time_s,snr_db\n0,5\n1,5\n0.5,6\n", "line 4: expected a time in seconds after 1"),
        ("time_s,snr_db\n0,5\n0,6\n", "line 3"),
        ("time_s,snr_db\nnan,5\n", "line 2"),
        ("time_s,snr_db\n,5\n", "line 2"),
    ],
)
def test_a_broken_recording_is_refused_with_its_line(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(LinkError, match=words):
        TraceSnr(trace_file(tmp_path, text))


def test_what_is_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="cannot read"):
        TraceSnr(tmp_path / "missing.csv")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(LinkError, match="cannot read"):
        TraceSnr(tmp_path / "binary")
    with pytest.raises(LinkError, match="period_s"):
        TraceSnr(trace_file(tmp_path, "5\n"), period_s=0.0)


@given(text=st.text(alphabet="0123456789.,-einfasr_db# \n", max_size=80))
def test_any_text_gives_a_trace_or_a_link_error(
    text: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = trace_file(tmp_path_factory.getbasetemp(), text)
    try:
        trace = read_trace(path)
    except LinkError:
        return
    assert len(trace.times_s) == len(trace.snr_db) > 0
    assert trace.length_s > trace.times_s[-1]
