"""Learned image codecs: the published sizes, exact power, honest noise, files that say what they are."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch

from comvla.errors import CheckpointError, CodecError
from comvla_vla.codecs import waveform
from comvla_vla.codecs.analogue import (
    equalise_mmse,
    instantaneous_snr_db,
    noise_power,
    normalise_power,
    to_latent,
    to_symbols,
    transmit,
)
from comvla_vla.codecs.files import NOTES, WEIGHTS, load_codec, save_codec
from comvla_vla.codecs.image_codec import (
    SMALL,
    SMALL_WITT,
    DeepJSCCConfig,
    ImageCodec,
    WITTConfig,
    config_from_json,
    config_to_json,
    rate,
)

TINY_WITT = WITTConfig(
    widths=(8, 16),
    depths=(2, 1),
    heads=(1, 2),
    window=4,
    latent_channels=12,
    modulation_layers=2,
    modulation_width=8,
)


def parameters(network):
    return sum(p.numel() for p in network.parameters())


@pytest.fixture(
    scope="module", params=[DeepJSCCConfig(channels=2), TINY_WITT], ids=["deepjscc", "witt"]
)
def codec(request):
    torch.manual_seed(0)
    return ImageCodec(request.param).eval()


# ---------------------------------------------------------------- the paper's sizes


def test_deepjscc_has_the_published_size():
    codec = ImageCodec(DeepJSCCConfig())
    assert round(parameters(codec.encoder), -2) == 78_100
    assert round(parameters(codec.decoder), -2) == 78_100


def test_witt_has_the_published_size():
    with torch.device("meta"):
        codec = ImageCodec(WITTConfig())
    assert round(parameters(codec.encoder), -5) == 14_100_000
    assert round(parameters(codec.decoder), -5) == 14_100_000


@pytest.mark.parametrize(
    ("config", "side", "latent", "kib_of_two_views", "uses_of_two_views"),
    [
        (DeepJSCCConfig(), 224, (16, 56, 56), 392.0, 50_176),
        (WITTConfig(), 256, (256, 96), 192.0, 24_576),
    ],
    ids=["deepjscc", "witt"],
)
def test_two_views_cost_what_the_paper_says(
    config, side, latent, kib_of_two_views, uses_of_two_views
):
    cost = rate(config, side, side)
    assert config.latent_shape(side, side) == latent
    assert 2 * cost.latent_bytes / 1024 == kib_of_two_views
    assert 2 * cost.channel_uses == uses_of_two_views


def test_the_published_networks_make_latents_of_these_shapes():
    with torch.device("meta"):
        witt, deepjscc = ImageCodec(WITTConfig()), ImageCodec(DeepJSCCConfig())
        latent = witt.encoder(torch.zeros(1, 3, 256, 256), torch.zeros(1))
        assert latent.shape == (1, 256, 96)
        assert witt.decoder(latent, torch.zeros(1)).shape == (1, 3, 256, 256)
        latent = deepjscc.encoder(torch.zeros(1, 3, 224, 224), torch.zeros(1))
        assert latent.shape == (1, 16, 56, 56)
        assert deepjscc.decoder(latent, torch.zeros(1)).shape == (1, 3, 224, 224)


def test_the_small_codecs_have_the_published_rates():
    for name, config in SMALL.items():
        published = {"deepjscc": (DeepJSCCConfig(), 224), "witt": (WITTConfig(), 256)}[name]
        theirs = rate(published[0], published[1], published[1])
        assert rate(config, 128, 128).per_pixel_value == pytest.approx(theirs.per_pixel_value)
    assert rate(SMALL["deepjscc"], 128, 128).per_pixel_value == pytest.approx(1 / 6)
    assert rate(SMALL["witt"], 128, 128).per_pixel_value == pytest.approx(1 / 16)


@pytest.mark.parametrize(
    ("config", "height", "width"),
    [(DeepJSCCConfig(), 130, 128), (SMALL_WITT, 224, 224), (SMALL_WITT, 128, 256)],
)
def test_a_size_that_does_not_fit_is_refused(config, height, width):
    with pytest.raises(CodecError, match="multiples of"):
        rate(config, height, width)


# ---------------------------------------------------------------- power, noise, equalisation


def test_every_picture_gets_exactly_its_power(codec):
    images = torch.rand(3, 3, 32, 32)
    images[1] *= 0.01  # a dark one gets no less
    symbols = codec.encode(images, torch.zeros(3))
    assert symbols.dtype == torch.complex64
    assert symbols.shape[1] == rate(codec.config, 32, 32).channel_uses
    power = symbols.to(torch.complex128).abs().square().mean(1)
    torch.testing.assert_close(power, torch.ones(3, dtype=torch.float64), rtol=1e-6, atol=0)


def test_power_normalisation_is_the_formula():
    z = torch.tensor([[3 + 4j, 0, 0, 12j]])
    expected = math.sqrt(4 * 2.5) * z / 13
    torch.testing.assert_close(normalise_power(z, power=2.5), expected)
    assert torch.equal(
        normalise_power(torch.zeros(1, 4, dtype=torch.complex64)), torch.zeros(1, 4) + 0j
    )


def test_symbols_are_pairs_of_values_and_come_back_as_they_were():
    latent = torch.arange(24.0).reshape(2, 3, 2, 2)
    symbols = to_symbols(latent)
    assert symbols.shape == (2, 6)
    assert symbols[0, :2].tolist() == [0 + 1j, 2 + 3j]
    assert torch.equal(to_latent(symbols, (3, 2, 2)), latent)
    with pytest.raises(CodecError, match="even number"):
        to_symbols(torch.zeros(1, 3))


@pytest.mark.parametrize("snr_db", [-3.0, 0.0, 10.0, 20.0])
@pytest.mark.parametrize("gain", [1 + 0j, 0.3 - 0.4j])
def test_measured_snr_is_the_stated_one_for_complex_symbols(snr_db, gain):
    generator = torch.Generator().manual_seed(1)
    symbols = normalise_power(to_symbols(torch.rand(1, 800_000, generator=generator)))
    h = torch.tensor([gain], dtype=torch.complex64)
    noise = noise_power(torch.tensor([snr_db]))
    received = transmit(symbols, h, noise, generator)
    error = received - h[:, None] * symbols
    measured = symbols.abs().square().mean() * h.abs().square() / error.abs().square().mean()
    stated = instantaneous_snr_db(h, noise)
    assert float(10 * torch.log10(measured)) == pytest.approx(float(stated), abs=0.03)
    assert float(stated) == pytest.approx(snr_db + 20 * math.log10(abs(gain)), abs=1e-4)
    # Half of the noise lies in each real part, and the parts have nothing to do with one another.
    parts = torch.view_as_real(error)[0]
    assert parts.square().mean(0).tolist() == pytest.approx([float(noise) / 2] * 2, rel=0.01)
    assert abs(float((parts[:, 0] * parts[:, 1]).mean())) < 0.01 * float(noise)


@pytest.mark.parametrize("gain", [1 + 0j, 0.2j, -1.1 + 0.7j])
def test_mmse_reaches_the_closed_form_and_no_scale_does_better(gain):
    generator = torch.Generator().manual_seed(2)
    symbols = torch.view_as_complex(torch.randn(1, 300_000, 2, generator=generator)) / math.sqrt(2)
    h, noise = torch.tensor([gain], dtype=torch.complex64), torch.tensor([0.25])
    received = transmit(symbols, h, noise, generator)
    estimate = equalise_mmse(received, h, noise)

    def error(guess):
        return float((guess - symbols).abs().square().mean())

    assert error(estimate) == pytest.approx(0.25 / (abs(gain) ** 2 + 0.25), rel=0.01)
    for other in (0.9, 1.1, 1 + 0.1j):
        assert error(other * estimate) > error(estimate)


def test_a_link_without_gain_gives_silence_and_a_picture_without_nan(codec):
    h, noise = torch.zeros(1, dtype=torch.complex64), torch.ones(1)
    assert not equalise_mmse(torch.ones(1, 4) + 0j, h, noise).any()
    with torch.inference_mode():
        seen = codec(torch.rand(1, 3, 32, 32), h, noise)
    assert torch.isfinite(seen).all()


def test_one_gain_for_all_symbols_of_a_picture():
    symbols = torch.ones(2, 5, dtype=torch.complex64)
    h = torch.tensor([2j, -1 + 0j], dtype=torch.complex64)
    received = transmit(symbols, h, torch.full((2,), 1e-12))
    torch.testing.assert_close(received, h[:, None].expand(2, 5), atol=1e-5, rtol=0)


def test_the_snr_speaks_to_witt_and_not_to_deepjscc(codec):
    images = torch.rand(1, 3, 32, 32)
    with torch.inference_mode():
        low, high = (codec.encode(images, torch.tensor([snr])) for snr in (0.0, 20.0))
    assert torch.equal(low, high) == (codec.config.name == "deepjscc")


def test_shifted_windows_do_not_join_opposite_borders():
    """A change at one border of the picture must not reach the other within one stage."""
    from comvla_vla.codecs.swin import stage

    torch.manual_seed(0)
    blocks = stage(8, 2, 2, 4).eval()
    x = torch.randn(1, 12, 12, 8)
    changed = x.clone()
    changed[0, 0, 0] += 1
    with torch.inference_mode():
        difference = (blocks(changed) - blocks(x)).abs().sum(-1)[0]
    reached = difference > 0
    assert reached[:6, :6].any()
    assert not reached[8:].any()
    assert not reached[:, 8:].any()


# ---------------------------------------------------------------- files


@pytest.fixture
def folder(codec, tmp_path):
    save_codec(tmp_path / "codec", codec, 32, {"seed": 7})
    return tmp_path / "codec"


def test_a_codec_comes_back_from_its_folder(codec, folder):
    trained = load_codec(folder)
    assert (trained.name, trained.image_size, trained.notes) == (codec.config.name, 32, {"seed": 7})
    images = torch.rand(1, 3, 32, 32)
    with torch.inference_mode():
        theirs, ours = (c.encode(images, torch.full((1,), 10.0)) for c in (trained.codec, codec))
    torch.testing.assert_close(theirs, ours, atol=0.02, rtol=0)  # half precision on disk
    assert save_codec(folder, trained.codec, 32, {}) == trained.fingerprint


def test_a_codec_of_another_version_is_refused(folder):
    header = json.loads((folder / NOTES).read_text())
    header["format"] = "comvla-codec-2"
    (folder / NOTES).write_text(json.dumps(header))
    with pytest.raises(CheckpointError, match=r"comvla-codec-2.*train it again"):
        load_codec(folder)


@pytest.mark.parametrize("damage", ["cut", "missing", "other weights", "unknown codec", "no json"])
def test_a_damaged_codec_is_refused(folder, damage):
    header = json.loads((folder / NOTES).read_text())
    weights = (folder / WEIGHTS).read_bytes()
    if damage == "cut":
        (folder / WEIGHTS).write_bytes(weights[:-10])
    elif damage == "missing":
        (folder / WEIGHTS).unlink()
    elif damage == "other weights":
        (folder / WEIGHTS).write_bytes(weights[:-1] + bytes([weights[-1] ^ 1]))
    elif damage == "unknown codec":
        (folder / NOTES).write_text(json.dumps({**header, "codec": "other"}))
    else:
        (folder / NOTES).write_text("{")
    with pytest.raises(CheckpointError):
        load_codec(folder)


def test_a_folder_without_a_codec_says_what_there_is(tmp_path):
    with pytest.raises(CheckpointError, match="deepjscc, witt"):
        load_codec(tmp_path)


def test_configurations_survive_json():
    for config in (*SMALL.values(), WITTConfig(), TINY_WITT):
        values = json.loads(json.dumps(config_to_json(config)))
        assert config_from_json(config.name, values) == config
    with pytest.raises(CodecError, match="does not fit"):
        config_from_json("witt", {"depth": 3})


# ---------------------------------------------------------------- what a receiver hands on


@pytest.fixture
def block(codec, folder):
    """Received symbols of one picture, and the codec that made them."""
    trained = load_codec(folder)
    rng = np.random.default_rng(0)
    count = rate(codec.config, 32, 32).channel_uses
    symbols = (rng.standard_normal((count, 2)) @ [1, 1j]).astype(np.complex64)
    return waveform.write_waveform(symbols, 0.5 - 1j, 0.1, trained), symbols, trained


def test_received_symbols_cross_as_they_are(block):
    data, symbols, trained = block
    read = waveform.read_waveform(data)
    assert np.array_equal(read.symbols, symbols)
    assert (read.gain, read.codec) == (0.5 - 1j, trained.name)
    assert read.noise == pytest.approx(0.1)
    # Apart from a header, the bytes are the float32 latent that the paper counts.
    assert len(data) - rate(trained.codec.config, 32, 32).latent_bytes < 64


def test_a_block_decodes_to_what_the_receiver_would_see(block):
    data, symbols, trained = block
    picture = waveform.decode_waveform(data, 32, 32, trained)
    with torch.inference_mode():
        expected = trained.codec.receive(
            torch.from_numpy(symbols)[None], (32, 32), torch.tensor([0.5 - 1j]), torch.tensor([0.1])
        )
    assert picture.dtype == np.uint8
    assert np.array_equal(picture, waveform.float_to_uint8(expected)[0])


def test_hostile_blocks_are_refused(block):
    data, symbols, trained = block
    header = len(data) - 8 * len(symbols)
    infinite = data[:header] + np.full_like(symbols, np.inf).tobytes()
    silent = waveform.write_waveform(symbols, 1 + 0j, 0.0, trained)
    cases = [
        b"",
        data[:20],
        b"X" + data[1:],
        data[:-3],
        data[:-8],
        data + b"12345678",
        infinite,
        silent,
    ]
    for case in cases:
        with pytest.raises(CodecError):
            waveform.decode_waveform(case, 32, 32, trained)
    for size in ((64, 64), (30, 30), (0, 0)):
        with pytest.raises(CodecError):
            waveform.decode_waveform(data, *size, trained)


def test_symbols_of_another_codec_are_refused(block, codec, tmp_path):
    data, _, _ = block
    torch.manual_seed(1)
    save_codec(tmp_path / "other", ImageCodec(codec.config), 32, {})
    with pytest.raises(CodecError, match="same trained codec on both sides"):
        waveform.decode_waveform(data, 32, 32, load_codec(tmp_path / "other"))
