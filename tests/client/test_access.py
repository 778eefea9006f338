"""What a robot sends to be let in, and how it tells distrust from a bad link."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import grpc
import pytest
from client_stubs import StubEdge, StubService, serving

from comvla.errors import HandshakeError
from comvla_client import ComVLAClient, TlsOptions
from comvla_client.cli import main
from comvla_client.commands import step as step_command
from comvla_client.errors import TransportError
from comvla_client.locked_out import locked_out


class Asking(StubService):
    """Lets in who brings the token ``open``."""

    def __init__(self) -> None:
        super().__init__()
        self.tokens: list[str] = []

    def GetModel(self, request: Any, context: Any) -> Any:
        headers = dict(context.invocation_metadata())
        self.tokens.append(headers.get("authorization", ""))
        if self.tokens[-1] != "Bearer open":
            context.abort(grpc.StatusCode.UNAUTHENTICATED, "who are you")
        return super().GetModel(request, context)


def test_a_server_that_does_not_know_the_robot_is_told_at_once() -> None:
    # With this patience the test would run into its own time limit if the client tried again.
    with serving(Asking()) as (target, service), pytest.raises(HandshakeError) as caught:
        ComVLAClient(target, edge=StubEdge(), token="shut", connect_timeout_s=10_000)
    for words in (target, "give it a token", "--token-file", "who are you"):
        assert words in str(caught.value)
    assert service.tokens == ["Bearer shut"]


def test_step_and_doctor_bring_the_token_of_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(step_command, "load_edge", lambda source: StubEdge())
    file = tmp_path / "token"
    file.touch(mode=0o600)
    file.write_text("open\n")
    with serving(Asking()) as (target, service):
        assert main(["step", target, "--token-file", str(file), "--deadline-s", "20"]) == 0
        main(["doctor", target, "--token-file", str(file), "--calls", "2"])
        assert "ok   handshake" in capsys.readouterr().out
        assert set(service.tokens) == {"Bearer open"}
        assert main(["doctor", target]) == 1
        out = capsys.readouterr().out
        assert "FAIL access" in out
        assert "a server is there, but the server does not know who calls" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--token-file", "/nowhere"], "cannot read the token in /nowhere"),
        (["--tls-ca", "/nowhere"], "cannot read ca '/nowhere'"),
        (["--tls-key", "/nowhere"], "got one of them"),
        (["--tls", "--insecure"], "contradict each other"),
    ],
)
def test_files_that_cannot_be_used_are_exit_code_two(
    capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    assert main(["doctor", "127.0.0.1:1", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("comvla: ")
    assert words in error


@pytest.mark.parametrize(
    ("code", "message", "words"),
    [
        ("UNAUTHENTICATED", "no", "token"),
        ("PERMISSION_DENIED", "no", "does not allow"),
        ("UNAVAILABLE", "CERTIFICATE_VERIFY_FAILED: certificate has expired", "expired"),
        ("UNAVAILABLE", "CERTIFICATE_VERIFY_FAILED: unable to get local issuer", "TlsOptions.ca"),
        ("UNAVAILABLE", "Hostname Verification Check failed.", "--tls-server-name"),
        ("UNAVAILABLE", "WRONG_VERSION_NUMBER", "no TLS"),
    ],
)
def test_distrust_has_words_of_its_own(code: str, message: str, words: str) -> None:
    told = locked_out(TransportError(code, message))
    assert told is not None
    assert words in told


@pytest.mark.parametrize("code", ["UNAVAILABLE", "DEADLINE_EXCEEDED", "INTERNAL"])
def test_a_bad_link_is_no_distrust(code: str) -> None:
    assert locked_out(TransportError(code, "Connection refused")) is None


def test_a_server_without_tls_is_named_as_such() -> None:
    with serving() as (target, _), pytest.raises(HandshakeError, match="it speaks no TLS"):
        ComVLAClient(target, edge=StubEdge(), tls=TlsOptions(), connect_timeout_s=10_000)
