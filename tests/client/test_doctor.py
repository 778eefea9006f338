"""``comvla doctor``: what it finds of servers and links that are well, slow, strange, or not there."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import grpc
import pytest
from client_stubs import INFO, StubEdge, StubService, answer, fault, other_model, serving
from slow_relay import relayed

from comvla import codec
from comvla.v1.policy_pb2 import InferRequest, InferResponse, LoadHint, ServerTimings
from comvla_client.budget import PAPER_LINK
from comvla_client.cli import main
from comvla_client.commands import doctor
from comvla_client.diagnosis import goodput, machine, reach, round_trips, silence, tokens
from comvla_client.diagnosis import server as server_checks
from comvla_client.diagnosis.finding import Allowance, Finding
from comvla_client.diagnosis.probes import upload_request, upload_s
from comvla_client.snr.nl80211 import Interface
from comvla_client.transport import GrpcTransport
from comvla_server.background import BackgroundServer

REFUSED = "127.0.0.1:1"


def examined(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, dict[str, Any]]:
    """The findings of a run by name; also checks status and verdict against them."""
    status = main(["doctor", *arguments, "--json"])
    out = json.loads(capsys.readouterr().out)
    findings = {finding["check"]: finding for finding in out["findings"]}
    failed = [name for name, finding in findings.items() if finding["status"] == "fail"]
    assert status == (1 if failed else 0)
    assert out["ok"] == (not failed)
    assert all(name in out["verdict"] for name in failed)
    for finding in out["findings"]:
        assert finding["status"] in ("ok", "note", "fail", "skip")
        assert finding["status"] != "fail" or finding["remedy"]
    return findings


def test_a_real_server_is_examined_from_end_to_end(
    server: BackgroundServer,
    checkpoint: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # Time enough for a busy machine, but none of it for a ping that is due after ten seconds.
    monkeypatch.setattr(silence, "PING_PERIOD_S", 0.1)
    findings = examined(
        capsys, server.target, "--edge", str(checkpoint), "--calls", "5", "--seconds", "60"
    )
    order = [name for name in findings if not name.startswith("tcp_")]
    assert order[:4] == ["torch", "reach", "handshake", "edge"]
    assert order[4:9] == ["health", "round trip", "query", "load", "clock"]
    assert order[9:14] == ["goodput", "idle", "link", "tokens", "period"]
    assert order[-1] == "keep-alive"
    # How quick a busy machine is proves nothing; the rest does.
    timed = {"round trip", "idle", "tcp_slow_start_after_idle", "tokens", "period", "load"}
    assert {name for name, each in findings.items() if each["status"] == "fail"} <= timed
    assert findings["health"]["found"] == "SERVING"
    values = {name: each["values"] for name, each in findings.items()}
    assert values["round trip"]["calls"] == 5
    assert 0.0 < values["round trip"]["median_s"] <= values["round trip"]["p99_s"]
    assert values["query"]["queries"] == 3
    assert 0.0 < values["query"]["server_s"] <= values["query"]["call_s"]
    assert values["clock"]["offset_s"] is None
    assert values["goodput"]["bits_per_s"] > 0.0
    assert values["link"]["token_budget"] > 512
    assert values["tokens"]["token_budget"] > 0
    assert values["period"]["chunk_s"] == pytest.approx(0.4)
    assert values["keep-alive"]["silence_s"] > 0.0


def test_it_tells_the_story_in_words_with_a_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    with serving() as (target, service):
        arguments = ["--snr-db", "-20", "--bandwidth-hz", "1e4", "--seconds", "3", "--calls", "3"]
        assert main(["doctor", target, *arguments]) == 1
    out = capsys.readouterr().out
    assert "ok   handshake  stub 5eed" in out
    assert "FAIL health" in out
    assert (
        "-> a proxy in between may not pass it on: allow the service grpc.health.v1.Health" in out
    )
    assert "FAIL link" in out
    assert "raise bandwidth" in out
    assert out.splitlines()[-1].startswith("verdict: ")
    assert "health" in out.splitlines()[-1]
    real = [request for request in service.requests if request.model_fingerprint == "5eed"]
    assert 1 <= len(real) <= 3  # it costs no more compute than that


def test_a_closed_port_is_a_finding(capsys: pytest.CaptureFixture[str]) -> None:
    findings = examined(capsys, REFUSED, "--connect-timeout-s", "1")
    assert list(findings) == ["torch", "reach"]
    assert "comvla-server serve" in findings["reach"]["remedy"]


def test_the_admin_surface_is_recognised(
    server: BackgroundServer, capsys: pytest.CaptureFixture[str]
) -> None:
    admin = server.admin_url.removeprefix("http://").rstrip("/")
    findings = examined(capsys, admin, "--connect-timeout-s", "3")
    assert list(findings)[-1] == "handshake"
    assert "admin surface" in findings["handshake"]["remedy"]


@contextmanager
def stranger(greeting: bytes) -> Iterator[str]:
    """Something that accepts connections and is no gRPC server."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        held: list[socket.socket] = []

        def accept() -> None:
            while True:
                try:
                    connection, _ = listening.accept()
                except OSError:
                    return
                held.append(connection)
                if greeting:
                    connection.sendall(greeting)

        thread = threading.Thread(target=accept, daemon=True)
        thread.start()
        host, port = listening.getsockname()
        yield f"{host}:{port}"
        listening.shutdown(socket.SHUT_RDWR)
    thread.join(10)
    for connection in held:
        connection.close()


@pytest.mark.parametrize("greeting", [b"", b"SSH-2.0-OpenSSH_9.2\r\n"])
def test_a_stranger_is_no_server(greeting: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    with stranger(greeting) as target:
        findings = examined(capsys, target, "--connect-timeout-s", "0.5")
    assert list(findings) == ["torch", "reach", "handshake"]
    assert findings["handshake"]["status"] == "fail"


def test_a_slow_and_far_link_is_measured_and_its_promise_corrected(
    server: BackgroundServer, capsys: pytest.CaptureFixture[str]
) -> None:
    with relayed(server.target, up_bits_per_s=2e6, delay_s=0.03) as target:
        findings = examined(capsys, target, "--seconds", "8", "--calls", "5")
    values = {name: each["values"] for name, each in findings.items()}
    # The relay lets no more through, and nothing sooner.
    assert values["goodput"]["bits_per_s"] < 2.5e6
    assert values["round trip"]["median_s"] >= 0.06
    assert findings["tokens"]["status"] == "fail"
    assert (
        "GoodputSnr" in findings["tokens"]["remedy"]
        or "lose the task" in (findings["tokens"]["remedy"])
    )
    assert values["period"]["expected_s"] > values["period"]["transfer_s"] > 0.03


def test_a_link_that_sleeps_is_found(
    server: BackgroundServer, capsys: pytest.CaptureFixture[str]
) -> None:
    with relayed(server.target, wake_s=0.5) as target:
        findings = examined(capsys, target, "--seconds", "8", "--calls", "3")
    assert findings["idle"]["status"] == "fail"
    assert findings["idle"]["values"]["penalty_s"] > 0.1
    assert "tcp_slow_start_after_idle" in findings["idle"]["remedy"]


def test_a_connection_that_is_forgotten_is_found(
    server: BackgroundServer, capsys: pytest.CaptureFixture[str]
) -> None:
    with relayed(server.target, forgets_s=1.0) as target:
        findings = examined(capsys, target, "--seconds", "6", "--calls", "3")
    assert findings["keep-alive"]["status"] == "fail"
    assert "firewall" in findings["keep-alive"]["remedy"]


def test_it_takes_no_longer_than_it_may(capsys: pytest.CaptureFixture[str]) -> None:
    """Short of time, it says what it left out."""
    with serving() as (target, _):
        began = time.monotonic()
        findings = examined(capsys, target, "--seconds", "1")
        took_s = time.monotonic() - began
    assert findings["idle"]["status"] == "skip"
    assert "--seconds 2" in findings["idle"]["remedy"]
    assert took_s < 10.0  # far from a limit that a busy machine could miss


def test_another_model_is_seen(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    edge = StubEdge(INFO)
    monkeypatch.setattr(doctor, "load_edge", lambda source: edge)
    with serving(StubService(other_model(fingerprint="beef"))) as (target, _):
        findings = examined(capsys, target, "--edge", "elsewhere", "--seconds", "1")
    assert findings["edge"]["status"] == "fail"
    assert "same checkpoint" in findings["edge"]["remedy"]


@pytest.mark.usefixtures("patient")
def test_a_server_that_goes_away_is_noticed(capsys: pytest.CaptureFixture[str]) -> None:
    class Fickle(StubService):
        asked = 0

        def GetModel(self, request: Any, context: Any) -> Any:
            self.asked += 1
            if self.asked > 3:
                context.abort(grpc.StatusCode.INTERNAL, "gone")
            return self.model

    with serving(Fickle()) as (target, _):
        findings = examined(capsys, target)
    assert "lost after 2 calls" in findings["round trip"]["found"]


def test_without_torch_it_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    findings = examined(capsys, REFUSED, "--connect-timeout-s", "1")
    assert "pip install 'comvla[edge]'" in findings["torch"]["remedy"]


@pytest.mark.parametrize(
    "arguments",
    [["nowhere"], [REFUSED, "--seconds", "0"], [REFUSED, "--seconds", "nan"]],
)
def test_what_cannot_run_has_status_2(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", *arguments]) == 2
    assert capsys.readouterr().err.startswith("comvla: expected")


# ---- each check by itself ---------------------------------------------------------------------


class Timed:
    """A transport whose calls take the time that a formula says; time is what it says, too."""

    def __init__(self, upload_s: Any = lambda size: 0.001, small_s: float = 0.001) -> None:
        self.now_s = 0.0
        self._upload_s = upload_s
        self._small_s = small_s
        self.uploads: list[int] = []

    def get_model(self, timeout_s: float) -> Any:
        self.now_s += self._small_s
        return None

    def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
        size = codec.wire_bytes(request.ByteSize())
        self.uploads.append(size)
        took_s = self._upload_s(size)
        self.now_s += min(took_s, timeout_s)
        raise fault("DEADLINE_EXCEEDED" if took_s > timeout_s else "FAILED_PRECONDITION")

    def close(self) -> None: ...


@pytest.fixture
def timed(monkeypatch: pytest.MonkeyPatch) -> Timed:
    transport = Timed()
    for module in ("probes", "goodput", "round_trips"):
        monkeypatch.setattr(
            f"comvla_client.diagnosis.{module}.time.perf_counter", lambda: transport.now_s
        )
    monkeypatch.setattr(
        silence.time, "sleep", lambda s: setattr(transport, "now_s", transport.now_s + s)
    )
    return transport


def allowance(timed: Timed, seconds: float = 15.0) -> Allowance:
    return Allowance(seconds, lambda: timed.now_s)


@pytest.mark.parametrize("bits_per_s", [200e3, 5e6, 80e6, 2e9])
def test_goodput_is_the_slope_whatever_a_call_costs(timed: Timed, bits_per_s: float) -> None:
    timed._upload_s = lambda size: 0.04 + 8 * size / bits_per_s
    finding, seen = goodput.goodput(timed, 0.04, 0, allowance(timed))
    assert seen is not None
    assert seen.bits_per_s == pytest.approx(bits_per_s, rel=0.3)
    assert finding.status == "ok"
    assert timed.now_s < 10.0


def test_goodput_keeps_to_the_cap_of_the_server(timed: Timed) -> None:
    goodput.goodput(timed, 0.001, 100 << 10, allowance(timed))
    assert max(timed.uploads) < 100 << 10


def test_full_packets_that_vanish_are_a_finding(timed: Timed) -> None:
    timed._upload_s = lambda size: 1e9
    finding, seen = goodput.goodput(timed, 0.01, 0, allowance(timed))
    assert seen is None
    assert finding.status == "fail"
    assert "ping -M do" in finding.remedy


def test_a_server_that_does_not_read_uploads_is_not_measured() -> None:
    class Busy(Timed):
        def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
            raise fault("RESOURCE_EXHAUSTED", "too many calls")

    finding, seen = goodput.goodput(Busy(), 0.01, 0, Allowance(5.0))
    assert (finding.status, seen) == ("skip", None)
    assert "too many calls" in finding.found


def test_time_that_the_robot_spends_on_itself_is_not_counted() -> None:
    now_s = [0.0]
    allowance = Allowance(10.0, lambda: now_s[0])
    now_s[0] = 1.0
    with allowance.paused():
        now_s[0] = 31.0
    now_s[0] = 33.0
    assert (allowance.elapsed_s(), allowance.left_s()) == (3.0, 7.0)


def test_median_p99_and_jitter_are_what_they_say() -> None:
    seen = round_trips.summary([0.010] * 50 + [0.012] * 49 + [0.200])
    assert (seen.median_s, seen.p99_s) == (0.011, 0.200)
    assert seen.jitter_s == pytest.approx((0.002 + 0.188) / 99)


def test_a_slow_way_is_told_from_an_unsteady_one(timed: Timed) -> None:
    slow, _ = round_trips.round_trips(
        timed, 3, other_model(control_period_s=1e-4), allowance(timed), 1.0
    )
    assert slow.status == "fail"
    assert "longer chunks" in slow.remedy
    steps = iter([0.001] * 20 + [0.5] + [0.001] * 100)
    timed.get_model = lambda timeout_s: setattr(  # type: ignore[method-assign]
        timed, "now_s", timed.now_s + next(steps)
    )
    unsteady, _ = round_trips.round_trips(
        timed, 50, other_model(control_period_s=0.05), allowance(timed), 1.0
    )
    assert unsteady.status == "fail"
    assert "now and then" in unsteady.remedy


def _answered(call_s: float = 0.010, server_s: float = 0.006, **hint: Any) -> server_checks.Queries:
    response = InferResponse(timings=ServerTimings(total_s=server_s), load=LoadHint(**hint))
    return server_checks.Queries(response, call_s, server_s, server_s - call_s)


def test_load_and_clock_judge_what_the_server_says() -> None:
    assert server_checks.load(_answered(utilization=0.4)).status == "ok"
    busy = server_checks.load(_answered(utilization=0.95, queue_depth=7, suggested_tokens=32))
    assert busy.status == "fail"
    assert "7 requests waiting, it would like 32 tokens" in busy.found
    assert server_checks.clock(_answered()).status == "ok"
    wrong = server_checks.clock(_answered(call_s=0.010, server_s=0.050))
    assert wrong.status == "fail"
    assert "40.0 ms more" in wrong.found


def test_queries_that_are_not_answered_say_why() -> None:
    class Picky(Timed):
        code = "INVALID_ARGUMENT"

        def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
            raise fault(self.code, "never heard of it")

    arguments = (INFO, "words", "int8", Allowance(5.0))
    finding, _ = server_checks.queries(Picky(), *arguments)
    assert finding.status == "skip"
    assert "--instruction" in finding.remedy
    Picky.code = "DEADLINE_EXCEEDED"
    finding, _ = server_checks.queries(Picky(), *arguments)
    assert finding.status == "fail"
    finding, _ = server_checks.queries(Picky(), INFO, "words", "int8", Allowance(0.0))
    assert finding.status == "skip"


def test_a_later_query_that_fails_leaves_the_first() -> None:
    class Once(Timed):
        def infer(self, request: InferRequest, timeout_s: float) -> InferResponse:
            if request.step:
                raise fault("UNAVAILABLE")
            return answer(request)

    finding, seen = server_checks.queries(Once(), INFO, "words", "int8", Allowance(5.0))
    assert finding.status == "ok"
    assert seen is not None


def test_tokens_of_a_goodput_are_those_that_fit_a_period() -> None:
    model = other_model(num_tokens=512, token_dim=96, tower_dims=(96,))
    seen = goodput.Goodput(bits_per_s=1e6, upload_bytes=1 << 16, upload_s=0.5)
    finding = tokens.by_goodput(seen, PAPER_LINK, model, "int8", claimed_db=-30.0)
    count = finding.values["token_budget"]
    fits = [
        8 * codec.request_wire_bytes(k, 96, "int8", proprio_dim=3, model_fingerprint="5eed")
        <= 1e6 * PAPER_LINK.period_s
        for k in (count, count + 1)
    ]
    assert fits == [True, False]
    assert finding.status == "ok"
    promised = tokens.by_goodput(seen, PAPER_LINK, model, "int8", claimed_db=10.0)
    assert promised.status == "fail"
    assert "dB (GoodputSnr" in promised.remedy


def test_the_expected_period_adds_up_and_is_judged() -> None:
    seen = goodput.Goodput(bits_per_s=1e5, upload_bytes=1 << 16, upload_s=0.5)
    finding = tokens.expected_period(9, seen, 0.02, 0.01, PAPER_LINK, INFO, "int8")
    values = finding.values
    assert values["expected_s"] == pytest.approx(0.03 + values["transfer_s"])
    assert finding.status == "ok"
    many = tokens.expected_period(10**9, seen, 0.02, 0.01, PAPER_LINK, INFO, "int8")
    assert many.values["tokens"] == INFO.num_tokens
    assert many.status == "note"
    far = tokens.expected_period(9, seen, 3.0, 0.01, PAPER_LINK, INFO, "int8")
    assert far.status == "fail"


def test_only_a_setting_that_was_seen_to_cost_something_counts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name, value in (("tcp_slow_start_after_idle", "1"), ("tcp_congestion_control", "cubic")):
        (tmp_path / name).write_text(value)
    examine = machine.examine_tcp
    monkeypatch.setattr(machine, "examine_tcp", lambda: examine(tmp_path))
    path = reach.Path("127.0.0.1", "bbr", 1200, 1148)

    def found(idle_costs: bool) -> dict[str, Finding]:
        return {each.check: each for each in machine.machine(path, idle_costs)}

    assert found(False)["tcp_slow_start_after_idle"].status == "note"
    harmful = found(True)["tcp_slow_start_after_idle"]
    assert harmful.status == "fail"
    assert "sysctl -w" in harmful.remedy
    assert "use bbr" in found(True)["tcp_congestion_control"].found
    assert found(True)["mtu"].status == "note"


def test_the_kernel_tells_the_path() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        finding, path = reach.reach(f"127.0.0.1:{listening.getsockname()[1]}", 5.0)
    assert finding.ok
    assert path is not None
    assert path.local_address == "127.0.0.1"
    if path.mtu_bytes is None:
        pytest.skip("this system does not tell a path's MTU")
    assert path.segment_bytes is not None
    assert path.segment_bytes < path.mtu_bytes
    assert machine.interface_of("127.0.0.1") == "lo"
    assert machine.interface_of("203.0.113.7") is None
    assert machine.interface_of("::1") is None


class Card:
    """A Wi-Fi card named wlan0."""

    saves: bool | Exception | None = True

    def interfaces(self) -> list[Interface]:
        return [Interface("wlan0", 7, 2, None)]

    def power_save(self, interface: Interface) -> bool | None:
        if isinstance(self.saves, Exception):
            raise self.saves
        return self.saves

    def close(self) -> None: ...


def test_a_wifi_card_that_sleeps_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "wlan0" / "phy80211").mkdir(parents=True)
    (tmp_path / "eth0").mkdir()
    monkeypatch.setattr(machine, "NET_FOLDER", tmp_path)
    monkeypatch.setattr(machine, "Nl80211", Card)
    asleep = machine.wifi("wlan0")
    assert asleep.status == "fail"
    assert "iw dev wlan0 set power_save off" in asleep.remedy
    for saves, status in ((False, "ok"), (None, "ok"), (RuntimeError("no"), "skip")):
        monkeypatch.setattr(Card, "saves", saves)
        assert machine.wifi("wlan0").status == status
    assert machine.wifi("eth0").status == "ok"
    assert machine.wifi(None).status == "skip"


def test_a_real_server_reads_uploads_whole_and_refuses_them(server: BackgroundServer) -> None:
    transport = GrpcTransport(server.target)
    try:
        assert upload_s(transport, upload_request(300_000), 20.0) > 0.0
    finally:
        transport.close()
