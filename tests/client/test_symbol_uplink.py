"""Learned codecs as an uplink form: symbols with noise, decoded by a real server, policy in the cloud."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from comvla.errors import ComVLAError, HandshakeError, LinkError
from comvla.v1.policy_pb2 import InferRequest
from comvla_client import ComVLAClient, LinkProfile
from comvla_client.observation import CheckedObservation
from comvla_client.registry import make_uplink
from comvla_client.symbol_uplink import SymbolUplink
from comvla_client.uplink import Setup, Uplink
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.image_decoders import SymbolDecoder
from comvla_server.vision import VisionHalf
from comvla_vla import CloudModel, EdgeModel, PolicyRequest
from comvla_vla.codecs import DeepJSCCConfig, ImageCodec, TrainedCodec, load_codec, save_codec
from comvla_vla.codecs.waveform import decode_waveform, read_waveform

Policy = tuple[EdgeModel, CloudModel]
WORDS = "pull the green drawer open"
KIB_OF_TWO_VIEWS = 128  # 2 · 16 · 32 · 32 float32 values


def observation(seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    images = [rng.integers(0, 256, (128, 128, 3), dtype=np.uint8) for _ in range(2)]
    return {"images": images, "proprio": rng.standard_normal(4)}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> TrainedCodec:
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("codec")
    save_codec(folder, ImageCodec(DeepJSCCConfig()), 128, {})
    return load_codec(folder)


@pytest.fixture(scope="module")
def seeing(policy: Policy, trained: TrainedCodec) -> Iterator[BackgroundServer]:
    """A server that looks at what this codec's decoder makes of symbols."""
    edge, cloud = policy
    vision = VisionHalf(edge, decoders={"deep_jscc": SymbolDecoder(trained)})
    with BackgroundServer(Engine(cloud, vision)) as running:
        yield running


def started(policy: Policy, form: SymbolUplink, **options: Any) -> SymbolUplink:
    values = {"link": LinkProfile(), "quantization": "int8", "budget": "paper", "min_tokens": 1}
    form.start(Setup(policy[0].info, None, **{**values, **options}))
    return form


def compress(form: SymbolUplink, seed: int = 0, count: int = 10**6) -> Uplink:
    obs = observation()
    checked = CheckedObservation(obs["images"], np.asarray(obs["proprio"], np.float32))
    return form.compress(checked, count, np.random.default_rng(seed))


def test_the_answer_is_the_policy_on_the_reconstructions(
    policy: Policy, seeing: BackgroundServer, trained: TrainedCodec
) -> None:
    edge, cloud = policy
    obs = observation()
    sent: list[Uplink] = []

    class Watched(SymbolUplink):
        def compress(self, *args: Any) -> Uplink:
            sent.append(super().compress(*args))
            return sent[-1]

    with ComVLAClient(
        seeing.target, edge=edge.info, uplink=Watched(trained, 10.0), deadline_s=30.0
    ) as client:
        chunk = client.step(obs, WORDS)
    images = sent[0].images
    assert images is not None
    seen = [decode_waveform(view.data, 128, 128, trained) for view in images.views]
    tokens = edge.encode(seen)
    proprio = np.asarray(obs["proprio"], np.float32)
    request = PolicyRequest(tokens, np.arange(len(tokens)), WORDS, proprio)
    np.testing.assert_allclose(chunk.actions, cloud.predict([request])[0], atol=1e-5)
    report = chunk.report
    assert (report.uplink, report.source) == ("deepjscc-10", "cloud")
    assert report.payload_bytes == KIB_OF_TWO_VIEWS * 1024
    assert 0 < report.encoded_bytes - report.payload_bytes < 256
    assert report.edge_flops == pytest.approx(2 * 0.17e9, rel=0.1)


@pytest.mark.parametrize("snr_db", [0.0, 10.0])
def test_all_views_cross_one_period_of_the_asked_snr(
    policy: Policy, trained: TrainedCodec, snr_db: float
) -> None:
    images = compress(started(policy, SymbolUplink(trained, snr_db))).images
    assert images is not None
    first, second = (read_waveform(view.data) for view in images.views)
    assert first.gain == second.gain
    assert abs(first.gain) == pytest.approx(1, abs=1e-6)
    assert first.noise == second.noise == pytest.approx(10 ** (-snr_db / 10), rel=1e-6)
    quiet = compress(started(policy, SymbolUplink(trained, 120.0))).images
    assert quiet is not None
    clean = read_waveform(quiet.views[0].data)
    assert clean.gain == first.gain  # the seed decides, whatever the SNR
    error = first.symbols - clean.symbols
    measured = float(np.mean(np.abs(clean.symbols) ** 2) / np.mean(np.abs(error) ** 2))
    assert 10 * math.log10(measured) == pytest.approx(snr_db, abs=0.2)


def test_a_seed_gives_one_period_and_another_gives_another(
    policy: Policy, trained: TrainedCodec
) -> None:
    form = started(policy, SymbolUplink(trained, 5.0))
    assert compress(form, 1).images == compress(form, 1).images
    assert compress(form, 1).images != compress(form, 2).images


def test_without_a_number_the_reported_snr_is_the_periods(
    policy: Policy, seeing: BackgroundServer, trained: TrainedCodec
) -> None:
    form = SymbolUplink(trained)
    with ComVLAClient(seeing.target, edge=policy[0].info, uplink=form, deadline_s=30.0) as client:
        assert client.step(observation(), WORDS, 7.0).report.source == "cloud"
        assert form.sizer.snr_db == pytest.approx(7.0)
        assert client.step(observation(), WORDS, -math.inf).report.fallback_reason == "no_link"
        with pytest.raises(LinkError, match="SNR"):
            client.step(observation(), WORDS)


def test_a_period_without_room_for_the_symbols_is_refused(
    policy: Policy, trained: TrainedCodec
) -> None:
    with pytest.raises(ValueError, match=r"16384 channel uses.*has 16000"):
        started(policy, SymbolUplink(trained, 10.0), link=LinkProfile(bandwidth_hz=320e3))
    form = started(policy, SymbolUplink(trained, 10.0), link=LinkProfile(bandwidth_hz=330e3))
    assert form.sizer.most_tokens == 16_500
    assert "16384 channel uses" in compress(form, count=16_000).refusal
    request = InferRequest(snr_db=3.0)
    options: dict[str, Any] = {"progressive": False, "least": 1, "window_s": 0.05}
    assert form.sizer.tokens_in(1.0, request, **options) == 16_500
    assert form.sizer.tokens_in(0.0, request, **options) == 0


def test_a_server_without_this_decoder_is_refused_at_the_handshake(
    server: BackgroundServer, policy: Policy, trained: TrainedCodec
) -> None:
    with pytest.raises(HandshakeError, match="no vision half"):
        ComVLAClient(server.target, edge=policy[0].info, uplink=SymbolUplink(trained, 10.0))


def test_symbols_of_other_weights_are_refused_in_words(
    policy: Policy, seeing: BackgroundServer, tmp_path: Path
) -> None:
    torch.manual_seed(1)
    save_codec(tmp_path, ImageCodec(DeepJSCCConfig()), 128, {})
    form = SymbolUplink(str(tmp_path), 10.0)
    with (
        ComVLAClient(seeing.target, edge=policy[0].info, uplink=form, deadline_s=30.0) as client,
        pytest.raises(ComVLAError, match="same trained codec"),
    ):
        client.step(observation(), WORDS)


@pytest.mark.parametrize("name", ["deepjscc-10", "witt-0", "deepjscc", "witt"])
def test_shipped_codecs_are_uplink_forms_by_name(name: str, policy: Policy) -> None:
    form = make_uplink(name)
    assert isinstance(form, SymbolUplink)
    assert (form.name, form.adjustable) == (name, "-" not in name)
    started(policy, form)


def test_an_snr_that_no_link_has_is_refused(trained: TrainedCodec) -> None:
    for snr_db in (math.nan, math.inf, -math.inf):
        with pytest.raises(LinkError):
            SymbolUplink(trained, snr_db)
