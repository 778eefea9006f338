"""Settings refuse what cannot work, when they are made."""

from __future__ import annotations

from typing import Any

import pytest

from comvla.errors import ComVLAError
from comvla_server.settings import ServerSettings, SettingsError


def test_a_server_listens_on_this_machine_only_unless_told_otherwise() -> None:
    assert ServerSettings().host == "127.0.0.1"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"host": ""}, "host must be an address"),
        ({"host": "127.0.0.1\n"}, "host must be an address"),
        ({"port": 65536}, "port must be a whole number from 0 to 65535, got 65536"),
        ({"admin_port": -1}, "admin_port must be a whole number"),
        ({"port": 5000, "admin_port": 5000}, "are both 5000"),
        ({"max_batch": 0}, "max_batch must be a whole number from 1"),
        ({"max_batch": 2.0}, "got 2.0"),
        ({"max_batch": True}, "got True"),
        ({"max_queue": 0}, "max_queue must be"),
        ({"max_sessions": 71}, "max_sessions must be a whole number from 72"),
        ({"max_request_bytes": 10}, "max_request_bytes must be"),
        ({"max_concurrent_calls": 0}, "max_concurrent_calls must be"),
        ({"default_deadline_s": 0.0}, "above 0"),
        ({"default_deadline_s": float("inf")}, "finite number of seconds"),
        ({"grace_s": -1.0}, "at least 0"),
        ({"grace_s": float("nan")}, "finite number of seconds"),
    ],
)
def test_nonsense_is_refused_with_the_range(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingsError, match=words) as caught:
        ServerSettings(**changes)
    assert isinstance(caught.value, ComVLAError)


def test_no_grace_is_a_choice() -> None:
    assert ServerSettings(grace_s=0.0).grace_s == 0.0
