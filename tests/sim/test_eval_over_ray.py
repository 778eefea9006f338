"""The same evaluation on one process, on several, and on a Ray cluster; and what happens when a worker dies."""

from __future__ import annotations

import json
import multiprocessing
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from comvla_sim.experiments import over_ray, runner
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.experiments.results import ResultsFile, Row

pytestmark = pytest.mark.simulator

SETTINGS = EvalSettings(model="random")
SPECS = [
    EpisodeSpec("normal", "hard_voting", k, task, 0)
    for k in (8, 4)
    for task in ("drawer-open", "lever-down")
]


def measure(
    path: Path, *, on_row: Callable[[Row], None] = lambda row: None, **how: Any
) -> list[dict[str, Any]]:
    """Rows of an evaluation without what may differ between runs, in the order of their specs."""
    subject = runner.inspect(SETTINGS)
    how = {"workers": 1, **how}
    with ResultsFile(path, subject.settings) as results:
        runner.run(
            SETTINGS,
            SPECS,
            results,
            shared=subject.settings,
            story=runner.environment(SETTINGS, "test"),
            on_row=on_row,
            **how,
        )
        rows = [json.loads(json.dumps(results.rows[spec])) for spec in SPECS]
    assert len(path.read_text().splitlines()) == len(SPECS)
    for row in rows:
        del row["wall_s"]
    return rows


@pytest.fixture(scope="module")
def one_process(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    return measure(tmp_path_factory.mktemp("one") / "rows.jsonl")


@pytest.fixture(scope="module")
def two_nodes() -> Iterator[str]:
    """The address of a Ray cluster with two nodes of one core each, on this machine."""
    ray = pytest.importorskip("ray", reason="needs Ray: pip install 'comvla[ray]'")
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": over_ray.STORE_BYTES}
    cluster = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
    cluster.add_node(**node)
    try:
        yield cluster.address
    finally:
        ray.shutdown()
        cluster.shutdown()


@pytest.mark.slow
def test_two_processes_measure_what_one_does_though_a_worker_is_killed(
    tmp_path: Path, one_process: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    killed: list[int] = []

    def kill_one(row: Row) -> None:
        if not killed:
            victim = multiprocessing.active_children()[0]
            victim.kill()
            killed.append(victim.pid or 0)

    assert measure(tmp_path / "rows.jsonl", workers=2, on_row=kill_one) == one_process
    assert killed
    assert "a worker process died; what it ran starts again" in capsys.readouterr().err


@pytest.mark.slow
def test_a_ray_cluster_of_two_nodes_measures_what_one_process_does(
    tmp_path: Path, one_process: list[dict[str, Any]], two_nodes: str
) -> None:
    assert measure(tmp_path / "rows.jsonl", ray=two_nodes) == one_process


@pytest.mark.slow
def test_an_episode_of_a_killed_ray_worker_runs_again(
    tmp_path: Path, one_process: list[dict[str, Any]], two_nodes: str
) -> None:
    psutil = pytest.importorskip("psutil", reason="finds the processes of Ray's workers")
    killed: list[int] = []

    def kill_one(row: Row) -> None:
        named = ("ray::episode_on_node",)
        mine = psutil.Process().children(recursive=True)
        victims = [p for p in mine if " ".join(p.cmdline()).startswith(named)]
        if victims and not killed:
            victims[0].kill()
            killed.append(victims[0].pid)

    rows = measure(tmp_path / "rows.jsonl", ray=two_nodes, on_row=kill_one)
    assert rows == one_process
    assert killed, "no worker was found to kill"


def test_a_cluster_that_does_not_answer_is_named_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray", reason="needs Ray: pip install 'comvla[ray]'")
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
    with pytest.raises(EvaluationError, match=rf"no Ray cluster answers at 127.0.0.1:{port}"):
        measure(tmp_path / "rows.jsonl", ray=f"127.0.0.1:{port}")
    assert (tmp_path / "rows.jsonl").read_text() == ""


@pytest.mark.parametrize("address", ["", "nowhere", "host:", "host:port", "ray://host:1"])
def test_an_address_that_is_none_is_refused(tmp_path: Path, address: str) -> None:
    pytest.importorskip("ray", reason="needs Ray: pip install 'comvla[ray]'")
    with pytest.raises(EvaluationError, match=r"HOST:PORT|no Ray cluster answers"):
        measure(tmp_path / "rows.jsonl", ray=address)


def test_a_node_with_another_version_or_other_weights_is_refused() -> None:
    subject = runner.inspect(SETTINGS)
    spec = json.dumps(SPECS[0].to_row())
    settings = json.dumps(vars(SETTINGS))
    for change in ({"model_fingerprint": "other"}, {"versions": {"comvla": "0.0.0"}}):
        shared = json.dumps({**subject.settings, **change})
        with pytest.raises(EvaluationError, match="install the same on all nodes"):
            over_ray.episode_on_node(settings, shared, spec)
