"""The results file survives crashes and refuses to mix measurements."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from eval_stubs import SETTINGS, made_up_row

from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.link_case import LinkCase
from comvla_sim.experiments.results import ResultsFile, read_rows, spec_of


def test_rows_come_back_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "results.jsonl"
    rows = [made_up_row(episode=episode) for episode in range(3)]
    with ResultsFile(path, SETTINGS) as results:
        for row in rows:
            results.append(row)
    with ResultsFile(path, SETTINGS) as results:
        assert list(results) == rows
        assert set(results.rows) == {spec_of(row) for row in rows}


@pytest.mark.parametrize("cut", [1, 40, 400])
def test_a_line_that_a_crash_cut_off_is_forgotten_and_written_over(
    tmp_path: Path, cut: int
) -> None:
    path = tmp_path / "results.jsonl"
    first, second, third = (json.dumps(made_up_row(episode=e)) + "\n" for e in range(3))
    path.write_text(first + second[:-cut])
    with ResultsFile(path, SETTINGS) as results:
        assert [row["episode"] for row in results] == [0]
        results.append(json.loads(third))
    assert path.read_text() == first + third


def test_other_settings_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    path.write_text(json.dumps(made_up_row(quantization="int4")) + "\n")
    with pytest.raises(EvaluationError, match=r"quantization 'int4'.*'int8'.*--out"):
        ResultsFile(path, SETTINGS)


def test_two_evaluations_cannot_write_one_file(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    with (
        ResultsFile(path, SETTINGS),
        pytest.raises(EvaluationError, match="another evaluation"),
    ):
        ResultsFile(path, SETTINGS)
    with ResultsFile(path, SETTINGS) as later:
        later.append(made_up_row())


def test_what_another_process_appends_before_the_lock_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one has written a row and let go of the file just when this one asks for the lock."""
    fcntl = pytest.importorskip("fcntl", reason="a system without file locks")
    path = tmp_path / "results.jsonl"
    lines = [json.dumps(made_up_row(episode=episode)) + "\n" for episode in range(2)]
    path.write_text(lines[0])
    flock = fcntl.flock

    def late(file: Any, operation: int) -> None:
        with path.open("a") as other:
            other.write(lines[1])
        flock(file, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    with ResultsFile(path, SETTINGS) as found:
        assert [row["episode"] for row in found] == [0, 1]
    assert path.read_text() == "".join(lines)


@pytest.mark.parametrize("tail", [b'{"for', b"\0" * 40, b'{"format": 2, "con\0\0'])
def test_what_a_crash_left_of_the_last_row_is_cut_off(tmp_path: Path, tail: bytes) -> None:
    path = tmp_path / "results.jsonl"
    whole = json.dumps(made_up_row()).encode() + b"\n"
    path.write_bytes(whole + tail)
    with ResultsFile(path, SETTINGS) as found:
        assert list(found) == [made_up_row()]
    assert path.read_bytes() == whole


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"not json\n", "line 1"),
        (b'{"format": 1}\n', "line 1"),
        (b"[1, 2]\n", "line 1"),
        (b"\xff\xfe\n", "line 1"),
        (b"\0\0\0", "ends in a line that is no result"),
        (b"a shopping list", "ends in a line that is no result.*name another file"),
        (json.dumps(made_up_row()).encode() + b"\nby hand", "ends in a line that is no result"),
        (json.dumps({**made_up_row(), "format": 99}).encode() + b"\n", "format 99.*1 and 2"),
    ],
)
def test_a_file_of_something_else_is_left_alone(
    tmp_path: Path, content: bytes, message: str
) -> None:
    path = tmp_path / "precious.txt"
    path.write_bytes(content)
    with pytest.raises(EvaluationError, match=message):
        ResultsFile(path, SETTINGS)
    assert path.read_bytes() == content


def old_row() -> dict[str, Any]:
    """A row as format 1 had it, which knew no link."""
    row = made_up_row()
    settings = {**row["settings"], "link": "ideal"}
    old = {k: v for k, v in row.items() if k not in ("link", "channel_seed", "link_use")}
    return {**old, "format": 1, "settings": settings}


def test_rows_of_format_1_are_read_and_continued(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    path.write_text(json.dumps(old_row()) + "\n")
    with ResultsFile(path, SETTINGS) as results:
        assert list(results) == [made_up_row()]
        results.append(made_up_row(episode=1))
    assert [row["episode"] for row in read_rows(path)[0]] == [0, 1]


def test_the_link_is_part_of_the_episode(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    links = (None, LinkCase(), LinkCase(mean_snr_db=5.0))
    with ResultsFile(path, SETTINGS) as results:
        for link in links:
            results.append(made_up_row(k=None if link else 16, link=link))
    with ResultsFile(path, SETTINGS) as results:
        assert [spec.link for spec in results.rows] == list(links)
        assert [spec.k for spec in results.rows] == [16, None, None]


def test_a_link_of_a_later_version_is_refused_and_of_an_earlier_one_has_defaults(
    tmp_path: Path,
) -> None:
    row = made_up_row(link=LinkCase())
    path = tmp_path / "results.jsonl"
    path.write_text(json.dumps({**row, "link": {**row["link"], "warp": 9}}) + "\n")
    with pytest.raises(EvaluationError, match="warp"):
        read_rows(path)
    assert LinkCase.from_dict({"channel": "rayleigh"}) == LinkCase("rayleigh")


def test_a_folder_or_a_missing_file_is_no_results_file(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="cannot read"):
        read_rows(tmp_path / "missing.jsonl")
    with pytest.raises(EvaluationError, match="cannot write"):
        ResultsFile(tmp_path, SETTINGS)
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(EvaluationError, match="cannot write"):
        ResultsFile(blocked / "results.jsonl", SETTINGS)


def test_an_episode_counts_once(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    twice = [made_up_row(success=True), made_up_row(success=False)]
    path.write_text("".join(json.dumps(row) + "\n" for row in twice))
    rows, complete = read_rows(path)
    assert [row["success"] for row in rows] == [True]
    assert complete == path.stat().st_size


@pytest.mark.skipif(sys.platform == "win32", reason="no limits on file sizes")
def test_a_full_disk_loses_no_row_and_leaves_no_half_one(tmp_path: Path) -> None:
    """A limit on the size of files stands in for the disk; the process is another one, which can be limited."""
    path = tmp_path / "results.jsonl"
    rows = [made_up_row(episode=episode) for episode in range(4)]
    room = sum(len(json.dumps(row)) + 1 for row in rows[:2]) + 100
    program = f"""
import json, resource, signal, sys
from pathlib import Path
from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.results import ResultsFile

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room}))
rows = json.loads(sys.stdin.read())
try:
    with ResultsFile(Path({str(path)!r}), rows[0]["settings"]) as results:
        for row in rows:
            results.append(row)
except EvaluationError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        input=json.dumps(rows),
        capture_output=True,
        text=True,
        check=True,
    )
    assert "the 2 episodes before are kept: make room" in done.stdout
    assert [json.loads(line) for line in path.read_text().splitlines()] == rows[:2]
    with ResultsFile(path, SETTINGS) as results:  # once there is room
        results.append(rows[2])
    assert [row["episode"] for row in read_rows(path)[0]] == [0, 1, 2]
