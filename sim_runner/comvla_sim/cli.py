"""``comvla-sim``: worlds, training, evaluation, demo and benchmarks on the command line.

Each subcommand is a module with ``add_parser(subparsers)`` and ``run(args) -> int``; what is heavy
is imported inside ``run``.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from comvla.errors import ComVLAError, DependencyError

COMMANDS = {
    "demo": "comvla_sim.demo.command",
    "eval": "comvla_sim.experiments.command",
    "train": "comvla_sim.training.command",
    "report": "comvla_sim.report.command",
    "figure": "comvla_sim.figures.command",
    "paper": "comvla_sim.paper.command",
    "psnr": "comvla_sim.codecs.psnr_command",
    "bench": "comvla_sim.bench.command",
    "link": "comvla_sim.netlink.command",
    "libero": "comvla_sim.worlds.libero.command",
}
"""Subcommand to module."""

USAGE_ERROR = 2


def build_parser(command: str | None = None) -> argparse.ArgumentParser:
    """The parser.

    Args:
        command: load this subcommand only, so that no other can be in its way; None loads all.

    Raises:
        DependencyError: a subcommand's module cannot be imported.
    """
    parser = argparse.ArgumentParser(
        prog="comvla-sim",
        description="Simulated robots driven by a split policy over a simulated radio link.",
    )
    parser.add_argument("--version", action="store_true", help="print the version and leave")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")
    for name in COMMANDS if command is None else (command,):
        try:
            module = importlib.import_module(COMMANDS[name])
        except ImportError as error:
            raise DependencyError(
                f"comvla-sim {name} cannot be loaded ({error}): pip install 'comvla[sim]'"
            ) from error
        module.add_parser(subparsers)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one subcommand.

    Args:
        argv: arguments without the program's name; None takes those of the process.

    Returns:
        The subcommand's exit code; 2 where the input made no sense; 130 after Ctrl-C.
    """
    arguments = sys.argv[1:] if argv is None else list(argv)
    named = arguments[0] if arguments and arguments[0] in COMMANDS else None
    try:
        parser = build_parser(named)
        args = parser.parse_args(arguments)
        if args.version:
            from importlib.metadata import version

            print(f"comvla {version('comvla')}")
            return 0
        if args.command is None:
            parser.print_help()
            return USAGE_ERROR
        return int(args.run(args))
    except ComVLAError as error:
        print(f"comvla-sim: {error}", file=sys.stderr)
        return USAGE_ERROR
    except ModuleNotFoundError as error:
        print(f"comvla-sim: {error.name} is missing: pip install 'comvla[sim]'", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        return 1  # the reader of a pipe left, e.g. `| head`


if __name__ == "__main__":
    sys.exit(main())
