"""The split model equals the undivided one, whatever was sent and whoever shared the batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from comvla import codec
from comvla.errors import InstructionError, ObservationError
from comvla_vla import CloudModel, CloudOptions, PolicyRequest, random_policy
from comvla_vla.preprocess import normalise

INSTRUCTIONS = ("pull the green drawer open", "press the button", "slide the window leftwards")


@pytest.fixture(scope="module")
def policy():
    return random_policy(seed=3)


@pytest.fixture(scope="module")
def observation():
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (128, 128, 3), dtype=np.uint8) for _ in range(2)]
    return images, rng.uniform(-1, 1, 4).astype(np.float32)


def undivided(policy, images, proprio, instruction, positions) -> np.ndarray:
    """One pass through both modules without any seam: dense tensors, no request, no codec."""
    edge, cloud = policy
    config = cloud.config
    ids = torch.tensor(cloud.prompt.ids(instruction))
    at = torch.as_tensor(positions)
    with torch.no_grad():
        pixels = normalise(torch.from_numpy(np.stack(images)), config.towers)[None]
        projected = cloud.net.projector(edge.net.vision_backbone(pixels))[0][at]
        state = torch.from_numpy(cloud.statistics.normalise_proprio(proprio))[None]
        actions, _ = cloud.net([projected], [at], [ids], state)
    return cloud.statistics.unnormalise_actions(actions.numpy())[0]


def through_the_wire(policy, images, proprio, instruction, positions) -> PolicyRequest:
    tokens = policy[0].encode(images).numpy()[positions]
    payload = codec.encode(tokens, positions, "float32")
    arrived, at = codec.decode(payload)
    return PolicyRequest(arrived, at, instruction, proprio)


@settings(max_examples=25, deadline=None)
@given(data=st.data(), k=st.sampled_from([1, 2, 16, 77, 512]))
def test_edge_codec_cloud_equals_undivided(policy, observation, data, k):
    images, proprio = observation
    seed = data.draw(st.integers(0, 2**31))
    positions = np.random.default_rng(seed).permutation(512)[:k]
    instruction = data.draw(st.sampled_from(INSTRUCTIONS))
    request = through_the_wire(policy, images, proprio, instruction, positions)
    want = undivided(policy, images, proprio, instruction, positions)
    np.testing.assert_allclose(policy[1].predict([request])[0], want, atol=1e-5)


def test_a_batch_of_mixed_sizes_equals_single_requests(policy, observation):
    images, proprio = observation
    rng = np.random.default_rng(1)
    requests = [
        through_the_wire(policy, images, proprio * s, text, rng.permutation(512)[:k])
        for k, text, s in [
            (16, INSTRUCTIONS[0], 1),
            (512, INSTRUCTIONS[1], 0.5),
            (16, INSTRUCTIONS[2], 0.1),
            (3, INSTRUCTIONS[0], 0.2),
            (200, INSTRUCTIONS[0], 0.7),
            (16, INSTRUCTIONS[0], 0.9),
        ]
    ]
    together = policy[1].predict(requests)
    for request, answer in zip(requests, together, strict=True):
        np.testing.assert_allclose(answer, policy[1].predict([request])[0], atol=1e-5)


def test_order_of_tokens_does_not_matter_but_positions_do(policy, observation):
    images, proprio = observation
    request = through_the_wire(policy, images, proprio, INSTRUCTIONS[0], np.arange(40))
    turned = PolicyRequest(
        request.tokens[::-1].copy(), request.positions[::-1].copy(), INSTRUCTIONS[0], proprio
    )
    moved = PolicyRequest(request.tokens, request.positions + 1, INSTRUCTIONS[0], proprio)
    here, same, other = policy[1].predict([request, turned, moved])
    np.testing.assert_allclose(here, same, atol=1e-5)
    assert np.abs(here - other).max() > 1e-3


def test_words_change_actions(policy, observation):
    images, proprio = observation
    one, two = (
        through_the_wire(policy, images, proprio, t, np.arange(64)) for t in INSTRUCTIONS[:2]
    )
    first, second = policy[1].predict([one, two])
    assert np.abs(first - second).max() > 1e-3


def test_every_word_has_its_queries(policy):
    edge, _ = policy
    assert edge.text_queries("press the button").shape == (3 * 4, 192)
    assert torch.equal(
        edge.text_queries("Press  the button."), edge.text_queries("press the button")
    )


@pytest.mark.parametrize(
    ("instruction", "words"),
    [
        ("", "empty"),
        ("   ", "empty"),
        ("open the fridge", "fridge"),
        ("the " * 40, "fewer words"),
        ("...", "any word"),
    ],
)
def test_instructions_that_make_no_prompt_are_refused(policy, instruction, words):
    with pytest.raises(InstructionError, match=words):
        policy[0].text_queries(instruction)
    with pytest.raises(InstructionError, match=words):
        policy[1].check_instruction(instruction)


@pytest.mark.parametrize(
    ("tokens", "positions", "proprio", "words"),
    [
        ((4, 95), [0, 1, 2, 3], (4,), r"tokens \(K, 96\)"),
        ((4, 96), [0, 1, 2], (4,), "K positions"),
        ((0, 96), [], (4,), "K > 0"),
        ((2, 96), [0, 512], (4,), r"0 \.\. 511"),
        ((2, 96), [-1, 5], (4,), r"0 \.\. 511"),
        ((2, 96), [0, 5], (3,), "proprioception"),
        ((2, 96), [0, 5], None, "proprioception"),
    ],
)
def test_requests_of_the_wrong_shape_are_refused(policy, tokens, positions, proprio, words):
    state = None if proprio is None else np.zeros(proprio, np.float32)
    request = PolicyRequest(
        np.zeros(tokens, np.float32), np.array(positions, np.int64), "press the button", state
    )
    with pytest.raises(ObservationError, match=words):
        policy[1].predict([request])


@pytest.mark.parametrize(
    ("images", "words"),
    [
        ([np.zeros((128, 128, 3), np.uint8)], "expects 2 camera views, got 1"),
        ([np.zeros((128, 128, 3), np.float32)] * 2, "view 0: expected a uint8"),
        (
            [np.zeros((128, 128, 3), np.uint8), np.zeros((128, 120, 3), np.uint8)],
            r"view 1: .*\(128, 120, 3\)",
        ),
        ([[0], [1]], "got list"),
    ],
)
def test_pictures_of_the_wrong_shape_are_refused(policy, images, words):
    with pytest.raises(ObservationError, match=words):
        policy[0].encode(images)


def test_pictures_need_not_be_contiguous(policy, observation):
    images, _ = observation
    flipped = [image[::-1, ::-1] for image in images]
    copies = [np.ascontiguousarray(image) for image in flipped]
    assert torch.equal(policy[0].encode(flipped), policy[0].encode(copies))


def test_compiled_rows_answer_alike_whatever_the_number_of_rows(policy, observation, monkeypatch):
    """Traced with free row counts; the code generator is left out, because it takes minutes."""
    graphs = []

    def trace(function, *, dynamic):
        def backend(graph, example_inputs):
            graphs.append(graph)
            return graph.forward

        return compiled(function, dynamic=dynamic, backend=backend)

    compiled = torch.compile
    monkeypatch.setattr(torch, "compile", trace)
    fresh = random_policy(seed=3)[1]
    cloud = CloudModel(
        fresh.net, fresh.prompt, fresh.statistics, fresh.info, CloudOptions(compile=True)
    )
    images, proprio = observation
    for ks in ([16], [40, 7, 40], [200], [512]):
        requests = [
            through_the_wire(policy, images, proprio, INSTRUCTIONS[0], np.arange(k)) for k in ks
        ]
        for ours, eager in zip(cloud.predict(requests), policy[1].predict(requests), strict=True):
            np.testing.assert_allclose(ours, eager, atol=1e-5)
    assert len(graphs) == 2, "one for what comes before attention and one for what comes after"
