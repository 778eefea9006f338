"""How many tokens the link carries in one control period: Eq. (1) and Eq. (4) of the paper."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

from comvla import codec
from comvla.errors import LinkError


@dataclass(frozen=True)
class LinkProfile:
    """A radio link as the paper models it.

    Attributes:
        bandwidth_hz: W, in hertz.
        period_s: T, the control period in which a payload has to arrive, in seconds.
        efficiency: η in (0, 1], what share of the Shannon capacity becomes tokens. The paper never
            states it; 0.38 fits its two published points (Object suite, Rician κ = 3, mean 5 dB).
        reserve_s: what is kept of the period for the round trip and the computing in the cloud, so
            that the *answer* can arrive within the period, in seconds. Budgets use the rest of the
            period; at 0, the default, they are Eq. (4) as the paper has it.

    Raises:
        LinkError: a value that is not finite or out of range.
    """

    bandwidth_hz: float = 20e6
    period_s: float = 0.05
    efficiency: float = 0.38
    reserve_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("bandwidth_hz", "period_s"):
            value = getattr(self, name)
            if not _is_finite_number(value) or value <= 0:
                raise LinkError(
                    f"expected a finite {name} > 0, got {value!r}: "
                    "a link that is down is an SNR of -inf dB, not a link without bandwidth or time"
                )
        if not _is_finite_number(self.efficiency) or not 0 < self.efficiency <= 1:
            raise LinkError(
                f"expected an efficiency in (0, 1], got {self.efficiency!r}: it is the share of the "
                "Shannon capacity that becomes tokens, 0.38 where nothing better is known"
            )
        if not _is_finite_number(self.reserve_s) or not 0 <= self.reserve_s < self.period_s:
            raise LinkError(
                f"expected a reserve_s of at least 0 and below the period of {self.period_s} s, got "
                f"{self.reserve_s!r}: it is the part of the period in which nothing is sent"
            )

    @property
    def window_s(self) -> float:
        """The part of the period in which a payload may cross, in seconds."""
        return self.period_s - self.reserve_s

    def capacity_bits(self, snr_db: float) -> float:
        """C_link = η · W · T · log2(1 + SNR), Eq. (1): bits that cross in one period.

        Args:
            snr_db: signal-to-noise ratio in dB; −inf means no link and gives 0.

        Raises:
            LinkError: NaN or +inf.
        """
        bits = _bits_in(self.efficiency, self.bandwidth_hz, self.period_s, 0.0, 1)
        return bits * _log2_one_plus(check_snr_db(snr_db))

    def window_bits(self, snr_db: float, periods: int = 1) -> float:
        """Bits that cross before the reserve begins: the capacity that budgets divide into tokens.

        Args:
            snr_db: signal-to-noise ratio in dB; −inf means no link and gives 0.
            periods: control periods that the payload may take; only the last has a reserve.

        Raises:
            LinkError: NaN or +inf.
        """
        bits = _bits_in(self.efficiency, self.bandwidth_hz, self.period_s, self.reserve_s, periods)
        return bits * _log2_one_plus(check_snr_db(snr_db))

    def snr_db(self, capacity_bits: float) -> float:
        """The SNR in dB at which so many bits cross in one period: the inverse of Eq. (1).

        Args:
            capacity_bits: C_link, finite; 0 gives −inf.

        Raises:
            LinkError: negative or not finite.
        """
        if not _is_finite_number(capacity_bits) or capacity_bits < 0:
            raise LinkError(f"expected capacity_bits >= 0 and finite, got {capacity_bits!r}")
        if capacity_bits == 0:
            return -math.inf
        octaves = capacity_bits / (self.efficiency * self.bandwidth_hz * self.period_s)
        if octaves > 100.0:  # 1 is nothing beside 2 ** 100
            return octaves * 10.0 * math.log10(2.0)
        return 10.0 * math.log10(math.expm1(octaves * math.log(2.0)))


@functools.lru_cache(maxsize=64)
def _bits_in(
    efficiency: float, bandwidth_hz: float, period_s: float, reserve_s: float, periods: int
) -> float:
    """η · W · t, the bits of one bit per second and hertz."""
    # The decimals as they were written: .29 · 100 · 1 are 29 bits, not 28.999999999999996.
    written = [Fraction(repr(float(v))) for v in (efficiency, bandwidth_hz, period_s, reserve_s)]
    return float(written[0] * written[1] * (periods * written[2] - written[3]))


def check_snr_db(snr_db: float) -> float:
    """The SNR as a float, if it is one that a link can have.

    Args:
        snr_db: in dB; −inf means no link.

    Raises:
        LinkError: NaN, +inf, or not a number.
    """
    try:
        value = float(snr_db)
    except (TypeError, ValueError):
        value = math.nan
    if math.isnan(value) or value == math.inf:
        raise LinkError(
            f"expected an SNR in dB below +inf, got {snr_db!r}: report -inf when there is no link, "
            "and the last good value when the modem gave none"
        )
    return value


def token_budget(snr_db: float, link: LinkProfile, bits_per_token: float) -> int:
    """K*(SNR) = ⌊η · W · T · log2(1 + SNR) / (D · B)⌋, Eq. (4).

    Args:
        snr_db: SNR in dB (linear inside the formula); −inf gives 0.
        link: bandwidth, period and efficiency.
        bits_per_token: D · B.

    Returns:
        The largest K with K · bits_per_token <= capacity; not clipped to the N tokens there are.

    Raises:
        LinkError: the SNR is NaN or +inf, or bits_per_token is not positive.
    """
    if not _is_finite_number(bits_per_token) or bits_per_token <= 0:
        raise LinkError(
            f"expected bits_per_token > 0, got {bits_per_token!r}: it is token_dim * bits_per_value"
        )
    # Floor division of floats is exact, where dividing first may round up to the next integer.
    return int(link.window_bits(snr_db) // bits_per_token)


def framed_token_budget(
    snr_db: float,
    link: LinkProfile,
    *,
    token_dim: int,
    quantization: str,
    num_towers: int = 1,
    session_id: str = "",
    step: int = 0,
    instruction: str = "",
    proprio_dim: int = 0,
    model_fingerprint: str = "",
    margin: float = 0.0,
    tcp_ip: bool = False,
    mtu_bytes: int = 1500,
) -> int:
    """The largest K whose request really fits: positions, scales, protobuf, gRPC and HTTP/2 included.

    Eq. (4) counts values only, so a payload that fills its budget overruns the link by what frames
    it. Here every byte of :func:`comvla.codec.request_wire_bytes` counts.

    Args:
        snr_db: SNR in dB; −inf gives 0.
        link: bandwidth, period and efficiency.
        token_dim: D.
        quantization: a name of :data:`comvla.codec.QUANTIZATIONS`.
        num_towers: vision towers whose features are concatenated; each may have its own scale.
        session_id: as in the request.
        step: as in the request.
        instruction: as in the request.
        proprio_dim: P.
        model_fingerprint: as in the request.
        margin: share of the capacity to leave unused, in [0, 1).
        tcp_ip: count TCP and IPv4 headers too.
        mtu_bytes: what one IP packet holds; used with ``tcp_ip``.

    Returns:
        K, not clipped to the N tokens there are; 0 where not even one token fits.

    Raises:
        LinkError: the SNR is NaN or +inf, or the margin is out of range.
        CodecError: sizes or a quantization that the codec does not know.
    """
    if not 0.0 <= margin < 1.0:
        raise LinkError(f"expected a margin in [0, 1), got {margin!r}: a share of the capacity")
    room_bytes = (1.0 - margin) * link.window_bits(snr_db) / 8.0

    def fits(k: int) -> bool:
        return room_bytes >= codec.request_wire_bytes(
            k,
            token_dim,
            quantization,
            num_towers=num_towers,
            session_id=session_id,
            step=step,
            instruction=instruction,
            proprio_dim=proprio_dim,
            model_fingerprint=model_fingerprint,
            tcp_ip=tcp_ip,
            mtu_bytes=mtu_bytes,
        )

    # Framing only adds, so the paper's budget bounds this one from above.
    bits_per_token = token_dim * codec.bits_per_value(quantization)
    return largest_that(fits, token_budget(snr_db, link, bits_per_token))


def largest_that(fits: Callable[[int], bool], high: int) -> int:
    """The largest k in 1 to ``high`` that fits, 0 where none does; what fits, fits when smaller."""
    low = 0
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low


def _log2_one_plus(snr_db: float) -> float:
    if snr_db == -math.inf:
        return 0.0
    if snr_db > 300.0:  # beyond a double's 10^(dB/10), and 1 is nothing beside it
        return snr_db / 10.0 * math.log2(10.0)
    return math.log2(1.0 + 10.0 ** (snr_db / 10.0))


def _is_finite_number(value: object) -> bool:
    try:
        return math.isfinite(value)  # type: ignore[arg-type]
    except TypeError:
        return False


PAPER_LINK = LinkProfile()
"""20 MHz, 50 ms, η = 0.38: the link of the paper's fading experiments."""
