"""Recorded files in memory, with readers for the rows of plain tables.

`laid_out` skips comment lines, and detects the cell separator and the decimal mark
unless a `Dialect` states them.
"""

from __future__ import annotations

import csv
import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import cached_property
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.files import (
    StrPath,
    decode_text,
    display_path,
    escape_unprintable,
    require_file,
)
from srs_twin.recordings.signals.units import TIMES, clean

if TYPE_CHECKING:
    import pyarrow as pa
    from pyarrow.csv import InvalidRow

MAX_BYTES = 256 << 20
"""Maximum file size in bytes (one hour of ten markers at 120 Hz needs half of it)."""

MAX_HEADER_BYTES = 4 << 20
"""Maximum header size in bytes (thousands of columns need about 1 MB)."""

MAX_VALUES = 1 << 26
"""Maximum number of cells in a table, which need half a gigabyte of memory."""

MAX_COLUMNS = 20_000

BLANK = ["", "NaN", "nan", "NAN", "-nan", "null", "NULL", "N/A", "n/a"]
"""Cell contents that denote a missing value."""

_PEEK = 1 << 16
_BLOCK = 8 << 20
"""Block size of the Arrow reader and maximum length of a line, bytes."""
_BLANKS = re.compile(rb"(?<=[,;|\t\n]) +(?=[,;|\t\r\n])|^ +(?=[,;|\t])")
_EMPTY_LINE = re.compile(rb"^[ \t,]*\r?$", re.MULTILINE)
_NUMBER = re.compile(
    r"\s*(?:[-+]?(?=.?\d)[\d.,]+(?:[eE][-+]?\d+)?|nan|\d{4}-\d\d-\d\d[T"
    r" ][\d:.,Z]+)?\s*",
    re.IGNORECASE,
)
_REPORTED_CELL = re.compile(
    r"column #(?P<column>\d+): Row #(?P<row>\d+): .* (?:invalid value|zone offset in)"
    r" '(?P<text>.*)'(?:\. If .*)?$",
    re.DOTALL,
)
_COMMENT = re.compile(r"\s*#|sep=.$", re.IGNORECASE)  # "sep=" is an Excel directive
_ZONE = re.compile(r"(?:Z|[+-]\d\d(?::?\d\d)?)\s*$")
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:")
# Decimal comma that cannot be a thousands separator, as in 0,5 or 1234,5.
_DECIMAL_COMMA = re.compile(
    rb"(?<![\d,])(?:0|\d{4,}),\d|\d,(?:\d{1,2}|\d{4,})(?![\d,])"
)
_SEPARATOR_NAMES = {
    ",": "commas",
    ";": "semicolons",
    "\t": "tabs",
    " ": "spaces",
    "|": "bars",
}
_EPOCH_RANGE = (1e9, 4.2e9)
"""Range of times that are interpreted as Unix times, s (years 2001 to 2103)."""
_MAX_EPOCH_STEP = 100.0
"""Maximum median step between Unix times without a unit, s.

Times with longer steps are not in seconds.
"""
_MAX_COMMENT_LINES = 1000


class Dialect(NamedTuple):
    """Layout of a plain table. Attributes left empty are detected from the file.

    Attributes:
        columns: column names of a file without a header.
        separator: cell separator. A space stands for any sequence of spaces and tabs.
    """

    columns: tuple[str, ...] = ()
    separator: str = ""
    decimal: str = ""


AS_FOUND = Dialect()
"""Dialect whose attributes are all detected from the file."""


class Times(NamedTuple):
    """Times of the rows in a table.

    Attributes:
        epoch_ns: Unix time that corresponds to a time of 0 s, ns, or None if the file
            contains no Unix times.
    """

    time: np.ndarray
    notes: list[str]
    epoch_ns: int | None


@dataclass(frozen=True)
class RecordedFile:
    """Recorded file in memory.

    Attributes:
        body: contents of a space-separated table with one space between cells, or None
            for other files.
        problem: reason why the file cannot be read as a table, or an empty string.
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
        """File contents without a byte order mark, with a line feed after each line."""
        if self.body is not None:
            return self.body
        text = self.data.removeprefix(b"\xef\xbb\xbf")
        # In files of the classic Mac OS, each line ends with a single carriage return.
        if b"\n" in text:
            return text
        return text.replace(b"\r", b"\n")

    @cached_property
    def first_line(self) -> str:
        """First line that is not blank."""
        wide = self.data.startswith(
            (b"\xff\xfe", b"\xfe\xff")
        )  # an error about UTF-16 is raised when the rows are read
        text = self.data.removeprefix(b"\xef\xbb\xbf").decode(
            "utf-16" if wide else "utf-8", "replace"
        )
        return next((line for line in text.splitlines() if line.strip()), "")

    @property
    def title(self) -> str:
        """First cell of the first line that is not blank."""
        return re.split(r"[,\t]", self.first_line)[0].strip(' "')

    @cached_property
    def sha256(self) -> str:
        """SHA-256 checksum of the file as a hexadecimal string."""
        return hashlib.sha256(self.data).hexdigest()

    def error(
        self, problem: str, line: int | None = None, column: int | None = None
    ) -> InputError:
        """Return an error that states a position in the file.

        `line` and `column` are counted from 1.
        """
        position = "".join(
            f":{number}" for number in (line, column) if number is not None
        )
        return InputError(f"{self.name}{position}: {problem}")

    def head(self, lines: int, after: int = 0) -> list[list[str]]:
        """Return the cells of at most `lines` header lines, without surrounding spaces.

        The first `after` lines of the file are skipped.
        """
        start = self.offset_of(after)
        split = self.raw[start : start + MAX_HEADER_BYTES].split(b"\n", lines)
        if len(split) <= lines and len(self.raw) > start + MAX_HEADER_BYTES:
            problem = (
                f"the header, or one line, is longer than {MAX_HEADER_BYTES >> 20} MB"
            )
            raise self.error(problem, after + len(split))
        rows = []
        for number, line in enumerate(split[:lines], start=after + 1):
            text = line.decode("utf-8", "replace").rstrip("\r")
            try:
                cells = next(
                    csv.reader([text], delimiter=self.separator, strict=True), []
                )
            except csv.Error as error:
                raise self.error(
                    f"the line is not valid CSV ({error})", number
                ) from error
            rows.append([cell.strip() for cell in cells])
        return rows

    def offset_of(self, line: int) -> int:
        """Return the byte offset of a line (from 0), or of the end of the file."""
        start = 0
        for _ in range(line):
            start = self.raw.find(b"\n", start) + 1 or len(self.raw)
        return start

    def line_of_row(self, row: int, header_lines: int) -> int:
        """Return the line of a row below a header, in a file that may have blank lines.

        `row` is counted from 0.
        """
        numbered = enumerate(BytesIO(self.raw), start=1)
        below = islice(numbered, header_lines, None)
        filled = (number for number, line in below if line.strip(b"\r\n"))
        return next(islice(filled, row, None))

    def rows(
        self,
        header_lines: int,
        columns: Sequence[int],
        width: int,
        *,
        section: bool = False,
        times: bool = False,
    ) -> tuple[np.ndarray, list[str]]:
        """Read the rows below a header.

        The last line is ignored if it has no line end, because the line may be cut off
        inside a number.

        Args:
            header_lines: number of header lines.
            columns: indices of the columns to read, counted from 0.
            width: number of cells per row.
            section: whether the rows end at an empty line instead of the end of the
                file.
            times: whether the columns contain times.

        Returns:
            Cell values, shape (rows, columns), and notes. Blank values are NaN.

        Raises:
            InputError: the table is empty or too large, a row has the wrong number of
                cells, or a cell is not a number.
        """
        raw = self.raw
        start = self.offset_of(header_lines)
        notes = []
        stop = self._end_of(start, section=section)
        if stop < len(raw) and not section:
            line = raw.count(b"\n", 0, stop) + 1
            notes.append(
                f"the last line ({line}) was left out, because it has no line end and"
                " may be cut off"
            )
        count = raw.count(b"\n", start, stop)
        if width > MAX_COLUMNS or count * width > MAX_VALUES:
            limit = f"at most {MAX_COLUMNS} columns and {MAX_VALUES} cells are allowed"
            raise self.error(f"the file has {count} rows of {width} cells, but {limit}")
        table = []
        if count:
            table = self._parsed(
                header_lines, columns, width, section=section, times=times
            )
        if not table or not len(table[0]):
            raise self.error(
                "no rows follow the header; record or export the file again",
                header_lines + 1,
            )
        return np.stack([column.to_numpy() for column in table], axis=1), notes

    def _end_of(self, start: int, *, section: bool) -> int:
        end = _EMPTY_LINE.search(self.raw, start) if section else None
        return max(start, end.start() if end else self.raw.rfind(b"\n") + 1)

    def times(self, clock: int, unit: str) -> Times:
        """Read the times of the rows in a plain table.

        The column with the index `clock` contains numbers or dates. If `unit` is empty,
        the numbers are in seconds. Unix times are shifted so that the earliest time is
        0.
        """
        import pyarrow as pa

        top = self.header_lines
        width = len(self.names)
        first = self.head(1, top)[0]
        if clock < len(first) and _DATE.match(first[clock]):
            notes: list[str] = []
            zone: str | None = "UTC"
            if not _ZONE.search(first[clock]):
                notes.append("the times state no time zone, so UTC is assumed")
                zone = None
            kind = pa.timestamp("ns", zone)
            (dates,) = self._parsed(top, [clock], width, kind, times=True)
            exact = dates.cast(pa.int64()).to_pylist()
            self._check_times([value is None for value in exact], clock)
            return _since_1970(exact, "ns", notes)
        values, notes = self.rows(top, [clock], width, times=True)
        time = values[:, 0]
        self._check_times((~np.isfinite(time)).tolist(), clock)
        if not _are_since_1970(time, unit):
            with np.errstate(over="ignore"):
                return Times(time * TIMES[unit or "s"], notes, None)
        # Unix times are parsed as decimal numbers, because double precision resolves
        # them only to 256 ns.
        return _since_1970([*map(Decimal, self.texts(clock))], unit or "s", notes)

    def texts(self, column: int) -> list[str]:
        """Return the cells of a column of a plain table, with decimal points."""
        import pyarrow as pa

        (texts,) = self._parsed(
            self.header_lines, [column], len(self.names), pa.string()
        )
        return [text.replace(self.decimal, ".") for text in texts.to_pylist()]

    def _check_times(self, missing: list[bool], clock: int) -> None:
        if any(missing):
            line = self.line_of_row(missing.index(True), self.header_lines)
            raise self.error("the row has no time", line, clock + 1)

    def _parsed(
        self,
        header_lines: int,
        columns: Sequence[int],
        width: int,
        kind: pa.DataType | None = None,
        *,
        section: bool = False,
        times: bool = False,
    ) -> list[pa.ChunkedArray]:
        import pyarrow as pa
        from pyarrow.csv import ConvertOptions, ParseOptions, ReadOptions, read_csv

        start = self.offset_of(header_lines)
        cut = memoryview(self.raw)[start : self._end_of(start, section=section)]
        names = [str(k) for k in range(width)]
        chosen = [names[k] for k in columns]
        uneven: list[InvalidRow] = []

        def refuse(row: InvalidRow) -> str:
            uneven.append(row)
            return "error"

        # Arrow reports the row of an error only if a single thread is used.
        reading = ReadOptions(column_names=names, use_threads=False, block_size=_BLOCK)
        parsing = ParseOptions(
            delimiter=self.separator,
            invalid_row_handler=refuse,
            newlines_in_values=False,
        )
        converting = ConvertOptions(
            column_types=dict.fromkeys(chosen, kind or pa.float64()),
            include_columns=chosen,
            null_values=BLANK,
            quoted_strings_can_be_null=True,
            decimal_point=self.decimal,
        )

        def read(rows: memoryview | bytes) -> list[pa.ChunkedArray]:
            table = read_csv(pa.py_buffer(rows), reading, parsing, converting)
            return list(table.columns)

        try:
            try:
                return read(cut)
            except pa.ArrowInvalid:
                # Arrow does not treat a cell of spaces as blank. Such cells are rare,
                # so the spaces are removed only after an error.
                return read(_BLANKS.sub(b"", bytes(cut)))
        except (pa.ArrowException, OSError) as error:
            if uneven:
                cells = uneven[0].actual_columns
                line = self.line_of_row((uneven[0].number or 1) - 1, header_lines)
                problem = f"the row has {cells} cells, but the header has {width}"
                raise self.error(problem, line) from error
            raise self._not_a_number(header_lines, str(error), times=times) from error

    def _not_a_number(
        self, header_lines: int, reported: str, *, times: bool
    ) -> InputError:
        """Return an error that points to the cell reported by Arrow.

        The row number that Arrow reports does not include empty lines.
        """
        cell = _REPORTED_CELL.search(reported)
        if cell is None:
            problem = (
                f"the file has no rows of numbers ({' '.join(reported.split())[:200]})"
            )
            return self.error(problem, header_lines + 1)
        # A quotation mark may join several lines into one cell.
        text = escape_unprintable(cell["text"].strip()[:60])
        problem = f"'{text}' is not a number; give a number or leave the cell empty"
        if times and ":" in text:
            problem = (
                f"'{text}' is not a number or an allowed time; give times as in"
                " 2026-03-01T12:00:00.5, with a time zone (Z or +01:00) in all rows or"
                " in none"
            )
        elif re.search(r"\d,\d", cell["text"]):
            problem += ", or use --decimal ',' for decimal commas"
        column = int(cell["column"]) + 1
        line = self.line_of_row(int(cell["row"]) - 1, header_lines)
        return self.error(problem, line, column)


def recording_file(path: StrPath) -> Path:
    """Return the path of a recording, or of the ROS 2 bag in a folder."""
    place = Path(path)
    inside = place.glob("*") if (place / "metadata.yaml").is_file() else ()
    bags = sorted(file for file in inside if file.suffix.lower() in (".db3", ".mcap"))
    if len(bags) > 1:
        names = ", ".join(file.name for file in bags[:3])
        raise InputError(
            f"{display_path(place)}: the folder has {len(bags)} bags; give one of them"
            f" ({names}, …)"
        )
    return require_file(bags[0] if bags else place, suffix=".csv")


def start_of(path: StrPath, dialect: Dialect = AS_FOUND) -> RecordedFile:
    """Read the first bytes of a file, and detect the layout of a plain table."""
    place = recording_file(path)
    return laid_out(RecordedFile(display_path(place), _bytes(place, _PEEK)), dialect)


def read_bytes(path: StrPath) -> RecordedFile:
    """Read a recorded file of any kind.

    Raises:
        InputError: the file is missing, not a regular file, not readable, empty, or too
            large.
    """
    place = recording_file(path)
    file = RecordedFile(display_path(place), _bytes(place, MAX_BYTES + 1))
    if len(file.data) > MAX_BYTES:
        megabytes = place.stat().st_size / (1 << 20)
        limit = MAX_BYTES >> 20
        raise file.error(
            f"the file size is {megabytes:.0f} MB, but at most {limit} MB are allowed;"
            " export a shorter recording"
        )
    if not file.raw.strip():
        raise file.error(
            "the file is empty; a recording has a header and rows of numbers"
        )
    return file


def _bytes(place: Path, limit: int) -> bytes:
    try:
        with place.open("rb") as stream:
            return stream.read(limit)
    except OSError as error:
        raise InputError(
            f"{display_path(place)}: the file cannot be read ({error.strerror})"
        ) from error


def read_file(path: StrPath) -> RecordedFile:
    """Read a recorded text file."""
    file = read_bytes(path)
    # A zero byte means that the file is not text. UTF-16 files, which may contain zero
    # bytes, raise another error.
    zero = file.data.find(b"\0")
    if zero >= 0 and not file.data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise file.error(
            f"this is not a text file, because byte {zero + 1} is 0x00; use a CSV file"
        )
    if not file.data.isascii():
        decode_text(file.data, file.name)
    return file


def laid_out(file: RecordedFile, dialect: Dialect = AS_FOUND) -> RecordedFile:
    """Return a file with known column names, cell separator and decimal mark."""
    if file.names or file.problem:
        return file
    start = file.raw[:MAX_HEADER_BYTES].split(b"\n", _MAX_COMMENT_LINES)
    lines = [
        line.decode("utf-8", "replace").strip("\r")
        for line in start[:_MAX_COMMENT_LINES]
    ]
    named = (
        k for k, line in enumerate(lines) if line.strip() and not _COMMENT.match(line)
    )
    top = next(named, 0)
    row = next(filter(str.strip, lines[top + 1 :]), "")
    separator = dialect.separator or _separator(lines[top], row)
    header = _header(lines, top, separator, dialect.columns)
    if separator == " ":
        body = b"\n".join(b" ".join(line.split()) for line in file.raw.split(b"\n"))
        file = replace(file, body=body)
    decimal = dialect.decimal or _decimal(file, separator, header.lines)
    notes = list(header.notes)
    problem = header.problem
    if len(start) == 1 and len(file.raw) > MAX_HEADER_BYTES:
        problem = f"the header, or one line, is longer than {MAX_HEADER_BYTES >> 20} MB"
    elif separator == decimal and '"' not in row:
        problem = (
            f"'{decimal}' cannot be both separator and decimal mark; give another"
            " --separator"
        )
    elif not decimal:
        decimal = ","
        problem = problem or (
            "commas in the numbers may be decimal marks or thousands separators; give"
            " --decimal ',' or '.'"
        )
    if separator + decimal != ",.":
        marks = "commas" if decimal == "," else "points"
        cells = _SEPARATOR_NAMES[separator]
        notes.append(
            f"the cells are separated by {cells}, and decimal marks are {marks}"
        )
    return replace(
        file,
        separator=separator,
        decimal=decimal,
        names=tuple(clean(name) for name in header.names),
        header_lines=header.lines,
        notes=tuple(notes),
        problem=problem,
    )


class _Header(NamedTuple):
    names: Sequence[str]
    lines: int
    notes: Sequence[str] = ()
    problem: str = ""


def _header(
    lines: Sequence[str], top: int, separator: str, columns: Sequence[str]
) -> _Header:
    comments = [line.lstrip("# ") for line in lines[:top] if line.strip()]
    cells = _cells(lines[top], separator)
    numbers = [bool(_NUMBER.fullmatch(cell)) for cell in cells if cell.strip()]
    if columns:
        has_names = not any(numbers)
    else:
        has_names = not numbers or not all(numbers)
    above = _cells(comments[-1], separator) if comments else []
    names_above = len(above) == len(cells) and not any(map(_NUMBER.fullmatch, above))
    if not has_names and not columns and names_above:
        columns = above
        comments = comments[:-1]
    notes = []
    if comments:
        notes.append(f"{len(comments)} comment lines above the header were skipped")
    if has_names:
        if columns:
            notes.insert(
                0,
                "the file has column names, so the names in --columns or in the map"
                " are ignored",
            )
        return _Header(cells, top + 1, notes)
    if columns:
        return _Header(columns, top, notes)
    example = "--columns time,x_1,y_1,… (or columns: [time, …] in a map)"
    problem = (
        f"the columns have no names, because the first line contains {len(cells)}"
        f" numbers; give {example}"
    )
    return _Header((), top, notes, problem)


def _decimal(file: RecordedFile, separator: str, header_lines: int) -> str:
    start = file.offset_of(header_lines)
    if separator == "," or file.raw.find(b",", start) < 0:
        return "."
    if _DECIMAL_COMMA.search(file.raw, start):
        return ","
    return ""


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:
        return [line]


def _separator(header: str, row: str) -> str:
    present = [mark for mark in ";\t|," if mark in header]
    words = header.split()
    by_spaces = present in ([], [","]) and len(words) == len(row.split()) > 1
    if by_spaces and (
        not present
        or all(_NUMBER.fullmatch(word) and word[-1] != "," for word in words)
    ):
        return " "
    fitting = (
        mark
        for mark in present
        if len(_cells(header, mark)) == len(_cells(row, mark)) > 1
    )
    return next(fitting, "," if "," in present else (*present, ",")[0])


def _are_since_1970(time: np.ndarray, unit: str) -> bool:
    scale = TIMES[unit or "s"]
    low, high = _EPOCH_RANGE
    in_range = low <= float(time.min()) * scale <= high
    if not in_range or unit or len(time) < 2:
        return in_range
    return bool(np.median(np.diff(np.sort(time))) < _MAX_EPOCH_STEP)


def _since_1970(
    exact: Sequence[int] | Sequence[Decimal], unit: str, notes: list[str]
) -> Times:
    origin = min(exact)
    since = np.array([float(value - origin) for value in exact]) * TIMES[unit]
    epoch_ns = round(origin * round(TIMES[unit] * 1e9))
    seconds, rest = divmod(epoch_ns, 10**9)
    note = f"the times are in {unit} since 1970; {seconds}.{rest:09d} s were subtracted"
    return Times(since, [*notes, note], epoch_ns)
