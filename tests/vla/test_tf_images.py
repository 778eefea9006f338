"""Pictures are prepared as TensorFlow prepared them, level by level."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from reference_data import GOLDEN, needs_golden

from comvla.errors import DependencyError, ObservationError
from comvla_vla import tf_images
from comvla_vla.preprocess import preprocess
from comvla_vla.presets import openvla_oft

PICTURES = ("full256", "wrist256", "noise256", "smooth256", "rect320x240")


@pytest.fixture(scope="module")
def stages():
    with np.load(GOLDEN / "preproc" / "preproc_tf.npz") as archive:
        return dict(archive)


def assert_nearly_equal(ours: np.ndarray, reference: np.ndarray) -> None:
    """At most one level off, on at most 5e-5 of the values."""
    off = np.abs(ours.astype(int) - reference)
    assert off.max() <= 1
    assert (off > 0).mean() <= 5e-5


@needs_golden
@pytest.mark.parametrize("name", PICTURES)
def test_every_stage_equals_tensorflows(stages, name):
    image = stages[f"{name}/in"]
    decoded = tf_images.through_jpeg(image)
    np.testing.assert_array_equal(decoded, stages[f"{name}/jpeg_decoded"])
    resized = tf_images.lanczos_resize(decoded, 224)
    np.testing.assert_allclose(resized, stages[f"{name}/lanczos_float"], atol=2e-4)
    assert_nearly_equal(tf_images.round_to_bytes(resized), stages[f"{name}/resized"])
    np.testing.assert_array_equal(
        tf_images.center_crop(stages[f"{name}/resized"]), stages[f"{name}/cropped"]
    )
    assert_nearly_equal(tf_images.prepare(image, 224), stages[f"{name}/cropped"])


@needs_golden
@pytest.mark.parametrize("name", ["sample_full_image", "sample_wrist_image"])
def test_a_picture_of_the_right_size_is_only_cropped(stages, name):
    np.testing.assert_array_equal(
        tf_images.prepare(stages[f"{name}/in"], 224), stages[f"{name}/cropped"]
    )


def test_a_constant_picture_stays_constant():
    """Weights of every output pixel sum to one, also at the borders."""
    image = np.full((97, 131, 3), 200, np.uint8)
    np.testing.assert_allclose(tf_images.lanczos_resize(image, 224), 200, atol=1e-3)
    np.testing.assert_array_equal(tf_images.center_crop(image[:97, :97]), 200)


def test_enlarging_interpolates_a_ramp():
    ramp = np.repeat(np.arange(0, 200, 4, dtype=np.uint8)[None, :, None], 3, axis=2).repeat(
        50, axis=0
    )
    out = tf_images.lanczos_resize(ramp, 100)[50, 10:90, 0]
    np.testing.assert_allclose(np.diff(out), 2, atol=0.2)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((64, 64), np.uint8), r"a picture \(H, W, 3\)"),
        (np.zeros((64, 64, 4), np.uint8), r"got \(64, 64, 4\)"),
        (np.zeros((0, 64, 3), np.uint8), r"got \(0, 64, 3\)"),
        (np.zeros((64, 64, 3), np.float32), "uint8"),
    ],
)
def test_what_is_no_picture_is_refused(image, words):
    with pytest.raises(ObservationError, match=words):
        preprocess([np.zeros((90, 80, 3), np.uint8), image], openvla_oft())


@pytest.mark.parametrize("package", ["simplejpeg", "PIL"])
def test_missing_packages_are_named(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(DependencyError, match=r"pip install 'comvla\[openvla\]'"):
        tf_images.prepare(np.zeros((256, 256, 3), np.uint8), 224)
