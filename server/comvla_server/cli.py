"""``comvla-server``: one module per subcommand, each with ``add_parser`` and ``run``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from comvla.errors import ComVLAError
from comvla_server import (
    config_command,
    inspect_command,
    ray_command,
    serve_command,
    split_command,
    swap_command,
    token_command,
)
from comvla_server.version import server_version

_DESCRIPTION = """\
The cloud half of a split Vision-Language-Action policy, as a gRPC service.

Robots send the visual tokens that their instruction voted for; the server finishes
the forward pass for many robots at once and answers with chunks of actions.
"""

_EPILOG = """\
examples:
  comvla-server serve --model mini              the shipped policy, on this machine only
  comvla-server serve --port 0 --admin-port 0   free ports; the ready line names them
  comvla-server config --max-batch 4            every setting in force, and where it came from
  comvla-server token new arm-7 --file tokens   a token for the robot arm-7
  comvla-server inspect mini                    what a checkpoint is and what a step costs
  comvla-server swap /models/next --token-file T  another checkpoint, without a failed call
  comvla-server split SRC DST --check           halves of a published checkpoint
  curl http://127.0.0.1:8080/metrics            what Prometheus scrapes

exit codes: 0 done, 1 calls were cut off or something broke, 2 a wrong setting, file, model or port
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser with every subcommand."""
    parser = argparse.ArgumentParser(
        prog="comvla-server",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"comvla {server_version()}")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    serve_command.add_parser(subparsers)
    config_command.add_parser(subparsers)
    ray_command.add_parser(subparsers)
    token_command.add_parser(subparsers)
    inspect_command.add_parser(subparsers)
    split_command.add_parser(subparsers)
    swap_command.add_parser(subparsers)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one subcommand and returns the exit code."""
    args = build_parser().parse_args(argv)
    try:
        return int(args.run(args))
    except ComVLAError as error:
        print(f"comvla-server: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
