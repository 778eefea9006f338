"""What one identity may do, on a clock of the test."""

from __future__ import annotations

import pytest

from comvla_server.identity import Identity, Limits
from comvla_server.rate_limits import RateLimits
from comvla_server.refusals import Refusal
from comvla_server.settings import ServerSettings


def test_open_calls_are_counted_off_though_limits_change_meanwhile() -> None:
    limits = RateLimits(ServerSettings(identity_max_calls=2), clock=lambda: 0.0)
    first = limits.begin(Identity("arm"))
    second = limits.begin(Identity("arm", Limits(requests_per_s=1000.0)))
    with pytest.raises(Refusal, match="has 2 calls open"):
        limits.begin(Identity("arm", Limits(requests_per_s=2000.0)))
    first()
    second()
    for _ in range(2):
        limits.begin(Identity("arm", Limits(requests_per_s=3000.0)))
