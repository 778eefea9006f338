"""Edge half, codec, a real server and the cloud half give the undivided reference's actions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference_data import INSTRUCTION, TOLERANCE, golden, needs_golden

from comvla.errors import CheckpointError, HandshakeError
from comvla_client import ComVLAClient
from comvla_client.pruners import VLAADP
from comvla_client.selection import FullTransmission
from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_vla import CloudModel, CloudOptions, random_policy
from comvla_vla.backbone import rotary_tables
from comvla_vla.fastv import last_row_attention
from comvla_vla.pruning import text_driven_scores

pytestmark = needs_golden


class Subset:
    """Sends given positions in a given order."""

    uses_language = False
    sends_all = True

    def __init__(self, positions) -> None:
        self.positions = np.asarray(positions, np.int32)

    def rank(self, context) -> np.ndarray:
        return self.positions


@pytest.fixture(scope="module")
def observation():
    inputs = golden("inputs")
    return {
        "images": [inputs["full_u8"], inputs["wrist_u8"]],
        "proprio": inputs["state_raw"].astype(np.float32),
    }


def with_options(cloud: CloudModel, **options) -> CloudModel:
    return CloudModel(
        cloud.net, cloud.prompt, cloud.statistics, cloud.info, CloudOptions(**options)
    )


def step(edge, cloud, observation, selector):
    """One step of a robot over gRPC, coded without loss."""
    with (
        BackgroundServer(Engine(cloud)) as server,
        ComVLAClient(
            server.target,
            edge=edge,
            selector=selector,
            quantization="float32",
            snr=60.0,
            deadline_s=60.0,
        ) as client,
    ):
        chunk = client.step(observation, INSTRUCTION)
    assert chunk.report.source == "cloud", chunk.report
    return chunk


@pytest.mark.parametrize(
    ("parts", "name"),
    [(("oft",), "oft"), (("lightvla",), "oft"), (("oft", "film"), "film")],
)
def test_full_transmission_equals_the_reference(reference, observation, parts, name):
    """LightVLA's checkpoint holds OFT's weights in shards, so unpruned it answers alike."""
    _, edge, cloud = reference(*parts)
    chunk = step(edge, cloud, observation, "full")
    assert chunk.report.tokens == 512
    want = golden(f"golden_{name}_fp32")["actions"]
    np.testing.assert_allclose(chunk.actions, want, atol=TOLERANCE)


def test_lightvla_by_name_equals_the_reference(reference, observation):
    want = golden("golden_lightvla_fp32")
    _, edge, cloud = reference("lightvla")
    chunk = step(edge, with_options(cloud, first_slot=1), observation, "lightvla")
    assert sorted(chunk.report.positions) == list(want["pruner_keep_idx"])
    assert chunk.report.tokens == len(want["pruner_keep_idx"])
    np.testing.assert_allclose(chunk.actions, want["actions"], atol=TOLERANCE)


@pytest.mark.parametrize("ratio", [0.75, 0.3])
def test_vla_adp_equals_the_reference(reference, observation, ratio):
    want = {
        k.split("/")[1]: v
        for k, v in golden("golden_adp_fp32").items()
        if k.startswith(f"L0_r{ratio}/")
    }
    _, edge, cloud = reference("oft")
    cloud = with_options(cloud, first_slot=0, compact_positions=True)
    chunk = step(edge, cloud, observation, VLAADP(ratio=ratio))
    assert sorted(chunk.report.positions) == list(want["keep_idx"])
    np.testing.assert_allclose(chunk.actions, want["actions"], atol=TOLERANCE)


@pytest.mark.parametrize("seed", range(4))
def test_arbitrary_subsets_equal_an_undivided_model(reference, observation, seed):
    _, edge, cloud = reference("oft")
    rng = np.random.default_rng(seed)
    positions = rng.permutation(512)[: (1, 17, 130, 511)[seed]]
    chunk = step(edge, cloud, observation, Subset(positions))
    tokens = edge.encode(observation["images"])
    state = cloud.statistics.normalise_proprio(observation["proprio"])
    with torch.no_grad():
        actions, _ = cloud.net(
            [edge.project(tokens)[positions]],
            [torch.from_numpy(positions)],
            [torch.tensor(cloud.prompt.ids(INSTRUCTION))],
            torch.from_numpy(state)[None],
        )
    want = cloud.statistics.unnormalise_actions(actions[0].numpy())
    np.testing.assert_allclose(chunk.actions, want, atol=TOLERANCE)


def test_diffusion_answers_alike_with_and_without_the_wire(reference, observation):
    _, edge, cloud = reference("oft", "diffusion")
    first = step(edge, cloud, observation, "full").actions
    again = step(edge, cloud, observation, FullTransmission()).actions
    np.testing.assert_array_equal(first, again)


def test_another_fine_tuning_is_refused_before_the_robot_moves(reference, observation):
    edge, cloud = reference("oft", "film").edge, reference("oft").cloud
    with pytest.raises(HandshakeError, match="the weights do not"):
        step(edge, cloud, observation, "full")


def test_the_small_policy_says_that_it_has_no_weights_for_these_pruners(observation):
    edge, _ = random_policy()
    with pytest.raises(CheckpointError, match="no weights for 'lightvla'"):
        edge.lightvla_scores(torch.zeros(512, 192), "press the button", np.zeros(4, np.float32))


@pytest.mark.parametrize("ratio", ["0.75", "0.3"])
def test_vla_adp_scores_from_the_second_layer(reference, ratio):
    """A probe of a later layer needs the layers before it, so only the server could do it; the rule is the same."""
    want = {
        k.split("/")[1]: v
        for k, v in golden("golden_adp_fp32").items()
        if k.startswith(f"L1_r{ratio}/")
    }
    net = reference("oft").cloud.net
    embedded = torch.from_numpy(golden("golden_oft_fp32")["inputs_embeds"])[0]
    rows = torch.cat([embedded[:513], embedded[514:]])  # without proprioception
    first, second = net.backbone.layers
    with torch.no_grad():
        tables = rotary_tables(torch.arange(len(rows)), net.config.backbone, rows.dtype)
        hidden = first(rows, *tables, [len(rows)])
        assert last_row_attention(first, rows, *tables, [len(rows)])[0].sum() == pytest.approx(1)
        words = torch.cat([hidden[:1], hidden[513:547], hidden[-1:]])
        zero = torch.zeros(1, dtype=torch.long)
        flat = rotary_tables(zero, net.config.backbone, rows.dtype)  # position 0 does not rotate

        def parts(x):
            return second.before(x, *flat)

        scores = text_driven_scores(parts(words)[0], parts(hidden[1:513])[1])
    np.testing.assert_allclose(scores.numpy(), want["importance"], atol=TOLERANCE)
