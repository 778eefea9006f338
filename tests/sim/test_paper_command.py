"""``comvla-sim paper`` from its options to its documents, stopped and resumed on the way."""

from __future__ import annotations

import errno
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from comvla_client import ComVLAClient
from comvla_sim import cli
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.layouts import evaluation_layout
from comvla_sim.experiments.plan import EvalSettings
from comvla_sim.experiments.worker import Worker
from comvla_sim.paper import (
    cells,
    film,
    gathering,
    kept_tokens,
    latency,
    layer_error,
    measuring,
)
from comvla_sim.paper.cells import Cell
from comvla_sim.paper.kept_tokens import dimmed
from comvla_sim.paper.results import write
from comvla_sim.worlds.tabletop import Tabletop

pytestmark = pytest.mark.simulator

FEW = {
    "table1": ((Cell("full"), Cell("hard_voting", 32), Cell("random", 32)),),
    "table3": ((Cell("soft_voting", 32), Cell("hard_voting", 32)),),
    "table4": (tuple(Cell("hard_voting", 32, q) for q in ("int4", "float16", "int8")),),
    "table2": (),
}

BACKWARDS = """\
import numpy as np


class LastFirst:
    uses_language = False
    sends_all = False

    def rank(self, context):
        return np.arange(len(context.tokens), dtype=np.int32)[::-1]
"""


@pytest.fixture(autouse=True)
def little_to_measure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Tabletop, "max_episode_steps", 8)
    for module in (cells, gathering):
        monkeypatch.setattr(module, "GROUPS", FEW)
    monkeypatch.setattr(gathering, "PAPER_CELLS", {Cell("full"): ("full", None)})
    monkeypatch.setattr(layer_error, "LAYOUTS", 1)
    monkeypatch.setattr(layer_error, "QUERIES_PER_LAYOUT", 1)


def paper(out: Path, part: str, *options: str) -> int:
    fixed = ["--model", "random", "--episodes", "1", "--workers", "1", "--out", str(out), "--json"]
    return cli.main(["paper", part, *fixed, *options])


@pytest.mark.slow
def test_a_table_is_measured_resumed_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "paper"
    run, ran = Worker.run, []

    def interrupted(self: Worker, spec: Any, *rest: Any) -> Any:
        if len(ran) == 5:
            raise KeyboardInterrupt
        ran.append(spec)
        return run(self, spec, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(Worker, "run", interrupted)
        assert paper(out, "table3") == 130
    assert "goes on from" in capsys.readouterr().err
    assert paper(out, "table3") == 0
    printed = json.loads(capsys.readouterr().out)
    assert {cell["method"]: cell["episodes"] for cell in printed["cells"]} == {
        "soft_voting": 8,
        "hard_voting": 8,
    }
    (voting,) = (t for t in printed["tables"] if t["part"].startswith("Table III"))
    assert voting["rows"][0][0] == "K = 32"
    for name in ("results.json", "results.md", "results.html", "results-bytes.svg"):
        assert (out / name).stat().st_size > 500

    def nobody(self: Worker, spec: Any, *rest: Any) -> Any:
        raise AssertionError(f"{spec} was measured already")

    monkeypatch.setattr(Worker, "run", nobody)
    docs = tmp_path / "docs"
    assert paper(out, "table3", "--measured-only", "--docs", str(docs)) == 0
    assert (docs / "results.md").read_bytes() == (out / "results.md").read_bytes()


@pytest.mark.slow
def test_where_nothing_may_be_measured_a_part_that_is_not_there_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def nobody(*_: Any, **__: Any) -> Any:
        raise AssertionError("something was measured")

    monkeypatch.setattr(Worker, "__init__", nobody)
    monkeypatch.setattr(latency, "measure_latency", nobody)
    monkeypatch.setattr(layer_error, "measure_errors", nobody)
    assert paper(tmp_path, "all", "--measured-only") == 0
    captured = capsys.readouterr()
    parts = ("latency", "pictures", "layers", "figure3")
    assert all(f"{name}: left out" in captured.err for name in parts)
    printed = json.loads(captured.out)
    assert not set(parts) & set(printed)
    assert printed["cells"] == []
    written = {Path(file).name for file in printed["files"]}
    assert written == {"results.json", "results.md", "results.html"} == names(tmp_path)
    text = (tmp_path / "results.md").read_text(encoding="utf-8")
    assert "## Table II" in text
    assert not any(f"## {part}" in text for part in ("Table I:", "Table IV", "Fig."))

    for name in ("latency", "pictures"):
        (tmp_path / f"{name}.json").write_text('{"kept": true}')
    assert paper(tmp_path, "table1", "--measured-only") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["latency"] == printed["pictures"] == {"kept": True}


@pytest.mark.parametrize("content", ['{"rows": [', "[]", "\x00"])
def test_a_damaged_part_is_named(
    content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "latency.json").write_text(content)
    assert paper(tmp_path, "table2", "--measured-only") == 2
    message = capsys.readouterr().err
    assert f"{tmp_path / 'latency.json'} cannot be read or is damaged" in message
    assert "without --measured-only" in message


@pytest.mark.parametrize("part", ["fig4", "fig5"])
def test_a_damaged_figure_is_no_empty_one(
    part: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / f"{gathering.SWEEP_OF[part]}.jsonl"
    file.write_text("not a row\n")
    assert paper(tmp_path, part, "--measured-only") == 2
    assert f"{file}, line 1 is no result" in capsys.readouterr().err


def test_a_file_is_there_whole_or_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "deep" / "latency.json"
    write(path, b"before")

    def full(self: Path, content: bytes) -> int:
        with self.open("wb") as file:
            file.write(content[:3])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(EvaluationError, match=r"cannot write .*latency.json: No space"):
        write(path, b"afterwards")
    assert names(path.parent) == {"latency.json"}
    assert path.read_bytes() == b"before"


@pytest.mark.slow
def test_a_strangers_file_among_those_to_take_over_is_left_out_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "others"
    folder.mkdir()
    (folder / "a.jsonl").write_text("my notes\n")
    (folder / "b.jsonl").write_text('{"format": 99}\n')
    options = ("--measured-only", "--reuse", str(folder))
    assert paper(tmp_path / "out", "table4", *options) == 0
    told = capsys.readouterr().err
    assert told.count(f"left out: {folder / 'a.jsonl'}, line 1 is no result") == 1
    assert told.count(f"left out: {folder / 'b.jsonl'}, line 1 has format 99") == 1


def test_methods_take_turns_while_they_are_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    step = ComVLAClient.step

    def told(self: ComVLAClient, *arguments: Any) -> Any:
        chunk = step(self, *arguments)
        asked.append(chunk.report.tokens_used)
        return chunk

    monkeypatch.setattr(ComVLAClient, "step", told)
    study = measuring.Plan(model="random").study("tabletop", "int8")
    measured = [Cell("hard_voting", 16), Cell("random", 4), Cell("full")]
    found = latency.measure_latency(study, measured, repetitions=2)
    assert asked == [16, 4, 512] * (latency.WARM_UP + 2)
    assert [(row["method"], row["k"]) for row in found["rows"]] == [
        (cell.method, cell.k) for cell in measured
    ]
    assert found["repetitions"] == 2


def names(folder: Path) -> set[str]:
    return {file.name for file in folder.iterdir()}


@pytest.mark.slow
def test_number_formats_share_what_is_measured_and_show_their_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert paper(tmp_path, "table4") == 0
    printed = json.loads(capsys.readouterr().out)
    assert {cell["quantization"] for cell in printed["cells"]} == {"int4", "float16", "int8"}
    formats = printed["layers"]["formats"]
    for suffix in ("", " massive"):
        errors = [formats[q + suffix]["layers"][0]["error"] for q in ("float16", "int8", "int4")]
        assert errors == sorted(errors)
        assert errors[0] < 1e-3
    assert formats["int4 massive"]["layers"][0]["error"] > 0.5
    assert {"first", "second", "p_value"} <= set(printed["pairs"][0])


@pytest.mark.slow
def test_what_a_query_costs_is_measured_by_every_method(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody's own selector stands beside those of the table."""
    monkeypatch.setattr(cells, "BUDGETS", (16,))
    (tmp_path / "backwards.py").write_text(BACKWARDS)
    monkeypatch.syspath_prepend(tmp_path)
    own = "backwards:LastFirst"
    assert paper(tmp_path, "table1", "--also", own) == 0
    printed = json.loads(capsys.readouterr().out)
    timed = {(row["method"], row["k"]) for row in printed["latency"]["rows"]}
    assert timed == {("full", None), ("hard_voting", 32), ("random", 32), (own, 16)}
    success = next(t for t in printed["tables"] if t["title"] == "Success")
    assert [row[7] for row in success["rows"] if row[0] == own] == ["8"]
    assert all(row["edge_ms"] > 0 < row["cloud_ms"] for row in printed["latency"]["rows"])
    assert printed["pictures"]["side"] == 224
    assert printed["pictures"]["kib"]["jpeg-95"] > 1
    (random,) = (row for row in printed["pairs"] if row["second"]["method"] == "random")
    assert random["first"]["method"] == "hard_voting"
    assert random["pairs"] == 8


@pytest.mark.slow
def test_stale_reports_take_over_what_a_figure_has_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gathering, "FIG5_SERIES", ("unenforced",))
    figure = ["figure", "csi-delay", "--series", "unenforced", "--csi-delay", "0,1,2,3,4"]
    options = ["--model", "random", "--episodes", "1", "--workers", "1"]
    assert cli.main([*figure, *options, "--out", str(tmp_path / "figure")]) == 0
    capsys.readouterr()
    monkeypatch.setattr(Worker, "run", None)  # whoever runs an episode fails
    assert paper(tmp_path / "paper", "fig5", "--reuse", str(tmp_path / "figure")) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [point["episodes"] for point in printed["csi-delay"]["points"]] == [8] * 5
    assert any(table["part"].startswith("Fig. 5") for table in printed["tables"])


def exit_code(arguments: list[str]) -> Any:
    try:
        return cli.main(arguments)
    except SystemExit as stopped:  # the parser's own
        return stopped.code


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("table5",), "invalid choice"),
        (("table1", "--world", "libero"), "--model PATH"),
        (("fig4", "--world", "libero", "--model", "x"), "comvla-sim figure fading --world"),
        (("table1", "--also", "nobody"), "got 'nobody'"),
        (("table1", "--also", "jpeg"), "--also jpeg: the link decides its quality"),
        (
            ("table1", "--also", "jpeg-900"),
            "--also jpeg-900: expected a jpeg quality from 1 to 100",
        ),
        (("table1", "--reuse", "nowhere/at/all"), "--reuse nowhere/at/all is no folder"),
        (("table3", "--measured-only", "--reuse", "nowhere"), "--reuse nowhere is no folder"),
        (("table4", "--also", "random"), "--also adds lines to Table I"),
        (("table1", "--episodes", "0"), "--episodes must be at least 1"),
        (
            ("table1", "--world", "libero", "--model", "x", "--suites", "y"),
            "choose among libero_sp",
        ),
    ],
)
def test_nonsense_is_refused_before_anything_runs(
    options: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(["paper", *options, "--out", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.glob("*.jsonl"))


def test_each_libero_suite_has_its_world_and_its_weights() -> None:
    plan = measuring.Plan(world="libero", model="./oft-{suite}")
    assert plan.suites() == ("libero_spatial", "libero_object", "libero_goal", "libero_10")


def test_pictures_show_what_is_kept_and_darken_the_rest() -> None:
    views = np.full((2, 8, 8, 3), 200, np.uint8)
    shown = dimmed(views, (2, 4, 4), np.array([0, 31]))
    assert shown.shape == (8, 16, 3)
    assert (shown[:2, :2] == 200).all()
    assert (shown[6:, 14:] == 200).all()
    assert (shown == 200).sum() == 2 * 2 * 2 * 3
    assert shown[4, 4].max() < 60


@pytest.mark.slow
def test_several_instructions_on_one_picture_and_a_film() -> None:
    from PIL import Image

    worker = Worker(EvalSettings())
    try:
        scene = kept_tokens.select_on_one_picture(worker, evaluation_layout(0, 0))
        words = {s.instruction for s in scene.selections if s.method == "hard_voting"}
        assert len(words) == 3
        assert [s.method for s in scene.selections].count("random") == 1
        for line in kept_tokens.overlaps(scene):
            assert line["object_kept"] == line["instructions"], "the thing that is named is kept"
            assert line["overlap"] < 1
        picture = Image.open(io.BytesIO(kept_tokens.draw(scene, (32, 16))))
        assert picture.format == "PNG"
        made = film.shoot(worker, "drawer-open", evaluation_layout(0, 0), k=16)
        moving: Any = Image.open(io.BytesIO(made.data))
        assert moving.n_frames == made.periods // film.FRAME_EVERY + 1
        assert made.queries == 1
    finally:
        worker.close()
