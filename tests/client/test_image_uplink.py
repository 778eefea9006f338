"""A robot that sends pictures: what crosses, what it may cost, and what a loss means."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from client_stubs import INFO, NARROW, WORDS, StubEdge, fault, model_response, observation
from test_client_import import WITHOUT_TORCH, run_python

from comvla import codec
from comvla.errors import HandshakeError, LinkError, ObservationError
from comvla.images import coding_number, images_bytes
from comvla.images.stills import encode_still
from comvla.images.video import VideoReader
from comvla.model_info import ModelInfo
from comvla.v1.policy_pb2 import GetModelResponse, InferRequest, InferResponse
from comvla_client import AsyncComVLAClient, ComVLAClient, LinkProfile, TransportError
from comvla_client.image_encoders import ADJUSTABLE, VideoEncoder
from comvla_client.image_uplink import ImageUplink
from comvla_client.registry import UnknownMethodError, make_uplink

CODINGS = ("jpeg", "webp", "avif", "h264")
WIDE = LinkProfile(bandwidth_hz=20e6)


class SeeingTransport:
    """A server with a vision half, as far as a client can tell; keeps what came.

    Script entries: an exception to raise, or None to answer.
    """

    def __init__(
        self, *script: Any, codings: tuple[str, ...] = CODINGS, info: ModelInfo = INFO
    ) -> None:
        self.script = list(script)
        self.info = info
        self.model: GetModelResponse = model_response(info)
        self.model.image_codings.extend(coding_number(name) for name in codings)
        self.requests: list[InferRequest] = []

    def get_model(self, timeout_s: float) -> GetModelResponse:
        return self.model

    def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        self.requests.append(request)
        action = self.script.pop(0) if self.script else None
        if action is not None:
            raise action
        h, a = self.info.action_horizon, self.info.action_dim
        return InferResponse(
            session_id=request.session_id,
            step=request.step,
            actions=[0.5] * (h * a),
            action_horizon=h,
            action_dim=a,
            tokens_used=self.info.num_tokens,
            model_fingerprint=self.info.fingerprint,
        )

    def close(self) -> None:
        pass


class AsyncSeeingTransport:
    """The same, awaitable."""

    def __init__(self) -> None:
        self.inner = SeeingTransport()

    async def get_model(self, timeout_s: float) -> GetModelResponse:
        return self.inner.get_model(timeout_s)

    async def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        return self.inner.infer(request, timeout_s)

    async def close(self) -> None:
        pass


def robot(transport: Any, **options: Any) -> ComVLAClient:
    return ComVLAClient(
        transport, **{"uplink": "jpeg-75", "link": WIDE, "deadline_s": 20.0, **options}
    )


def test_a_robot_without_a_model_takes_the_servers_word_for_it() -> None:
    transport = SeeingTransport()
    with robot(transport) as client:
        assert client.info == INFO
        report = client.step(observation(), WORDS, 10.0).report
    (request,) = transport.requests
    assert (report.source, report.uplink, report.tokens) == ("cloud", "jpeg-75", 0)
    assert request.payload == b""
    assert request.model_fingerprint == INFO.fingerprint
    for view, image in zip(request.images.views, observation()["images"], strict=True):
        assert view.data == encode_still("jpeg", image, 75)
        assert image.shape == (view.height, view.width, 3)


def test_a_robot_that_knows_its_model_refuses_another() -> None:
    from dataclasses import replace

    with robot(SeeingTransport(), edge=INFO) as client:
        assert client.info == INFO
    with pytest.raises(HandshakeError, match="weights do not"):
        robot(SeeingTransport(), edge=replace(INFO, fingerprint="other"))


def test_every_byte_is_accounted_for() -> None:
    transport = SeeingTransport()
    with robot(transport, uplink="webp-60") as client:
        report = client.step(observation(), WORDS, 10.0).report
    (request,) = transport.requests
    lengths = [len(view.data) for view in request.images.views]
    assert report.payload_bytes == sum(lengths)
    assert report.encoded_bytes == images_bytes(lengths, 16, 16) == request.images.ByteSize()
    assert report.framed_bytes == codec.wire_bytes(len(request.SerializeToString()))
    assert report.payload_bytes < report.encoded_bytes < report.framed_bytes
    assert report.token_budget > 0
    assert report.paper_budget is None
    assert report.edge_flops == 0.0
    assert report.timings_s["encode"] > 0.0


@pytest.mark.parametrize("budget", ["paper", "framed"])
@pytest.mark.parametrize("coding", ["jpeg", "webp"])
def test_the_best_quality_that_fits_is_sent(budget: str, coding: str) -> None:
    transport = SeeingTransport()
    everything = SeeingTransport()
    obs = observation()
    costs = {}
    for quality in ADJUSTABLE:
        with robot(everything, uplink=f"{coding}-{quality}") as client:
            sent = client.step(obs, WORDS, 40.0).report
        costs[quality] = sent.payload_bytes
        if budget == "framed":
            size = len(everything.requests[-1].SerializeToString())
            costs[quality] = codec.wire_bytes(size) + codec.CALL_HEADERS_BYTES
    chosen = []
    link = LinkProfile(bandwidth_hz=32e3 if coding == "jpeg" else 12e3, efficiency=1.0)
    with robot(transport, uplink=coding, budget=budget, link=link) as client:
        for snr_db in (-20.0, 20.0, 24.0, 27.0, 30.0, 60.0):
            report = client.step(obs, WORDS, snr_db).report
            room = link.capacity_bits(snr_db) / 8
            # The session's name, which is drawn, may differ by nothing: both have the same length.
            fitting = [q for q in ADJUSTABLE if costs[q] <= room]
            if fitting:
                assert report.image_quality == max(fitting), snr_db
                assert report.source == "cloud"
            else:
                assert report.fallback_reason == "no_link"
                assert f"as {coding}-5, the link carries" in report.detail or room < 200
                assert "picture" in report.detail
                assert report.payload_bytes == report.framed_bytes == 0
            chosen.append(report.image_quality)
    assert None in chosen
    assert len(set(chosen)) >= 3


def test_a_fixed_quality_goes_whole_or_not_at_all() -> None:
    transport = SeeingTransport()
    with robot(transport, link=NARROW) as client:
        assert client.step(observation(), WORDS, 10.0).report.fallback_reason == "no_link"
        assert not transport.requests
        assert client.step(observation(), WORDS).source == "cloud", "no SNR, no limit"
        assert client.step(observation(), WORDS, float("-inf")).report.fallback_reason == "no_link"
    with robot(transport, uplink="jpeg", budget=1500, link=NARROW) as client:
        report = client.step(observation(), WORDS, 10.0).report
        assert 1400 < report.payload_bytes <= 1500, "a fixed number of bytes, whatever the SNR"


def test_a_quality_that_the_link_decides_needs_to_know_the_link() -> None:
    with robot(SeeingTransport(), uplink="jpeg") as client, pytest.raises(LinkError, match="snr"):
        client.step(observation(), WORDS)


def test_a_server_that_cannot_see_is_refused_before_the_robot_moves() -> None:
    with pytest.raises(HandshakeError, match="--vision on"):
        robot(SeeingTransport(codings=()))
    with pytest.raises(HandshakeError, match=r"jpeg, webp.*sends h264"):
        robot(SeeingTransport(codings=("jpeg", "webp")), uplink="h264")


def test_pictures_do_not_go_in_pieces() -> None:
    with pytest.raises(ValueError, match="arrive whole or not at all"):
        robot(SeeingTransport(), sending="progressive")


def test_the_margin_applies_to_pictures_too() -> None:
    transport = SeeingTransport()
    from comvla_client import SnrReading

    with robot(transport, uplink="jpeg", sending="margin", link=WIDE) as client:
        fresh = client.step(observation(), WORDS, SnrReading(10.0)).report
        stale = client.step(observation(), WORDS, SnrReading(10.0, age_s=5.0)).report
    assert fresh.image_quality is not None
    assert stale.token_budget < fresh.token_budget


def test_tokens_need_an_edge_model_and_say_so() -> None:
    with pytest.raises(ValueError, match=r"edge=load_edge.*jpeg-75"):
        ComVLAClient(SeeingTransport())
    with pytest.raises(ValueError, match="edge=load_edge"):
        ComVLAClient(SeeingTransport(), uplink="random", edge=INFO)


def test_a_selector_is_an_uplink_too() -> None:
    transport = SeeingTransport()
    with robot(transport, uplink="random", edge=StubEdge(), budget=4) as client:
        report = client.step(observation(), WORDS).report
    assert (report.uplink, report.tokens) == ("random", 4)


async def test_the_asyncio_client_needs_no_model_either() -> None:
    client = AsyncComVLAClient(AsyncSeeingTransport(), uplink="jpeg-75", deadline_s=20.0)
    with pytest.raises(HandshakeError, match="connect first"):
        _ = client.info
    async with client:
        assert client.info == INFO
        assert (await client.step(observation(), WORDS, 30.0)).source == "cloud"


class TestVideo:
    """A difference is sent only where the server surely has what it builds on."""

    def follows(self, transport: SeeingTransport) -> list[int | None]:
        return [
            r.images.follows_step if r.images.HasField("follows_step") else None
            for r in transport.requests
        ]

    def steps(self, client: ComVLAClient, count: int, first: int = 0) -> None:
        for number in range(first, first + count):
            client.step(observation(number), WORDS, 30.0)

    def test_a_key_frame_and_then_differences(self) -> None:
        transport = SeeingTransport()
        with robot(transport, uplink="h264") as client:
            self.steps(client, 4)
        assert self.follows(transport) == [None, 0, 1, 2]
        for view in range(2):
            reader = VideoReader(16, 16)
            for number, request in enumerate(transport.requests):
                picture = reader.read(request.images.views[view].data)
                assert np.abs(picture.astype(int) - observation(number)["images"][view]).mean() < 60

    @pytest.mark.parametrize(
        "error",
        [fault("ABORTED", "key frame needed"), fault("DEADLINE_EXCEEDED"), fault("UNAVAILABLE")],
    )
    def test_a_key_frame_after_any_loss(self, error: TransportError) -> None:
        transport = SeeingTransport(None, None, error, None, None)
        with robot(transport, uplink="h264") as client:
            self.steps(client, 5)
        assert self.follows(transport) == [None, 0, 1, None, 3]

    def test_a_key_frame_after_a_reset(self) -> None:
        transport = SeeingTransport()
        with robot(transport, uplink="h264") as client:
            self.steps(client, 2)
            client.reset()
            self.steps(client, 2)
        assert self.follows(transport) == [None, 0, None, 0]

    def test_a_step_without_a_link_breaks_nothing(self) -> None:
        transport = SeeingTransport()
        with robot(transport, uplink="h264") as client:
            self.steps(client, 2)
            client.step(observation(), WORDS, float("-inf"))
            self.steps(client, 1)
        assert self.follows(transport) == [None, 0, 1]
        assert transport.requests[-1].step == 3

    def test_pictures_that_did_not_fit_were_never_sent(self) -> None:
        transport = SeeingTransport()
        with robot(transport, uplink="h264-10", link=NARROW) as client:
            client.step(observation(0), WORDS, 60.0)
            assert client.step(observation(1), WORDS, 0.0).report.fallback_reason == "no_link"
            client.step(observation(2), WORDS, 60.0)
        assert self.follows(transport) == [None, None]

    def test_a_step_that_nobody_settled_counts_as_lost(self) -> None:
        encoder = VideoEncoder()
        pictures = observation()["images"]
        assert encoder.encode(pictures, 23).follows_step is None
        encoder.settle(7, True)
        assert encoder.encode(pictures, 23).follows_step == 7
        assert encoder.encode(pictures, 23).follows_step is None

    def test_pictures_of_another_size_begin_anew(self) -> None:
        encoder = VideoEncoder()
        encoder.encode([np.zeros((16, 16, 3), np.uint8)], 23)
        encoder.settle(0, True)
        assert encoder.encode([np.zeros((32, 16, 3), np.uint8)], 23).follows_step is None


def test_a_refusal_about_pictures_is_an_error_of_the_observation() -> None:
    error = fault("INVALID_ARGUMENT", "expected picture 0 of 16 x 16 pixels")
    with robot(SeeingTransport(error)) as client, pytest.raises(ObservationError, match="16 x 16"):
        client.step(observation(), WORDS, 30.0)


@pytest.mark.parametrize(
    "name", ["gif-75", "jpeg-", "jpeg-x", "telepathy", "jpeg75", "no.such.module:Thing", "math:pi"]
)
def test_an_unknown_form_is_refused_with_those_that_exist(name: str) -> None:
    with pytest.raises(UnknownMethodError, match=r"hard_voting|no\.such\.module|no class"):
        make_uplink(name)


@pytest.mark.parametrize("name", ["jpeg-0", "jpeg-101", "h264-52"])
def test_a_quality_that_does_not_exist_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="expected a"):
        make_uplink(name)


def test_a_number_of_bytes_below_one_is_no_budget() -> None:
    with pytest.raises(ValueError, match="number of bytes"):
        robot(SeeingTransport(), budget=0)


def test_forms_of_ones_own_are_taken_as_they_are() -> None:
    form = ImageUplink(VideoEncoder(40), name="mine")
    assert make_uplink(form) is form
    with robot(SeeingTransport(), uplink=form) as client:
        assert client.step(observation(), WORDS, 30.0).report.uplink == "mine"


def test_a_robot_without_torch_sends_pictures() -> None:
    out = run_python(
        WITHOUT_TORCH
        + """
    import numpy as np
    from comvla_client.registry import make_uplink
    form = make_uplink("jpeg-75")
    print(form.name, form.needs_edge, "torch" in sys.modules)
    """
    )
    assert out.split() == ["jpeg-75", "False", "False"]
