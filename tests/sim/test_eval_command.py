"""``comvla-sim eval`` from its options to its JSON, stopped and resumed on the way."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from comvla_server.background import BackgroundServer
from comvla_server.engine import Engine
from comvla_server.settings import ServerSettings
from comvla_sim import cli
from comvla_sim.experiments import command, methods, rollout, runner, worker
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.plan import EpisodeSpec, EvalSettings
from comvla_sim.experiments.runner import Worker
from comvla_sim.figures.measuring import Study, kept
from comvla_sim.worlds.tabletop import Tabletop
from comvla_vla import CloudOptions, FastV, random_policy

pytestmark = pytest.mark.simulator


@pytest.fixture(autouse=True)
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Tabletop, "max_episode_steps", 8)


def evaluate(out: Path, *options: str) -> int:
    fixed = ["eval", "--model", "random", "--episodes", "2", "--workers", "1", "--out", str(out)]
    return cli.main([*fixed, *options])


def read(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_the_json_has_rows_with_intervals_and_the_file_everything_to_repeat_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "results.jsonl"
    options = ("--method", "full,hard_voting", "--k", "16,4", "--instructions")
    assert evaluate(out, *options, "drawer-open,lower the black lever gently", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert len(printed["rows"]) == 3 * 2
    for row in printed["rows"]:
        assert row["episodes"] == 2
        assert 0 <= row["low"] <= row["successes"] / 2 <= row["high"] <= 1
        assert row["instruction"] in ("pull the green drawer open", "lower the black lever gently")
        assert {"method", "k"} <= set(row)
    assert {(a["method"], a["k"]) for a in printed["aggregate"]} == {
        ("full", 512),
        ("hard_voting", 16),
        ("hard_voting", 4),
    }
    assert printed["results"] == str(out)
    lines = read(out)
    assert len(lines) == 3 * 2 * 2
    for line in lines:
        assert line["settings"]["model_fingerprint"] == random_policy(0)[0].info.fingerprint
        assert line["settings"]["versions"]["mujoco"]
        assert line["environment"]["transport"] == "in-process"
        assert line["environment"]["command"]


def test_a_second_run_measures_only_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "results.jsonl"
    options = ("--method", "hard_voting", "--k", "16", "--instructions", "drawer-open", "--json")
    assert evaluate(out, *options) == 0
    first = json.loads(capsys.readouterr().out)
    ran: list[object] = []
    run = Worker.run

    def counted(self: Worker, spec: Any) -> Any:
        ran.append(spec)
        return run(self, spec)

    monkeypatch.setattr(Worker, "run", counted)
    assert evaluate(out, *options) == 0
    again = json.loads(capsys.readouterr().out)
    assert again.pop("pace") == {"episodes": 0, "steps_per_s": None}
    assert first.pop("pace")["episodes"] == 2
    assert again == first
    assert not ran
    assert evaluate(out, *options[:3], "16,4", *options[4:]) == 0
    assert [(spec.k, spec.episode) for spec in ran] == [(4, 0), (4, 1)]
    assert len(read(out)) == 4


def test_ctrl_c_leaves_a_file_that_the_same_command_completes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "results.jsonl"
    options = ("--method", "hard_voting", "--k", "16", "--instructions", "drawer-open")

    @contextmanager
    def interrupting(total: int, done: int) -> Iterator[Any]:
        def interrupt(row: dict[str, Any]) -> None:
            raise KeyboardInterrupt

        yield interrupt

    with monkeypatch.context() as patch:
        patch.setattr(command, "episode_bar", interrupting)
        assert evaluate(out, *options) == 130
    assert len(read(out)) == 1
    assert str(out) in capsys.readouterr().err
    assert evaluate(out, *options) == 0
    assert [line["episode"] for line in read(out)] == [0, 1]
    assert "success over all instructions" in capsys.readouterr().out


@pytest.mark.slow
def test_two_processes_and_a_real_server_measure_the_same_as_one_process(
    tmp_path: Path,
) -> None:
    """Worker processes do not see this test's patches, so their episodes have full length."""
    Tabletop.max_episode_steps = 160  # undone by the fixture
    options = ("--method", "random", "--k", "8", "--instructions", "lever-down", "--condition")
    # Batches of one: sharing a pass changes the last bits of an answer.
    settings = ServerSettings(max_batch=1)
    with BackgroundServer(Engine(random_policy(0)[1]), settings) as server:
        remote = ("--workers", "2", "--target", server.target)
        assert evaluate(tmp_path / "remote.jsonl", *options, "normal", *remote) == 0
    assert evaluate(tmp_path / "local.jsonl", *options, "normal") == 0
    rows = {}
    for name in ("remote", "local"):
        rows[name] = sorted(read(tmp_path / f"{name}.jsonl"), key=lambda row: row["episode"])
        for row in rows[name]:
            del row["wall_s"], row["environment"]
            # A session's name has another length with every connection.
            del row["framed_bytes"]
    assert rows["remote"] == rows["local"]


@pytest.mark.parametrize("failures", [1, worker.MOST_TRIES])
def test_an_episode_starts_again_when_its_server_left_a_query_unanswered(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    failures: int,
) -> None:
    monkeypatch.setattr(worker, "PAUSE_S", 0.0)
    cloud = random_policy(0)[1]
    predict, left = cloud.predict, [failures]

    def failing_at_first(requests: Any) -> Any:
        if left[0]:
            left[0] -= 1
            raise RuntimeError("out of memory")
        return predict(requests)

    options = ("--method", "hard_voting", "--k", "16", "--instructions", "drawer-open")
    with BackgroundServer(Engine(cloud)) as server:
        cloud.predict = failing_at_first  # type: ignore[method-assign]
        remote = (*options, "--target", server.target)
        assert evaluate(tmp_path / "remote.jsonl", *remote) == (
            2 if failures == worker.MOST_TRIES else 0
        )
        told = capsys.readouterr().err
        assert told.count("the episode starts again") == min(failures, worker.MOST_TRIES - 1)
        assert "RuntimeError" in told
        assert evaluate(tmp_path / "remote.jsonl", *remote) == 0, "it goes on as the server does"
    assert [row["episode"] for row in read(tmp_path / "remote.jsonl")] == [0, 1]
    assert all(row["fallbacks"] == 0 for row in read(tmp_path / "remote.jsonl"))


def test_a_file_of_another_seed_is_not_continued(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "results.jsonl"
    options = ("--method", "full", "--instructions", "drawer-open")
    assert evaluate(out, *options) == 0
    assert evaluate(out, *options, "--seed", "1") == 2
    assert "seed" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--method", "telepathy"), "telepathy"),
        (("--k", "600"), "512"),
        (("--instructions", "make-coffee"), "make-coffee"),
        (("--quantization", "int2"), "int4"),
        (("--world", "moon"), "moon"),
        (("--model", "/nowhere/at/all"), "/nowhere/at/all"),
        (("--episodes", "9999"), "--episodes"),
        (("--workers", "-1"), "--workers"),
    ],
)
def test_nonsense_is_refused_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], message: str
) -> None:
    out = tmp_path / "results.jsonl"
    assert evaluate(out, *options) == 2
    error = capsys.readouterr().err
    assert error.startswith("comvla-sim: ")
    assert message in error
    assert "Traceback" not in error
    assert not out.exists()


LINK = ("--channel", "rician", "--mean-snr-db", "10", "--csi-delay", "1", "--enforce", "prefix")


def test_episodes_over_a_link_are_measured_resumed_and_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "results.jsonl"
    options = ("--method", "full,hard_voting", "--instructions", "drawer-open", "--json")
    assert evaluate(out, *options, *LINK, "--sending", "paper,progressive") == 0
    printed = json.loads(capsys.readouterr().out)
    found = {(a["method"], a["k"], a["link"]["sending"]) for a in printed["aggregate"]}
    sendings = ("paper", "progressive")
    assert found == {("full", 512, s) for s in sendings} | {
        ("hard_voting", None, s) for s in sendings
    }
    for line in printed["aggregate"]:
        assert line["link"]["bandwidth_hz"] == 0.88e6
        assert line["link_use"]["sent"] + line["link_use"]["no_link"] == line["queries"]
    lines = read(out)
    assert {line["format"] for line in lines} == {2}
    assert all(line["channel_seed"] is not None for line in lines)
    # Another link, and none at all, go into the same file.
    assert evaluate(out, *options, *LINK, "--csi-delay", "0", "--bandwidth-hz", "2e5") == 0
    assert evaluate(out, *options, "--k", "16") == 0
    assert evaluate(out, *options, *LINK, "--sending", "paper,progressive") == 0
    assert len(read(out)) == 2 * (4 + 2 + 2)
    report = tmp_path / "report"
    assert cli.main(["report", str(out), "--out", str(report)]) == 0
    text = (report / "report.md").read_text()
    assert "hard_voting over rician 10 dB, d=1, prefix, progressive" in text
    assert "K = link" in text


def test_the_terminal_names_links(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--method", "hard_voting", "--instructions", "drawer-open")
    assert evaluate(tmp_path / "results.jsonl", *options, *LINK) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "rician 10 dB" in shown
    assert "link" in shown


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--csi-delay", "1"), "add --channel"),
        (("--link-budget", "paper"), "--link-budget"),
        (("--channel", "fog"), "--channel 'fog'"),
        (("--channel", ","), "--channel is empty"),
        (("--channel", "trace:/nowhere.csv"), "/nowhere.csv"),
        ((*LINK, "--enforce", "kindly"), "--enforce 'kindly'"),
        ((*LINK, "--sending", "pigeon"), "--sending 'pigeon'"),
        ((*LINK, "--csi-delay", "-1"), "--csi-delay"),
        ((*LINK, "--bandwidth-hz", "-5"), "bandwidth_hz"),
        ((*LINK, "--efficiency", "0"), "efficiency"),
        ((*LINK, "--rician-k", "-1"), "rician_k"),
        (("--k", "link"), "choose a --channel"),
    ],
)
def test_a_link_that_makes_no_sense_is_refused_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], message: str
) -> None:
    out = tmp_path / "results.jsonl"
    assert evaluate(out, *options) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert not out.exists()


def test_a_target_that_is_no_address_is_a_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollout, "CONNECT_TIMEOUT_S", 0.5)
    options = ("--method", "full", "--instructions", "drawer-open", "--target", "nobody")
    assert evaluate(tmp_path / "results.jsonl", *options) == 2
    assert "nobody" in capsys.readouterr().err


def test_without_a_name_the_file_is_named_after_what_must_not_be_mixed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fixed = ["eval", "--model", "random", "--episodes", "1", "--workers", "1", "--seed", "5"]
    assert cli.main([*fixed, "--method", "full", "--instructions", "drawer-open"]) == 0
    (path,) = tmp_path.glob("runs/eval/*.jsonl")
    fingerprint = random_policy(0)[0].info.fingerprint
    assert path.name == f"tabletop-comvla-mini-{fingerprint[:8]}-int8-seed5.jsonl"


def test_rows_of_a_server_that_runs_its_model_another_way_are_kept_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    settings = EvalSettings(model="random", seed=5)
    fixed = ["eval", "--model", "random", "--episodes", "1", "--workers", "1", "--seed", "5"]
    options = [*fixed, "--method", "full", "--instructions", "drawer-open"]
    cloud = random_policy(0)[1]
    pruning = cloud.with_options(CloudOptions(fastv=FastV(2, 0.75)))
    with BackgroundServer(Engine(pruning), ServerSettings()) as server:
        assert cli.main([*options, "--target", server.target]) == 0
    (pruned,) = tmp_path.glob("runs/eval/*.jsonl")
    assert pruned.name.endswith("-int8-seed5-fastv-2-0.75.jsonl")
    (row,) = read(pruned)
    assert row["settings"]["run_options"] == ["fastv=2,0.75"]

    # Nobody takes them over as rows of the model as it is ...
    spec, subject = EpisodeSpec.from_row(row), runner.inspect(settings)
    study = Study(settings, subject, ("drawer-open",), 1, tmp_path / "paper", 1)
    folder = tmp_path / "runs" / "eval"
    assert kept("any", replace(study, reuse=(folder,)), [spec]) == {}
    with BackgroundServer(Engine(cloud), ServerSettings()) as server:
        # ... nor goes on in their file,
        plain = [*options, "--target", server.target]
        assert cli.main([*plain, "--out", str(pruned)]) == 2
        assert "run_options ['fastv=2,0.75'], this evaluation has None" in capsys.readouterr().err
        # and a server without options continues what was measured without one.
        assert cli.main(options) == 0
        capsys.readouterr()
        assert cli.main(plain) == 0
        assert "1 of 1 episodes are there" in capsys.readouterr().err
    (same,) = set(tmp_path.glob("runs/eval/*.jsonl")) - {pruned}
    assert "run_options" not in read(same)[0]["settings"]
    assert list(kept("any", replace(study, reuse=(folder,)), [spec])) == [spec]

    assert cli.main(["report", str(same), str(pruned), "--out", str(tmp_path / "report")]) == 0
    text = (tmp_path / "report" / "report.md").read_text()
    assert "int8, fastv=2,0.75\n" in text
    assert "runs the model with fastv=2,0.75." in text


OWN = """\
import numpy as np


class Turned:
    \"\"\"In raster order, from somewhere on.\"\"\"

    uses_language = False
    sends_all = False

    def rank(self, context):
        return np.roll(np.arange(len(context.tokens), dtype=np.int32), 0)
"""


def test_an_edited_selector_of_ones_own_is_measured_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    out, source = tmp_path / "results.jsonl", tmp_path / "own_turned.py"
    method = "own_turned:Turned"
    options = ("--method", f"full,{method}", "--k", "16", "--instructions", "drawer-open")

    def begin(text: str) -> str:
        """What a new process says that finds this source."""
        source.write_text(text)
        sys.modules.pop("own_turned", None)
        methods.find_method.cache_clear()
        importlib.invalidate_caches()
        assert evaluate(out, *options) == 0
        return capsys.readouterr().err

    begin(OWN)
    assert "4 of 4 episodes are there" in begin(OWN)
    told = begin(OWN.replace(", 0)", ", 100)"))
    assert "2 of 4 episodes are there" in told
    assert f"2 episodes of {method} do not count, its source was another one" in told
    assert "4 of 4 episodes are there" in begin(OWN.replace(", 0)", ", 100)"))
    rows = read(out)
    assert [row["method"] for row in rows].count(method) == 4
    assert len({row["source_sha256"] for row in rows if row["method"] == method}) == 2
    assert all("source_sha256" not in row for row in rows if row["method"] == "full")

    assert cli.main(["report", str(out), "--out", str(tmp_path / "report")]) == 0
    assert "2 of 6 episodes are left out" in capsys.readouterr().err

    # Rows of versions that did not look at the source do not count either, but are read.
    untold = [{k: v for k, v in row.items() if k != "source_sha256"} for row in rows]
    out.write_text("".join(json.dumps(row) + "\n" for row in untold))
    assert "2 of 4 episodes are there" in begin(OWN)
    # A worker, here or on a node of a cluster, that has another source measures nothing.
    wanted = EpisodeSpec.from_row({**rows[0], "method": method, "source_sha256": "other"})
    bare = Worker(EvalSettings(model="random"))
    try:
        with pytest.raises(EvaluationError, match="another source here"):
            bare.run(wanted)
    finally:
        bare.close()


def test_a_server_that_does_not_answer_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollout, "CONNECT_TIMEOUT_S", 0.5)
    assert evaluate(tmp_path / "results.jsonl", "--method", "full", "--target", "127.0.0.1:1") == 2
    error = capsys.readouterr().err
    assert "--target 127.0.0.1:1: the server does not say how it runs its model" in error
    assert not list(tmp_path.iterdir())
