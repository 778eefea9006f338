"""Coded pictures: what is written can be read, and what a stranger writes cannot do harm."""

from __future__ import annotations

import io
import struct
import sys
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from comvla import codec, handshake
from comvla.errors import CodecError, DependencyError
from comvla.images import (
    IMAGE_CODINGS,
    MAX_VIEW_PIXELS,
    coding_name,
    coding_number,
    images_bytes,
    most_data_bytes,
)
from comvla.images.stills import STILL_CODINGS, decode_still, encode_still
from comvla.images.video import VideoReader, VideoWriter
from comvla.v1 import policy_pb2


def scene(height: int = 48, width: int = 64, shift: int = 0) -> np.ndarray:
    """A picture with edges and slopes, like those of a camera."""
    y, x = np.mgrid[0:height, 0:width]
    boxes = ((x + shift) // 12 + y // 9) % 3 * 80
    return np.stack([boxes, (x + shift) * 2 % 256, y * 3 % 256], axis=-1).astype(np.uint8)


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


@pytest.mark.parametrize("coding", STILL_CODINGS)
def test_a_file_brings_the_picture_back_better_for_more_bytes(coding: str) -> None:
    image = scene(96, 128)
    files = [encode_still(coding, image, quality) for quality in (20, 60, 95)]
    quality_db = [psnr_db(decode_still(coding, file, 96, 128), image) for file in files]
    assert [len(file) for file in files] == sorted(len(file) for file in files)
    assert quality_db == sorted(quality_db)
    assert quality_db[-1] > 24


@pytest.mark.parametrize("size", [(48, 64), (47, 63), (16, 16), (33, 16)])
def test_video_brings_every_picture_back_and_differences_are_small(size: tuple[int, int]) -> None:
    writer, reader = VideoWriter(*size, crf=18), VideoReader(*size)
    lengths = []
    for shift in (0, 0, 1, 2):
        image = scene(*size, shift)
        unit = writer.write(image)
        lengths.append(len(unit))
        assert psnr_db(reader.read(unit), image) > 18
    assert lengths[1] < lengths[0] / 4, "the same picture again"


def test_key_frames_carry_no_message_of_the_encoder() -> None:
    assert b"x264" not in VideoWriter(48, 64).write(scene())


def test_a_difference_needs_what_it_builds_on() -> None:
    writer = VideoWriter(48, 64)
    writer.write(scene())
    with pytest.raises(CodecError, match="key frame"):
        VideoReader(48, 64).read(writer.write(scene(shift=3)))


def damaged(file: bytes) -> dict[str, bytes]:
    return {
        "empty": b"",
        "cut in half": file[: len(file) // 2],
        "one byte short": file[:-1],
        "something behind it": file + b"\x00",
        "another file behind it": file + file,
        "noise": np.random.default_rng(0).bytes(len(file)),
    }


@pytest.mark.parametrize("coding", STILL_CODINGS)
@pytest.mark.parametrize("damage", damaged(b"  ").keys())
def test_a_damaged_file_is_refused(coding: str, damage: str) -> None:
    file = damaged(encode_still(coding, scene(), 75))[damage]
    with pytest.raises(CodecError, match="expected"):
        decode_still(coding, file, 48, 64)


@pytest.mark.parametrize(
    "damage", sorted(set(damaged(b"  ")) - {"one byte short", "something behind it"})
)
def test_a_damaged_access_unit_is_refused(damage: str) -> None:
    """What is stuffed behind the last slice cannot be told from it: its length alone is bounded."""
    file = damaged(VideoWriter(48, 64).write(scene()))[damage]
    with pytest.raises(CodecError, match="expected"):
        VideoReader(48, 64).read(file)


@pytest.mark.parametrize("coding", STILL_CODINGS)
def test_one_coding_does_not_pass_for_another(coding: str) -> None:
    for other in set(STILL_CODINGS) - {coding}:
        with pytest.raises(CodecError):
            decode_still(coding, encode_still(other, scene(), 75), 48, 64)


@pytest.mark.parametrize("coding", STILL_CODINGS)
def test_a_bomb_is_refused_by_what_it_announces(coding: str) -> None:
    bomb = encode_still(coding, np.zeros((2048, 2048, 3), np.uint8), 1)
    assert len(bomb) < most_data_bytes(48, 64)
    with pytest.raises(CodecError, match="as announced"):
        decode_still(coding, bomb, 48, 64)
    with pytest.raises(CodecError, match=f"1 to {MAX_VIEW_PIXELS} pixels"):
        decode_still(coding, bomb, 2049, 2048)


def test_a_stream_of_giant_pictures_gets_no_memory() -> None:
    bomb = VideoWriter(2048, 2048).write(np.zeros((2048, 2048, 3), np.uint8))
    assert len(bomb) < most_data_bytes(48, 64)
    with pytest.raises(CodecError, match="48 x 64"):
        VideoReader(48, 64).read(bomb)


def test_more_bytes_than_pixels_are_no_picture() -> None:
    with pytest.raises(CodecError, match="bytes for a picture"):
        decode_still("jpeg", bytes(most_data_bytes(8, 8) + 1), 8, 8)


def jpeg(**options: object) -> bytes:
    file = io.BytesIO()
    Image.fromarray(scene()).save(file, "JPEG", **options)
    return file.getvalue()


def test_a_progressive_jpeg_is_refused_because_its_passes_cost_time() -> None:
    with pytest.raises(CodecError, match="baseline"):
        decode_still("jpeg", jpeg(progressive=True), 48, 64)


def test_a_comment_that_looks_like_an_end_is_no_end() -> None:
    file = jpeg(comment=b"\xff\xd9 not the end")
    assert decode_still("jpeg", file, 48, 64).shape == (48, 64, 3)


def test_animations_and_other_colours_are_refused() -> None:
    file = io.BytesIO()
    frames = [Image.fromarray(scene(shift=shift)) for shift in (0, 9)]
    frames[0].save(file, "WEBP", save_all=True, append_images=frames[1:])
    with pytest.raises(CodecError, match="got 2 of"):
        decode_still("webp", file.getvalue(), 48, 64)
    file = io.BytesIO()
    Image.fromarray(scene()).convert("L").save(file, "JPEG")
    with pytest.raises(CodecError, match="in L"):
        decode_still("jpeg", file.getvalue(), 48, 64)


def test_a_png_bomb_never_meets_its_parser() -> None:
    chunk = struct.pack(">II", 50_000, 50_000) + b"\x08\x02\x00\x00\x00"
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + chunk
    file = head + struct.pack(">I", zlib.crc32(b"IHDR" + chunk))
    for coding in STILL_CODINGS:
        with pytest.raises(CodecError):
            decode_still(coding, file, 48, 64)


@given(st.binary(max_size=400), st.sampled_from(STILL_CODINGS))
@settings(deadline=None, max_examples=300)
def test_no_bytes_do_anything_but_decode_or_be_refused(data: bytes, coding: str) -> None:
    heads = {"jpeg": b"\xff\xd8\xff", "webp": b"RIFF", "avif": b"\0\0\0\x1cftypavif"}
    for file in (data, heads[coding] + data):
        with pytest.raises(CodecError):
            decode_still(coding, file, 48, 64)


@given(st.integers(0, 2**31 - 1), st.data())
@settings(deadline=None, max_examples=100)
def test_flipped_bits_decode_or_are_refused(seed: int, data: st.DataObject) -> None:
    coding = data.draw(st.sampled_from([*STILL_CODINGS, "h264"]))
    rng = np.random.default_rng(seed)
    file = (
        VideoWriter(48, 64).write(scene())
        if coding == "h264"
        else encode_still(coding, scene(), 75)
    )
    broken = bytearray(file)
    for at in rng.integers(0, len(broken), 5):
        broken[at] ^= 1 << int(rng.integers(8))
    try:
        if coding == "h264":
            picture = VideoReader(48, 64).read(bytes(broken))
        else:
            picture = decode_still(coding, bytes(broken), 48, 64)
    except CodecError:
        return
    assert picture.shape == (48, 64, 3)


@given(
    st.lists(st.integers(0, 70_000), min_size=1, max_size=4),
    st.integers(1, 5000),
    st.integers(1, 5000),
    st.none() | st.integers(0, 2**40),
)
@settings(deadline=None)
def test_images_bytes_is_the_serialised_length(
    lengths: list[int], height: int, width: int, follows_step: int | None
) -> None:
    images = policy_pb2.CodedImages(
        coding=coding_number("webp"),
        views=[
            policy_pb2.CodedImage(data=bytes(length), height=height, width=width)
            for length in lengths
        ],
        follows_step=follows_step,
    )
    size = images_bytes(lengths, height, width, follows_step)
    assert size == len(images.SerializeToString())
    request = policy_pb2.InferRequest(session_id="robot", step=3, images=images)
    expected = codec.infer_request_bytes(
        0,
        session_id="robot",
        step=3,
        snr=False,
        snr_age=False,
        protocol_version=0,
        images_length=size,
    )
    assert len(request.SerializeToString()) == expected


def test_the_handshake_says_what_is_read() -> None:
    assert IMAGE_CODINGS == ("jpeg", "webp", "avif", "h264", "deep_jscc", "witt")
    assert [coding_number(name) for name in IMAGE_CODINGS] == [1, 2, 3, 4, 5, 6]
    response = policy_pb2.GetModelResponse(image_codings=[1, 4, 99])  # type: ignore[list-item]
    assert handshake.offered_image_codings(response) == ("jpeg", "h264")
    assert coding_name(0) is None
    with pytest.raises(CodecError, match="jpeg, webp"):
        coding_number("gif")
    assert handshake.image_coding_mismatch("h264", ("jpeg", "h264")) is None
    assert "--vision on" in (handshake.image_coding_mismatch("jpeg", ()) or "")
    assert "choose one" in (handshake.image_coding_mismatch("avif", ("jpeg",)) or "")


def test_what_is_missing_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(DependencyError, match=r"comvla\[video\]"):
        VideoWriter(16, 16)
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(DependencyError, match=r"comvla\[images\]"):
        encode_still("jpeg", scene(), 75)


def test_qualities_out_of_range_are_refused() -> None:
    with pytest.raises(CodecError, match="1 to 100"):
        encode_still("jpeg", scene(), 0)
    with pytest.raises(CodecError, match="0 to 51"):
        VideoWriter(16, 16, crf=52)
    with pytest.raises(CodecError, match="expected a picture of"):
        VideoWriter(16, 16).write(scene())
