"""``comvla step`` and ``comvla doctor``: what they say, and what their exit status means."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from client_stubs import StubEdge, StubService, serving
from PIL import Image

from comvla_client.cli import main
from comvla_client.commands import step as step_command
from comvla_client.commands.doctor import Finding
from comvla_server.background import BackgroundServer

REFUSED = "127.0.0.1:1"


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
    arguments = ["--edge", str(checkpoint), "--tokens", "16", "--deadline-s", "20", "--json"]
    assert main(["step", server.target, *arguments]) == 0
    out = printed(capsys)
    assert np.shape(out["actions"]) == (8, 4)
    assert out["report"]["source"] == "cloud"
    assert out["report"]["tokens"] == out["report"]["tokens_used"] == 16


@pytest.mark.usefixtures("stub_edge")
def test_step_tells_the_story_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    with serving() as (target, _):
        assert main(["step", target, "--bandwidth-hz", "10e3", "--efficiency", "1"]) == 0
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
        assert main(["step", target, *pictures, "--proprio", "1", "2", "3"]) == 0
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


def test_doctor_finds_a_real_server_well(
    server: BackgroundServer, checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["doctor", server.target, "--edge", str(checkpoint), "--calls", "5", "--json"])
    out = printed(capsys)
    findings = {finding["check"]: finding for finding in out["findings"]}
    assert list(findings) == ["torch", "reach", "handshake", "edge", "health", "round trip", "link"]
    assert findings["health"]["found"] == "SERVING"
    assert findings["round trip"]["values"]["calls"] == 5
    assert findings["link"]["values"]["token_budget"] > 512
    # Whether five calls stay below a control period is the machine's affair.
    assert all(finding["ok"] for name, finding in findings.items() if name != "round trip")
    assert out["ok"] == all(finding["ok"] for finding in out["findings"])


def test_doctor_gives_each_finding_its_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    with serving() as (target, _):
        assert main(["doctor", target, "--snr-db", "-20", "--bandwidth-hz", "1e4"]) == 1
    out = capsys.readouterr().out
    assert "ok   handshake  stub 5eed" in out
    assert "FAIL health" in out
    assert "grpc.health.v1.Health" in out
    assert "FAIL link" in out
    assert "raise bandwidth" in out


def test_doctor_stops_at_a_closed_port(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", REFUSED, "--connect-timeout-s", "1", "--json"]) == 1
    out = printed(capsys)
    assert out["findings"][-1]["check"] == "reach"
    assert "comvla-server serve" in out["findings"][-1]["remedy"]


def test_doctor_recognises_a_stranger(
    server: BackgroundServer, capsys: pytest.CaptureFixture[str]
) -> None:
    admin = server.admin_url.removeprefix("http://").rstrip("/")
    assert main(["doctor", admin, "--connect-timeout-s", "3"]) == 1
    out = capsys.readouterr().out
    assert "FAIL handshake" in out
    assert "admin surface" in out


def test_doctor_sees_another_model(
    server: BackgroundServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("comvla_client.commands.doctor.load_edge", lambda source: StubEdge())
    assert main(["doctor", server.target, "--edge", "elsewhere", "--calls", "2"]) == 1
    out = capsys.readouterr().out
    assert "FAIL edge" in out
    assert "same checkpoint" in out


def test_doctor_notices_a_server_that_goes_away(capsys: pytest.CaptureFixture[str]) -> None:
    class Fickle(StubService):
        asked = 0

        def GetModel(self, request: Any, context: Any) -> Any:
            self.asked += 1
            if self.asked > 3:
                context.abort(grpc.StatusCode.INTERNAL, "gone")
            return self.model

    with serving(Fickle()) as (target, _):
        assert main(["doctor", target]) == 1
    assert "lost after 2 calls" in capsys.readouterr().out


def test_doctor_without_torch_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["doctor", REFUSED, "--connect-timeout-s", "1"]) == 1
    assert "pip install 'comvla[edge]'" in capsys.readouterr().out


def test_a_slow_way_is_a_finding() -> None:
    from argparse import Namespace

    from client_stubs import INFO, StubTransport, other_model

    from comvla_client.commands.doctor import _round_trips

    arguments = Namespace(calls=3, connect_timeout_s=1.0)
    slow: Finding = _round_trips(StubTransport(), arguments, other_model(control_period_s=1e-9))
    quick = _round_trips(StubTransport(), arguments, other_model(control_period_s=10.0))
    assert not slow.ok
    assert "longer chunks" in slow.remedy
    assert quick.ok
    assert INFO.control_period_s == 0.05


def test_the_module_is_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "comvla_client", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "comvla doctor" in done.stdout
