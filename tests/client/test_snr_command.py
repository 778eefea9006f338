"""``comvla snr`` and ``--snr-source``: which source is meant, and what is printed of it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from client_stubs import StubEdge, serving
from waiting import until

from comvla_client.cli import main
from comvla_client.commands import snr as snr_command
from comvla_client.commands import snr_arguments
from comvla_client.commands import step as step_command
from comvla_client.snr.polled import Measurement, PolledSource

DEADLINE = ("--deadline-s", "20")  # one that a busy machine can keep


class Radio(PolledSource):
    """A device that hears 17 dB once, and then nothing more."""

    opened_with: ClassVar[list[Any]] = []
    last: ClassVar[Radio]
    closed = False

    def __init__(self, which: str | None = None) -> None:
        super().__init__(0.001, start_timeout_s=60.0)
        Radio.opened_with.append(which)
        Radio.last = self
        self._start()

    def _measure(self) -> Measurement:
        if self._latest is not None:
            raise OSError("the antenna fell off")
        signals = {"Lte": {"snr": 17.0, "rsrp": -95.0}}
        return Measurement(17.0, details={"state": "registered", "signals": signals})

    def _release(self) -> None:
        Radio.closed = True


@pytest.fixture
def radio(monkeypatch: pytest.MonkeyPatch) -> type[Radio]:
    Radio.opened_with, Radio.closed = [], False
    monkeypatch.setattr(snr_arguments, "ModemManagerSnr", Radio)
    monkeypatch.setattr(snr_arguments, "WifiSnr", Radio)
    return Radio


def test_readings_are_printed_as_json_lines(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = tmp_path / "t.csv"
    trace.write_text("-inf\n")
    arguments = [f"trace:{trace}", "--count", "2", "--interval-s", "0", "--json"]
    assert main(["snr", *arguments]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(rows) == 2
    assert rows[0]["snr_db"] == "-inf"
    assert rows[0]["capacity_bits"] == 0.0


def test_a_radio_is_shown_with_what_is_behind_its_reading_and_what_is_wrong(
    radio: type[Radio], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    paused_s: list[float] = []

    def pause(seconds: float) -> None:
        paused_s.append(seconds)
        until(lambda: radio.last.problem is not None)

    clock = SimpleNamespace(monotonic=time.monotonic, sleep=pause)
    monkeypatch.setattr(snr_command, "time", clock)
    assert main(["snr", "modem:3", "--count", "3", "--interval-s", "0.05"]) == 0
    assert paused_s == [0.05, 0.05]
    assert radio.opened_with == ["3"]
    assert radio.closed
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    for words in ("17.0 dB", "ms old", "state registered", "Lte rsrp -95", "the antenna fell off"):
        assert words in lines[-1]


def test_wifi_is_what_is_shown_when_nothing_is_said(
    radio: type[Radio], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["snr", "--count", "1"]) == 0
    assert main(["snr", "wifi:wlan1", "--count", "1"]) == 0
    assert radio.opened_with == [None, "wlan1"]


@pytest.mark.parametrize("source", ["radar", "trace", "trace:", "constant:much", "modems:1"])
def test_an_unknown_source_is_told_what_there_is(
    source: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ending:
        main(["snr", source])
    assert ending.value.code == 2
    assert "expected constant[:DB], wifi[:INTERFACE]" in capsys.readouterr().err


def test_mistakes_have_status_2_and_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, words in (
        ([f"trace:{tmp_path}/none.csv"], "none.csv"),
        (["constant:nan"], "nan"),
        (["constant", "--interval-s", "-1"], "--interval-s"),
        (["constant", "--efficiency", "2"], "efficiency"),
    ):
        assert main(["snr", *arguments, "--count", "1"]) == 2
        error = capsys.readouterr().err
        assert error.startswith("comvla: ")
        assert words in error


def test_ctrl_c_ends_the_display_quietly() -> None:
    command = [sys.executable, "-m", "comvla_client", "snr", "constant:3", "--interval-s", "60"]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # As from a terminal: whoever runs the tests in the background has Ctrl-C ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as display:
        assert display.stdout is not None
        assert display.stderr is not None
        assert "3.0 dB" in display.stdout.readline()
        display.send_signal(signal.SIGINT)
        assert display.wait(20) == 0
        assert display.stderr.read() == ""


@pytest.mark.usefixtures("patient")
def test_a_step_is_sized_by_the_source_that_was_chosen(
    radio: type[Radio], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(step_command, "load_edge", lambda source: StubEdge())
    with serving() as (target, service):
        assert main(["step", target, "--snr-source", "wifi", "--json", *DEADLINE]) == 0
        assert service.requests[0].snr_db == 17.0
        assert radio.closed
        report = json.loads(capsys.readouterr().out)["report"]
        assert report["snr_db"] == 17.0
        assert main(["step", target, "--snr-source", "constant:4", *DEADLINE]) == 0
        assert main(["step", target, "--snr-db", "5", *DEADLINE]) == 0
    assert [request.snr_db for request in service.requests[1:]] == [4.0, 5.0]
