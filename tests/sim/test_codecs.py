"""Training and measuring of learned codecs."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import comvla_vla.codecs
from comvla_sim import cli
from comvla_sim.codecs.digital import QUALITIES, jpeg_ladder
from comvla_sim.codecs.fading import RICIAN_K, draw_gains
from comvla_sim.codecs.fidelity import psnr_db, ssim
from comvla_sim.codecs.figures import Measured, pictures_figure, psnr_figure
from comvla_sim.codecs.measuring import curves, reconstruct
from comvla_sim.codecs.pictures import Pictures
from comvla_sim.codecs.trainer import CodecRecipe, CodecTrainer, draw_periods
from comvla_sim.training.run_state import TrainingError
from comvla_sim.worlds import make
from comvla_vla.codecs import CODECS, load_codec, rate
from comvla_vla.codecs.files import TrainedCodec
from comvla_vla.codecs.image_codec import config_to_json
from comvla_vla.codecs.witt import WITTConfig

WITT = WITTConfig(
    widths=(8, 16),
    depths=(1, 1),
    heads=(1, 2),
    window=4,
    latent_channels=12,
    modulation_layers=1,
    modulation_width=8,
)
RECIPES = {
    "deepjscc": CodecRecipe("deepjscc", {"channels": 4}, 32, 1, steps=60, warmup_steps=5),
    "witt": CodecRecipe(
        "witt", config_to_json(WITT), 32, 1, steps=60, warmup_steps=5, learning_rate=5e-3
    ),
}


class Frames:
    """Frames of two views, each a coloured disc before a gradient."""

    def __init__(self, count=24, size=32):
        rng = np.random.default_rng(0)
        ramp = np.linspace(0, 1, size)
        x, y = np.meshgrid(ramp, ramp)
        images = np.empty((count, 2, size, size, 3))
        for frame, view in np.ndindex(count, 2):
            colour, (u, v) = rng.uniform(size=3), rng.uniform(0.2, 0.8, size=2)
            disc = (np.hypot(x - u, y - v) < 0.25)[..., None]
            images[frame, view] = np.where(disc, colour, (0.5 * x + 0.3 * y)[..., None])
        self.images = (255 * images).astype(np.uint8)

    def __len__(self):
        return len(self.images)

    def gather_images(self, indices):
        return self.images[np.asarray(indices)]


@pytest.fixture
def pictures():
    return Pictures(Frames(), seed=0)


# ---------------------------------------------------------------- pictures and periods


def test_an_epoch_shows_every_view_of_every_frame_once(pictures):
    assert (len(pictures), pictures.views) == (48, 2)
    epoch = torch.cat([pictures.batch(step, 8) for step in range(6)])
    assert epoch.shape == (48, 3, 32, 32)
    assert len({image.numpy().tobytes() for image in epoch}) == 48
    again = torch.cat([pictures.batch(step, 8) for step in range(6, 12)])
    assert not torch.equal(epoch, again)
    assert {i.numpy().tobytes() for i in epoch} == {i.numpy().tobytes() for i in again}


def test_pictures_are_rgb_in_unit_range(pictures):
    expected = Frames().images[3, 1].transpose(2, 0, 1) / 255
    assert np.allclose(pictures.of([7])[0].numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("kind", RICIAN_K)
def test_gains_have_unit_power_and_the_right_spread(kind):
    power = np.abs(draw_gains(kind, 200_000, np.random.default_rng(0)).astype(np.complex128)) ** 2
    k = RICIAN_K[kind]
    variance = 0.0 if math.isinf(k) else (1 + 2 * k) / (1 + k) ** 2  # of |h|², Rician
    assert power.mean() == pytest.approx(1, abs=0.01)
    assert power.var() == pytest.approx(variance, abs=0.02)


def test_every_picture_of_a_step_has_a_period_of_its_own():
    recipe = replace(RECIPES["witt"], channels=("rayleigh",), mean_snr_db=(0.0, 20.0))
    gain, noise = draw_periods(recipe, 64, np.random.default_rng(0))
    assert len(set(gain.tolist())) == len(set(noise.tolist())) == 64
    assert 0.01 <= float(noise.min()) <= float(noise.max()) <= 1.0


def test_an_unknown_channel_says_which_there_are():
    with pytest.raises(TrainingError, match="awgn, rician, rayleigh"):
        draw_gains("fibre", 1, np.random.default_rng(0))


# ---------------------------------------------------------------- training


@pytest.mark.parametrize("name", RECIPES)
def test_a_handful_of_steps_improves_a_codec(name, pictures, tmp_path):
    trainer = CodecTrainer(RECIPES[name], tmp_path)
    originals = (255 * pictures.spread(16)).byte().permute(0, 2, 3, 1).numpy()

    def quality():
        return psnr_db(originals, reconstruct(trainer.codec, originals, "awgn", 20.0)).mean()

    before = quality()
    trainer.run(pictures, lambda _: None)
    after = quality()
    assert after > before + 2, (before, after)


@pytest.mark.parametrize("name", RECIPES)
def test_an_interrupted_training_ends_where_an_uninterrupted_one_does(name, pictures, tmp_path):
    recipe = replace(RECIPES[name], steps=6)
    whole = CodecTrainer(recipe, tmp_path / "whole")
    whole.run(pictures, lambda _: None)
    CodecTrainer(recipe, tmp_path / "parts").run(pictures, lambda _: None, until=4)
    torch.manual_seed(99)  # whatever happened in between
    rest = CodecTrainer(recipe, tmp_path / "parts")
    assert rest.resume()
    assert rest.step == 4
    rest.run(pictures, lambda _: None)
    for name_, value in whole.codec.state_dict().items():
        assert torch.equal(value, rest.codec.state_dict()[name_]), name_


def test_a_folder_of_another_recipe_or_a_damaged_one_is_refused(pictures, tmp_path):
    recipe = replace(RECIPES["deepjscc"], steps=1)
    CodecTrainer(recipe, tmp_path).run(pictures, lambda _: None)
    with pytest.raises(TrainingError, match="another learning_rate, seed"):
        CodecTrainer(replace(recipe, seed=1, learning_rate=1.0), tmp_path).resume()
    (tmp_path / "state-1.safetensors").write_bytes(b"")
    with pytest.raises(TrainingError, match="cannot read"):
        CodecTrainer(recipe, tmp_path).resume()
    assert not CodecTrainer(recipe, tmp_path / "new").resume()


# ---------------------------------------------------------------- measures


def test_psnr_is_the_formula():
    black = np.zeros((2, 4, 4, 3), np.uint8)
    off = black.copy()
    off[0] += 10
    off[1, 0, 0, 0] = 255
    assert psnr_db(black, off) == pytest.approx(
        [10 * math.log10(255**2 / 100), 10 * math.log10(4 * 4 * 3)]
    )
    assert psnr_db(black, black)[0] == math.inf


def test_ssim_is_the_formula_in_its_one_window():
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 256, (2, 1, 11, 11, 3)).astype(np.uint8)
    offsets = np.arange(11) - 5
    weights = np.exp(-(offsets**2) / (2 * 1.5**2))
    weights = np.outer(weights, weights) / weights.sum() ** 2
    expected = []
    for channel in range(3):
        x, y = a[0, ..., channel] / 255, b[0, ..., channel] / 255
        mx, my = (weights * x).sum(), (weights * y).sum()
        vx, vy = (weights * (x - mx) ** 2).sum(), (weights * (y - my) ** 2).sum()
        cov = (weights * (x - mx) * (y - my)).sum()
        light = (2 * mx * my + 1e-4) / (mx**2 + my**2 + 1e-4)
        expected.append(light * (2 * cov + 9e-4) / (vx + vy + 9e-4))
    assert ssim(a, b) == pytest.approx([np.mean(expected)])
    assert ssim(a, a) == pytest.approx([1.0])


@pytest.fixture(scope="module")
def shown():
    return np.ascontiguousarray(Frames(count=3, size=64).images.reshape(-1, 64, 64, 3))


def test_ideal_digital_transmission_takes_the_best_that_fits(shown):
    ladder = jpeg_ladder(shown)
    assert ladder.psnr_db.shape == (len(QUALITIES), len(shown))
    assert (ladder.scan_bytes < ladder.file_bytes).all()
    uses = 1000
    by_snr = [ladder.at_capacity(uses, snr)[0] for snr in (-5.0, 5.0, 15.0, 25.0)]
    assert by_snr == sorted(by_snr)
    assert ladder.at_capacity(10**9, 0.0) == (ladder.psnr_db.max(0).mean(), 1.0)
    assert ladder.at_capacity(1, 0.0) == (ladder.grey_psnr_db.mean(), 0.0)
    # Exactly enough, and one bit too few: at 0 dB a use carries one bit.
    most = int(ladder.scan_bytes[:, :1].max()) * 8
    one = replace(
        ladder,
        scan_bytes=ladder.scan_bytes[:, :1],
        psnr_db=ladder.psnr_db[:, :1],
        grey_psnr_db=ladder.grey_psnr_db[:1],
    )
    assert one.at_capacity(most, 0.0)[0] > one.at_capacity(most - 1, 0.0)[0]


def test_curves_and_figures_of_a_codec(pictures, shown, tmp_path):
    trainer = CodecTrainer(RECIPES["deepjscc"], tmp_path)
    trainer.run(pictures, lambda _: None)
    trained = TrainedCodec(trainer.codec.eval(), "deepjscc", 64, "ab" * 32, {})
    lines = curves(trained.codec, shown, ("awgn", "rayleigh"), (0.0, 20.0))
    assert [(line["channel"], line["mean_snr_db"]) for line in lines] == [
        ("awgn", 0.0),
        ("awgn", 20.0),
        ("rayleigh", 0.0),
        ("rayleigh", 20.0),
    ]
    json.dumps(lines)
    assert lines == curves(trained.codec, shown, ("awgn", "rayleigh"), (0.0, 20.0))
    measured = Measured(trained, rate(trained.codec.config, 64, 64), lines)
    svg = psnr_figure([measured], jpeg_ladder(shown), "svg").decode()
    assert "capacity" in svg
    assert "deepjscc, Rayleigh" in svg
    assert pictures_figure([trained], shown[:1], snrs_db=(10.0,)).startswith(b"\x89PNG")


# ---------------------------------------------------------------- the command


@pytest.mark.slow
@pytest.mark.simulator
def test_the_command_leaves_a_codec_and_its_curve(tmp_path, capsys):
    out = tmp_path / "run"
    options = ["--size", "32", "--layouts", "1", "--held-out-layouts", "1", "--steps", "2"]
    command = ["train", "codec", "--codec", "deepjscc", *options, "--workers", "1"]
    folders = ["--out", str(out), "--data", str(tmp_path / "frames")]
    assert cli.main([*command, *folders, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["per_view"] == {
        "values": 1024,
        "latent_bytes": 4096,
        "channel_uses": 512,
        "per_pixel_value": 1 / 6,
    }
    assert {p.name for p in out.iterdir()} >= {"psnr.svg", "psnr.png", "pictures.png", "codec"}
    # Again: nothing is left to train, and everything is the same.
    assert cli.main([*command, *folders]) == 0
    assert json.loads((out / "summary.json").read_text())["fingerprint"] == summary["fingerprint"]
    figure = ["psnr", "--codec", str(out / "codec"), "--layouts", "1", "--pictures", "4"]
    assert cli.main([*figure, "--data", str(tmp_path / "frames"), "--out", str(tmp_path)]) == 0
    drawn = json.loads((tmp_path / "psnr.json").read_text())
    assert drawn["codecs"][0]["fingerprint"] == summary["fingerprint"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--codec", "witt", "--size", "100"], "multiples of 128"),
        (["--codec", "deepjscc", "--steps", "0"], "at least one of --steps"),
        (["--codec", "deepjscc", "--layouts", "200000"], "1 to 100000 --layouts"),
    ],
)
def test_options_that_make_no_sense_are_refused_before_any_work(options, words, capsys, tmp_path):
    assert cli.main(["train", "codec", *options, "--out", str(tmp_path)]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- what is shipped


@pytest.fixture(scope="module")
def tables():
    """Pictures of tables that neither training nor the measured curves saw, in the midst of motion."""
    world = make("tabletop", image_size=128)
    seen = []
    for seed in range(990_000, 990_004):
        world.reset(seed=seed)
        for _ in range(25):
            world.advance(world.expert_action())
        seen.extend(world.observe()["images"])
    world.close()
    return np.stack(seen)


@pytest.mark.simulator
@pytest.mark.parametrize("name", CODECS)
def test_a_shipped_codec_keeps_its_promise_on_new_tables(name, tables):
    trained = load_codec(name)
    lines = curves(trained.codec, tables, ("awgn",), (-5.0, 0.0, 5.0, 10.0, 15.0, 20.0))
    ratios = {line["mean_snr_db"]: line["psnr_db"] for line in lines}
    assert list(ratios.values()) == sorted(ratios.values())
    assert ratios[10.0] >= 24.0
    promised = {
        line["mean_snr_db"]: line["psnr_db"]
        for line in trained.notes["curves"]
        if line["channel"] == "awgn"
    }
    assert ratios[10.0] == pytest.approx(promised[10.0], abs=1.5)


@pytest.mark.parametrize("name", CODECS)
def test_a_shipped_codec_is_small_and_its_card_says_what_was_measured(name):
    trained = load_codec(name)
    folder = Path(comvla_vla.codecs.__file__).parent / "shipped"
    assert sum(f.stat().st_size for f in folder.rglob("*.safetensors")) < 1.3e6
    card = (folder / "README.md").read_text(encoding="utf-8")
    assert trained.fingerprint[:16] in card
    for line in trained.notes["curves"]:
        assert f"{line['psnr_db']:.1f} / {line['ssim']:.3f}" in card, (name, line)
