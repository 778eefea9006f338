"""``comvla``: the robot's side on the command line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from comvla.errors import ComVLAError
from comvla_client.commands import doctor, snr, step

_DESCRIPTION = """\
The robot's side of ComVLA: look at a link and a server, or send one observation through them.

  comvla doctor 127.0.0.1:50051             is a server there, how far away, what fits the link?
  comvla step 127.0.0.1:50051 --snr-db 10   one synthetic observation through the shipped policy
  comvla snr wifi                           what this robot's radio reports, live

A server is started with `comvla-server serve --model mini`.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of all subcommands; each lives in its own module of ``comvla_client.commands``."""
    parser = argparse.ArgumentParser(
        prog="comvla",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    subparsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for command in (doctor, snr, step):
        command.add_parser(subparsers).set_defaults(run=command.run)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command.

    Args:
        argv: arguments without the program's name; None takes those of the process.

    Returns:
        0 when all is well, 1 when something was found wrong, 2 when the command could not run.
    """
    arguments = build_parser().parse_args(argv)
    try:
        return int(arguments.run(arguments))
    except ComVLAError as error:
        print(f"comvla: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
