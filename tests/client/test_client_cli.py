"""``comvla step``: what it says, and what its exit status means."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client_stubs import StubEdge, serving
from PIL import Image

from comvla_client.cli import main
from comvla_client.commands import step as step_command
from comvla_server.background import BackgroundServer

REFUSED = "127.0.0.1:1"
# One that a busy machine can keep: these tests are about words, not about time.
DEADLINE = ("--deadline-s", "20")


@pytest.fixture
def stub_edge(monkeypatch: pytest.MonkeyPatch) -> None:
    """``--edge`` gives the stub, so that no checkpoint is needed."""
    monkeypatch.setattr(step_command, "load_edge", lambda source: StubEdge())


def printed(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    parsed: dict[str, Any] = json.loads(capsys.readouterr().out)
    return parsed


def test_step_prints_actions_and_report_as_json(
    server: BackgroundServer, checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--edge", str(checkpoint), "--tokens", "16", *DEADLINE, "--json"]
    assert main(["step", server.target, *arguments]) == 0
    out = printed(capsys)
    assert np.shape(out["actions"]) == (8, 4)
    assert out["report"]["source"] == "cloud"
    assert out["report"]["tokens"] == out["report"]["tokens_used"] == 16


def test_step_repeats_as_one_robot(
    server: BackgroundServer, checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--edge", str(checkpoint), "--tokens", "16", *DEADLINE, "--json"]
    assert main(["step", server.target, *arguments, "--repeat", "3", "--every-s", "0"]) == 0
    reports = [json.loads(line)["report"] for line in capsys.readouterr().out.splitlines()]
    assert [report["step"] for report in reports] == [0, 1, 2]
    assert len({report["session"] for report in reports}) == 1


@pytest.mark.parametrize("option", [("--repeat", "-1"), ("--every-s", "nan"), ("--every-s", "-1")])
def test_step_refuses_a_rhythm_that_cannot_be(
    option: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["step", "127.0.0.1:1", *option]) == 2
    assert "--repeat 0" in capsys.readouterr().err


@pytest.mark.usefixtures("stub_edge")
def test_step_tells_the_story_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    with serving() as (target, _):
        assert main(["step", target, "--bandwidth-hz", "10e3", "--efficiency", "1", *DEADLINE]) == 0
    out = capsys.readouterr().out
    for words in ("stub (N 32, D 12)", "from the cloud", "K* 18", "18 tokens, 216 B", "server ms"):
        assert words in out


@pytest.mark.usefixtures("stub_edge")
def test_step_without_a_link_falls_back_with_status_1(capsys: pytest.CaptureFixture[str]) -> None:
    with serving() as (target, service):
        assert main(["step", target, "--snr-db=-inf"]) == 1
    assert "no_link" in capsys.readouterr().out
    assert service.requests == []


@pytest.mark.usefixtures("stub_edge")
def test_step_reads_pictures_and_resizes_them(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a.png", "b.png")]
    for file, value in zip(files, (0, 255), strict=True):
        Image.new("RGBA", (40, 30), (value, value, value, 255)).save(file)
    pictures = [argument for file in files for argument in ("--image", str(file))]
    with serving() as (target, service):
        assert main(["step", target, *pictures, "--proprio", "1", "2", "3", *DEADLINE]) == 0
    assert list(service.requests[0].proprio) == [1.0, 2.0, 3.0]


@pytest.mark.usefixtures("stub_edge")
def test_mistakes_are_told_in_one_line_with_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = tmp_path / "text.png"
    text.write_text("no picture")
    with serving() as (target, _):
        for arguments, words in (
            ([target, "--image", str(text)], "PNG or JPEG"),
            ([target, "--image", str(tmp_path / "missing.png")], "missing.png"),
            ([target, "--proprio", "1"], "proprio"),
            ([target, "--efficiency", "2"], "efficiency"),
            ([target, "--instruction", " "], "in words"),
            ([REFUSED, "--connect-timeout-s", "0.1"], "comvla-server serve"),
        ):
            assert main(["step", *arguments]) == 2
            error = capsys.readouterr().err
            assert error.startswith("comvla: ")
            assert words in error
            assert "Traceback" not in error


def test_the_module_is_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "comvla_client", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "comvla doctor" in done.stdout
