"""What one identity may send, so that no robot takes the share of the others."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from comvla_server.identity import Identity
from comvla_server.refusals import Reason, Refusal
from comvla_server.settings import ServerSettings
from comvla_server.wording import shown

BURST_S = 2.0
"""Seconds of its rate that an identity may use at once after a pause."""

_MOST_REMEMBERED = 4096


@dataclass
class TokenBucket:
    """Fills at a steady rate, and may be overdrawn once: what is larger than the bucket passes when
    it is full, and is paid for afterwards.

    Attributes:
        rate: units per second, 0 for no limit.
        least: units that must be there.
        level: units that are there.
        at_s: when that was, on the caller's clock.
    """

    rate: float
    least: float
    level: float
    at_s: float

    @classmethod
    def full(cls, rate: float, least: float, now_s: float) -> TokenBucket:
        """A bucket that holds its whole burst."""
        return cls(rate, least, max(least, rate * BURST_S), now_s)

    def wait_s(self, now_s: float) -> float:
        """Seconds until something may be taken, 0.0 for at once."""
        if not self.rate:
            return 0.0
        full = max(self.least, self.rate * BURST_S)
        self.level = min(full, self.level + self.rate * max(0.0, now_s - self.at_s))
        self.at_s = now_s
        return max(0.0, (self.least - self.level) / self.rate)

    def take(self, units: float) -> None:
        """Takes something."""
        if self.rate:
            self.level -= units


@dataclass
class _Account:
    rates: tuple[float, float]
    requests: TokenBucket
    size: TokenBucket
    open_calls: int = 0


class RateLimits:
    """Keeps an account for each identity. Identities that nobody was asked for are not limited.

    Args:
        settings: limits of identities that have none of their own.
        clock: monotonic seconds.
    """

    def __init__(
        self, settings: ServerSettings, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._settings = settings
        self._clock = clock
        self._accounts: OrderedDict[str, _Account] = OrderedDict()

    def begin(self, identity: Identity) -> Callable[[], None]:
        """Counts a call that begins.

        Returns:
            What to call, once, when it has ended.

        Raises:
            Refusal: too many calls lately, or open.
        """
        if not identity.name:
            return _nothing
        account = self._account(identity)
        most = self._settings.identity_max_calls
        if account.open_calls >= most:
            raise Refusal(
                Reason.RATE,
                f"{shown(identity.name)} has {account.open_calls} calls open, expected at most "
                f"{most}: retry when one has ended",
            )
        wait_s = account.requests.wait_s(self._clock())
        if wait_s > 0:
            raise Refusal(
                Reason.RATE,
                f"{shown(identity.name)} may make {account.requests.rate:g} calls per second and "
                f"made more: retry in {wait_s:.2f} s, or ask for a higher limit",
                retry_after_s=wait_s,
            )
        account.requests.take(1)
        account.open_calls += 1

        def ended() -> None:
            account.open_calls -= 1

        return ended

    def charge(self, identity: Identity, size_bytes: int) -> None:
        """Counts a message that has arrived.

        Raises:
            Refusal: larger than this identity may send, or too many bytes lately.
        """
        if not identity.name:
            return
        largest = identity.limits.max_request_bytes
        if largest is not None and size_bytes > largest:
            raise Refusal(
                Reason.OVERSIZE,
                f"expected a request of at most {largest} bytes from {shown(identity.name)}, got "
                f"{size_bytes}: send fewer tokens or a narrower quantization, or ask for a higher "
                "limit",
            )
        account = self._account(identity)
        wait_s = account.size.wait_s(self._clock())
        if wait_s > 0:
            raise Refusal(
                Reason.RATE,
                f"{shown(identity.name)} may send {account.size.rate:g} bytes per second and sent "
                f"more: retry in {wait_s:.2f} s, send fewer tokens, or ask for a higher limit",
                retry_after_s=wait_s,
            )
        account.size.take(size_bytes)

    def _account(self, identity: Identity) -> _Account:
        limits, settings = identity.limits, self._settings
        rates = (
            _chosen(limits.requests_per_s, settings.identity_requests_per_s),
            _chosen(limits.bytes_per_s, settings.identity_bytes_per_s),
        )
        account = self._accounts.get(identity.name)
        if account is None or account.rates != rates:
            now_s = self._clock()
            requests = TokenBucket.full(rates[0], 1.0, now_s)
            size = TokenBucket.full(rates[1], 1.0, now_s)
            if account is None:
                account = self._accounts[identity.name] = _Account(rates, requests, size, 0)
            else:  # in place: calls that are open will be counted off this very account
                account.rates, account.requests, account.size = rates, requests, size
            if len(self._accounts) > _MOST_REMEMBERED:
                self._accounts.popitem(last=False)
        self._accounts.move_to_end(identity.name)
        return account


def _chosen(own: float | None, otherwise: float) -> float:
    return otherwise if own is None else own


def _nothing() -> None:
    pass
