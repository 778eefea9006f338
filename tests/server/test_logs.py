"""Log lines: one event each, whatever a client sends."""

from __future__ import annotations

import io
import json
import logging

import pytest

from comvla_server import logs
from comvla_server.log_throttle import LogThrottle

EVIL = "a\nERROR forged \x1b[31m\u2028line"


def test_json_lines_carry_the_event_and_its_fields() -> None:
    stream = io.StringIO()
    logs.configure("json", "info", stream)
    logging.getLogger("comvla_server.x").info("refused: %s", EVIL, extra={"step": 3})
    logging.getLogger("comvla_server.x").debug("not shown")
    (line,) = stream.getvalue().splitlines()
    event = json.loads(line)
    assert event["message"] == f"refused: {EVIL}"
    assert (event["level"], event["logger"], event["step"]) == ("info", "comvla_server.x", 3)
    assert event["time"].endswith("Z")


def test_plain_lines_cannot_be_forged() -> None:
    stream = io.StringIO()
    logs.configure("plain", "info", stream)
    logging.getLogger("comvla_server.x").warning("refused: %s", EVIL, extra={"session": EVIL})
    (line,) = stream.getvalue().splitlines()
    assert line.isprintable()
    assert r"a\nERROR forged \x1b[31m\u2028line" in line
    assert "session=" in line


@pytest.mark.parametrize("log_format", logs.FORMATS)
def test_the_server_s_own_failures_come_with_a_stack_trace(log_format: str) -> None:
    stream = io.StringIO()
    logs.configure(log_format, "info", stream)
    try:
        raise ValueError("broken")
    except ValueError:
        logging.getLogger("comvla_server.x").exception("failed")
    assert "Traceback" in stream.getvalue()
    assert "ValueError: broken" in stream.getvalue()


def test_a_flood_of_refusals_is_one_line_a_second_and_counted() -> None:
    now_s = [0.0]
    throttle = LogThrottle(lambda: now_s[0], interval_s=1.0)
    assert throttle.allow("invalid") == 0
    assert [throttle.allow("invalid") for _ in range(5)] == [None] * 5
    assert throttle.allow("overload") == 0
    now_s[0] = 1.0
    assert throttle.allow("invalid") == 5
    now_s[0] = 2.0
    assert throttle.allow("invalid") == 0
