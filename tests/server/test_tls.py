"""TLS and mutual TLS against real servers: who is let in, who is refused, and with what words."""

from __future__ import annotations

import logging
import socket
import ssl
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from authorities import Authority, Pair, encrypted
from server_stubs import PATIENCE_S, StubCloud, eventually, message

from comvla.errors import HandshakeError
from comvla.v1 import policy_pb2, policy_pb2_grpc
from comvla_client import AccessError, AsyncComVLAClient, ComVLAClient, TlsOptions
from comvla_client.access import Access
from comvla_client.transport import GrpcTransport, TransportError
from comvla_server import cli
from comvla_server.background import BackgroundServer
from comvla_server.certificates import CertificateError
from comvla_server.engine import Engine
from comvla_server.settings import ServerSettings
from comvla_vla import random_policy

UNAVAILABLE = grpc.StatusCode.UNAVAILABLE


@pytest.fixture(scope="module")
def authority() -> Authority:
    return Authority()


@pytest.fixture(scope="module")
def policy() -> Any:
    return random_policy(seed=0)


@pytest.fixture
def files(tmp_path: Path, authority: Authority) -> dict[str, Path]:
    """The server's files."""
    certificate, key = authority.issue("server").write(tmp_path, "server")
    return {
        "tls_certificate": certificate,
        "tls_key": key,
        "tls_client_ca": authority.write(tmp_path),
    }


@pytest.fixture
def server(files: dict[str, Path]) -> Iterator[BackgroundServer]:
    """A server that shows its certificate and asks for one."""
    with BackgroundServer(Engine(StubCloud()), ServerSettings(**files)) as running:
        yield running


def options(authority: Authority, robot: Pair | None = None, **more: Any) -> TlsOptions:
    """What a robot of this authority has."""
    pair = (None, None) if robot is None else (robot.certificate, robot.key)
    return TlsOptions(authority.pem, *pair, **more)


def outcome(target: str, tls: TlsOptions | None) -> tuple[str, str]:
    """Status and words of one small call."""
    with Access(target, tls).channel() as channel:
        stub = policy_pb2_grpc.PolicyServiceStub(channel)
        call = stub.GetModel.future(policy_pb2.GetModelRequest(), timeout=PATIENCE_S)
        error = call.exception(timeout=PATIENCE_S)
    return ("OK", "") if error is None else (error.code().name, error.details())


def fails_with(words: str, kind: type[Exception], ask: Callable[[float], object]) -> None:
    """Asks for a server with so many seconds. Who waits for one tells only at the end what it met,
    and the time has to be long enough to meet anything: on a busy machine another try has longer."""
    met = []
    for timeout_s in (1.0, 4.0, 16.0):
        with pytest.raises(kind) as caught:
            ask(timeout_s)
        met.append(str(caught.value))
        if words in met[-1]:
            return
    pytest.fail(f"expected {words!r}, got {met}")


def certificate_of(port: int) -> str:
    """What the server shows to strangers."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with (
        socket.create_connection(("127.0.0.1", port), PATIENCE_S) as plain,
        context.wrap_socket(plain) as encrypted_socket,
    ):
        shown = encrypted_socket.getpeercert(binary_form=True)
    assert shown is not None
    return ssl.DER_cert_to_PEM_cert(shown)


def https(url: str, authority: Authority) -> int:
    """Status of the admin surface for a client that trusts the authority."""
    context = ssl.create_default_context(cadata=authority.pem.decode())
    with urllib.request.urlopen(url, context=context, timeout=PATIENCE_S) as answer:
        return int(answer.status)


def test_a_robot_with_a_certificate_is_let_in(
    server: BackgroundServer, authority: Authority
) -> None:
    assert outcome(server.target, options(authority, authority.issue("arm-7"))) == ("OK", "")


def test_the_session_belongs_to_the_name_in_the_certificate(
    server: BackgroundServer, authority: Authority
) -> None:
    def infer(name: str) -> Any:
        tls = options(authority, authority.issue(name))
        with Access(server.target, tls).channel() as channel:
            stub = policy_pb2_grpc.PolicyServiceStub(channel)
            return stub.Infer.future(message("mine"), timeout=PATIENCE_S).exception(PATIENCE_S)

    assert infer("arm-7") is None
    error = infer("arm-8")
    assert error.code() is grpc.StatusCode.PERMISSION_DENIED
    assert "'mine' belongs to another identity than 'arm-8'" in error.details()


def test_a_certificate_whose_name_is_no_identity_is_unauthenticated(
    server: BackgroundServer, authority: Authority
) -> None:
    code, words = outcome(server.target, options(authority, authority.issue("my robot")))
    assert code == "UNAUTHENTICATED"
    assert "one common name" in words


def stranger(authority: Authority) -> TlsOptions:
    return options(authority, Authority("elsewhere").issue("arm-7"))


REFUSED: dict[str, tuple[Callable[[Authority], TlsOptions | None], str]] = {
    "a robot that trusts another authority": (
        lambda authority: options(Authority("other"), authority.issue("arm-7")),
        "CERTIFICATE_VERIFY_FAILED",
    ),
    "a robot of another authority": (stranger, ""),
    "an expired robot": (
        lambda authority: options(authority, authority.issue("arm-7", days=(-2, -1))),
        "",
    ),
    "a robot without a certificate": (options, ""),
    "a robot without TLS": (lambda _: None, ""),
    "a robot that calls another name": (
        lambda authority: options(
            authority, authority.issue("arm-7"), server_name="elsewhere.example"
        ),
        "Hostname Verification",
    ),
}


@pytest.mark.parametrize("who", list(REFUSED))
def test_unavailable_is_what_a_failed_handshake_gives(
    server: BackgroundServer, authority: Authority, who: str
) -> None:
    tls, words = REFUSED[who]
    code, details = outcome(server.target, tls(authority))
    assert code == "UNAVAILABLE"
    assert words in details


@pytest.mark.parametrize(
    ("who", "words"),
    [
        ("a robot that trusts another authority", "TlsOptions.ca"),
        ("a robot without a certificate", "certificate of this robot"),
        ("a robot without TLS", "it may ask for TLS"),
        ("a robot that calls another name", "--tls-server-name"),
    ],
)
def test_the_client_says_what_is_wrong_before_the_robot_moves(
    server: BackgroundServer, authority: Authority, policy: Any, who: str, words: str
) -> None:
    tls = REFUSED[who][0](authority)
    fails_with(
        words,
        HandshakeError,
        lambda timeout_s: ComVLAClient(
            server.target, edge=policy[0], tls=tls, connect_timeout_s=timeout_s
        ),
    )


def test_an_expired_server_is_not_trusted(authority: Authority, policy: Any) -> None:
    expired = authority.issue("server", days=(-2, -1))
    plain = grpc.server(ThreadPoolExecutor(1))
    credentials = grpc.ssl_server_credentials([(expired.key, expired.certificate)])
    port = plain.add_secure_port("127.0.0.1:0", credentials)
    plain.start()
    try:
        with pytest.raises(HandshakeError, match="its certificate has expired: renew it"):
            ComVLAClient(f"127.0.0.1:{port}", edge=policy[0], tls=options(authority))
    finally:
        plain.stop(None)


async def test_both_clients_drive_a_robot_over_mutual_tls(
    files: dict[str, Path], authority: Authority, policy: Any, tmp_path: Path
) -> None:
    edge, cloud = policy
    certificate, key = authority.issue("arm-7").write(tmp_path, "arm-7")
    tls = TlsOptions(ca=files["tls_client_ca"], certificate=certificate, key=str(key))
    height, width = edge.info.image_size
    obs = {
        "images": [np.zeros((height, width, 3), np.uint8)] * edge.info.grid[0],
        "proprio": np.zeros(edge.info.proprio_dim, np.float32),
    }
    words = "pull the green drawer open"
    with BackgroundServer(Engine(cloud), ServerSettings(**files)) as server:
        with ComVLAClient(server.target, edge=edge, tls=tls, budget=8, deadline_s=20) as client:
            assert client.step(obs, words).source == "cloud"
        async with AsyncComVLAClient(
            server.target, edge=edge, tls=tls, budget=8, deadline_s=20
        ) as client_aio:
            assert (await client_aio.step(obs, words)).source == "cloud"


BAD_FILES: dict[str, tuple[Callable[[dict[str, Path], Authority], None], str]] = {
    "expired certificate": (
        lambda files, authority: write(files, authority.issue("server", days=(-2, -1))),
        r"the certificate CN=server expired on 20\d\d.*renew it",
    ),
    "certificate of tomorrow": (
        lambda files, authority: write(files, authority.issue("server", days=(1, 2))),
        "is valid only from.*clock",
    ),
    "key of another certificate": (
        lambda files, authority: (
            files["tls_key"].write_bytes(authority.issue("other").key) and None
        ),
        "does not belong to the certificate.*made together",
    ),
    "key behind a password": (
        lambda files, authority: (
            files["tls_key"].write_bytes(encrypted(files["tls_key"].read_bytes())) and None
        ),
        "is encrypted.*openssl pkey",
    ),
    "no key": (
        lambda files, authority: files["tls_key"].write_text("hello") and None,
        "holds no private key in PEM form",
    ),
    "no certificate": (
        lambda files, authority: files["tls_certificate"].write_text("hello") and None,
        "holds no certificate in PEM form",
    ),
    "missing file": (
        lambda files, authority: files["tls_key"].unlink(),
        "cannot read .*server.key",
    ),
    "expired authority of robots": (
        lambda files, authority: (
            files["tls_client_ca"].write_bytes(authority.issue("ca", days=(-2, -1)).certificate)
            and None
        ),
        "tls_client_ca.*expired",
    ),
}


def write(files: dict[str, Path], pair: Pair) -> None:
    files["tls_certificate"].write_bytes(pair.certificate)
    files["tls_key"].write_bytes(pair.key)


@pytest.mark.parametrize("fault", list(BAD_FILES))
def test_bad_files_stop_the_start_before_anything_listens(
    files: dict[str, Path], authority: Authority, fault: str
) -> None:
    spoil, words = BAD_FILES[fault]
    spoil(files, authority)
    with pytest.raises(CertificateError, match=words):
        BackgroundServer(Engine(StubCloud()), ServerSettings(**files)).start()
    assert not any(t.name == "comvla-inference" for t in threading.enumerate())


def test_on_the_command_line_they_are_exit_code_two_and_one_clear_line(
    files: dict[str, Path], authority: Authority, capfd: pytest.CaptureFixture[str]
) -> None:
    files["tls_key"].write_bytes(authority.issue("other").key)
    arguments = ["serve", "--port", "0", "--admin-port", "0"]
    for name, path in files.items():
        arguments += ["--" + name.replace("_", "-"), str(path)]
    assert cli.main(arguments) == 2
    stdout, stderr = capfd.readouterr()
    assert stdout == ""
    assert "does not belong to the certificate" in stderr
    assert len(stderr.splitlines()) == 1


def test_a_new_certificate_is_shown_without_a_restart(
    tmp_path: Path, files: dict[str, Path], authority: Authority
) -> None:
    settings = ServerSettings(**files, reload_interval_s=0.02)
    with BackgroundServer(Engine(StubCloud()), settings) as server:
        ports = (server.server.port, server.server.admin_port)
        old = files["tls_certificate"].read_text()
        assert [certificate_of(port) for port in ports] == [old, old]
        robot = options(authority, authority.issue("arm-7"))
        with Access(server.target, robot).channel() as channel:
            stub = policy_pb2_grpc.PolicyServiceStub(channel)
            stub.GetModel(policy_pb2.GetModelRequest(), timeout=PATIENCE_S)
            new = authority.issue("server", days=(-1, 60))
            new.write(tmp_path, "server")
            eventually(lambda: certificate_of(ports[1]) == new.certificate.decode())
            assert certificate_of(ports[0]) == new.certificate.decode()
            # Connections that are open go on.
            stub.GetModel(policy_pb2.GetModelRequest(), timeout=PATIENCE_S)
        metrics = server.server.metrics.registry
        ends_s = metrics.get_sample_value(
            "comvla_certificate_not_after_seconds", {"certificate": "server"}
        )
        assert ends_s == pytest.approx(time.time() + 60 * 86400, abs=600)
        assert https(f"{server.admin_url}/healthz", authority) == 200


def test_robots_of_a_new_authority_are_let_in_without_a_restart(
    files: dict[str, Path], authority: Authority
) -> None:
    new = Authority("new")
    with BackgroundServer(Engine(StubCloud()), ServerSettings(**files)) as server:
        robot = options(authority, new.issue("arm-7"))
        assert outcome(server.target, robot)[0] == "UNAVAILABLE"
        files["tls_client_ca"].write_bytes(authority.pem + new.pem)
        eventually(lambda: outcome(server.target, robot)[0] == "OK")


def test_a_new_certificate_that_is_no_good_leaves_the_old_one(
    files: dict[str, Path], authority: Authority, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    old = files["tls_certificate"].read_text()
    settings = ServerSettings(**files, reload_interval_s=0.02)
    with BackgroundServer(Engine(StubCloud()), settings) as server:
        registry = server.server.metrics.registry

        def failures() -> float:
            labels = {"file": "certificate"}
            return registry.get_sample_value("comvla_reload_failures_total", labels) or 0.0

        assert failures() == 0
        write(files, authority.issue("server", days=(-2, -1)))
        eventually(failures)
        ports = (server.server.port, server.server.admin_port)
        assert [certificate_of(port) for port in ports] == [old, old]
        assert outcome(server.target, options(authority, authority.issue("a")))[0] == "OK"
    assert "the old one stays" in caplog.text


def test_a_certificate_near_its_end_and_a_key_for_all_eyes_are_warned_about(
    files: dict[str, Path], authority: Authority, caplog: pytest.LogCaptureFixture
) -> None:
    write(files, authority.issue("server", days=(-1, 3)))
    files["tls_key"].chmod(0o644)
    with BackgroundServer(Engine(StubCloud()), ServerSettings(**files)):
        pass
    assert "server certificate ends in 3.0 days" in caplog.text
    assert "chmod 600" in caplog.text


def test_the_robots_own_certificate_can_be_renewed(
    server: BackgroundServer, authority: Authority, tmp_path: Path
) -> None:
    certificate, key = authority.issue("arm-7", days=(-2, -1)).write(tmp_path, "arm-7")
    tls = TlsOptions(ca=authority.pem, certificate=certificate, key=key)
    transport = GrpcTransport(server.target, tls)
    try:
        fails_with("UNAVAILABLE", TransportError, transport.get_model)
        authority.issue("arm-7").write(tmp_path, "arm-7")
        assert transport.get_model(PATIENCE_S).model_name == "stub"
        key.unlink()  # half replaced: the last good pair is used
        assert transport.get_model(PATIENCE_S).model_name == "stub"
    finally:
        transport.close()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"certificate": b"x"}, "got one of them"),
        ({"ca": "/nowhere.pem"}, "cannot read ca '/nowhere.pem'"),
        ({"ca": b"hello"}, "expected ca in PEM form"),
    ],
)
def test_the_client_refuses_files_that_cannot_be_used(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(AccessError, match=words):
        Access("127.0.0.1:1", TlsOptions(**changes))
