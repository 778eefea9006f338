"""How many tokens a crowded server asks for, against calculations by hand."""

from __future__ import annotations

import pytest

from comvla_server.cost_model import CostModel, Work
from comvla_server.load_policy import LoadPolicy
from comvla_server.offered_load import OfferedLoad

N, BATCH = 512, 8
FIXED_S, REQUEST_S, TOKEN_S = 0.008, 0.001, 0.0001


def known_costs(token_s: float = TOKEN_S) -> CostModel:
    costs = CostModel()
    costs.fixed_s, costs.request_s, costs.token_s = FIXED_S, REQUEST_S, token_s
    costs._seconds.append(1.0)
    return costs


def fleet(load: OfferedLoad, rate: float, ks: list[int], seconds: float = 12.0) -> float:
    """Requests at a steady rate, K in turns; returns when they end."""
    now_s = 1000.0
    for i in range(int(rate * seconds)):
        now_s = 1000.0 + i / rate
        load.note(Work(1, ks[i % len(ks)]), now_s)
    load.note_pressure(now_s)
    return now_s


def offered(costs: CostModel | None = None, **policy: float) -> OfferedLoad:
    return OfferedLoad(costs or known_costs(), BATCH, N, LoadPolicy(**policy))  # type: ignore[arg-type]


def cost_s(k: float) -> float:
    return FIXED_S / BATCH + REQUEST_S + k * TOKEN_S


def test_the_load_is_what_is_asked_over_what_can_be_done() -> None:
    load = offered()
    now_s = fleet(load, 150.0, [100])
    assert load.requests_per_s(now_s) == pytest.approx(150.0, rel=0.02)
    assert load.load(now_s) == pytest.approx(150.0 * cost_s(100), rel=0.02)
    assert load.load(now_s + 60.0) == pytest.approx(0.0, abs=1e-9)


def test_a_server_with_time_to_spare_has_no_wish() -> None:
    load = offered()
    now_s = fleet(load, 50.0, [100])  # 0.6 of the capacity
    assert load.load(now_s) < 0.8
    assert load.advice(now_s) == 0


def test_a_crowded_server_asks_for_as_many_tokens_as_it_can_take_from_each() -> None:
    load = offered()
    now_s = fleet(load, 150.0, [100])
    # rate · cost(K) = 0.8 of the time
    expected = (0.8 / 150.0 - FIXED_S / BATCH - REQUEST_S) / TOKEN_S
    assert load.advice(now_s) == pytest.approx(expected, abs=2)
    assert 150.0 * cost_s(load.advice(now_s)) == pytest.approx(0.8, rel=0.05)


def test_robots_on_thin_links_leave_room_to_the_others() -> None:
    load = offered()
    now_s = fleet(load, 150.0, [10, 10, 100, 100])
    mean = (0.8 / 150.0 - FIXED_S / BATCH - REQUEST_S) / TOKEN_S
    expected = (4 * mean - 20) / 2
    assert load.advice(now_s) == pytest.approx(expected, abs=3)
    assert load.advice(now_s) > mean


def test_advice_that_is_followed_stays_as_it_is() -> None:
    load = offered()
    now_s = fleet(load, 150.0, [100])
    first = load.advice(now_s)
    for i in range(3000):
        now_s += 1 / 150.0
        load.note(Work(1, min(100, load.advice(now_s) or 100)), now_s)
        assert load.advice(now_s) == pytest.approx(first, abs=2), i


def test_advice_ceases_when_robots_leave() -> None:
    load = offered()
    now_s = fleet(load, 150.0, [100])
    advice = load.advice(now_s)
    for _ in range(600):
        now_s += 1 / 30.0
        load.note(Work(1, min(100, load.advice(now_s) or 100)), now_s)
    assert advice > 0
    assert load.advice(now_s) == 0


def test_never_fewer_than_policies_can_use() -> None:
    load = offered(advise_least_tokens=20)
    now_s = fleet(load, 2000.0, [100])
    assert load.advice(now_s) == 20


def test_where_tokens_cost_nothing_fewer_would_not_help() -> None:
    load = offered(known_costs(token_s=0.0))
    now_s = fleet(load, 2000.0, [100])
    assert load.load(now_s) > 1.0
    assert load.advice(now_s) == 0


def test_advice_can_be_switched_off() -> None:
    load = offered(advise_tokens=False)
    assert load.advice(fleet(load, 150.0, [100])) == 0


def test_pictures_take_their_share_and_are_not_advised() -> None:
    costs = known_costs()
    costs.picture_s = 0.002
    load = OfferedLoad(costs, BATCH, N, LoadPolicy())
    now_s = 1000.0
    for i in range(360):  # 30 a second, every tenth with pictures
        now_s = 1000.0 + i / 30.0
        load.note(Work(1, N, 1) if i % 10 == 0 else Work(1, 300), now_s)
    load.note_pressure(now_s)
    shared = FIXED_S / BATCH + REQUEST_S
    left_s = 0.8 / 30.0 - shared - 0.1 * (0.002 + N * TOKEN_S)
    assert load.advice(now_s) == pytest.approx(left_s / (TOKEN_S * 0.9), abs=8)


def test_robots_that_keep_a_model_busy_and_their_deadlines_too_are_not_advised() -> None:
    load = offered()
    now_s = 1000.0
    for i in range(1800):
        now_s = 1000.0 + i / 150.0
        load.note(Work(1, 100), now_s)
    assert load.load(now_s) > 1.0
    assert load.advice(now_s) == 0
    load.note_pressure(now_s)
    assert load.advice(now_s + 0.2) > 0
