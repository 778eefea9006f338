"""ModemManager's part of D-Bus that matters here, served on a bus of its own by a real dbus-daemon."""

from __future__ import annotations

import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

SERVICE = "org.freedesktop.ModemManager1"
MODEM_PATH = "/org/freedesktop/ModemManager1/Modem/0"
UNKNOWN_OBJECT = "org.freedesktop.DBus.Error.UnknownObject"


@contextmanager
def bus(folder: Path) -> Iterator[str]:
    """A message bus; gives its address."""
    program = shutil.which("dbus-daemon")
    if program is None:
        pytest.skip("needs dbus-daemon: apt-get install dbus-daemon")
    address = f"unix:path={folder}/bus"
    daemon = subprocess.Popen(
        [
            program,
            "--session",
            "--nofork",
            "--nopidfile",
            f"--address={address}",
            "--print-address",
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert daemon.stdout is not None
        assert daemon.stdout.readline().startswith("unix:"), "dbus-daemon did not start"
        yield address
    finally:
        daemon.terminate()
        daemon.wait(10)
        assert daemon.stdout is not None
        daemon.stdout.close()


class FakeModemManager:
    """Owns the service's name on a bus and answers for one modem.

    Attributes:
        signals: what the Signal interface shows, by technology.
        state: ``MMModemState``.
        present: whether there is a modem.
        rates: what Setup was called with.
        refuse: name of the D-Bus error with which Setup is refused; None accepts.
    """

    def __init__(self, address: str) -> None:
        from jeepney import message_bus
        from jeepney.io.blocking import Proxy, open_dbus_connection

        self.signals: dict[str, dict[str, float]] = {"Lte": {"snr": 12.0, "rsrp": -95.0}}
        self.state = 11
        self.present = True
        self.rates: list[int] = []
        self.refuse: str | None = None
        self._stop = threading.Event()
        self._connection = open_dbus_connection(address)
        assert Proxy(message_bus, self._connection).RequestName(SERVICE) == (1,)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(10)
        self._connection.close()

    def __enter__(self) -> FakeModemManager:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve(self) -> None:
        from jeepney import HeaderFields, MessageType, new_error, new_method_return

        while not self._stop.is_set():
            try:
                message = self._connection.receive(timeout=0.02)
            except TimeoutError:
                continue
            if message.header.message_type is not MessageType.method_call:
                continue
            fields = message.header.fields
            try:
                signature, body = self._answer(
                    fields[HeaderFields.path], fields[HeaderFields.member], message.body
                )
            except LookupError as error:
                reply = new_error(message, str(error.args[0]), "s", ("as scripted",))
            else:
                reply = new_method_return(message, signature, body)
            self._connection.send(reply)

    def _answer(self, path: str, method: str, body: tuple[Any, ...]) -> tuple[str, tuple[Any, ...]]:
        if method == "GetManagedObjects":
            interfaces: dict[str, dict[str, Any]] = {
                f"{SERVICE}.Modem": {"State": ("i", self.state)},
                f"{SERVICE}.Modem.Signal": self._properties(),
            }
            return "a{oa{sa{sv}}}", ({MODEM_PATH: interfaces} if self.present else {},)
        if path != MODEM_PATH or not self.present:
            raise LookupError(UNKNOWN_OBJECT)
        if method == "Setup":
            if self.refuse is not None:
                raise LookupError(self.refuse)
            self.rates.append(body[0])
            return "", ()
        if method == "GetAll":
            return "a{sv}", (self._properties(),)
        assert method == "Get"
        return "v", (("i", self.state),)

    def _properties(self) -> dict[str, Any]:
        shown: dict[str, Any] = {"Rate": ("u", self.rates[-1] if self.rates else 0)}
        for technology in ("Cdma", "Evdo", "Gsm", "Umts", "Lte", "Nr5g"):
            values = self.signals.get(technology, {}) if self.rates else {}
            shown[technology] = ("a{sv}", {key: ("d", value) for key, value in values.items()})
        return shown
