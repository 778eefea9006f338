"""Messages between a world and its simulator survive the pipe; anything else is refused."""

from __future__ import annotations

import contextlib
import io
import json
import struct
import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from comvla_sim.worlds.libero.child import framing
from comvla_sim.worlds.libero.child.framing import FramingError, Message, encode, read

DTYPES = st.sampled_from(["<f8", "<f4", "|u1", "<i8", "|b1"])
ARRAYS = DTYPES.flatmap(lambda d: npst.arrays(d, npst.array_shapes(min_dims=0, min_side=0)))


def read_bytes(data: bytes) -> Message:
    stream = io.BytesIO(data)

    def read_exactly(number: int) -> bytes:
        received = stream.read(number)
        if len(received) < number:
            raise EOFError
        return received

    return read(read_exactly)


def frame(header: Any, body: bytes = b"", *, magic: bytes = b"CVL1") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<4sIQ", magic, len(text), len(body)) + text + body


@settings(deadline=None)
@given(
    st.text(),
    st.dictionaries(st.text(), st.integers() | st.text() | st.none()),
    st.dictionaries(st.text(), ARRAYS, max_size=3),
)
def test_what_goes_in_comes_out(
    kind: str, fields: dict[str, Any], arrays: dict[str, np.ndarray[Any, Any]]
) -> None:
    back = read_bytes(encode(Message(kind, fields, arrays)))
    assert (back.kind, dict(back.fields)) == (kind, fields)
    assert list(back.arrays) == list(arrays)
    for name, array in arrays.items():
        assert back.arrays[name].dtype == array.dtype
        assert back.arrays[name].shape == array.shape
        assert back.arrays[name].tobytes() == array.tobytes()
        assert back.arrays[name].flags.writeable


def test_arrays_in_any_memory_order_arrive_as_they_look() -> None:
    array = np.arange(6.0).reshape(2, 3).T[::-1]
    np.testing.assert_array_equal(
        read_bytes(encode(Message("ok", {}, {"a": array}))).arrays["a"], array
    )


@pytest.mark.parametrize("array", [np.array(["x"]), np.array([None]), np.array([1 + 1j])])
def test_only_plain_numbers_are_sent(array: Any) -> None:
    with pytest.raises(FramingError, match="permitted"):
        encode(Message("ok", {}, {"a": array}))


@pytest.mark.parametrize(
    "data",
    [
        frame({}, magic=b"HTTP"),
        frame(b"\xff\xfe"),
        frame([]),
        frame({"kind": "ok", "fields": {}}),
        frame({"kind": 1, "fields": {}, "arrays": []}),
        frame({"kind": "ok", "fields": [], "arrays": []}),
        frame({"kind": "ok", "fields": {}, "arrays": [["a", "|O", [1]]]}, b"12345678"),
        frame({"kind": "ok", "fields": {}, "arrays": [["a", "<f8", [2]]]}, b"12345678"),
        frame({"kind": "ok", "fields": {}, "arrays": [["a", "<f8", [-1]]]}, b"12345678"),
        frame({"kind": "ok", "fields": {}, "arrays": [["a", "<f8", [10**30]]]}, b"12345678"),
        frame({"kind": "ok", "fields": {}, "arrays": [["a", "<f8", "1"]]}, b"12345678"),
        frame({"kind": "ok", "fields": {}, "arrays": []}, b"12345678"),
        struct.pack("<4sIQ", b"CVL1", framing.MAX_HEADER_BYTES + 1, 0),
        struct.pack("<4sIQ", b"CVL1", 2, framing.MAX_BODY_BYTES + 1),
    ],
)
def test_what_is_no_message_is_refused(data: bytes) -> None:
    with pytest.raises(FramingError):
        read_bytes(data)


def test_a_message_that_is_too_large_is_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(framing, "MAX_BODY_BYTES", 7)
    with pytest.raises(FramingError, match="accepted"):
        encode(Message("ok", {}, {"a": np.zeros(1)}))


@settings(deadline=None)
@given(st.data())
def test_a_message_cut_short_or_damaged_never_does_worse_than_fail(data: st.DataObject) -> None:
    whole = encode(Message("step", {"a": 1}, {"action": np.arange(7.0)}))
    cut = data.draw(st.integers(0, len(whole) - 1))
    with pytest.raises(EOFError):
        read_bytes(whole[:cut])
    place, value = data.draw(st.integers(0, len(whole) - 1)), data.draw(st.integers(0, 255))
    damaged = whole[:place] + bytes([value]) + whole[place + 1 :]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with contextlib.suppress(FramingError, EOFError):
            read_bytes(damaged)
