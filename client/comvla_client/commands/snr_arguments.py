"""Choosing an SNR source on the command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TypeAlias

from comvla_client.snr import ConstantSnr, ModemManagerSnr, SnrSource, TraceSnr, WifiSnr

OpenSource: TypeAlias = "Callable[[], SnrSource]"
"""Makes the source that was asked for; devices are opened only when a command runs."""

FORMS = "constant[:DB], wifi[:INTERFACE], modem[:NUMBER] or trace:FILE"


_HELP = f"where the SNR comes from: {FORMS} (default: %(default)s)"


def add_snr_source(parser: argparse.ArgumentParser) -> None:
    """The option of a command that does something else and needs an SNR for it."""
    parser.add_argument(
        "--snr-source",
        type=snr_source,
        default="constant",
        metavar="SOURCE",
        help=f"{_HELP}; constant is --snr-db",
    )


def add_source(parser: argparse.ArgumentParser) -> None:
    """The argument of a command that is about the source."""
    parser.add_argument(
        "source", nargs="?", type=snr_source, default="wifi", metavar="SOURCE", help=_HELP
    )


def snr_source(text: str) -> OpenSource | None:
    """Reads ``kind`` or ``kind:what``.

    Returns:
        How to open it; None for ``constant`` without a number, which is ``--snr-db``.

    Raises:
        argparse.ArgumentTypeError: no such kind.
    """
    kind, _, what = text.partition(":")
    if kind == "constant" and not what:
        return None
    if kind == "constant":
        try:
            return partial(ConstantSnr, float(what))
        except ValueError:
            pass
    elif kind == "wifi":
        return partial(WifiSnr, what or None)
    elif kind == "modem":
        return partial(ModemManagerSnr, what or None)
    elif kind == "trace" and what:
        return partial(TraceSnr, what)
    raise argparse.ArgumentTypeError(f"expected {FORMS}, got {text!r}")


@contextmanager
def opened(source: OpenSource | None, snr_db: float) -> Iterator[SnrSource]:
    """The source while a command runs; closed afterwards.

    Args:
        source: what :func:`snr_source` gave.
        snr_db: the constant where it gave None.

    Raises:
        DependencyError, SnrSourceError, LinkError: there is none; the message says what to use instead.
    """
    made = ConstantSnr(snr_db) if source is None else source()
    try:
        yield made
    finally:
        close = getattr(made, "close", None)
        if close is not None:
            close()
