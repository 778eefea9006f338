"""Messages on a pipe: JSON for what is small, raw bytes for arrays. Nothing in them can execute.

    "CVL1" | header length, 4 bytes | body length, 8 bytes | header | body

Integers are little-endian. The header is ``{"kind": ..., "fields": {...}, "arrays": [[name, dtype,
shape], ...]}`` in UTF-8; the body is the arrays' bytes in that order, in C order and little-endian.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

MAGIC = b"CVL1"
MAX_HEADER_BYTES = 1 << 20
MAX_BODY_BYTES = 1 << 28

_PREFIX = struct.Struct("<4sIQ")
_DTYPES = {"<f8": np.float64, "<f4": np.float32, "|u1": np.uint8, "<i8": np.int64, "|b1": np.bool_}


class FramingError(ValueError):
    """Bytes that are no message."""


@dataclass(frozen=True)
class Message:
    """One message.

    Attributes:
        kind: what it is: a request's name, ``"ok"`` or ``"error"``.
        fields: JSON values.
        arrays: NumPy arrays of one of the permitted types.
    """

    kind: str
    fields: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, Any] = field(default_factory=dict)


def encode(message: Message) -> bytes:
    """The bytes of a message.

    Raises:
        FramingError: an array of a type that is not permitted, or a message too large.
    """
    described, bodies = [], []
    for name, array in message.arrays.items():
        # ascontiguousarray would turn a scalar array into one of shape (1,).
        values = np.asarray(array, order="C")
        if values.dtype.str not in _DTYPES:
            raise FramingError(f"array {name!r} is {values.dtype}; permitted: {list(_DTYPES)}")
        described.append([name, values.dtype.str, list(values.shape)])
        bodies.append(values.tobytes())
    header = json.dumps(
        {"kind": message.kind, "fields": dict(message.fields), "arrays": described}
    ).encode()
    body = b"".join(bodies)
    _check_sizes(len(header), len(body))
    return _PREFIX.pack(MAGIC, len(header), len(body)) + header + body


def read(read_exactly: Callable[[int], bytes]) -> Message:
    """Reads one message.

    Args:
        read_exactly: returns that many bytes; raises EOFError at the end of the pipe.

    Raises:
        EOFError: the pipe ended.
        FramingError: what came is no message.
    """
    magic, header_bytes, body_bytes = _PREFIX.unpack(read_exactly(_PREFIX.size))
    if magic != MAGIC:
        raise FramingError(f"expected a message starting with {MAGIC!r}, got {magic!r}")
    _check_sizes(header_bytes, body_bytes)
    header = read_exactly(header_bytes)
    body = memoryview(read_exactly(body_bytes))
    try:
        content = json.loads(header)
        kind, fields, described = content["kind"], content["fields"], content["arrays"]
        if not isinstance(kind, str) or not isinstance(fields, dict):
            raise TypeError("kind is a string and fields an object")
        arrays, offset = {}, 0
        for name, dtype, shape in described:
            taken = _take(body[offset:], dtype, shape)
            arrays[str(name)] = taken
            offset += taken.nbytes
    except (ValueError, KeyError, TypeError) as error:
        raise FramingError(f"a header that makes no sense: {error!r}") from error
    if offset != body_bytes:
        raise FramingError(f"arrays of {offset} bytes in a body of {body_bytes}")
    return Message(kind, fields, arrays)


def _take(body: memoryview, dtype: str, shape: list[int]) -> Any:
    if dtype not in _DTYPES:
        raise ValueError(f"dtype {dtype!r} is not permitted")
    if not isinstance(shape, list) or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"shape {shape!r}")
    count = math.prod(shape)
    if count * np.dtype(dtype).itemsize > len(body):
        raise ValueError(f"shape {shape} is larger than the body")
    # A copy: what comes from bytes cannot be written to.
    return np.frombuffer(body, dtype, count).reshape(shape).copy()


def _check_sizes(header_bytes: int, body_bytes: int) -> None:
    if header_bytes > MAX_HEADER_BYTES or body_bytes > MAX_BODY_BYTES:
        raise FramingError(
            f"a message of {header_bytes} + {body_bytes} bytes; "
            f"at most {MAX_HEADER_BYTES} + {MAX_BODY_BYTES} are accepted"
        )
