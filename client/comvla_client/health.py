"""Asks grpc.health.v1 without its package, which a robot need not install."""

from __future__ import annotations

import asyncio
from typing import Any

import grpc

from comvla_client import channel
from comvla_client.access import Access
from comvla_client.revival import discard

# Both messages have one field, so their bytes are spelled out here: an empty request asks about the
# whole server, and the answer is the field tag 0x08 and one digit.
_CHECK = "/grpc.health.v1.Health/Check"

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
    connection = access.channel()
    check: grpc.UnaryUnaryMultiCallable[bytes, bytes] = connection.unary_unary(_CHECK)
    try:
        return _status(check(b"", timeout=timeout_s))
    except grpc.RpcError as error:
        raise channel.transport_error(error) from error
    finally:
        discard([connection])


async def check_health_aio(access: Access, timeout_s: float) -> str:
    """:func:`check_health` on the running event loop."""
    connection = access.aio_channel()
    check: Any = connection.unary_unary(_CHECK)
    try:
        return _status(await asyncio.wait_for(check(b"", timeout=timeout_s), timeout_s))
    except asyncio.TimeoutError:
        raise channel.unanswered(timeout_s) from None
    except grpc.RpcError as error:
        raise channel.transport_error(error) from error
    finally:
        await connection.close()


def _status(answer: bytes) -> str:
    number = answer[1] if len(answer) == 2 and answer[0] == 0x08 else 0
    return _STATUS.get(number, "UNKNOWN")
