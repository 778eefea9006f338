"""One call as HTTP/2 frames on a connection of its own, in which something is wrong (RFC 9113)."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, replace

from comvla_sim.fuzz.mutations import mutated_bytes, mutated_fields, plain_request

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
DATA, HEADERS, PRIORITY, RST_STREAM, SETTINGS = 0, 1, 2, 3, 4
PING, GOAWAY, WINDOW_UPDATE, CONTINUATION = 6, 7, 8, 9
END_STREAM, END_HEADERS, ACK = 0x1, 0x4, 0x1
LAST_PING = b"fuzzdone"
"""What the last frame of an unspoilt connection asks to be echoed: by then the server has read it all."""

_PATH = b"/comvla.v1.PolicyService/Infer"
_PATHS = (
    _PATH,
    _PATH,
    b"/comvla.v1.PolicyService/GetModel",
    b"/grpc.health.v1.Health/Check",
    b"/",
    b"",
)


@dataclass(frozen=True)
class Frame:
    """One frame; ``length`` lies where it is given."""

    kind: int
    flags: int
    stream: int
    payload: bytes
    length: int | None = None

    def encode(self) -> bytes:
        """As it crosses the wire."""
        length = len(self.payload) if self.length is None else self.length
        head = (length & 0xFF_FFFF).to_bytes(3, "big") + bytes(
            (self.kind & 0xFF, self.flags & 0xFF)
        )
        return head + (self.stream & 0xFFFF_FFFF).to_bytes(4, "big") + self.payload


def mutated_connection(rng: random.Random) -> bytes:
    """All that a client sends on one connection: preface, settings, one call, a ping."""
    wrong = rng.random() < 0.5
    message = mutated_fields(rng) if wrong else plain_request(rng).SerializeToString()
    frames = [
        Frame(SETTINGS, 0, 0, b""),
        Frame(HEADERS, END_HEADERS, 1, _header_block(rng)),
        *_data(message, rng),
        Frame(PING, 0, 0, LAST_PING),
    ]
    for _ in range(rng.randint(0, 2)):
        rng.choice(_MUTATIONS)(frames, rng)
    content = b"".join(frame.encode() for frame in frames)
    if rng.random() < 0.2:
        content = mutated_bytes(content, rng)
    preface = PREFACE if rng.random() < 0.98 else mutated_bytes(PREFACE, rng)
    return preface + content


def _header_block(rng: random.Random) -> bytes:
    """Literal headers without compression (RFC 7541, 6.2.2); now and then a wrong one."""
    fields = [
        (b":method", b"POST"),
        (b":scheme", b"http"),
        (b":path", rng.choice(_PATHS)),
        (b":authority", b"localhost"),
        (b"content-type", b"application/grpc"),
        (b"te", b"trailers"),
        (b"grpc-timeout", rng.choice((b"2S", b"2S", b"1n", b"99999999H", b"-1S", b"x", b""))),
    ]
    match rng.randrange(10):
        case 0:
            del fields[rng.randrange(len(fields))]
        case 1:
            fields.insert(rng.randrange(8), rng.choice(fields))
        case 2:
            fields.append((rng.randbytes(rng.randrange(1, 9)), rng.randbytes(rng.randrange(9))))
        case 3:
            fields.append((b"x-long", b"a" * rng.choice((100, 9000, 20_000))))
        case 4:
            fields.append((b"grpc-encoding", rng.choice((b"gzip", b"deflate", b"none", b"\xff"))))
        case _:
            pass
    block = b"".join(b"\x00" + _text(name) + _text(value) for name, value in fields)
    return mutated_bytes(block, rng) if rng.random() < 0.1 else block


def _text(text: bytes) -> bytes:
    length = len(text)
    if length < 127:
        return bytes((length,)) + text
    out, rest = bytearray(b"\x7f"), length - 127
    while rest >= 128:
        out.append(rest % 128 | 0x80)
        rest //= 128
    out.append(rest)
    return bytes(out) + text


def _data(message: bytes, rng: random.Random) -> list[Frame]:
    """The message behind gRPC's five bytes, in one frame or several; now and then they lie."""
    compressed, length = 0, len(message)
    if rng.random() < 0.15:
        compressed = rng.choice((1, 2, 255))
    if rng.random() < 0.15:
        length = rng.choice((0, 1, length + 1, 2**20, 2**31 - 1, 2**32 - 1))
    content = bytes((compressed,)) + length.to_bytes(4, "big") + message
    size = rng.choice((16_384, 16_384, 1000, 100, 7))
    if len(content) > 100 * size:
        size = 16_384
    parts = [content[at : at + size] for at in range(0, len(content), size)]
    return [
        Frame(DATA, END_STREAM if i == len(parts) - 1 else 0, 1, part)
        for i, part in enumerate(parts)
    ]


def _field(frames: list[Frame], rng: random.Random) -> None:
    at = rng.randrange(len(frames))
    match rng.randrange(4):
        case 0:
            frames[at] = replace(frames[at], kind=rng.choice((*range(11), 255)))
        case 1:
            frames[at] = replace(frames[at], flags=rng.choice((0, 1, 4, 8, 0x20, 0x2C, 0xFF)))
        case 2:
            frames[at] = replace(frames[at], stream=rng.choice((0, 1, 2, 3, 2**31 - 1, 2**31)))
        case _:
            frames[at] = replace(frames[at], length=rng.choice((0, 1, 8, 16_385, 2**24 - 1)))


def _payload(frames: list[Frame], rng: random.Random) -> None:
    at = rng.randrange(len(frames))
    frames[at] = replace(frames[at], payload=mutated_bytes(frames[at].payload, rng))


def _order(frames: list[Frame], rng: random.Random) -> None:
    at = rng.randrange(len(frames))
    match rng.randrange(4):
        case 0:
            del frames[at]
        case 1:
            frames.insert(at, frames[rng.randrange(len(frames))])
        case 2:
            rng.shuffle(frames)
        case _:
            frames[at:at] = [frames[at]] * rng.choice((2, 20, 200))


def _extra(frames: list[Frame], rng: random.Random) -> None:
    number = rng.choice((0, 1, 2**31 - 1, 2**32 - 1)).to_bytes(4, "big")
    setting = rng.choice((1, 2, 3, 4, 5, 6, 99)).to_bytes(2, "big")
    extra = rng.choice(
        (
            Frame(SETTINGS, 0, 0, setting + number),
            Frame(SETTINGS, ACK, 0, number),
            Frame(WINDOW_UPDATE, 0, rng.choice((0, 1, 3)), number),
            Frame(RST_STREAM, 0, 1, number),
            Frame(PRIORITY, 0, 1, number + b"\x10"),
            Frame(GOAWAY, 0, 0, number + number + b"bye"),
            Frame(CONTINUATION, 0, 1, rng.randbytes(20)),
            Frame(PING, ACK, 0, rng.randbytes(8)),
            Frame(HEADERS, END_HEADERS, rng.choice((1, 2, 3)), rng.randbytes(20)),
        )
    )
    at = rng.randrange(len(frames) + 1)
    frames[at:at] = [extra] * rng.choice((1, 1, 1, 50))


_MUTATIONS: tuple[Callable[[list[Frame], random.Random], None], ...] = (
    _field,
    _field,
    _payload,
    _order,
    _extra,
)
