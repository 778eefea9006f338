"""Observations and instructions that do not fit are refused before anything is computed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from client_stubs import INFO, WORDS, StubEdge, StubTransport, observation, other_model

from comvla.errors import InstructionError, ObservationError
from comvla_client import ComVLAClient
from comvla_client.observation import check_observation

GOOD = observation()
VIEW = GOOD["images"][0]


def changed(**changes: Any) -> dict[str, Any]:
    return {**GOOD, **changes}


BAD_OBSERVATIONS: dict[str, tuple[Any, str]] = {
    "no mapping": ([VIEW, VIEW], "mapping"),
    "no images": ({"proprio": GOOD["proprio"]}, "'images'"),
    "images is None": (changed(images=None), "'images'"),
    "no proprio": ({"images": GOOD["images"]}, "'proprio'"),
    "a lone picture": (changed(images=VIEW), "list of 2 views"),
    "a string": (changed(images="ab"), "list of 2 views"),
    "one view": (changed(images=[VIEW]), "2 views"),
    "three views": (changed(images=[VIEW] * 3), "2 views"),
    "floats": (changed(images=[VIEW, VIEW / 255.0]), "view 1 as a uint8"),
    "a nested list": (changed(images=[VIEW, VIEW.tolist()]), "view 1 as a uint8"),
    "channels first": (changed(images=[VIEW.transpose(2, 0, 1), VIEW]), "view 0 of shape"),
    "with alpha": (changed(images=[np.zeros((16, 16, 4), np.uint8), VIEW]), "alpha"),
    "grey": (changed(images=[VIEW[..., 0], VIEW]), "view 0 of shape"),
    "another size": (changed(images=[VIEW, VIEW[:15]]), r"\(16, 16, 3\)"),
    "short proprio": (changed(proprio=np.zeros(2)), r"shape \(3,\)"),
    "two-dimensional proprio": (changed(proprio=np.zeros((1, 3))), r"shape \(3,\)"),
    "NaN": (changed(proprio=[0.0, float("nan"), 0.0]), "finite"),
    "infinity": (changed(proprio=[0.0, 0.0, -float("inf")]), "finite"),
    "beyond float32": (changed(proprio=[1e300, 0.0, 0.0]), "finite"),
    "words": (changed(proprio=["a", "b", "c"]), "3 numbers"),
    "ragged": (changed(proprio=[[1], [1, 2], 3]), "3 numbers"),
    "booleans": (changed(proprio=[True, False, True]), "3 numbers"),
}


@pytest.mark.parametrize("name", BAD_OBSERVATIONS)
def test_a_bad_observation_is_refused_before_anything_is_sent(name: str) -> None:
    obs, words = BAD_OBSERVATIONS[name]
    edge, transport = StubEdge(), StubTransport()
    with ComVLAClient(transport, edge=edge, budget=4, deadline_s=20.0) as client:
        with pytest.raises(ObservationError, match=words):
            client.step(obs, WORDS)
        assert transport.requests == []
        assert edge.calls == []
        assert client.step(GOOD, WORDS).report.step == 0, "a refused observation is no step"


@pytest.mark.parametrize(
    ("instruction", "words"),
    [
        ("", "in words"),
        (" \n\t", "in words"),
        (b"push", "as str"),
        (None, "as str"),
        ("w " * 9, "at most 8"),
    ],
)
def test_a_bad_instruction_is_refused_before_anything_is_sent(instruction: Any, words: str) -> None:
    edge, transport = StubEdge(), StubTransport()
    with ComVLAClient(transport, edge=edge, budget=4, deadline_s=20.0) as client:
        with pytest.raises(InstructionError, match=words):
            client.step(GOOD, instruction)
        assert transport.requests == []
        assert "encode" not in edge.calls


def test_any_memory_layout_of_a_picture_will_do() -> None:
    mirrored = [VIEW[:, ::-1], np.asfortranarray(VIEW)]
    checked = check_observation(changed(images=mirrored), INFO)
    assert all(image.flags.c_contiguous for image in checked.images)
    np.testing.assert_array_equal(checked.images[0], VIEW[:, ::-1])


def test_views_may_come_stacked_or_as_a_tuple() -> None:
    for images in (np.stack([VIEW, VIEW]), (VIEW, VIEW)):
        assert len(check_observation(changed(images=images), INFO).images) == 2


@pytest.mark.parametrize("proprio", [[1, 2, 3], (1.0, 2.0, 3.0), np.array([1, 2, 3], np.float16)])
def test_proprioception_becomes_float32(proprio: Any) -> None:
    values = check_observation(changed(proprio=proprio), INFO).proprio
    assert values.dtype == np.float32
    assert values.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("obs", [{"images": GOOD["images"]}, GOOD, changed(proprio="unused")])
def test_a_model_without_proprioception_ignores_it(obs: dict[str, Any]) -> None:
    assert check_observation(obs, other_model(proprio_dim=0)).proprio.shape == (0,)
