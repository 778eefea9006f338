"""ModemManager over D-Bus: which modems there are, and what they hear.

The interface is org.freedesktop.ModemManager1 as its reference manual describes it. Messages are
carried by jeepney.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from comvla.errors import DependencyError
from comvla_client.errors import SnrSourceError

SERVICE = "org.freedesktop.ModemManager1"
ROOT = "/org/freedesktop/ModemManager1"
MODEM = f"{SERVICE}.Modem"
SIGNAL = f"{SERVICE}.Modem.Signal"

REGISTERED = 8
"""``MM_MODEM_STATE_REGISTERED``: from this state on a modem has a network."""

CALL_TIMEOUT_S = 2.0

_GONE = (
    "org.freedesktop.DBus.Error.UnknownObject",
    "org.freedesktop.DBus.Error.UnknownMethod",
    "org.freedesktop.DBus.Error.UnknownInterface",
)
_NO_SERVICE = (
    "org.freedesktop.DBus.Error.ServiceUnknown",
    "org.freedesktop.DBus.Error.NameHasNoOwner",
)
_INSTEAD = "use GoodputSnr (measures what arrives, over any interface) or ConstantSnr"


class ModemGoneError(SnrSourceError):
    """The modem is no longer there, though ModemManager is."""


@dataclass(frozen=True)
class ModemState:
    """What a modem says of its radio.

    Attributes:
        state: ``MMModemState``; 8 and more mean registered with a network.
        rate_s: seconds between its measurements; 0 where nobody asked for any.
        signals: values in dB and dBm by technology: ``{"Lte": {"snr": 12.0, "rsrp": -95.0, ...}}``.
    """

    state: int
    rate_s: int
    signals: Mapping[str, Mapping[str, float]]


class ModemManager:
    """A connection to ModemManager.

    Args:
        bus: ``"SYSTEM"``, ``"SESSION"``, or the address of a bus.

    Raises:
        DependencyError: jeepney is not installed.
        SnrSourceError: no such bus.
    """

    def __init__(self, bus: str = "SYSTEM") -> None:
        try:
            from jeepney.io.blocking import open_dbus_connection
        except ImportError as error:
            raise DependencyError(
                "reading a modem needs jeepney: pip install 'comvla[modem]', or use GoodputSnr or "
                "ConstantSnr"
            ) from error
        try:
            self._connection = open_dbus_connection(bus)
        except (OSError, KeyError, RuntimeError, ValueError, StopIteration) as error:
            raise SnrSourceError(
                f"expected a D-Bus at {bus} to ask ModemManager, got {type(error).__name__}: "
                f"{error}; start dbus and ModemManager, or {_INSTEAD}"
            ) from error

    def modems(self) -> list[str]:
        """Object paths of all modems that can report their signal.

        Raises:
            SnrSourceError: ModemManager does not run.
        """
        (objects,) = self._call(ROOT, "org.freedesktop.DBus.ObjectManager", "GetManagedObjects")
        return sorted(path for path, interfaces in objects.items() if SIGNAL in interfaces)

    def set_up(self, modem: str, rate_s: int) -> None:
        """Asks a modem to measure its signal every ``rate_s`` seconds.

        Raises:
            SnrSourceError: it does not, or this user may not ask for it.
        """
        self._call(modem, SIGNAL, "Setup", "u", (rate_s,))

    def state(self, modem: str) -> ModemState:
        """What a modem heard last.

        Raises:
            ModemGoneError: it is no longer there.
            SnrSourceError: ModemManager does not answer.
        """
        signal = self._properties(modem, SIGNAL)
        (variant,) = self._call(
            modem, "org.freedesktop.DBus.Properties", "Get", "ss", (MODEM, "State")
        )
        return ModemState(
            state=int(variant[1]),
            rate_s=int(signal.get("Rate", 0)),
            signals={
                name: numbers
                for name, value in signal.items()
                if isinstance(value, dict) and (numbers := _numbers(value))
            },
        )

    def close(self) -> None:
        """Closes the connection."""
        self._connection.close()

    def _properties(self, path: str, interface: str) -> dict[str, Any]:
        (values,) = self._call(path, "org.freedesktop.DBus.Properties", "GetAll", "s", (interface,))
        return {name: variant[1] for name, variant in values.items()}

    def _call(
        self,
        path: str,
        interface: str,
        method: str,
        signature: str = "",
        body: tuple[Any, ...] = (),
    ) -> Any:
        from jeepney import DBusAddress, MessageType, new_method_call

        address = DBusAddress(path, bus_name=SERVICE, interface=interface)
        message = new_method_call(address, method, signature or None, body)
        try:
            reply = self._connection.send_and_get_reply(message, timeout=CALL_TIMEOUT_S)
        except TimeoutError as error:
            raise SnrSourceError(
                f"expected an answer of ModemManager to {method} within {CALL_TIMEOUT_S:g} s, got "
                f"none: restart it, or {_INSTEAD}"
            ) from error
        if reply.header.message_type is MessageType.error:
            raise _error(reply, method)
        return reply.body


def _error(reply: Any, method: str) -> SnrSourceError:
    from jeepney import HeaderFields

    name = str(reply.header.fields.get(HeaderFields.error_name))
    words = str(reply.body[0]) if reply.body else ""
    if name in _GONE:
        return ModemGoneError(f"the modem is gone ({name}: {words}): plug it in, or {_INSTEAD}")
    if name in _NO_SERVICE:
        return SnrSourceError(
            f"expected ModemManager on the bus, it does not run ({words}): start it with "
            f"`systemctl start ModemManager`, or {_INSTEAD}"
        )
    if name.endswith((".AccessDenied", ".Unauthorized")):
        return SnrSourceError(
            f"ModemManager does not let this user call {method} ({words}): allow the polkit action "
            f"org.freedesktop.ModemManager1.Device.Control, or {_INSTEAD}"
        )
    return SnrSourceError(f"ModemManager answered {method} with {name}: {words}; {_INSTEAD}")


def _numbers(variants: Mapping[str, Any]) -> dict[str, float]:
    """The values of one technology; those that a modem marks as unknown left out."""
    values = {key: variant[1] for key, variant in variants.items()}
    return {
        key: float(value)
        for key, value in values.items()
        # Unknown is left out, or some huge number, by version of ModemManager and modem.
        if isinstance(value, int | float) and math.isfinite(value) and abs(value) < 1000.0
    }
