"""The file of results: one JSON object per line and episode, appended as episodes end."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from comvla_sim.experiments.errors import EvaluationError
from comvla_sim.experiments.plan import EpisodeSpec

try:
    import fcntl
except ImportError:  # a system without file locks
    fcntl = None  # type: ignore[assignment]

FORMAT = 2
"""Format 1 knew the ideal link only; its rows are read as such."""

_START = b'{"format": '
"""Every row begins so, whatever its format."""

Row = dict[str, Any]

spec_of = EpisodeSpec.from_row


def _current(row: Row) -> Row:
    """A row of an older format as this version would have written it."""
    if row.get("format") != 1:
        return row
    settings = {key: value for key, value in row["settings"].items() if key != "link"}
    unknown = dict.fromkeys(("link", "channel_seed", "link_use"))
    return {**row, **unknown, "format": FORMAT, "settings": settings}


def _require_format(row: Row, where: str) -> None:
    if row.get("format") != FORMAT:
        raise EvaluationError(
            f"{where} has format {row.get('format')!r}, this version reads 1 and {FORMAT}: use the "
            "version of comvla that wrote it, or run the evaluation again"
        )


def key_of(row: Mapping[str, Any]) -> tuple[str, EpisodeSpec]:
    """What makes two rows the same measurement: settings (the seed among them) and episode."""
    return json.dumps(row["settings"], sort_keys=True), spec_of(row)


def read_rows(path: Path) -> tuple[list[Row], int]:
    """The rows of a results file, and how many of its bytes hold complete ones.

    A last line that was cut off by a crash is left out. Of rows about the same episode under the
    same settings the first counts.

    Raises:
        EvaluationError: unreadable, or not a results file; the message names the line.
    """
    try:
        return _parsed(path, path.read_bytes())
    except OSError as error:
        raise EvaluationError(f"cannot read {path}: {error.strerror}") from error


def _parsed(path: Path, content: bytes) -> tuple[list[Row], int]:
    rows: list[Row] = []
    seen: set[tuple[str, EpisodeSpec]] = set()
    complete = content.rfind(b"\n") + 1
    for number, line in enumerate(content[:complete].splitlines(), start=1):
        try:
            row = _current(json.loads(line))
            _require_format(row, f"{path}, line {number}")
            key = key_of(row)
        except EvaluationError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise EvaluationError(
                f"{path}, line {number} is no result of comvla-sim eval ({error!r}): "
                "name another file"
            ) from error
        if key not in seen:
            seen.add(key)
            rows.append(row)
    cut_off = content[complete:]
    begun = cut_off.rstrip(b"\0")  # a power failure leaves zeros
    if begun[: len(_START)] != _START[: len(begun)] or (begun != cut_off and not rows):
        raise EvaluationError(
            f"{path} ends in a line that is no result of comvla-sim eval, not even the beginning of one "
            f"(expected {_START.decode()}..., got {cut_off[: len(_START)]!r}): name another file"
        )
    return rows, complete


class ResultsFile:
    """Appends results and knows which are there; a context manager.

    Args:
        path: made with its folders where it does not exist.
        settings: what the rows must have been measured with (their ``settings``).

    Attributes:
        rows: by episode.

    Raises:
        EvaluationError: the file holds results of other settings, is no results file, or is being
            written by another process.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]) -> None:
        self.path = path
        self.rows: dict[EpisodeSpec, Row] = {}
        self._settings = dict(settings)
        self._file: BinaryIO | None = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = path.open("a+b", buffering=0)
        except OSError as error:
            raise EvaluationError(f"cannot write {path}: {error.strerror}") from error
        try:
            self._take_over(file)
        except BaseException:
            file.close()
            raise
        self._file = file

    def _take_over(self, file: BinaryIO) -> None:
        """Locks the file, then reads it: until then another process may append to it."""
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise EvaluationError(
                    f"{self.path} is being written by another evaluation: wait for it, or name "
                    "another file with --out"
                ) from error
        try:
            file.seek(0)
            content = file.read()
        except OSError as error:
            raise EvaluationError(f"cannot read {self.path}: {error.strerror}") from error
        rows, complete = _parsed(self.path, content)
        for row in rows:
            self._require_same_settings(row)
            self.rows[spec_of(row)] = row
        if len(content) > complete:
            file.truncate(complete)  # a line that a crash cut off

    def _require_same_settings(self, row: Row) -> None:
        found = row["settings"]
        for key in sorted({*found, *self._settings}):
            if found.get(key) != self._settings.get(key):
                raise EvaluationError(
                    f"{self.path} was measured with {key} {found.get(key)!r}, this evaluation has "
                    f"{self._settings.get(key)!r}: name another file with --out, or use the same "
                    "settings"
                )

    def append(self, row: Row) -> None:
        """Writes one row through to the file.

        Raises:
            EvaluationError: the disk is full, or gone; the rows before are kept.
        """
        if self._file is None:
            raise ValueError("the results file is closed")
        line = (json.dumps(row, allow_nan=False) + "\n").encode()
        number = self._file.fileno()
        before = os.fstat(number).st_size
        written = 0
        try:
            while written < len(line):
                written += os.write(number, line[written:])
        except OSError as error:
            os.ftruncate(number, before)  # a row is there whole or not at all
            raise EvaluationError(
                f"cannot write to {self.path} ({error.strerror}); the {len(self.rows)} episodes "
                "before are kept: make room, then run the same command again to go on"
            ) from error
        self.rows[spec_of(row)] = row

    def close(self) -> None:
        """Harmless when repeated."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> ResultsFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows.values())
