"""What a payload costs, before any framing: the paper's accounting and this codec's own."""

from __future__ import annotations

import operator

from comvla.codec.layout import MAX_TOWERS, header_bytes, record_bytes
from comvla.codec.quantizers import Quantizer, quantizer_named
from comvla.errors import CodecError


def payload_bytes(k: int, token_dim: int, quantization: str) -> int:
    """TX as the paper counts it: ``K * D * B / 8`` bytes, rounded up. No positions, no scales.

    The paper's kilobytes are KiB: 512 tokens of 2176 INT8 values are 1088.0 KiB.

    Raises:
        CodecError: negative ``k``, ``token_dim`` below 1, or an unknown quantization.
    """
    quantizer = _checked(quantization, k=k, token_dim=token_dim)
    return -(-k * token_dim * quantizer.bits // 8)


def encoded_bytes(k: int, token_dim: int, quantization: str, *, num_towers: int = 1) -> int:
    """Exact length of what :func:`comvla.codec.encode` writes for ``k`` tokens.

    Raises:
        CodecError: negative ``k``, ``token_dim`` below 1, ``num_towers`` outside 1..16, or an
            unknown quantization.
    """
    quantizer = _checked(quantization, k=k, token_dim=token_dim, num_towers=num_towers)
    return header_bytes(num_towers) + k * record_bytes(quantizer, token_dim, num_towers)


def prefix_tokens(nbytes: int, token_dim: int, quantization: str, *, num_towers: int = 1) -> int:
    """Whole tokens in the first ``nbytes`` bytes of a payload, the inverse of `encoded_bytes`.

    The payload is taken as long enough; the caller clips to the tokens that were sent. 0 where the
    cut falls inside the header or the first token.

    Raises:
        CodecError: negative ``nbytes``, ``token_dim`` below 1, ``num_towers`` outside 1..16, or an
            unknown quantization.
    """
    quantizer = _checked(quantization, nbytes=nbytes, token_dim=token_dim, num_towers=num_towers)
    records = max(0, nbytes - header_bytes(num_towers))
    return records // record_bytes(quantizer, token_dim, num_towers)


def _checked(quantization: str, **numbers: int) -> Quantizer:
    lowest = {"token_dim": 1, "num_towers": 1}
    for name, number in numbers.items():
        try:
            whole = operator.index(number)
        except TypeError:
            raise CodecError(f"expected an integer {name}, got {number!r}") from None
        if whole < lowest.get(name, 0):
            raise CodecError(f"expected {name} of at least {lowest.get(name, 0)}, got {number}")
    if numbers.get("num_towers", 1) > MAX_TOWERS:
        raise CodecError(f"expected num_towers up to {MAX_TOWERS}, got {numbers['num_towers']}")
    return quantizer_named(quantization)
