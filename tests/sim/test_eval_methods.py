"""Every way of telling the cloud what the robot sees is a method: listed, sized, evaluated, shown."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from eval_stubs import ListeningTransport, made_up_row
from test_eval_plan import grid

from comvla_client import registry
from comvla_server.vision import VisionHalf
from comvla_sim import cli, worlds
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.in_process import InProcessTransport
from comvla_sim.experiments.methods import find_method, methods, order, shown_k
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.experiments.rollout import run_episode
from comvla_sim.experiments.runner import Worker
from comvla_sim.experiments.summary import summarise
from comvla_sim.report.tables import all_tables
from comvla_sim.worlds import World
from comvla_sim.worlds.tabletop import Tabletop
from comvla_vla import CloudModel, EdgeModel, lend_pruners, random_policy

SETTINGS = EvalSettings(model="random", seed=7)


def test_every_row_says_what_it_is() -> None:
    known = methods()
    assert list(known)[:3] == ["hard_voting", "soft_voting", "random"]
    assert {"fastv", "lightvla", "vla_adp", "jpeg", "webp", "avif", "h264"} <= set(known)
    for name, method in known.items():
        assert method.summary
        assert method.source
        assert method.equation or method.selector() is None, name


def test_help_lists_every_method(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["eval", "--help"])
    text = capsys.readouterr().out
    for name, method in methods().items():
        assert name in text
        assert method.summary in text


def test_methods_without_a_k_of_ones_choice_run_once() -> None:
    wanted = ("hard_voting", "full", "lightvla", "fastv", "jpeg-75", "h264-30")
    specs = list(grid(methods=wanted, tasks=("drawer-open",), episodes=1).specs(512))
    assert [(spec.method, spec.k) for spec in specs] == [
        ("hard_voting", 32),
        ("hard_voting", 16),
        *((name, 512) for name in wanted[1:]),
    ]
    grid(methods=("jpeg-75", "lightvla"), ks=()).check(num_tokens=512, seed=0)


def test_only_what_listens_can_be_misled() -> None:
    wanted = ("multi_voting", "lightvla", "jpeg-75", "token_norm")
    specs = grid(conditions=("wrong_selection",), methods=wanted).specs(512)
    assert {spec.method for spec in specs} == {"multi_voting", "lightvla"}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("telepathy", "hard_voting.*jpeg.*in evaluations fastv"),
        ("jpeg-101", "quality from 1 to 100"),
        ("jpeg", "name one, such as jpeg-75"),
        ("nowhere:Nothing", "package.module:ClassName"),
        ("own_broken:Half", r"cannot import the module 'own_broken'.*SyntaxError"),
        ("own_sulking:Any", r"cannot import the module 'own_sulking'.*RuntimeError: not today"),
        (
            "own_demanding:Needy",
            r"--method own_demanding:Needy: cannot make one.*'friend'.*defaults",
        ),
    ],
)
def test_what_is_no_method_is_refused_with_what_there_is(
    name: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_broken.py").write_text("class Half(:\n")
    (tmp_path / "own_sulking.py").write_text("raise RuntimeError('not today')\n")
    demanding = "class Needy:\n    def __init__(self, friend):\n        pass\n"
    (tmp_path / "own_demanding.py").write_text(demanding)
    with pytest.raises(EvaluationError, match=words):
        grid(methods=(name,)).check(num_tokens=512, seed=0)


def test_tables_keep_their_order_and_show_k_only_where_it_means_something() -> None:
    shuffled = ["mine:Own", "jpeg-75", "lightvla", "hard_voting", "full", "h264", "jpeg-50"]
    assert sorted(shuffled, key=order) == [
        "full",
        "hard_voting",
        "lightvla",
        "jpeg-50",
        "jpeg-75",
        "h264",
        "mine:Own",
    ]
    shown = {name: shown_k(name, 512) for name in ("full", "jpeg-75", "lightvla", "fastv", "a:B")}
    assert shown == {"full": "512", "jpeg-75": "–", "lightvla": "own", "fastv": "512", "a:B": "512"}


def test_a_report_has_a_column_for_what_has_no_k() -> None:
    made = [
        ("hard_voting", 16),
        ("hard_voting", 8),
        ("full", 512),
        ("jpeg-75", 512),
        ("lightvla", 512),
    ]
    summary = summarise([made_up_row(method=method, k=k) for method, k in made])
    table = all_tables(summary)[0]
    assert table.header == ("method", "K = 512", "K = 16", "K = 8", "its own size")
    cells = {row[0]: row[1:] for row in table.rows}
    assert cells["jpeg-75"][:3] == ("–", "–", "–") != cells["jpeg-75"][3:]
    assert cells["jpeg-75"][3] != "–"
    assert cells["full"][0] != "–"


def test_an_installed_package_offers_selectors(monkeypatch: pytest.MonkeyPatch) -> None:
    offered = EntryPoint("offered", "comvla_client.selection:TokenNorm", registry.ENTRY_POINTS)
    monkeypatch.setattr(registry, "entry_points", lambda group: [offered])
    assert "offered" in registry.table()
    assert type(registry.make_selector("offered")).__name__ == "TokenNorm"
    assert find_method.__wrapped__("offered").listens is False
    with pytest.raises(ValueError, match="is taken"):
        registry.register("hard_voting", registry.SELECTORS["random"])


class EveryOther:
    """Every other token, first to last."""

    uses_language = False
    sends_all = True

    def rank(self, context: Any) -> np.ndarray:
        return np.arange(0, len(context.tokens), 2, dtype=np.int32)


class Attentive:
    """Looks at everything that the guide promises."""

    uses_language = True
    sends_all = False
    seen: ClassVar[list[tuple[str, int, int]]] = []

    def rank(self, context: Any) -> np.ndarray:
        words = len(context.instruction.split())
        queries = context.edge.text_queries(context.instruction)
        assert torch.equal(queries, context.queries)
        self.seen.append((context.instruction, words, len(context.proprio)))
        return np.roll(np.arange(len(context.tokens), dtype=np.int32), words)


@pytest.fixture(scope="module")
def policy() -> Iterator[tuple[EdgeModel, CloudModel]]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    edge, cloud = random_policy(seed=0)
    lend_pruners(edge, cloud)
    yield edge, cloud
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Tabletop, "max_episode_steps", 16)
        world = worlds.make("tabletop")
        yield world
        world.close()


def run(
    world: World, policy: tuple[EdgeModel, CloudModel], method: str
) -> tuple[dict[str, Any], ListeningTransport]:
    edge, cloud = policy
    transport = ListeningTransport(InProcessTransport(cloud, VisionHalf(edge)))
    spec = EpisodeSpec("normal", method, 16, "drawer-open", 0)
    return run_episode(world, edge, transport, spec, SETTINGS), transport


@pytest.mark.simulator
@pytest.mark.parametrize("method", ["jpeg-75", "webp-50", "h264-30"])
def test_pictures_are_evaluated_like_everything_else(
    world: World, policy: tuple[EdgeModel, CloudModel], method: str
) -> None:
    row, sent = run(world, policy, method)
    again, _ = run(world, policy, method)
    assert row["success"] == again["success"]
    assert row["steps"] == again["steps"]
    assert row["payload_bytes"] == again["payload_bytes"]
    assert row["queries"] == len(sent.requests) == 2
    pictures = [len(view.data) for r in sent.requests for view in r.images.views]
    assert row["payload_bytes"] == sum(pictures)
    assert row["encoded_bytes"] == sum(r.images.ByteSize() for r in sent.requests)
    assert row["edge_flops"] == 0
    edge, cloud = policy
    per_query = edge.vision_flops() + cloud.flops(512, row["instruction"])
    assert row["cloud_flops"] == 2 * per_query
    assert row["selection"]["distinct_votes"] is None
    assert row["selection"]["object_frames"] == 0
    json.dumps(row)


@pytest.mark.simulator
@pytest.mark.parametrize(
    "method", ["lightvla", "vla_adp", "multi_voting", "diverse_voting", "view_quotas"]
)
def test_every_selector_is_evaluated(
    world: World, policy: tuple[EdgeModel, CloudModel], method: str
) -> None:
    row, sent = run(world, policy, method)
    assert row["queries"] == 2
    if method == "lightvla":
        assert 0 < len(sent.positions(0)) < 512
    elif method == "vla_adp":
        assert sent.positions(0) == list(range(512)), "its gate is shut for three windows"
    else:
        assert len(sent.positions(0)) == 16


@pytest.mark.simulator
def test_a_class_of_ones_own_is_a_method(
    world: World, policy: tuple[EdgeModel, CloudModel]
) -> None:
    _, sent = run(world, policy, f"{__name__}:EveryOther")
    assert sent.positions(0) == list(range(0, 512, 2))


@pytest.mark.simulator
def test_a_class_of_ones_own_sees_the_other_instruction_as_it_sees_its_own(
    world: World, policy: tuple[EdgeModel, CloudModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Attentive, "seen", [])
    method = f"{__name__}:Attentive"
    row, _ = run(world, policy, method)
    assert row["selection"]["frames"] == 2
    assert row["selection"]["overlap"] is not None
    told, other = Attentive.seen[:2]
    assert told[0] == row["spoken"] != other[0]
    assert told[2] == other[2] == policy[0].info.proprio_dim


@pytest.mark.simulator
def test_fastv_runs_in_the_cloud_half_of_its_own_episodes_only() -> None:
    worker = Worker(SETTINGS)
    try:
        targets = [worker.target(find_method(name)) for name in ("full", "fastv", "jpeg-75")]
        assert targets[0] is targets[2] is not targets[1]
        clouds = [target._engine._cloud for target in targets[:2]]  # type: ignore[union-attr]
        assert clouds[0].net is clouds[1].net
        words = "pull the green drawer open"
        assert clouds[1].flops(512, words) < clouds[0].flops(512, words)
    finally:
        worker.close()


def test_fastv_cannot_be_asked_of_a_server_that_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "rows.jsonl"), "--model", "random"]
    assert cli.main(["eval", "--method", "fastv", "--target", "127.0.0.1:1", *out]) == 2
    assert "serve with --fastv 3,0.75 and evaluate --method full" in capsys.readouterr().err


def test_borrowed_weights_are_those_of_a_split_with_pruners() -> None:
    from comvla_vla.presets import mini

    lent, cloud = random_policy(seed=1)
    lend_pruners(lent, cloud)
    config = replace(mini(), edge_pruners=("lightvla", "vla_adp"))
    carried, _ = random_policy(seed=1, config=config)
    assert lent.config.edge_pruners == carried.config.edge_pruners
    assert sys.modules["torch"].equal(
        lent.net.probe.self_attn.qk_proj.weight,
        cloud.net.backbone.layers[0].self_attn.qkv_proj.weight[: 2 * config.backbone.hidden],
    )
    assert lent.net.proprio_projector is cloud.net.proprio_projector
