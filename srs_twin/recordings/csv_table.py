"""Recorded CSV files: bytes within bounds, a header with units, rows of numbers, errors with their place.

A plain table names its columns in the first line: ``x_1``, ``x_1_mm``, ``pressure_plus_2 (kPa)``,
``time_ms``. What has no unit is in SI. Numbers are read by Arrow. Comments, separator and decimal mark are
found (`laid_out`), or given as a `Dialect`.
"""

from __future__ import annotations

import csv
import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.files import decode_text, display_path, require_file
from srs_twin.recordings.signals.units import TIMES, bracketed, clean, is_clock, symbol, unit_of

CLOCK = {"time": TIMES}
"""The column that holds the time, by any name of `is_clock`."""

MAX_BYTES = 256 << 20
"""An hour of ten markers at 120 Hz has half as many."""

MAX_HEADER_BYTES = 4 << 20
"""A take in which thousands of markers came and went has a header of one megabyte."""

MAX_VALUES = 1 << 26
"""Rows times columns: half a gigabyte of numbers."""

MAX_COLUMNS = 20_000

BLANK = ["", "NaN", "nan", "NAN", "-nan", "null", "NULL", "N/A", "n/a"]
"""What stands where nothing was seen."""

_PEEK = 1 << 16  # bytes that tell a format
_BLOCK = 8 << 20  # bytes that Arrow takes at a time; no line is longer
_LISTED = 5  # columns that a message lists
_EMPTY_LINE = re.compile(rb"^[ \t,]*\r?$", re.MULTILINE)
_NUMBER = re.compile(
    r"\s*(?:[-+]?(?=.?\d)[\d.,]+(?:[eE][-+]?\d+)?|nan|\d{4}-\d\d-\d\d[T ][\d:.,Z]+)?\s*", re.IGNORECASE
)
_COMMENT = re.compile(r"\s*#|sep=.$", re.IGNORECASE)  # the second is Excel's
_ZONE = re.compile(r"(?:Z|[+-]\d\d:?\d\d)\s*$")
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:")
# A comma that separates no thousands: 0,5 or 1234,5 or 1,25 or 1,2345.
_DECIMAL_COMMA = re.compile(rb"(?<![\d,])(?:0|\d{4,}),\d|\d,(?:\d{1,2}|\d{4,})(?![\d,])")
_CALLED = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "spaces", "|": "bars"}
_SINCE_1970 = (1e9, 4.2e9)  # s: from 2001 to 2103
_SLOWEST = 100.0  # s between rows: a size taken as time since 1970 would be a mistaken unit
_MOST_COMMENTS = 1000  # lines


class Dialect(NamedTuple):
    """Layout of a plain table; empty where it is found.

    Attributes:
        columns: names, for a file whose first line has none.
        separator: of the cells of a line; a space for runs of spaces and tabs.
        decimal: mark, "." or ",".
    """

    columns: tuple[str, ...] = ()
    separator: str = ""
    decimal: str = ""


AS_FOUND = Dialect()


class TimedRows(NamedTuple):
    """Rows of a table with their times.

    Attributes:
        time: shape (rows,), s.
        values: shape (rows, columns).
        notes: what was left out and subtracted, in words.
        epoch_ns: what was subtracted from times since 1970, ns; None from other times.
    """

    time: np.ndarray
    values: np.ndarray
    notes: list[str]
    epoch_ns: int | None


@dataclass(frozen=True)
class RecordedFile:
    """A recorded file as it was read.

    Attributes:
        name: as messages show it.
        data: its bytes.
        separator: of the cells of a line.
        decimal: mark of numbers.
        body: the bytes to read instead, where cells are separated by runs of spaces.
        names: of the columns of a plain table.
        header_lines: lines above its rows.
        notes: how the table is laid out, in words.
        problem: why it cannot be read as a table; empty where it can.
    """

    name: str
    data: bytes
    separator: str = ","
    decimal: str = "."
    body: bytes | None = None
    names: tuple[str, ...] = ()
    header_lines: int = 1
    notes: tuple[str, ...] = ()
    problem: str = ""

    @cached_property
    def raw(self) -> bytes:
        """The bytes without a byte order mark."""
        return self.data.removeprefix(b"\xef\xbb\xbf") if self.body is None else self.body

    @cached_property
    def first_line(self) -> str:
        """The first line of text that is not blank."""
        wide = self.data.startswith((b"\xff\xfe", b"\xfe\xff"))  # the reader says how to save it
        text = self.data.removeprefix(b"\xef\xbb\xbf").decode("utf-16" if wide else "utf-8", "replace")
        return next((line for line in text.splitlines() if line.strip()), "")

    @property
    def title(self) -> str:
        """The first cell of that line."""
        return re.split(r"[,\t]", self.first_line)[0].strip(' "')

    @cached_property
    def sha256(self) -> str:
        """Hash of the file, hexadecimal."""
        return hashlib.sha256(self.data).hexdigest()

    def error(self, what: str, line: int | None = None, column: int | None = None) -> InputError:
        """Return an error that names the place, both counted from 1; a column is a cell's number."""
        place = "".join(f":{number}" for number in (line, column) if number is not None)
        return InputError(f"{self.name}{place}: {what}")

    def head(self, lines: int, after: int = 0) -> list[list[str]]:
        """Return the stripped cells of up to that many lines, those after the first `after`.

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
                cells = next(csv.reader([text], delimiter=self.separator, strict=True), [])
            except csv.Error as error:
                raise self.error(f"no line of a CSV file ({error})", number) from error
            rows.append([cell.strip() for cell in cells])
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
        stop = self._end_of(start, section=section)
        if stop < len(raw) and not section:
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
        cut = memoryview(raw)[start:stop]
        table = self._parsed(cut, header_lines, columns, width) if count else []
        if not table or not len(table[0]):
            raise self.error("a header and no rows below it", header_lines + 1)
        values = np.stack([column.to_numpy() for column in table], axis=1)
        infinite = np.isinf(values)
        if infinite.any():
            notes.append(f"{int(infinite.sum())} infinite numbers: taken as not seen")
            values[infinite] = np.nan
        return values, notes

    def _end_of(self, start: int, *, section: bool = False) -> int:
        """Return where rows end: behind their last line end, or at an empty line."""
        end = _EMPTY_LINE.search(self.raw, start) if section else None
        return max(start, end.start() if end else self.raw.rfind(b"\n") + 1)

    def times(self, clock: int, unit: str) -> tuple[np.ndarray, list[str], int | None]:
        """Read the times of a plain table's rows; times since 1970 begin at 0.

        Args:
            clock: which column holds them, as numbers or as dates, counted from 0.
            unit: of numbers; empty: s, or the unit in which they are times since 1970.

        Returns:
            Shape (rows,), s; what was subtracted, in words; and in ns, None from other times.

        Raises:
            InputError: as `rows`, or a row without a time.
        """
        import pyarrow as pa

        top, start, width = self.header_lines, self._start_of(self.header_lines), len(self.names)
        cut, notes = memoryview(self.raw)[start : self._end_of(start)], list[str]()
        first = _cells(bytes(cut[:_BLOCK]).split(b"\n", 1)[0].decode("utf-8", "replace"), self.separator)
        exact: list[Any] = []
        if clock < len(first) and _DATE.match(first[clock]):
            kind, unit = pa.timestamp("ns", "UTC" if _ZONE.search(first[clock]) else None), "ns"
            exact = self._parsed(cut, top, [clock], width, kind)[0].cast(pa.int64()).to_pylist()
            time = np.array(exact, dtype=float)
        else:
            values, notes = self.rows(top, [clock], width)
            time = values[:, 0]
        if (missing := np.isnan(time)).any():
            raise self.error("a row without a time", top + 1 + int(missing.argmax()), clock + 1)
        if not exact:
            since_1970 = _epoch_unit(time, unit)
            if not since_1970:
                with np.errstate(over="ignore"):
                    return time * TIMES[unit or "s"], notes, None
            # A double has a resolution of 256 ns at times since 1970 in ns.
            (texts,), unit = self._parsed(cut, top, [clock], width, pa.string()), since_1970
            exact = [Decimal(text.replace(self.decimal, ".")) for text in texts.to_pylist()]
        origin = min(exact)
        since = np.array([float(each - origin) for each in exact]) * TIMES[unit]
        epoch_ns = round(origin * round(TIMES[unit] * 1e9))
        notes.append(f"time since 1970 in {unit}: {epoch_ns // 10**9}.{epoch_ns % 10**9:09d} s subtracted")
        return since, notes, epoch_ns

    def _parsed(
        self, cut: memoryview, header_lines: int, columns: Sequence[int], width: int, kind: Any = None
    ) -> list[Any]:
        """Return Arrow's columns of rows, numbers unless another kind is given."""
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
        converting = ConvertOptions(
            column_types=dict.fromkeys(chosen, kind or pa.float64()), include_columns=chosen,
            null_values=BLANK, quoted_strings_can_be_null=True, decimal_point=self.decimal,
        )  # fmt: skip
        try:
            return list(read_csv(pa.py_buffer(cut), reading, parsing, converting).columns)
        except (pa.ArrowException, OSError) as error:
            if uneven:
                what = f"{uneven[0].actual_columns} cells where the header has {width}"
                raise self.error(what, header_lines + (uneven[0].number or 0)) from error
            raise self._not_a_number(
                bytes(cut).split(b"\n"), header_lines + 1, columns, str(error)
            ) from error

    def _not_a_number(
        self, lines: Sequence[bytes], first: int, columns: Sequence[int], reported: str
    ) -> InputError:
        """Return an error at the first cell that is no number; Arrow does not tell its line."""
        marks = str.maketrans(",.", ".,") if self.decimal == "," else {}
        for number, line in enumerate(lines, start=first):
            cells = _cells(line.decode("utf-8", "replace").rstrip("\r"), self.separator)
            for column in columns:
                text = cells[column].strip() if column < len(cells) else ""
                try:
                    float("nan" if text in BLANK else text.translate(marks))
                except ValueError:
                    comma = ", --decimal ',' for decimal commas" if re.search(r"\d,\d", text) else ""
                    what = f"'{text[:60]}' is no number; a number or nothing is wanted{comma}"
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
        raise InputError(
            f"{display_path(place)}: a folder with {len(bags)} bags; give one of them ({names}, …)"
        )
    return require_file(bags[0] if bags else place, suffix=".csv")


def start_of(path: str | os.PathLike[str], dialect: Dialect = AS_FOUND) -> RecordedFile:
    """Read the first bytes of a file, laid out as a table.

    Raises:
        InputError: it is missing or cannot be read.
    """
    place = recording_file(path)
    return laid_out(RecordedFile(display_path(place), _bytes(place, _PEEK)), dialect)


def read_bytes(path: str | os.PathLike[str]) -> RecordedFile:
    """Read a recorded file of any kind.

    Raises:
        InputError: missing, no regular file, not readable, empty, or too large.
    """
    place = recording_file(path)
    file = RecordedFile(display_path(place), _bytes(place, MAX_BYTES + 1))
    if len(file.data) > MAX_BYTES:
        megabytes, most = place.stat().st_size / (1 << 20), MAX_BYTES >> 20
        raise file.error(f"{megabytes:.0f} MB; at most {most} MB are read (export a shorter take)")
    if not file.raw.strip():
        raise file.error("empty; a recording has a header and rows of numbers")
    return file


def _bytes(place: Path, most: int) -> bytes:
    """Return the first bytes of a file."""
    try:
        with place.open("rb") as stream:
            return stream.read(most)
    except OSError as error:
        raise InputError(f"{display_path(place)}: cannot be read ({error.strerror})") from error


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
        decode_text(file.data, file.name)
    return file


def laid_out(file: RecordedFile, dialect: Dialect = AS_FOUND) -> RecordedFile:
    """Return a file with its names, separator and decimal mark, as given or as its first lines tell."""
    if file.names or file.problem:
        return file
    start = file.raw[:MAX_HEADER_BYTES].split(b"\n", _MOST_COMMENTS)
    lines = [line.decode("utf-8", "replace").strip("\r") for line in start[:_MOST_COMMENTS]]
    top = next((k for k, line in enumerate(lines) if line.strip() and not _COMMENT.match(line)), 0)
    header, row = lines[top], next(filter(str.strip, lines[top + 1 :]), "")
    comments = [line.lstrip("# ") for line in lines[:top] if line.strip()]
    separator, notes, problem = dialect.separator or _separator(header, row), [], ""
    if len(start) == 1 and len(file.raw) > MAX_HEADER_BYTES:
        problem = f"the header, or a line, is longer than {MAX_HEADER_BYTES >> 20} MB"
    names, header_lines = _cells(header, separator), top + 1
    numbers = [bool(_NUMBER.fullmatch(cell)) for cell in names if cell.strip()]
    if any(numbers) if dialect.columns else numbers and all(numbers):
        above, header_lines = _cells(comments[-1], separator) if comments else [], top
        if dialect.columns:
            names = list(dialect.columns)
        elif len(above) == len(names) and not any(map(_NUMBER.fullmatch, above)):
            names, comments = above, comments[:-1]
        else:
            example = "--columns time,x_1,y_1,… (columns: [time, …] in a map)"
            problem, names = f"{len(names)} numbers and no names of columns: give {example}", []
    elif dialect.columns:
        notes.append("columns are named by the file: those of --columns or the map are not used")
    if comments:
        notes.append(f"{len(comments)} lines of comments above the names skipped")
    if separator == " ":
        file = replace(file, body=b"\n".join(b" ".join(line.split()) for line in file.raw.split(b"\n")))
    rows, decimal = file._start_of(header_lines), dialect.decimal or "."
    if not dialect.decimal and separator != "," and file.raw.find(b",", rows) >= 0:
        decimal = ","
        if not _DECIMAL_COMMA.search(file.raw, rows):
            problem = problem or "commas in numbers may be decimal or of thousands: give --decimal ',' or '.'"
    if separator == decimal and '"' not in row:
        problem = f"'{decimal}' cannot separate cells and decimals: give another --separator"
    if separator + decimal != ",.":
        notes.append(
            f"cells separated by {_CALLED[separator]}, decimal {'commas' if decimal == ',' else 'points'}"
        )
    return replace(
        file, separator=separator, decimal=decimal, names=tuple(clean(name) for name in names),
        header_lines=header_lines, notes=tuple(notes), problem=problem,
    )  # fmt: skip


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:
        return [line]


def _separator(header: str, row: str) -> str:
    """Return the separator that gives two lines as many cells; commas last, which may be decimal."""
    there, words = [each for each in ";\t|," if each in header], header.split()
    whole = there in ([], [","]) and len(words) == len(row.split()) > 1
    if whole and (not there or all(_NUMBER.fullmatch(each) and each[-1] != "," for each in words)):
        return " "
    fitting = (each for each in there if len(_cells(header, each)) == len(_cells(row, each)) > 1)
    return next(fitting, "," if "," in there else (*there, ",")[0])


def _epoch_unit(time: np.ndarray, stated: str) -> str:
    """Return the unit of times since 1970, as stated or by their size and steps; empty for other times."""
    usual = 0.0 if stated or len(time) < 2 else float(np.median(np.diff(np.sort(time))))
    for unit in [stated] if stated else ("s", "ms", "us", "ns"):
        low, high = (limit / TIMES[unit] for limit in _SINCE_1970)
        if low <= time.min() <= high and usual * TIMES[unit] < _SLOWEST:
            return unit
    return ""


def first_line_names(path: str | os.PathLike[str], dialect: Dialect = AS_FOUND) -> list[str]:
    """Return the names of a table's columns in lower case; none where it has none.

    Raises:
        InputError: it cannot be read.
    """
    return [name.lower() for name in laid_out(read_file(path), dialect).names]


_NAME = re.compile(r"([A-Za-z][A-Za-z_]*?)(?:_(\d{1,3})([a-z])?)?(?:[_ ]+([^\W\d_]+(?:/\w+)?|%))?")


@dataclass(frozen=True)
class CsvColumn:
    """One column of a plain table.

    Attributes:
        place: counted from 0.
        name: base name, e.g. "x".
        number: 1 and on; 0 where the name has none.
        letter: behind the number ("a", "b" for two markers), or empty.
        unit: symbol, as the name or a map gives it; empty where none does.
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
        unused: names of the other columns.
        notes: what was assumed of units, in words.
    """

    file: RecordedFile
    columns: tuple[CsvColumn, ...]
    unused: tuple[str, ...]
    notes: tuple[str, ...] = ()

    def error(self, column: CsvColumn, what: str, row: int | None = None) -> InputError:
        """Return an error at a column's name, or at its cell in a row counted from 0."""
        line = self.file.header_lines or 1 if row is None else self.file.header_lines + 1 + row
        return self.file.error(what, line, column.place + 1)

    def clock(self, otherwise: str) -> CsvColumn:
        """Return the column of the time.

        Raises:
            InputError: there is none; with the message `otherwise`.
        """
        if (found := next((each for each in self.columns if each.name in CLOCK), None)) is None:
            raise self.file.error(otherwise, self.file.header_lines or 1)
        return found

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
        places = [column.place for column in columns]
        values, notes = self.file.rows(self.file.header_lines, places, len(self.file.names))
        with np.errstate(over="ignore"):  # callers refuse what is too large
            return values * [column.factor for column in columns], [*self.file.notes, *self.notes, *notes]

    def read_timed(
        self, clock: CsvColumn | None, columns: Sequence[CsvColumn], rate_hz: float | None = None
    ) -> TimedRows:
        """Return the numbers of columns in SI with their times; without a clock, rows are counted.

        Raises:
            InputError: as `RecordedFile.timed`.
        """
        values, notes = self.read(columns) if columns else (np.empty((0, 0)), [])
        if clock is None:
            rate = rate_hz or 1.0
            counted = f"frames counted, {rate:g} a second"
            return TimedRows(np.arange(len(values)) / rate, values, [*notes, counted], None)
        time, noted, epoch_ns = self.file.times(clock.place, clock.unit)
        return TimedRows(time, values, list(dict.fromkeys([*notes, *noted])), epoch_ns)

    def unused_columns(self) -> list[str]:
        """Return which columns were not used, in words; empty where all were."""
        return not_used(self.unused)


def not_used(names: Sequence[str]) -> list[str]:
    """Return which columns were not used, in words; empty where all were."""
    listed = ", ".join(names[:_LISTED]) + (", …" if len(names) > _LISTED else "")
    return [f"{len(names)} columns not used: {listed}"] if names else []


class Meaning(NamedTuple):
    """Meaning of a column whose name is somebody else's, as a map has it.

    Attributes:
        name: ``pressure_plus_1``, ``time``.
        default: unit where the column's name states none.
        unit: of the column; empty where the map does not say.
    """

    name: str
    default: str = ""
    unit: str = ""


def read_table(
    file: RecordedFile,
    known: Mapping[str, Mapping[str, float]],
    names: Mapping[str, Meaning] | None = None,
) -> CsvTable:
    """Read the header of a plain table.

    Args:
        file: the table, laid out or not.
        known: base name → its units (name → factor to SI); empty for what has no unit.
        names: column → what it holds, for names of somebody else.

    Raises:
        UnknownNameError: one of these columns is not there.
        InputError: no header, a name twice, or a unit that is not known.
    """
    file = laid_out(file)
    if file.problem:
        raise file.error(file.problem, file.header_lines + (not file.names))
    meanings = {clean(name): meaning for name, meaning in (names or {}).items()}
    for name in meanings:
        if name not in file.names:
            raise UnknownNameError("column", name, file.names)
    taken = {each.name for each in meanings.values()}
    if "time" in known.keys() - taken:
        clocks = [text for text in file.names if is_clock(text) and text not in meanings]
        clock = min(clocks, key=lambda text: text.lower() not in ("time", "t"), default="")
        meanings |= {clock: Meaning("time")} if clock else {}
    seen: dict[tuple[str, int, str], CsvColumn] = {}
    unused, notes = [], []
    for place, text in enumerate(file.names):
        meaning = meanings.get(text)
        own = meaning is None and bracketed(text)[0] not in taken
        try:
            column, note = _column(place, text, known, meaning) if meaning or own else (None, "")
        except InputError as error:
            raise file.error(str(error), file.header_lines or 1, place + 1) from error
        notes += [note] if note else []
        if column is None:
            unused.append(text[:40])
            continue
        first = seen.setdefault((column.name, column.number, column.letter), column)
        if first is not column:
            said = f"{text}: the same as column '{file.names[first.place]}'"
            raise file.error(said, file.header_lines or 1, place + 1)
    return CsvTable(file, tuple(seen.values()), tuple(unused), tuple(notes))


def _column(
    place: int, text: str, known: Mapping[str, Mapping[str, float]], meaning: Meaning | None
) -> tuple[CsvColumn | None, str]:
    """Return a column that is known, and a note on its unit."""
    bare, bracket = bracketed(text)
    match = _NAME.fullmatch(meaning.name if meaning else bare)
    name, number, letter, trailing = match.groups() if match else [""] * 4
    unit, note = trailing or bracket or "", ""
    if name.lower() not in known and trailing and number is None:
        name, unit = f"{name}_{trailing}", bracket  # no unit: the name's own last word
    units = known.get(name.lower())
    if units is None or (meaning is None and name.lower() == "time"):
        return None, ""
    if meaning is not None and units:
        unit, note = unit_of(text, units, meaning.default, meaning.unit)
    elif meaning is None and unit and not symbol(unit, units):
        raise InputError(f"{text}: unit '{unit}' is not known; allowed: {', '.join(units) or 'none'}")
    unit, number = symbol(unit, units), int(number or 0)
    return CsvColumn(place, name.lower(), number, letter or "", unit, units.get(unit, 1.0), text), note
