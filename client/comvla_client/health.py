"""Asks grpc.health.v1 without its package, which a robot need not install."""

from __future__ import annotations

import grpc

from comvla_client import channel
from comvla_client.access import Access

_STATUS = {0: "UNKNOWN", 1: "SERVING", 2: "NOT_SERVING", 3: "SERVICE_UNKNOWN"}


def check_health(access: Access, timeout_s: float) -> str:
    """What the server says of its own health.

    Args:
        access: how to reach it.
        timeout_s: longest to wait, in seconds.

    Returns:
        ``SERVING``, ``NOT_SERVING``, ``UNKNOWN`` or ``SERVICE_UNKNOWN``.

    Raises:
        TransportError: no answer, or no health service there.
    """
    with access.channel() as connection:
        # Both messages have one field, so their bytes are spelled out here: an empty request asks
        # about the whole server, and the answer is the field tag 0x08 and one digit.
        check: grpc.UnaryUnaryMultiCallable[bytes, bytes]
        check = connection.unary_unary("/grpc.health.v1.Health/Check")
        try:
            answer: bytes = check(b"", timeout=timeout_s)
        except grpc.RpcError as error:
            raise channel.transport_error(error) from error
    number = answer[1] if len(answer) == 2 and answer[0] == 0x08 else 0
    return _STATUS.get(number, "UNKNOWN")
