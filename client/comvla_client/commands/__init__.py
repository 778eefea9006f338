"""Subcommands of ``comvla``: each module has ``add_parser(subparsers)`` and ``run(arguments)``."""
