"""The server guide's way from nothing to a robot with a certificate and a token works as printed."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import ssl
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import markdown
import pytest

import comvla_client.cli

SERVER = markdown.ROOT / "docs" / "server.md"
SECTION = SERVER.read_text(encoding="utf-8").partition("\n## Security\n")[2].partition("\n## ")[0]
PATIENCE_S = 60.0

pytestmark = pytest.mark.skipif(
    shutil.which("openssl") is None or shutil.which("bash") is None,
    reason="needs openssl and bash: apt-get install openssl",
)


def printed(language: str) -> str:
    """The section's blocks of one language, one after another."""
    return "\n".join(re.findall(rf"^```{language}\n(.*?)^```$", SECTION, re.M | re.S))


def command(program: str) -> list[str]:
    """Arguments of the command that the section prints for a program."""
    (line,) = re.findall(rf"^\$ {program} (.*)$", printed("console"), re.M)
    return shlex.split(line)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the printed commands were typed."""
    folder = tmp_path_factory.mktemp("fleet")
    program = folder / "bin" / "comvla-server"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m comvla_server "$@"\n')
    program.chmod(0o755)
    path = f"{program.parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(
        ["bash", "-euc", printed("bash")],
        cwd=folder,
        env={**os.environ, "PATH": path},
        check=True,
        capture_output=True,
        timeout=PATIENCE_S,
    )
    return folder


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[tuple[str, str]]:
    """gRPC target and admin URL of the server that the section starts, on free ports."""
    arguments = [*command("comvla-server"), "--port", "0", "--admin-port", "0"]
    with subprocess.Popen(
        [sys.executable, "-m", "comvla_server", *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            found = re.search(r"grpc=0\.0\.0\.0:(\d+) admin=https://0\.0\.0\.0:(\d+)", line)
            assert found, process.communicate()[1]
            yield f"127.0.0.1:{found[1]}", f"https://127.0.0.1:{found[2]}"
        finally:
            process.kill()


@pytest.mark.slow
def test_the_robot_of_the_guide_finds_its_server_well(
    folder: Path,
    server: tuple[str, str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    arguments = [word.replace("127.0.0.1:50051", server[0]) for word in command("comvla")]
    comvla_client.cli.main([*arguments, "--calls", "2", "--json"])
    findings = {row["check"]: row for row in json.loads(capsys.readouterr().out)["findings"]}
    for check in ("reach", "handshake", "health"):
        assert findings[check]["ok"], findings
    assert findings["round trip"]["values"]["calls"] == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("left_out", "words"),
    [
        ("--token-file", "--token-file"),
        ("--tls-ca", "--tls-ca"),
    ],
)
def test_without_one_of_its_files_the_robot_is_told_what_is_missing(
    folder: Path,
    server: tuple[str, str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    left_out: str,
    words: str,
) -> None:
    monkeypatch.chdir(folder)
    arguments = [word.replace("127.0.0.1:50051", server[0]) for word in command("comvla")]
    at = arguments.index(left_out)
    del arguments[at : at + 2]
    assert comvla_client.cli.main([*arguments, "--json"]) == 1
    (last,) = json.loads(capsys.readouterr().out)["findings"][-1:]
    assert last["check"] == "access"
    assert words in last["remedy"]


@pytest.mark.slow
def test_the_admin_surface_of_the_guide_takes_the_token_of_prometheus(
    folder: Path, server: tuple[str, str]
) -> None:
    context = ssl.create_default_context(cafile=str(folder / "ca.pem"))
    token = (folder / "prometheus.token").read_text().strip()
    with httpx.Client(base_url=server[1], verify=context, timeout=PATIENCE_S) as http:
        assert http.get("/readyz").status_code == 200
        assert http.get("/metrics").status_code == 401
        metrics = http.get("/metrics", headers={"authorization": f"Bearer {token}"})
    assert "comvla_certificate_not_after_seconds" in metrics.text


def test_what_the_guide_makes_is_secret(folder: Path) -> None:
    for name in ("ca.key", "server.key", "arm-7.key", "arm-7.token", "tokens", "admin-tokens"):
        assert (folder / name).stat().st_mode & 0o077 == 0, name
