"""The settings as options of a command."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from typing import Any

from comvla_server.setting_fields import SettingField, fields_of
from comvla_server.settings import ServerSettings
from comvla_server.settings_sources import CONFIG_VARIABLE, InForce, resolve


def add_flags(parser: argparse.ArgumentParser) -> None:
    """One option for each setting, in groups, and ``--config``."""
    parser.add_argument(
        "--config",
        metavar="FILE",
        help=f"settings in TOML, e.g. max_batch = 8; or name the file in {CONFIG_VARIABLE}",
    )
    groups: dict[str, Any] = {}
    for field in fields_of(ServerSettings).values():
        title = field.declared.group
        if title not in groups:
            groups[title] = parser.add_argument_group(title)
        _add_flag(groups[title], field)


def settings_of(
    arguments: argparse.Namespace, environment: Mapping[str, str] | None = None
) -> InForce:
    """The settings in force for parsed arguments.

    Args:
        arguments: of a parser that :func:`add_flags` has seen.
        environment: variables of the process where None.

    Raises:
        SettingsError: a value or a name that is no good, or a contradiction.
    """
    fields = fields_of(ServerSettings)
    given = {
        name: _joined(fields[name], value)
        for name, value in vars(arguments).items()
        if name in fields
    }
    return resolve(given, os.environ if environment is None else environment, arguments.config)


def _joined(field: SettingField, value: Any) -> Any:
    join = field.declared.join
    return join(value) if join is not None and isinstance(value, list) else value


def _add_flag(group: Any, field: SettingField) -> None:
    declared, default = field.declared, field.serve_default
    words = declared.words.replace("%", "%%")
    if field.kind is bool:
        group.add_argument(
            field.flag,
            action=argparse.BooleanOptionalAction,
            default=argparse.SUPPRESS,
            help=words,
        )
        return
    shown = words if default is None else f"{words} (default: {_text(default)})"
    group.add_argument(
        field.flag,
        # Text, so that flags, variables and files are read and refused by the same code.
        type=str,
        action="store" if declared.join is None else "append",
        choices=declared.choices or None,
        default=argparse.SUPPRESS,
        metavar=None if declared.choices else _metavar(field),
        help=shown,
    )


def _metavar(field: SettingField) -> str:
    if field.declared.metavar is not None:
        return field.declared.metavar
    if field.declared.path:
        return "FILE"
    if field.kind is float:
        return "SECONDS" if field.declared.unit == "seconds" else "X"
    return "N" if field.kind in (int, int | None) else field.name.rpartition("_")[2].upper()


def _text(default: object) -> str:
    return f"{default:g}" if isinstance(default, float) else str(default)
