"""Valid requests in which something is wrong: field by field, or byte by byte."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable
from functools import cache

import numpy as np

from comvla import codec
from comvla.images import coding_number
from comvla.v1 import policy_pb2
from comvla_sim.fuzz.target import CODINGS, INFO, valid_request

TEXTS = ("", " ", "open it", "\x00", "a" * 3000, "ж" * 500, "a\r\nb", "%s%n{}", "../..", "\u202e")
NAMES = ("robot", "robot.0", "a" * 128, "a" * 129, "A.B:c@d/e+f=g-h", "robot.99999999999")
FLOATS = (0.0, -0.0, math.nan, math.inf, -math.inf, 1e38, -1e38, 1e-45, 1.0, 65504.0, 65536.0)
INTEGERS = (0, 1, 2, 7, 255, 256, 2**31, 2**32 - 1, 2**63, 2**64 - 1)
SHORTS = (0, 1, 2, 8, 16, 24, 127, 128, 255, 4096, 65535)

_HEADER_BYTES = 16  # with two towers
_COUNTS = (0, 1, 1, 2, 3, 4, 6, 8, 12, 16, 32, INFO.num_tokens)

Mutation = Callable[[policy_pb2.InferRequest, random.Random], None]


@cache
def payload(count: int, quantization: str) -> bytes:
    """K random tokens at random positions."""
    rng = np.random.default_rng(count)
    tokens = rng.normal(size=(count, INFO.token_dim)).astype(np.float32)
    positions = rng.permutation(INFO.num_tokens)[:count]
    return codec.encode(tokens, positions, quantization, tower_dims=INFO.tower_dims)


def plain_request(rng: random.Random) -> policy_pb2.InferRequest:
    """A request that is right, of one of some hundreds of robots."""
    content = payload(rng.choice(_COUNTS), rng.choice(codec.QUANTIZATIONS))
    return valid_request(f"s{rng.randrange(600)}", rng.randrange(4), content)


def mutated_fields(rng: random.Random) -> bytes:
    """One to three fields replaced."""
    request = plain_request(rng)
    for _ in range(rng.randint(1, 3)):
        rng.choice(TOKEN_MUTATIONS)(request, rng)
    return request.SerializeToString()


def mutated_pictures(rng: random.Random) -> bytes:
    """Pictures in place of tokens, with zero to two things wrong about them."""
    request = plain_request(rng)
    request.ClearField("payload")
    coding = rng.choice(CODINGS)
    request.images.coding = coding_number(coding)
    for data in _files(coding, rng.randrange(8)):
        rows, columns = INFO.image_size
        request.images.views.add(data=data, height=rows, width=columns)
    for _ in range(rng.randint(0, 2)):
        rng.choice(_PICTURE_MUTATIONS)(request, rng)
    if rng.random() < 0.1:
        rng.choice(TOKEN_MUTATIONS)(request, rng)
    return request.SerializeToString()


def mutated_message(rng: random.Random) -> bytes:
    """The bytes of a right request, or a few bytes of nothing at all."""
    if rng.random() < 0.1:
        return rng.randbytes(rng.randrange(300))
    return mutated_bytes(plain_request(rng).SerializeToString(), rng)


def mutated_bytes(data: bytes, rng: random.Random) -> bytes:
    """Flipped, cut, doubled, inserted, moved or replaced bytes."""
    content = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(content) + 1)
        match rng.randrange(7):
            case 0 if content:
                content[at % len(content)] ^= 1 << rng.randrange(8)
            case 1:
                del content[at:]
            case 2:
                content[at:at] = content[: rng.randrange(64)]
            case 3:
                content[at:at] = rng.randbytes(rng.randrange(16))
            case 4:
                del content[at : at + rng.randrange(1, 9)]
            case 5:  # a varint that says too much
                content[at : at + 1] = b"\xff" * rng.randrange(1, 11) + b"\x01"
            case _:
                content[at : at + 4] = rng.randbytes(4)
    return bytes(content)


@cache
def _files(coding: str, number: int) -> tuple[bytes, ...]:
    """One file per view. Of a video the first is a key frame, number by number a later one."""
    from comvla.images.stills import encode_still
    from comvla.images.video import VideoWriter

    rows, columns = INFO.image_size
    x = np.arange(rows)[:, None] * 9 + np.arange(columns)[None, :] * 5
    frames = [((x + 31 * i)[..., None] % 256).repeat(3, axis=2).astype(np.uint8) for i in range(8)]
    views = INFO.grid[0]
    if coding != "h264":
        return tuple(encode_still(coding, frames[(number + v) % 8], 60) for v in range(views))
    writer = VideoWriter(rows, columns, 30)
    units = [writer.write(frame) for frame in frames]
    return (units[number % 8],) * views


def _text(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    name = rng.choice(("session_id", "instruction", "model_fingerprint"))
    setattr(
        request, name, rng.choice(NAMES if name == "session_id" and rng.random() < 0.5 else TEXTS)
    )


def _number(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    if rng.random() < 0.7:
        request.step = rng.choice(INTEGERS)
    else:
        request.protocol_version = rng.choice(INTEGERS) % 2**32


def _proprio(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    right = len(request.proprio)
    length = rng.choice((0, 1, right, right, right, right, right + 1, 500))
    request.proprio[:] = [rng.choice(FLOATS) for _ in range(length)]


def _link(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    request.snr_db = rng.choice(FLOATS)
    request.snr_age_s = rng.choice(FLOATS)


def _payload(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    request.payload = mutated_bytes(request.payload, rng)


def _payload_length(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    """Cut anywhere, or with more behind it; sometimes more than any message may have."""
    length = len(request.payload)
    wanted = rng.choice((rng.randrange(length + 1), length + rng.randrange(1, 99), 3 * length))
    if rng.random() < 0.01:
        wanted = 80_000
    request.payload = (request.payload + bytes(wanted))[:wanted]


def _payload_header(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    """Lies in the header: version, quantization, towers, widths, counts."""
    content = bytearray(request.payload)
    at = rng.randrange(4, _HEADER_BYTES)
    content[at : at + 2] = struct.pack("<H", rng.choice(SHORTS))
    request.payload = bytes(content)


def _payload_records(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    """A position, a scale or a value: out of range, repeated, not finite, huge."""
    content = bytearray(request.payload)
    if len(content) <= _HEADER_BYTES + 8:
        return
    record = (len(content) - _HEADER_BYTES) // max(1, struct.unpack_from("<H", content, 10)[0])
    at = _HEADER_BYTES + record * rng.randrange(
        max(1, (len(content) - _HEADER_BYTES) // max(1, record))
    )
    match rng.randrange(3):
        case 0:
            content[at : at + 2] = struct.pack("<H", rng.choice(SHORTS))
        case 1:
            content[at + 2 : at + 6] = struct.pack("<f", rng.choice(FLOATS))
        case _:
            somewhere = rng.randrange(_HEADER_BYTES, len(content) - 4)
            content[somewhere : somewhere + 4] = struct.pack("<f", rng.choice(FLOATS))
    request.payload = bytes(content)


def _both(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    """Tokens and pictures."""
    request.images.coding = rng.randrange(9)  # type: ignore[assignment]
    request.images.views.add(data=rng.randbytes(rng.randrange(40)), height=16, width=16)


def _view_file(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    for view in request.images.views[: rng.randint(1, 2)]:
        view.data = mutated_bytes(view.data, rng)


def _view_size(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    for view in request.images.views[: rng.randint(1, 2)]:
        view.height = rng.choice((0, 1, 15, 16, 17, 8192, 2**31, 2**32 - 1))
        view.width = rng.choice((0, 1, 15, 16, 17, 8192, 2**31, 2**32 - 1))


def _views(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    if rng.random() < 0.5 and request.images.views:
        del request.images.views[-1]
    for _ in range(rng.choice((0, 1, 2, 300))):
        request.images.views.add(data=b"x", height=16, width=16)


def _coding(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    request.images.coding = rng.choice((0, 1, 2, 3, 4, 5, 6, 7, 2**31 - 1))  # type: ignore[assignment]


def _follows(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    request.images.follows_step = rng.choice((*range(4), *INTEGERS))


def _bomb(request: policy_pb2.InferRequest, rng: random.Random) -> None:
    """A file of another size than is announced."""
    from comvla.images.stills import encode_still

    side = rng.choice((1, 8, 17, 512))
    for view in request.images.views[:1]:
        view.data = encode_still("jpeg", np.zeros((side, side, 3), np.uint8), 50)


TOKEN_MUTATIONS: tuple[Mutation, ...] = (
    _text,
    _number,
    _proprio,
    _link,
    _payload,
    _payload_length,
    _payload_header,
    _payload_records,
    _both,
)
"""What may be wrong with a request of tokens."""

_PICTURE_MUTATIONS: tuple[Mutation, ...] = (
    _view_file,
    _view_file,
    _view_size,
    _views,
    _coding,
    _follows,
    _bomb,
    _number,
)
