"""The busy meter against a plain sum."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from comvla_server.busy import BusyMeter

WINDOW_S = 5.0


@given(
    st.lists(st.tuples(st.floats(0.0, 3.0), st.floats(0.0, 8.0)), max_size=30),
    st.floats(0.0, 10.0),
    st.booleans(),
)
def test_utilization_is_the_busy_share_of_the_window(
    pauses_and_work: list[tuple[float, float]], rest_s: float, at_work: bool
) -> None:
    meter = BusyMeter(WINDOW_S)
    now_s = 100.0
    spans = []
    for pause_s, work_s in pauses_and_work:
        now_s += pause_s
        meter.begin(now_s)
        spans.append((now_s, now_s + work_s))
        now_s += work_s
        meter.end(now_s)
        meter.utilization(now_s)
    if at_work:
        meter.begin(now_s)
        spans.append((now_s, now_s + rest_s))
    now_s += rest_s
    horizon_s = now_s - WINDOW_S
    busy_s = sum(max(0.0, end - max(start, horizon_s)) for start, end in spans)
    assert meter.utilization(now_s) == pytest.approx(min(1.0, busy_s / WINDOW_S), abs=1e-9)


def test_an_end_without_a_beginning_is_ignored() -> None:
    meter = BusyMeter()
    meter.end(10.0)
    assert meter.utilization(10.0) == 0.0
