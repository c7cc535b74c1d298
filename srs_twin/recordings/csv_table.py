"""Recorded CSV files: bytes within bounds, a header with units, rows of numbers, errors with their place.

A plain table names its columns in the first line: ``x_1``, ``x_1_mm``, ``pressure_plus_2 (kPa)``,
``time_ms``. What has no unit is in SI. Numbers are read by Arrow.
"""

from __future__ import annotations

import csv
import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.files import decoded, existing, shown
from srs_twin.recordings.signals.units import TIMES

CLOCK = {"time": TIMES, "t": TIMES}
"""Names of the column that holds the time."""

MAX_BYTES = 256 << 20
"""An hour of ten markers at 120 Hz has half as many."""

MAX_HEADER_BYTES = 4 << 20
"""A take in which thousands of markers came and went has a header of one megabyte."""

MAX_VALUES = 1 << 26
"""Rows times columns: half a gigabyte of numbers."""

MAX_COLUMNS = 20_000

BLANK = ["", "NaN", "nan", "NAN", "-nan", "null", "NULL", "N/A", "n/a"]
"""What stands where nothing was seen."""

_BLOCK = 8 << 20  # bytes that Arrow takes at a time; no line is longer
_LISTED = 5  # columns that a message lists
_EMPTY_LINE = re.compile(rb"^[ \t,]*\r?$", re.MULTILINE)


@dataclass(frozen=True)
class RecordedFile:
    """A recorded file as it was read.

    Attributes:
        name: as messages show it.
        data: its bytes.
        separator: of the cells of a line.
    """

    name: str
    data: bytes
    separator: str = ","

    @cached_property
    def raw(self) -> bytes:
        """The bytes without a byte order mark."""
        return self.data.removeprefix(b"\xef\xbb\xbf")

    @cached_property
    def sha256(self) -> str:
        """Hash of the file, hexadecimal."""
        return hashlib.sha256(self.data).hexdigest()

    def error(self, what: str, line: int | None = None, column: int | None = None) -> InputError:
        """Return an error that names the place, both counted from 1; a column is a cell's number."""
        place = "".join(f":{number}" for number in (line, column) if number is not None)
        return InputError(f"{self.name}{place}: {what}")

    def head(self, lines: int, after: int = 0) -> list[list[str]]:
        """Return the cells of up to that many lines, those after the first `after`.

        Raises:
            InputError: the lines are longer than any header, or are no CSV.
        """
        start = self._start_of(after)
        found = self.raw[start : start + MAX_HEADER_BYTES].split(b"\n", lines)
        if len(found) <= lines and len(self.raw) > start + MAX_HEADER_BYTES:
            what = f"the header, or a line, is longer than {MAX_HEADER_BYTES >> 20} MB"
            raise self.error(what, after + len(found))
        rows = []
        for number, line in enumerate(found[:lines], start=after + 1):
            text = line.decode("utf-8", "replace").rstrip("\r")
            try:
                rows.append(next(csv.reader([text], delimiter=self.separator, strict=True), []))
            except csv.Error as error:
                raise self.error(f"no line of a CSV file ({error})", number) from error
        return rows

    def _start_of(self, line: int) -> int:
        """Return where a line begins, counted from 0; the end of the file where there are fewer."""
        start = 0
        for _ in range(line):
            start = self.raw.find(b"\n", start) + 1 or len(self.raw)
        return start

    def rows(
        self, header_lines: int, columns: Sequence[int], width: int, *, section: bool = False
    ) -> tuple[np.ndarray, list[str]]:
        """Read the rows below a header.

        A last line without a line end may be cut anywhere, also inside a number: it is left out, and said so.

        Args:
            header_lines: how many lines the header has.
            columns: which columns to read, counted from 0.
            width: how many cells a row has.
            section: whether the rows end at an empty line; else at the end of the file.

        Returns:
            Shape (rows, columns), NaN where a cell is blank or not finite; what was left out, in words.

        Raises:
            InputError: no rows, too many values, a row with more or fewer cells, a cell that is no number.
        """
        raw, start, notes = self.raw, self._start_of(header_lines), []
        end = _EMPTY_LINE.search(raw, start) if section else None
        stop = max(start, end.start() if end else raw.rfind(b"\n") + 1)
        if stop < len(raw) and not end:
            line = raw.count(b"\n", 0, stop) + 1
            notes.append(f"line {line}, the last, has no line end and may be cut: left out")
        # The first row alone, before all others are looked at.
        first = raw[start : max(raw.find(b"\n", start, stop), start)]
        cells = first.count(self.separator.encode()) + 1
        if first.strip() and b'"' not in first and cells != width:
            raise self.error(f"{cells} cells where the header has {width}", header_lines + 1)
        count = raw.count(b"\n", start, stop)
        if width > MAX_COLUMNS or count * width > MAX_VALUES:
            most = f"at most {MAX_COLUMNS} columns and {MAX_VALUES} cells are read"
            raise self.error(f"{count} rows of {width} cells; {most}")
        values = self._numbers(start, stop, header_lines, columns, width) if count else np.empty((0, 0))
        if not len(values):
            raise self.error("a header and no rows below it", header_lines + 1)
        infinite = np.isinf(values)
        if infinite.any():
            notes.append(f"{int(infinite.sum())} infinite numbers: taken as not seen")
            values[infinite] = np.nan
        return values, notes

    def _numbers(
        self, start: int, stop: int, header_lines: int, columns: Sequence[int], width: int
    ) -> np.ndarray:
        import pyarrow as pa
        from pyarrow.csv import ConvertOptions, ParseOptions, ReadOptions, read_csv

        names = [str(k) for k in range(width)]
        chosen = [names[k] for k in columns]
        uneven: list[Any] = []

        def refuse(row: Any) -> str:
            uneven.append(row)
            return "error"

        # One thread: only then does Arrow know on which row a fault lies.
        reading = ReadOptions(column_names=names, use_threads=False, block_size=_BLOCK)
        parsing = ParseOptions(delimiter=self.separator, invalid_row_handler=refuse, newlines_in_values=False)
        types = dict.fromkeys(chosen, pa.float64())
        converting = ConvertOptions(
            column_types=types, include_columns=chosen, null_values=BLANK, quoted_strings_can_be_null=True
        )
        try:
            table = read_csv(pa.py_buffer(memoryview(self.raw)[start:stop]), reading, parsing, converting)
        except (pa.ArrowException, OSError) as error:
            if uneven:
                what = f"{uneven[0].actual_columns} cells where the header has {width}"
                raise self.error(what, header_lines + (uneven[0].number or 0)) from error
            lines = self.raw[start:stop].split(b"\n")
            raise self._not_a_number(lines, header_lines + 1, columns, str(error)) from error
        return np.stack([column.to_numpy() for column in table.columns], axis=1)

    def _not_a_number(
        self, lines: Sequence[bytes], first: int, columns: Sequence[int], reported: str
    ) -> InputError:
        """Return an error at the first cell that is no number; Arrow does not tell its line."""
        for number, line in enumerate(lines, start=first):
            cells = line.decode("utf-8", "replace").rstrip("\r").split(self.separator)
            for column in columns:
                text = cells[column].strip('"') if column < len(cells) else ""
                try:
                    float(text if text not in BLANK else "nan")
                except ValueError:
                    what = f"'{text[:60]}' is no number; a number or nothing is wanted"
                    return self.error(what, number, column + 1)
        return self.error(f"no rows of numbers ({' '.join(reported.split())[:200]})", first)


def recording_file(path: str | os.PathLike[str]) -> Path:
    """Return the file of a recording, which of a ROS 2 bag lies in a folder.

    Raises:
        InputError: it is missing, or a folder without one such file.
    """
    place = Path(path)
    inside = place.glob("*") if (place / "metadata.yaml").is_file() else ()
    bags = sorted(each for each in inside if each.suffix in (".db3", ".mcap"))
    if len(bags) > 1:
        names = ", ".join(each.name for each in bags[:3])
        raise InputError(f"{shown(place)}: a folder with {len(bags)} bags; give one of them ({names}, …)")
    return existing(bags[0] if bags else place, suffix=".csv")


def read_bytes(path: str | os.PathLike[str]) -> RecordedFile:
    """Read a recorded file of any kind.

    Raises:
        InputError: missing, no regular file, not readable, empty, or too large.
    """
    place = recording_file(path)
    name = shown(place)
    try:
        if (megabytes := place.stat().st_size / (1 << 20)) > MAX_BYTES >> 20:
            limit = f"at most {MAX_BYTES >> 20} MB are read (export a shorter take)"
            raise InputError(f"{name}: {megabytes:.0f} MB; {limit}")
        file = RecordedFile(name, place.read_bytes())
    except OSError as error:
        raise InputError(f"{name}: cannot be read ({error.strerror})") from error
    if not file.raw.strip():
        raise file.error("empty; a recording has a header and rows of numbers")
    return file


def read_file(path: str | os.PathLike[str]) -> RecordedFile:
    """Read a recorded file of text.

    Raises:
        InputError: as `read_bytes`, or not UTF-8 text.
    """
    file = read_bytes(path)
    # A byte order mark of UTF-16, or a zero byte anywhere: neither stands in a CSV file.
    zero = file.data.find(b"\0")
    if zero >= 0 and not file.data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise file.error(f"not text (byte {zero + 1} is 0x00); a CSV file is wanted")
    if not file.data.isascii():
        decoded(file.data, file.name)
    return file


def first_line_names(path: str | os.PathLike[str]) -> list[str]:
    """Return the cells of a file's first line in lower case.

    Raises:
        InputError: it cannot be read.
    """
    first = read_file(path).raw[:MAX_HEADER_BYTES].split(b"\n", 1)[0]
    return [cell.strip().lower() for cell in first.decode("utf-8", "replace").split(",")]


_NAME = re.compile(
    r"\s*([A-Za-z][A-Za-z_]*?)(?:_(\d{1,3})([a-z])?)?(?:_([A-Za-z]+)|\s*[(\[]\s*(\w+)\s*[)\]])?\s*"
)


@dataclass(frozen=True)
class CsvColumn:
    """One column of a plain table.

    Attributes:
        place: counted from 0.
        name: base name, e.g. "x".
        number: 1 and on; 0 where the name has none.
        letter: behind the number ("a", "b" for two markers), or empty.
        unit: as the name gives it, lower case; empty where it gives none.
        factor: to SI.
        text: the whole name.
    """

    place: int
    name: str
    number: int
    letter: str
    unit: str
    factor: float
    text: str


@dataclass(frozen=True)
class CsvTable:
    """A plain table whose header was read.

    Attributes:
        file: it stands in.
        columns: that are known.
        width: cells in a row.
        unused: names of the other columns.
    """

    file: RecordedFile
    columns: tuple[CsvColumn, ...]
    width: int
    unused: tuple[str, ...]

    def error(self, column: CsvColumn, what: str, row: int | None = None) -> InputError:
        """Return an error at a column's name, or at its cell in a row counted from 0."""
        return self.file.error(what, 1 if row is None else row + 2, column.place + 1)

    def clock(self, otherwise: str) -> CsvColumn:
        """Return the column of the time.

        Raises:
            InputError: there is none; with the message `otherwise`.
        """
        for column in self.columns:
            if column.name in CLOCK:
                return column
        raise self.file.error(otherwise, 1)

    def per_segment(self, names: Sequence[str], robot: str, segments: int) -> list[CsvColumn]:
        """Return the columns of these names, segment by segment from the head.

        Raises:
            InputError: one is missing, or there is one of another segment.
        """
        found = {(column.name, column.number): column for column in self.columns if column.name in names}
        wanted = [(name, segment) for segment in range(1, segments + 1) for name in names]
        for name, segment in wanted:
            if (name, segment) not in found:
                raise self.file.error(f"{name}_{segment} is missing; {robot} has {segments} segments", 1)
        for key, column in found.items():
            if key not in wanted:
                raise self.error(column, f"{column.text}: {robot} has {segments} segments")
        return [found[key] for key in wanted]

    def read(self, columns: Sequence[CsvColumn]) -> tuple[np.ndarray, list[str]]:
        """Return the numbers of columns in SI, shape (rows, columns), and what was left out, in words.

        Raises:
            InputError: as `RecordedFile.rows`.
        """
        values, notes = self.file.rows(1, [column.place for column in columns], self.width)
        with np.errstate(over="ignore"):  # callers refuse what is too large
            return values * [column.factor for column in columns], notes

    def read_timed(
        self, clock: CsvColumn, columns: Sequence[CsvColumn]
    ) -> tuple[np.ndarray, np.ndarray, list[str]]:
        """Return times (rows,), s, the numbers of columns in SI, and what was left out, in words.

        Raises:
            InputError: as `read`, or a row without a time.
        """
        values, notes = self.read([clock, *columns])
        if (missing := np.isnan(values[:, 0])).any():
            raise self.error(clock, "a row without a time", int(missing.argmax()))
        return values[:, 0], values[:, 1:], notes

    def unused_columns(self) -> list[str]:
        """Return which columns were not used, in words; empty where all were."""
        if not self.unused:
            return []
        listed = ", ".join(self.unused[:_LISTED]) + (", …" if len(self.unused) > _LISTED else "")
        return [f"{len(self.unused)} columns not used: {listed}"]


def read_table(
    file: RecordedFile, known: Mapping[str, Mapping[str, float]], names: Mapping[str, str] | None = None
) -> CsvTable:
    """Read the header of a plain table.

    Args:
        file: the table.
        known: base name → its units (name → factor to SI); empty for what has no unit.
        names: column → what it holds, for names of somebody else.

    Raises:
        UnknownNameError: one of these columns is not there.
        InputError: no header, another separator, a name twice, or a unit that is not known.
    """
    (cells,) = file.head(1)
    for separator, called in ((";", "semicolons"), ("\t", "tabs")):
        if len(cells) == 1 and separator in cells[0]:
            remedy = "save it with commas, and points in numbers"
            raise file.error(f"cells are separated by {called}; {remedy}", 1)
    if names:
        there = [cell.strip() for cell in cells]
        for name in names:
            if name not in there:
                raise UnknownNameError("column", name, there)
        cells = [names.get(cell, "" if cell in names.values() else cell) for cell in there]
    columns = [_column(file, place, text, known) for place, text in enumerate(cells)]
    seen: dict[tuple[str, int, str], CsvColumn] = {}
    for each in filter(None, columns):
        first = seen.setdefault((each.name, each.number, each.letter), each)
        if first is not each:
            said = f"{cells[each.place]}: the same as column '{cells[first.place]}'"
            raise file.error(said, 1, each.place + 1)
    unused = [cell.strip()[:40] for cell, column in zip(cells, columns, strict=True) if column is None]
    return CsvTable(file, tuple(seen.values()), len(cells), tuple(unused))


def _column(
    file: RecordedFile, place: int, text: str, known: Mapping[str, Mapping[str, float]]
) -> CsvColumn | None:
    match = _NAME.fullmatch(text)
    name, number, letter, trailing, bracketed = match.groups() if match else [""] * 5
    unit = (trailing or bracketed or "").lower()
    if name.lower() not in known and trailing and number is None:
        name, unit = f"{name}_{trailing}", ""  # no unit: the name's own last word
    units = known.get(name.lower())
    if units is None:
        return None
    if unit and unit not in units:
        allowed = ", ".join(units) or "none"
        raise file.error(f"{text}: unit '{unit}' is not known; allowed: {allowed}", 1, place + 1)
    factor = units.get(unit, 1.0)
    return CsvColumn(place, name.lower(), int(number or 0), letter or "", unit, factor, text.strip())
