"""How one setting is declared: its default, its words, and what it may be.

The declaration serves everything that speaks of settings: checks, flags, environment variables,
configuration files and ``comvla-server config``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar, get_type_hints

from comvla.errors import ComVLAError

T = TypeVar("T")

ENVIRONMENT_PREFIX = "COMVLA_"

_KEY = "comvla"


class SettingsError(ComVLAError, ValueError):
    """A server setting that makes no sense; the message names the range and the remedy."""


@dataclass(frozen=True)
class Declaration:
    """What is known of a setting beside its name and type.

    Attributes:
        words: what it does, for people.
        group: heading under which ``--help`` shows it.
        metavar: stand-in for the value in ``--help``.
        choices: the only values allowed, empty for any.
        low: least number allowed.
        high: greatest number allowed.
        above_zero: whether 0 is refused where numbers have to be finite and not negative.
        unit: of a number that may be fractional, for messages.
        hint: remedy for a number out of range.
        path: whether it names a file.
        serve_default: default of the command line where it differs from the one in code.
        parse: text to value, where the type alone does not say how.
        join: makes one text of an option that may be given several times.
    """

    words: str
    group: str
    metavar: str | None = None
    choices: tuple[str, ...] = ()
    low: int = 0
    high: int = 2**31 - 1
    above_zero: bool = False
    unit: str = "seconds"
    hint: str = ""
    path: bool = False
    serve_default: Any = None
    parse: Callable[[str], Any] | None = None
    join: Callable[[list[str]], str] | None = None


@dataclass(frozen=True)
class SettingField:
    """One setting of a model of settings.

    Attributes:
        name: as in code and in configuration files.
        kind: its type, ``bool``, ``int``, ``float``, ``str``, ``Path``, or one of these or None.
        default: in code.
        declared: the rest.
    """

    name: str
    kind: Any
    default: Any
    declared: Declaration

    @property
    def flag(self) -> str:
        """Its option on the command line."""
        return "--" + self.name.replace("_", "-")

    @property
    def variable(self) -> str:
        """Its environment variable."""
        return ENVIRONMENT_PREFIX + self.name.upper()

    @property
    def serve_default(self) -> Any:
        """Its default on the command line."""
        given = self.declared.serve_default
        return self.default if given is None else given


def setting(default: T, words: str, group: str, **declared: Any) -> T:
    """A dataclass field that is a setting; see :class:`Declaration` for what can be declared."""
    metadata = {_KEY: Declaration(words, group, **declared)}
    field: T = dataclasses.field(default=default, metadata=metadata)
    return field


def fields_of(model: type) -> dict[str, SettingField]:
    """The settings of a model, by name, in the order of declaration."""
    kinds = get_type_hints(model)
    return {
        field.name: SettingField(field.name, kinds[field.name], field.default, declared)
        for field in dataclasses.fields(model)
        if (declared := field.metadata.get(_KEY)) is not None
    }


def check_value(field: SettingField, value: object) -> None:
    """Refuses what a setting alone can tell is wrong.

    Raises:
        SettingsError: another type, out of range, or not among the choices.
    """
    declared = field.declared
    if value is None and field.default is None:
        return
    if declared.choices and value not in declared.choices:
        raise SettingsError(
            f"{field.name} must be one of {', '.join(declared.choices)}, got {value!r}"
        )
    if field.kind is bool and not isinstance(value, bool):
        raise SettingsError(f"{field.name} must be true or false, got {value!r}")
    if field.kind in (int, int | None):
        _check_whole(field.name, value, declared.low, declared.high, declared.hint)
    if field.kind is float:
        _check_amount(field.name, value, declared)


def _check_whole(name: str, value: object, low: int, high: int, hint: str) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise SettingsError(
            f"{name} must be a whole number from {low} to {high}, got {value!r}"
            + (f": {hint}" if hint else "")
        )


def _check_amount(name: str, value: object, declared: Declaration) -> None:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if number and math.isfinite(value) and (value > 0 or (value == 0 and not declared.above_zero)):  # type: ignore[arg-type,operator]
        return
    least = "above 0" if declared.above_zero else "at least 0"
    raise SettingsError(
        f"{name} must be a finite number of {declared.unit} {least}, got {value!r}"
        + (f": {declared.hint}" if declared.hint else "")
    )
