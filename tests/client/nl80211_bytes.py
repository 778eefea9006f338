"""Netlink messages of the wireless subsystem: recorded from a kernel, or laid out as nl80211.h says.

They go through pyroute2's own decoder in the tests, as those of a kernel would.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

NESTED = 0x8000
GET_INTERFACE, GET_STATION, GET_SURVEY, GET_POWER_SAVE = 7, 19, 51, 62  # as the answers name them

# The attributes of struct survey_info, sta_info and rate_info.
SURVEY_FREQUENCY, SURVEY_NOISE, SURVEY_IN_USE = 1, 2, 3
STA_INACTIVE_TIME, STA_SIGNAL, STA_TX_BITRATE, STA_SIGNAL_AVG = 1, 7, 8, 13
RATE_BITRATE, RATE_BITRATE32 = 1, 5


def attribute(kind: int, value: bytes) -> bytes:
    """One netlink attribute, padded to four bytes."""
    return struct.pack("=HH", 4 + len(value), kind) + value + b"\0" * (-len(value) % 4)


def u32(kind: int, value: int) -> bytes:
    return attribute(kind, struct.pack("=I", value))


def message(command: int, *attributes: bytes) -> bytes:
    """A message of the nl80211 family (28 here; the kernel gives it a number at boot)."""
    body = struct.pack("=BBH", command, 1, 0) + b"".join(attributes)
    return struct.pack("=IHHII", 16 + len(body), 28, 2, 1, 99) + body


def decoded(raw: bytes) -> Any:
    """The message as pyroute2 reads it."""
    from pyroute2.netlink.nl80211 import nl80211cmd

    parsed = nl80211cmd(raw)
    parsed.decode()
    return parsed


def recorded(kind: str) -> list[bytes]:
    """What a real kernel answered: interface, station, survey or power_save."""
    lines = Path(__file__).with_name("nl80211_linux_6_1.txt").read_text("ascii").splitlines()
    return [bytes.fromhex(line.split()[1]) for line in lines if line.startswith(f"{kind} ")]


def interface(index: int, name: str, kind: int = 2, width: int | None = 3) -> bytes:
    parts = [
        u32(3, index),
        attribute(4, name.encode() + b"\0"),
        u32(5, kind),
        attribute(6, bytes(range(6))),
    ]
    if width is not None:
        parts += [u32(38, 5180), u32(159, width)]
    return message(GET_INTERFACE, *parts)


def station(
    signal_dbm: int | None = -52,
    *,
    average_dbm: int | None = None,
    inactive_ms: int = 12,
    rate: tuple[bytes, ...] = (),
) -> bytes:
    info = [u32(STA_INACTIVE_TIME, inactive_ms)]
    if signal_dbm is not None:
        info.append(attribute(STA_SIGNAL, struct.pack("=b", signal_dbm)))
    if average_dbm is not None:
        info.append(attribute(STA_SIGNAL_AVG, struct.pack("=b", average_dbm)))
    if rate:
        info.append(attribute(STA_TX_BITRATE | NESTED, b"".join(rate)))
    body = attribute(21 | NESTED, b"".join(info))
    return message(GET_STATION, u32(3, 7), attribute(6, bytes.fromhex("02aabbccddee")), body)


def survey(noise_dbm: int | None, *, in_use: bool, frequency_mhz: int = 5180) -> bytes:
    info = [u32(SURVEY_FREQUENCY, frequency_mhz)]
    if noise_dbm is not None:
        info.append(attribute(SURVEY_NOISE, struct.pack("=B", noise_dbm & 0xFF)))
    if in_use:
        info.append(attribute(SURVEY_IN_USE, b""))
    return message(GET_SURVEY, u32(3, 7), attribute(84 | NESTED, b"".join(info)))


def power_save(state: int) -> bytes:
    return message(GET_POWER_SAVE, u32(93, state))
