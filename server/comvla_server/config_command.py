"""``comvla-server config``: what is in force, and where each value came from."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

from comvla_server.settings_flags import add_flags, settings_of
from comvla_server.settings_sources import InForce
from comvla_server.tokens import masked

_DESCRIPTION = """\
Print every setting of the server, and why it is what it is. Takes the options of `serve`, and
starts nothing. Flags win over the environment (COMVLA_MAX_BATCH=4), that over the file that
--config or COMVLA_CONFIG names, that over the defaults.

The file is TOML, one setting a line: max_batch = 4. Paths in it are relative to its folder.
Settings that contradict one another are told here as they are by `serve`, with exit code 2.
"""


def add_parser(subparsers: Any) -> None:
    """Registers the subcommand."""
    parser = subparsers.add_parser(
        "config",
        help="print the settings in force, and why",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    add_flags(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Prints the settings.

    Raises:
        SettingsError: a value or a name that is no good, or a contradiction.
    """
    in_force = settings_of(args)
    rows = describe(in_force)
    if args.json:
        print(json.dumps({"settings": rows}))
        return 0
    widest = max(len(str(row["value"])) for row in rows.values())
    for name, row in rows.items():
        value = "-" if row["value"] is None else row["value"]
        print(f"{name:26} {value!s:{min(widest, 48)}}  {in_force.origins[name]}")
    return 0


def describe(in_force: InForce) -> dict[str, dict[str, Any]]:
    """Value and origin of each setting, ready for JSON. No secret is ever shown.

    Settings hold the names of files with secrets, not secrets; one that was given in place of a
    file's name is masked.
    """
    return {
        name: {"value": _plain(value), **dataclasses.asdict(in_force.origins[name])}
        for name, value in vars(in_force.settings).items()
    }


def _plain(value: object) -> Any:
    if isinstance(value, (str, Path)):
        return masked(str(value))
    return list(value) if isinstance(value, tuple) else value
