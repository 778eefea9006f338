"""Recorded links: the SNR of each control period out of a file."""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from comvla.errors import LinkError
from comvla_sim.channel.base import Channel, checked, checked_period_s

GAP = 1.5
"""A step of the time column longer than so many median steps is a gap."""


@dataclass(frozen=True)
class _Row:
    line: int
    snr_db: float
    time_s: float | None


class TraceChannel(Channel):
    """A recorded link, repeated from its start when it ends.

    The file is text: one SNR in dB per line, or CSV with a header that has a column ``snr_db`` and,
    optionally, ``time_s``. Empty lines and lines that start with ``#`` are skipped; ``-inf`` means
    no link. Times have to rise without gaps: a trace says what the link was, and nobody knows what
    it was in a gap.

    Args:
        path: the file.
        period_s: control period in seconds. A file with times is brought to it: each period has the
            latest value measured at or before its start. None, and files without times: one value
            for each period, as they stand.
        max_gap_s: longest step between two times, in seconds; by default 1.5 times the median step.
        start: the period of the file to begin with, counted around its end.

    Raises:
        LinkError: a file that cannot be read, has no values or has one that is no SNR, times that
            are no numbers, stand still, run backwards or leave a gap; the message names the line.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        period_s: float | None = None,
        max_gap_s: float | None = None,
        start: int = 0,
    ) -> None:
        self.path = Path(path)
        rows = self._read()
        if not rows:
            raise LinkError(f"the SNR trace {self.path} has no values: one SNR in dB per line")
        self._values = [row.snr_db for row in rows]
        if rows[0].time_s is not None:
            times = np.array([row.time_s for row in rows], dtype=np.float64)
            step_s = self._check_times(rows, times, max_gap_s)
            if period_s is not None:
                self._values = self._resampled(times, step_s, checked_period_s(period_s))
        self._start = int(start) % len(self._values)

    def _read(self) -> list[_Row]:
        try:
            lines = self.path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise LinkError(f"cannot read the SNR trace {self.path}: {error}") from error
        numbered = [(i, line.strip()) for i, line in enumerate(lines, start=1)]
        numbered = [(i, line) for i, line in numbered if line and not line.startswith("#")]
        snr_column, time_column = 0, None
        if numbered:
            header = [cell.strip() for cell in next(csv.reader([numbered[0][1]]))]
            if "snr_db" in header:
                snr_column = header.index("snr_db")
                time_column = header.index("time_s") if "time_s" in header else None
                numbered = numbered[1:]
        return [self._row(i, line, snr_column, time_column) for i, line in numbered]

    def _row(self, number: int, line: str, snr_column: int, time_column: int | None) -> _Row:
        cells = next(csv.reader([line]))
        value = _number(cells, snr_column)
        if math.isnan(value) or value == math.inf:
            raise LinkError(
                f"{self.path}, line {number}: expected an SNR in dB (or -inf for no link), "
                f"got {line!r}"
            )
        if time_column is None:
            return _Row(number, value, None)
        time_s = _number(cells, time_column)
        if not math.isfinite(time_s):
            raise LinkError(f"{self.path}, line {number}: expected a time in seconds, got {line!r}")
        return _Row(number, value, time_s)

    def _check_times(
        self,
        rows: list[_Row],
        times: np.ndarray[tuple[int], np.dtype[np.float64]],
        max_gap_s: float | None,
    ) -> float:
        """The median step in seconds, once all steps are found to be sound."""
        if len(rows) == 1:
            return math.inf
        steps = np.diff(times)
        backwards = np.flatnonzero(steps <= 0)
        if backwards.size:
            row = rows[int(backwards[0]) + 1]
            raise LinkError(
                f"{self.path}, line {row.line}: time runs backwards or stands still, "
                f"{times[backwards[0]]:g} s and then {row.time_s:g} s: sort the trace and keep one "
                "value for each time"
            )
        step_s = float(np.median(steps))
        longest_s = GAP * step_s
        if max_gap_s is not None:
            longest_s = checked("max_gap_s", max_gap_s, unit=" (seconds)", minimum=0.0)
        gaps = np.flatnonzero(steps > longest_s)
        if gaps.size:
            row = rows[int(gaps[0]) + 1]
            raise LinkError(
                f"{self.path}, line {row.line}: a gap of {steps[gaps[0]]:g} s, where at most "
                f"{longest_s:g} s may pass between two values: cut the trace there, fill the gap "
                "with -inf where the link was down, or allow it with max_gap_s (the last value "
                "before it is then held)"
            )
        return step_s

    def _resampled(
        self, times: np.ndarray[tuple[int], np.dtype[np.float64]], step_s: float, period_s: float
    ) -> list[float]:
        if math.isinf(step_s):
            return self._values
        # The last value stands for one more step. A hair is added, since .15 / .05 is 2.9999...
        periods = max(1, int((times[-1] - times[0] + step_s) / period_s + 1e-9))
        starts = times[0] + period_s * np.arange(periods)
        latest = np.searchsorted(times, starts + 1e-9 * period_s, side="right") - 1
        return [self._values[index] for index in latest]

    def __len__(self) -> int:
        """Periods until the trace begins again."""
        return len(self._values)

    def __iter__(self) -> Iterator[float]:
        return itertools.cycle(self._values[self._start :] + self._values[: self._start])


def _number(cells: list[str], column: int) -> float:
    try:
        return float(cells[column])
    except (IndexError, ValueError):
        return math.nan
