"""Pictures in place of tokens, over a real server: answered, bounded, repeated, and never in the way of others."""

from __future__ import annotations

import contextvars
import re
import threading
import time
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import grpc
import numpy as np
import pytest
from server_stubs import STUB_INFO, Robot, StubCloud, eventually, message, stub_actions

from comvla import codec
from comvla.errors import CheckpointError, HandshakeError, KeyFrameNeededError
from comvla.images import coding_number
from comvla.images.stills import encode_still
from comvla.images.video import VideoWriter
from comvla.v1 import policy_pb2
from comvla_server.background import BackgroundServer
from comvla_server.decoding import Decoding
from comvla_server.engine import Engine
from comvla_server.identity import Identity, caller, set_caller
from comvla_server.image_decoders import DECODERS, VideoDecoder
from comvla_server.inference_thread import InferenceThread
from comvla_server.settings import ServerSettings
from comvla_server.vision import VisionHalf
from comvla_vla import CloudModel, EdgeModel, ImageRequest, PolicyRequest, random_policy

CLASSICAL = ("jpeg", "webp", "avif", "h264")
SIDE = STUB_INFO.image_size[0]


class StubVision:
    """A token is the mean colour of its patch, eight times over."""

    def __init__(self, decoders: Any = None, any_image_size: bool = False) -> None:
        self.info = STUB_INFO
        self.any_image_size = any_image_size
        self.decoders = (
            {name: DECODERS[name]() for name in CLASSICAL} if decoders is None else decoders
        )

    def encode(self, images: Any, instruction: Any) -> np.ndarray:
        cells = np.asarray(images[0], np.float32).reshape(4, SIDE // 4, 4, SIDE // 4, 3)
        means = cells.mean(axis=(1, 3, 4)).ravel() / 255
        return np.repeat(means[:, None], STUB_INFO.token_dim, axis=1)

    def flops(self, request: ImageRequest) -> float:
        return 7e6


def scene(shift: int = 0) -> np.ndarray:
    x = np.arange(SIDE) * 20 + shift * 10
    return np.repeat((x[:, None] + x)[..., None] % 256, 3, axis=2).astype(np.uint8)


def images(
    coding: str = "jpeg", data: bytes | None = None, **changes: Any
) -> policy_pb2.CodedImages:
    if data is None:
        data = encode_still(coding, scene(), 90)
    view = {"data": data, "height": SIDE, "width": SIDE, **changes.pop("view", {})}
    fields: dict[str, Any] = {
        "coding": coding_number(coding),
        "views": [policy_pb2.CodedImage(**view)],
    }
    return policy_pb2.CodedImages(**{**fields, **changes})


def coded_as(number: int) -> policy_pb2.CodedImages:
    pictures = images()
    pictures.coding = number  # type: ignore[assignment]
    return pictures


def seeing(step: int = 0, session: str = "robot", **changes: Any) -> policy_pb2.InferRequest:
    return message(session, step, **{"payload": b"", "images": images(), **changes})


@contextmanager
def serving(
    vision: Any = None, **settings: Any
) -> Iterator[tuple[Robot, StubCloud, BackgroundServer]]:
    cloud = StubCloud()
    engine = Engine(cloud, StubVision() if vision is None else vision)
    with (
        BackgroundServer(engine, ServerSettings(**settings)) as server,
        Robot(server.target) as robot,
    ):
        cloud.forget()
        yield robot, cloud, server


@pytest.fixture(scope="module")
def running() -> Iterator[Robot]:
    with serving() as (robot, _, _):
        yield robot


@pytest.mark.parametrize("coding", ["jpeg", "webp", "avif", "h264"])
def test_pictures_are_answered_like_the_tokens_that_they_become(
    running: Robot, coding: str
) -> None:
    flat = np.full((SIDE, SIDE, 3), 128, np.uint8)  # which every coding keeps as it is
    unit = (
        VideoWriter(SIDE, SIDE).write(flat) if coding == "h264" else encode_still(coding, flat, 95)
    )
    answer = running.infer(seeing(session=coding, images=images(coding, unit)))
    tokens = np.full((16, 8), 128 / 255, np.float32)
    expected = stub_actions(
        PolicyRequest(tokens, np.arange(16), "open it", np.zeros(2, np.float32))
    )
    np.testing.assert_allclose(answer.actions, expected.ravel(), rtol=0.05)
    assert answer.tokens_used == STUB_INFO.num_tokens
    assert answer.cloud_flops == 7e6 + 1000 * STUB_INFO.num_tokens
    assert answer.timings.decode_s > 0


def test_the_handshake_and_the_admin_surface_tell_the_codings() -> None:
    with serving() as (robot, _, server):
        offered = model_of(robot).image_codings
        assert list(offered) == [1, 2, 3, 4]
        with urllib.request.urlopen(f"{server.admin_url}/v1/model") as page:
            codings = b'"image_codings":["jpeg","webp","avif","h264"]'
            assert codings in page.read()


def model_of(robot: Robot) -> policy_pb2.GetModelResponse:
    return robot.stub.GetModel(policy_pb2.GetModelRequest(), timeout=60)


HOSTILE: dict[str, tuple[policy_pb2.InferRequest, str]] = {
    "tokens and pictures": (message(images=images()), "tokens or pictures, got both"),
    "no view": (seeing(images=images(views=[])), "expected 1 pictures"),
    "two views": (seeing(images=images(views=images().views[:] * 2)), "got 2"),
    "empty": (seeing(images=images(data=b"")), "got 0"),
    "not a picture": (seeing(images=images(data=b"x" * 99)), "picture: expected a jpeg"),
    "something behind it": (
        seeing(images=images(data=encode_still("jpeg", scene(), 90) + b"!")),
        "nothing behind it",
    ),
    "another coding than it says": (
        seeing(images=images(coding="webp", data=encode_still("jpeg", scene(), 90))),
        "expected a webp",
    ),
    "a size that is not the model's": (
        seeing(images=images(view={"height": 9})),
        "9 x 8 are announced",
    ),
    "a size that is not the picture's": (
        seeing(images=images(data=encode_still("jpeg", np.zeros((16, 16, 3), np.uint8), 90))),
        "got 1 of 16 x 16",
    ),
    "giant": (seeing(images=images(view={"height": 2**31, "width": 2**31})), "are announced"),
    "more bytes than pixels": (seeing(images=images(data=bytes(70_000))), "got 70000"),
    "a bomb": (
        seeing(images=images("avif", encode_still("avif", np.zeros((2048, 2048, 3), np.uint8), 1))),
        "got 1 of 2048 x 2048",
    ),
    "a difference to nothing in time": (
        seeing(images=images("h264", b"x" * 50, follows_step=3)),
        "follow a step before 0",
    ),
    "video noise": (seeing(images=images("h264", b"\0\0\0\1\x67" + b"x" * 50)), "do not decode"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_picture_is_refused_in_words(running: Robot, name: str) -> None:
    request, words = HOSTILE[name]
    with pytest.raises(grpc.RpcError) as refused:
        running.infer(request)
    assert refused.value.code() is grpc.StatusCode.INVALID_ARGUMENT, refused.value.details()
    assert words in refused.value.details()
    assert running.infer(seeing(session="another")).tokens_used == 16, "the server goes on"


def test_codings_that_are_not_read_are_a_mismatch(running: Robot) -> None:
    for number in (0, 7, 77):
        with pytest.raises(grpc.RpcError) as refused:
            running.infer(seeing(images=coded_as(number)))
        assert refused.value.code() is grpc.StatusCode.FAILED_PRECONDITION
        assert "jpeg, webp, avif, h264" in refused.value.details()


def test_a_server_without_vision_says_how_it_would_have_one() -> None:
    with BackgroundServer(Engine(StubCloud())) as server, Robot(server.target) as robot:
        assert not model_of(robot).image_codings
        with pytest.raises(grpc.RpcError) as refused:
            robot.infer(seeing())
    assert refused.value.code() is grpc.StatusCode.FAILED_PRECONDITION
    assert "--vision on" in refused.value.details()


def test_halves_of_different_models_are_never_joined() -> None:
    class Other(StubVision):
        def __init__(self) -> None:
            super().__init__({})
            self.info = random_policy()[0].info

    with pytest.raises(HandshakeError, match="different models"):
        Engine(StubCloud(), Other())


def test_models_that_resize_take_any_size_within_bounds() -> None:
    class Resizing(StubVision):
        def encode(self, images: Any, instruction: Any) -> np.ndarray:
            return super().encode([np.asarray(images[0])[:SIDE, :SIDE]], instruction)

    large = encode_still("jpeg", np.zeros((300, 200, 3), np.uint8), 75)
    with serving(Resizing(any_image_size=True)) as (robot, _, _):
        view = {"height": 300, "width": 200}
        assert robot.infer(seeing(images=images(data=large, view=view))).tokens_used == 16
        with pytest.raises(grpc.RpcError) as refused:
            robot.infer(seeing(1, images=images(data=large, view={"height": 2049, "width": 2048})))
    assert "up to 4194304 pixels" in refused.value.details()


def test_a_repeat_is_answered_from_the_record_and_other_content_is_a_conflict() -> None:
    with serving() as (robot, cloud, _):
        first = robot.infer(seeing())
        again = robot.infer(seeing())
        assert list(first.actions) == list(again.actions)
        assert len(cloud.batches) == 1
        with pytest.raises(grpc.RpcError) as refused:
            robot.infer(seeing(images=images(data=encode_still("jpeg", scene(3), 90))))
    assert "sent before with other content" in refused.value.details()


class SlowDecoder:
    """Decodes when it is told to."""

    def __init__(self) -> None:
        self.go = threading.Event()
        self.entered = threading.Semaphore(0)
        self.calls = 0

    def decode(self, request: Any) -> list[np.ndarray]:
        self.calls += 1
        self.entered.release()
        assert self.go.wait(60)
        return [scene()]


def test_repeats_that_come_while_pictures_are_decoded_are_computed_once() -> None:
    decoder = SlowDecoder()
    with (
        serving(StubVision({"jpeg": decoder})) as (robot, cloud, server),
        ThreadPoolExecutor(3) as pool,
    ):
        calls = [pool.submit(robot.infer, seeing()) for _ in range(3)]
        assert decoder.entered.acquire(timeout=60)
        registry = server.server.metrics.registry
        all_bytes = 3 * codec.wire_bytes(seeing().ByteSize())
        eventually(lambda: registry.get_sample_value("comvla_tx_framed_bytes_total") == all_bytes)
        decoder.go.set()
        answers = [call.result(60) for call in calls]
        assert len({tuple(answer.actions) for answer in answers}) == 1
        assert len(cloud.batches) == 1


def test_tokens_pass_pictures_that_take_long_to_decode() -> None:
    decoder = SlowDecoder()
    with (
        serving(StubVision({"jpeg": decoder})) as (robot, _, _),
        ThreadPoolExecutor(1) as pool,
    ):
        waiting = pool.submit(robot.infer, seeing())
        assert decoder.entered.acquire(timeout=60)
        assert robot.infer(message("other")).tokens_used == 3
        assert model_of(robot).model_name == "stub"
        assert not waiting.done()
        decoder.go.set()
        assert waiting.result(60).tokens_used == 16


def test_no_more_than_so_many_wait_to_be_decoded_and_the_late_cost_nothing() -> None:
    decoder = SlowDecoder()
    with (
        serving(StubVision({"jpeg": decoder}), max_queue=2, max_batch=1, admission=False) as (
            robot,
            cloud,
            server,
        ),
        ThreadPoolExecutor(4) as pool,
    ):
        first = pool.submit(robot.infer, seeing(session="a"))
        assert decoder.entered.acquire(timeout=60)
        service = server.server._service
        assert service is not None
        assert service.models.default is not None
        decoding = service.models.default.decoding
        codes = []

        def in_line() -> bool:
            # Where the machine is busy a call may be over before it stands in line.
            number = len(codes) + 1
            late = seeing(session=f"b{number}")
            codes.append(robot.refused(late, timeout_s=0.2 * number)[0])
            return decoding._waiting == 2

        eventually(in_line)
        assert codes[0] is grpc.StatusCode.DEADLINE_EXCEEDED
        # The late one still stands in line, where it will cost nothing.
        with pytest.raises(grpc.RpcError) as full:
            robot.infer(seeing(session="c"))
        assert full.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "wait for their pictures" in full.value.details()
        decoder.go.set()
        assert first.result(60).tokens_used == 16
        assert robot.infer(seeing(session="d")).tokens_used == 16
        assert decoder.calls == 2, "a and d"
        assert len(cloud.batches) == 2


def test_every_byte_of_a_picture_is_counted() -> None:
    with serving() as (robot, _, server):
        request = seeing()
        robot.infer(request)
        robot.infer(message("tokens"))
        with urllib.request.urlopen(f"{server.admin_url}/metrics") as page:
            text = page.read().decode()

    def counted(name: str) -> float:
        found = re.search(rf"^comvla_{name}_total (\S+)$", text, re.MULTILINE)
        assert found, name
        return float(found[1])

    picture = len(request.images.views[0].data)
    assert counted("tx_image_bytes") == picture
    assert counted("tx_payload_bytes") == picture + 3 * 8 * 4
    assert counted("tx_encoded_bytes") == request.images.ByteSize() + len(message().payload)
    assert counted("tokens_received") == 3


class TestVideo:
    def units(self, count: int) -> list[bytes]:
        writer = VideoWriter(SIDE, SIDE)
        return [writer.write(scene(shift)) for shift in range(count)]

    def request(self, step: int, unit: bytes, follows: int | None, session: str = "film") -> Any:
        return seeing(step, session, images=images("h264", unit, follows_step=follows))

    def refused(self, robot: Robot, request: Any) -> str:
        with pytest.raises(grpc.RpcError) as refused:
            robot.infer(request)
        assert refused.value.code() is grpc.StatusCode.ABORTED
        return str(refused.value.details())

    def test_a_stream_goes_on_from_step_to_step_and_sessions_do_not_mix(
        self, running: Robot
    ) -> None:
        units = self.units(3)
        for step, unit in enumerate(units):
            for session in ("left", "right"):
                follows = step - 1 if step else None
                assert running.infer(self.request(step, unit, follows, session)).tokens_used == 16

    def test_without_what_it_builds_on_a_key_frame_is_asked_for(self, running: Robot) -> None:
        units = self.units(3)
        details = self.refused(running, self.request(1, units[1], 0, "fresh"))
        assert details.startswith("key frame needed")
        running.infer(self.request(2, self.units(1)[0], None, "fresh"))
        skipped = self.request(5, units[2], 3, "fresh")
        assert "holds those of step 2" in self.refused(running, skipped)

    def test_a_repeat_needs_no_key_frame_even_where_its_answer_was_lost(self) -> None:
        """The frame was decoded, the call was given up: the same bytes again find it decoded."""
        with serving() as (robot, cloud, _):
            units = self.units(3)
            robot.infer(self.request(0, units[0], None))
            cloud.forget()
            cloud.hold()
            lost = robot.send(self.request(1, units[1], 0))
            cloud.wait_until_running()
            lost.cancel()
            cloud.release()
            assert robot.infer(self.request(1, units[1], 0)).tokens_used == 16
            assert robot.infer(self.request(2, units[2], 1)).tokens_used == 16

    def test_nobody_builds_on_the_pictures_of_another_identity(self) -> None:
        """Even under a session's right name and step: the picture that steers a robot is its own."""
        decoder, units = VideoDecoder(), self.units(2)

        def as_robot(name: str, request: Any) -> Any:
            context = contextvars.copy_context()
            context.run(set_caller, Identity(name))
            return context.run(decoder.decode, request)

        as_robot("left", self.request(0, units[0], None))
        with pytest.raises(KeyFrameNeededError):
            as_robot("right", self.request(1, units[1], 0))
        as_robot("right", self.request(0, VideoWriter(SIDE, SIDE).write(255 - scene()), None))
        (picture,) = as_robot("left", self.request(1, units[1], 0))
        assert np.abs(picture.astype(int) - scene(1)).mean() < 20

    async def test_decoders_know_who_calls(self) -> None:
        thread = InferenceThread("test")
        set_caller(Identity("left"))
        decoding = Decoding(thread, 4)
        assert await decoding.run(caller, time.monotonic() + 60) == Identity("left")
        assert thread.close(60)

    def test_the_least_recently_seen_stream_leaves_first(self) -> None:
        with serving(StubVision({"h264": VideoDecoder(max_sessions=2)})) as (robot, _, _):
            units = self.units(2)
            for session in "abc":
                robot.infer(self.request(0, units[0], None, session))
            self.refused(robot, self.request(1, units[1], 0, "a"))
            assert robot.infer(self.request(1, units[1], 0, "c")).tokens_used == 16

    def test_a_broken_difference_ends_the_stream(self) -> None:
        with serving() as (robot, _, _):
            units = self.units(3)
            robot.infer(self.request(0, units[0], None))
            with pytest.raises(grpc.RpcError) as broken:
                robot.infer(self.request(1, units[1][: len(units[1]) // 2], 0))
            assert broken.value.code() is grpc.StatusCode.INVALID_ARGUMENT
            self.refused(robot, self.request(2, units[2], 1))


@pytest.fixture(scope="module")
def policy() -> tuple[EdgeModel, CloudModel]:
    return random_policy(seed=3)


def test_a_real_vision_half_gives_the_robots_own_tokens(
    policy: tuple[EdgeModel, CloudModel],
) -> None:
    edge, cloud = policy
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (*edge.info.image_size, 3), dtype=np.uint8) for _ in range(2)]
    words, proprio = "pull the green drawer open", np.zeros(4, np.float32)
    engine = Engine(cloud, VisionHalf(edge))
    seen, batch_mate = engine.predict(
        [
            ImageRequest(pictures, words, proprio),
            PolicyRequest(edge.encode(pictures)[:5], np.arange(5), words, proprio),
        ]
    )
    tokens = PolicyRequest(edge.encode(pictures), np.arange(edge.info.num_tokens), words, proprio)
    [expected] = cloud.predict([tokens])
    np.testing.assert_allclose(seen, expected, atol=1e-5)
    assert not np.allclose(seen, batch_mate)
    cost = engine.flops(ImageRequest(pictures, words, proprio))
    assert cost == edge.vision_flops() + cloud.flops(edge.info.num_tokens, words)
    assert edge.vision_flops() < edge.flops(0)


def test_a_whole_checkpoint_is_served_with_vision_and_a_half_without(tmp_path: Any) -> None:
    from comvla_server.model_loading import load_engine
    from comvla_vla import split_checkpoint

    def codings(model: str, vision: str = "auto") -> tuple[str, ...]:
        return load_engine(ServerSettings(model=model, vision=vision)).image_codings

    assert "jpeg" in codings("mini")
    assert not codings("mini", "off")
    split_checkpoint("mini", tmp_path / "split")
    assert not codings(str(tmp_path / "split" / "cloud"))
    with pytest.raises(CheckpointError, match="edge half was asked for"):
        codings(str(tmp_path / "split" / "cloud"), "on")


def test_vision_shares_what_stands_in_both_halves() -> None:
    from comvla_server.vision import load_vision
    from comvla_vla import load_cloud

    cloud = load_cloud("mini")
    vision = load_vision("mini", cloud)
    assert vision._edge.net.projector is cloud.net.projector
    towers = sum(p.numel() for p in vision._edge.net.vision_backbone.parameters())
    assert vision.weight_bytes == 4 * towers
