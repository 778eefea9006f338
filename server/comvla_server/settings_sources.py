"""Where settings come from: flags over environment over a TOML file over defaults."""

from __future__ import annotations

import difflib
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter, ValidationError

from comvla_server.setting_fields import (
    ENVIRONMENT_PREFIX,
    SettingField,
    SettingsError,
    fields_of,
)
from comvla_server.settings import ServerSettings

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CONFIG_VARIABLE = ENVIRONMENT_PREFIX + "CONFIG"

# Variables of this project's other programs, which may share an environment with the server.
_OTHERS = ("COMVLA_LIBERO_", "COMVLA_GOLDEN", "COMVLA_PROTO_PYTHON")

# Kubernetes puts the address of every service into the environment of every container, and a service
# named comvla gets names that begin like this project's own.
_SERVICE_LINK = re.compile(
    r"COMVLA_(\w+_)?(SERVICE_HOST|SERVICE_PORT(_\w+)?|PORT(_\d+_(TCP|UDP|SCTP)(_(PROTO|PORT|ADDR))?)?)"
)
_SERVICE_URL = re.compile(r"(tcp|udp|sctp)://")


@dataclass(frozen=True)
class Origin:
    """Where the value of a setting came from.

    Attributes:
        source: ``flag``, ``environment``, ``file`` or ``default``.
        where: the option, variable or file; empty for a default.
    """

    source: str
    where: str = ""

    def __str__(self) -> str:
        return f"{self.source} {self.where}".strip()


@dataclass(frozen=True)
class InForce:
    """Settings, and why they are what they are.

    Attributes:
        settings: checked.
        origins: for each setting, by name.
    """

    settings: ServerSettings
    origins: dict[str, Origin]


def resolve(
    flags: Mapping[str, str | bool], environment: Mapping[str, str], config: str | None = None
) -> InForce:
    """Puts the sources on top of one another.

    Args:
        flags: settings by name, as typed on the command line.
        environment: variables of the process.
        config: TOML file; where None, ``COMVLA_CONFIG`` names one or there is none.

    Raises:
        SettingsError: a name that no setting has, a value that cannot be read, or a contradiction.
    """
    fields = fields_of(ServerSettings)
    values = {name: field.serve_default for name, field in fields.items()}
    origins = {name: Origin("default") for name in fields}
    path = config or environment.get(CONFIG_VARIABLE)
    layers = (
        _from_file(Path(path), fields) if path else {},
        _from_environment(environment, fields),
        {
            name: (_read(fields[name], value, fields[name].flag), Origin("flag", fields[name].flag))
            for name, value in flags.items()
        },
    )
    for layer in layers:
        for name, (value, origin) in layer.items():
            values[name], origins[name] = value, origin
    return InForce(ServerSettings(**values), origins)


def _from_file(path: Path, fields: Mapping[str, SettingField]) -> dict[str, tuple[Any, Origin]]:
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(
            f"cannot read the configuration file {path}: {error}; correct --config"
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(
            f"{path} is not TOML: {error}; a line looks like max_batch = 8"
        ) from error
    origin = Origin("file", str(path))
    layer = {}
    for name, value in content.items():
        if name not in fields:
            raise _unknown(name, f"in {path}", fields)
        where = f"{name} in {path}"
        field = fields[name]
        if isinstance(value, str):
            value = _read(field, value, where)
            if isinstance(value, Path):
                value = path.parent / value  # secrets lie beside the file that names them
        else:
            value = _strict(field, value, where)
        layer[name] = (value, origin)
    return layer


def _from_environment(
    environment: Mapping[str, str], fields: Mapping[str, SettingField]
) -> dict[str, tuple[Any, Origin]]:
    by_variable = {field.variable: field for field in fields.values()}
    layer = {}
    for variable in sorted(environment):
        if not variable.startswith(ENVIRONMENT_PREFIX) or variable == CONFIG_VARIABLE:
            continue
        field, value = by_variable.get(variable), environment[variable]
        if field is not None and _SERVICE_LINK.fullmatch(variable) and _SERVICE_URL.match(value):
            raise SettingsError(
                f"{variable} is {value}, which Kubernetes wrote for a service named comvla: set "
                "enableServiceLinks: false for the pod, or name the service otherwise"
            )
        if field is not None:
            layer[field.name] = (_read(field, value, variable), Origin("environment", variable))
        elif not variable.startswith(_OTHERS) and not _SERVICE_LINK.fullmatch(variable):
            raise _unknown(variable, "in the environment", by_variable)
    return layer


def _unknown(name: str, where: str, known: Iterable[str]) -> SettingsError:
    # The value stays unsaid: it may be a secret that was put into the wrong place.
    close = difflib.get_close_matches(name, list(known), n=1)
    remedy = f"did you mean {close[0]}?" if close else "`comvla-server config` lists what there is"
    return SettingsError(f"no setting is called {name} ({where}): {remedy}")


def _read(field: SettingField, value: str | bool, where: str) -> Any:
    """A value that was given as text."""
    if isinstance(value, str) and field.declared.parse is not None:
        try:
            return field.declared.parse(value)
        except ValueError as error:
            raise _unreadable(field, value, where) from error
    try:
        return _adapter(field, strict=False).validate_python(value)
    except ValidationError as error:
        raise _unreadable(field, value, where) from error


def _strict(field: SettingField, value: object, where: str) -> Any:
    """A value that came with a type of its own: 1 is not true, and 8.0 not 8."""
    if field.declared.join is not None and isinstance(value, list):
        return _read(field, field.declared.join(list(map(str, value))), where)
    if field.declared.parse is not None and isinstance(value, list):
        return _read(field, ",".join(map(str, value)), where)
    try:
        return _adapter(field, strict=True).validate_python(value)
    except ValidationError as error:
        raise _unreadable(field, value, where) from error


def _adapter(field: SettingField, strict: bool) -> TypeAdapter[Any]:
    return TypeAdapter(field.kind, config=ConfigDict(strict=strict))


def _unreadable(field: SettingField, value: object, where: str) -> SettingsError:
    kinds = {bool: "true or false", int: "a whole number", float: "a number"}
    kind = next(
        (words for known, words in kinds.items() if field.kind in (known, known | None)), ""
    )
    expected = kind or f"text like {field.declared.metavar or field.name.upper()}"
    return SettingsError(f"{where} must be {expected}, got {value!r}: {field.declared.words}")
