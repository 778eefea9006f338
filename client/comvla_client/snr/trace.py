"""A recorded link, played back in real time."""

from __future__ import annotations

import bisect
import csv
import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from comvla.errors import LinkError
from comvla_client.snr.source import SnrReading

SNR_COLUMN = "snr_db"
TIME_COLUMNS = ("time_s", "time", "t")


@dataclass(frozen=True)
class Trace:
    """A recorded link.

    Attributes:
        times_s: seconds since the first reading, increasing.
        snr_db: SNR in dB of each; −inf means no link.
        length_s: when the recording ends: the last reading counts for as long as one usually does.
    """

    times_s: tuple[float, ...]
    snr_db: tuple[float, ...]
    length_s: float


def read_trace(path: str | Path, period_s: float = 0.05) -> Trace:
    """Reads a trace from a text file.

    One SNR in dB per line; or CSV with a header that has a column ``snr_db`` and, if it likes, one of
    ``time_s``, ``time`` or ``t`` in seconds; or two columns without a header: time, SNR. Empty lines
    and lines that start with ``#`` are skipped.

    Args:
        path: the file.
        period_s: seconds from one reading to the next where the file has no times.

    Raises:
        LinkError: a file that cannot be read or has no values; a value that is no SNR, or a time
            that is no number or not after the one before; the message names the line.
    """
    if not (math.isfinite(period_s) and period_s > 0.0):
        raise LinkError(f"expected a period_s > 0 in seconds, got {period_s!r}")
    path = Path(path)
    rows = _rows(path)
    time_column, snr_column = None, 0
    if rows:
        header = [cell.strip().lower() for cell in rows[0][1]]
        if SNR_COLUMN in header:
            snr_column = header.index(SNR_COLUMN)
            time_column = next((header.index(n) for n in TIME_COLUMNS if n in header), None)
            rows = rows[1:]
        elif len(header) == 2:
            time_column, snr_column = 0, 1
    if not rows:
        raise LinkError(f"the SNR trace {path} has no values: one SNR in dB per line, or time,SNR")
    values = tuple(_snr_db(path, number, cells, snr_column) for number, cells in rows)
    if time_column is None:
        times = tuple(i * period_s for i in range(len(values)))
        return Trace(times, values, len(values) * period_s)
    times = _times_s(path, rows, time_column)
    steps = sorted(b - a for a, b in itertools.pairwise(times)) or [period_s]
    return Trace(times, values, times[-1] + steps[len(steps) // 2])


class TraceSnr:
    """Plays a recorded link; it starts at the first reading, and again from the front at its end.

    Where the recording has a gap, the reading before it grows old, as it did on the day.

    Args:
        path: a file that :func:`read_trace` reads.
        period_s: seconds from one reading to the next where the file has no times.
        repeat: start again at the end; otherwise the last reading grows old.
        clock: monotonic seconds.

    Raises:
        LinkError: no such trace; the message names the line.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        period_s: float = 0.05,
        repeat: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.trace = read_trace(path, period_s)
        self._repeat = repeat
        self._clock = clock
        self._started_s: float | None = None

    def read(self) -> SnrReading:
        """The last reading before now, and how long ago it was."""
        now_s = self._clock()
        if self._started_s is None:
            self._started_s = now_s
        trace = self.trace
        played_s = max(0.0, now_s - self._started_s)
        if self._repeat:
            played_s %= trace.length_s
        index = max(0, bisect.bisect_right(trace.times_s, played_s) - 1)
        return SnrReading(trace.snr_db[index], max(0.0, played_s - trace.times_s[index]))


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise LinkError(f"cannot read the SNR trace {path}: {error}") from error
    numbered = [(i, line.strip()) for i, line in enumerate(lines, start=1)]
    return [
        (number, next(csv.reader([line])))
        for number, line in numbered
        if line and not line.startswith("#")
    ]


def _number(cells: list[str], column: int) -> float:
    try:
        return float(cells[column])
    except (IndexError, ValueError):
        return math.nan


def _snr_db(path: Path, number: int, cells: list[str], column: int) -> float:
    value = _number(cells, column)
    if math.isnan(value) or value == math.inf:
        raise LinkError(
            f"{path}, line {number}: expected an SNR in dB (or -inf for no link), got "
            f"{','.join(cells)!r}"
        )
    return value


def _times_s(path: Path, rows: list[tuple[int, list[str]]], column: int) -> tuple[float, ...]:
    times: list[float] = []
    for number, cells in rows:
        value = _number(cells, column)
        if not math.isfinite(value) or (times and value <= times[-1]):
            after = f" after {times[-1]:g}" if times else ""
            raise LinkError(
                f"{path}, line {number}: expected a time in seconds{after}, got "
                f"{','.join(cells)!r}: sort the trace, and leave one reading for each time"
            )
        times.append(value)
    return tuple(value - times[0] for value in times)
