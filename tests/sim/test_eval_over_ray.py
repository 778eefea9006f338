"""The same evaluation on one process, on several, and on a Ray cluster; and what happens when a worker dies."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from comvla_sim.experiments import over_processes, over_ray, runner
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.experiments.results import ResultsFile, Row
from comvla_sim.experiments.worker import Measured

pytestmark = pytest.mark.simulator

SETTINGS = EvalSettings(model="random")
SPECS = [
    EpisodeSpec("normal", "hard_voting", k, task, 0)
    for k in (8, 4)
    for task in ("drawer-open", "lever-down")
]
GATE = "COMVLA_TEST_GATE"
PATIENCE_S = 60.0
RUN_IN_WORKER = over_processes._run_in_worker


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


def run_behind_the_gate(settings: EvalSettings, spec: EpisodeSpec) -> Measured:
    """In a worker: an episode. All but the first wait until there is a file."""
    deadline = time.monotonic() + PATIENCE_S
    while spec != SPECS[0] and not os.path.exists(os.environ[GATE]):
        assert time.monotonic() < deadline, "nobody opened the gate"
        time.sleep(0.01)
    return RUN_IN_WORKER(settings, spec)


@pytest.mark.slow
def test_two_processes_measure_what_one_does_though_a_worker_is_killed(
    tmp_path: Path,
    one_process: list[dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # However late this process hears of the first episode, the others are not over by then.
    gate = tmp_path / "gate"
    monkeypatch.setenv(GATE, str(gate))
    monkeypatch.setattr(over_processes, "_run_in_worker", run_behind_the_gate)
    killed: list[int] = []

    def kill_one(row: Row) -> None:
        if not killed:
            victim = multiprocessing.active_children()[0]
            victim.kill()
            killed.append(victim.pid or 0)
            gate.touch()

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
        for process in psutil.Process().children(recursive=True):
            # A process of Ray's may have ended since it was listed.
            with contextlib.suppress(psutil.Error):
                if not killed and " ".join(process.cmdline()).startswith("ray::episode_on_node"):
                    process.kill()
                    killed.append(process.pid)

    rows = measure(tmp_path / "rows.jsonl", ray=two_nodes, on_row=kill_one)
    assert rows == one_process
    assert killed, "no worker was found to kill"


def test_a_cluster_that_is_not_there_is_named(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="needs Ray: pip install 'comvla[ray]'")
    # Bound and never listened at: nobody else can take it.
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(EvaluationError, match=f"no Ray cluster answers at {address}"):
            measure(tmp_path / "rows.jsonl", ray=address)
    assert (tmp_path / "rows.jsonl").read_text() == ""


def test_a_cluster_that_does_not_answer_is_named_before_ray_gives_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    over = threading.Event()
    silent = SimpleNamespace(is_initialized=lambda: False, init=lambda **_: over.wait(PATIENCE_S))
    monkeypatch.setattr(over_ray, "_ray", lambda: silent)
    monkeypatch.setattr(over_ray, "JOIN_TIMEOUT_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        address = f"127.0.0.1:{listening.getsockname()[1]}"
        try:
            with pytest.raises(EvaluationError, match=rf"{address}.*no answer within 0\.1 s"):
                measure(tmp_path / "rows.jsonl", ray=address)
        finally:
            over.set()
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
