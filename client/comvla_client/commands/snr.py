"""``comvla snr``: what this robot's radio says of its link, live."""

from __future__ import annotations

import argparse
import json
import math
import time
from typing import Any

from comvla.number_arguments import whole
from comvla_client.commands.arguments import Subparsers, add_link, link_of
from comvla_client.commands.snr_arguments import add_source, opened
from comvla_client.errors import SnrSourceError
from comvla_client.snr import SnrReading, SnrSource

_DESCRIPTION = """\
Prints the SNR that a source reports, again and again, until Ctrl-C: walk about with the robot and
see what its radio sees. With --json, one object a line.

  comvla snr wifi                  the first associated Wi-Fi interface (pip install 'comvla[wifi]')
  comvla snr wifi:wlan1            a certain one
  comvla snr modem                 LTE or 5G through ModemManager (pip install 'comvla[modem]')
  comvla snr trace:walk.csv        a recording, in real time
"""


def add_parser(subparsers: Subparsers) -> argparse.ArgumentParser:
    """Adds ``snr`` to the commands."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "snr",
        help="print what a radio reports, live",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_source(parser)
    parser.add_argument(
        "--interval-s",
        type=float,
        default=0.5,
        metavar="S",
        help="seconds between lines (default: %(default)s)",
    )
    parser.add_argument("--count", type=whole(0), metavar="N", help="stop after so many lines")
    parser.add_argument("--json", action="store_true", help="print one JSON object a line")
    add_link(parser)
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Prints readings. 0 at the end of ``--count`` or by Ctrl-C."""
    if not (math.isfinite(arguments.interval_s) and arguments.interval_s >= 0.0):
        raise SnrSourceError(f"expected --interval-s >= 0 in seconds, got {arguments.interval_s}")
    link = link_of(arguments)
    with opened(arguments.source, arguments.snr_db) as source:
        began_s = time.monotonic()
        printed = 0
        try:
            while arguments.count is None or printed < arguments.count:
                if printed:
                    time.sleep(arguments.interval_s)
                row = _row(source, time.monotonic() - began_s)
                row["capacity_bits"] = round(link.capacity_bits(float(row["snr_db"])), 1)
                print(json.dumps(row) if arguments.json else _line(row), flush=True)
                printed += 1
        except (KeyboardInterrupt, BrokenPipeError):  # how a live display is ended
            pass
    return 0


def _row(source: SnrSource, elapsed_s: float) -> dict[str, Any]:
    reading: SnrReading = source.read()
    return {
        "time_s": round(elapsed_s, 3),
        # JSON has no infinity.
        "snr_db": "-inf" if reading.snr_db == -math.inf else round(reading.snr_db, 2),
        "age_s": round(reading.age_s, 3),
        "std_db": reading.std_db,
        "details": getattr(source, "details", {}),
        "problem": getattr(source, "problem", None),
    }


def _line(row: dict[str, Any]) -> str:
    words = [
        f"{row['time_s']:8.1f} s  {float(row['snr_db']):7.1f} dB  {1e3 * row['age_s']:6.0f} ms old",
        f"{row['capacity_bits'] / 8e3:7.1f} kB a period",
    ]
    words += [f"{name} {value}" for name, value in row["details"].items() if _is_plain(value)]
    for name, values in row["details"].get("signals", {}).items():
        words += [f"{name} {key} {value:g}" for key, value in values.items()]
    if row["problem"]:
        words.append(f"NO NEW READING: {row['problem']}")
    return "  ".join(words)


def _is_plain(value: object) -> bool:
    return isinstance(value, str | int | float)
