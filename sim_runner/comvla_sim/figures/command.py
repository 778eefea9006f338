"""``comvla-sim figure``: one subcommand for each figure, each a module with ``add_parser``."""

from __future__ import annotations

import argparse
import importlib

FIGURES = {"psnr": "comvla_sim.figures.psnr"}
"""Name of a figure to the module that registers it."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers the subcommand and all figures."""
    parser = subparsers.add_parser("figure", help="draw a figure, measuring what it needs")
    figures = parser.add_subparsers(metavar="NAME", title="figures", required=True)
    for module in FIGURES.values():
        importlib.import_module(module).add_parser(figures)
