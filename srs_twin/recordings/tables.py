"""CSV tables: names, units and rows of numbers, and where in the file something is wrong.

Units that recordings come in, and what they are in SI.

Rows of numbers after a CSV header, read by Arrow; what is wrong with them, with its place.

Columns of a plain CSV file: names like ``x_1``, ``x_1_mm``, ``pressure_plus_2 (kPa)`` and ``time_ms``.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin.recordings.source import Source

LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
ANGLES = {"rad": 1.0, "deg": 0.017453292519943295}
PRESSURES = {"pa": 1.0, "kpa": 1e3, "bar": 1e5, "psi": 6894.757}

MOTIVE_LENGTHS = {
    "meters": "m", "centimeters": "cm", "millimeters": "mm", "inches": "in", "feet": "ft",
}  # fmt: skip
"""Words after 'Length Units' in a Motive export."""


MAX_VALUES = 1 << 26
"""Rows times columns: half a gigabyte of numbers."""

MAX_COLUMNS = 20_000

BLANK = ["", "NaN", "nan", "NAN", "-nan", "null", "NULL", "N/A", "n/a"]
"""What stands where nothing was seen."""

_BLOCK = 8 << 20  # bytes that Arrow takes at a time; no line is longer


@dataclass(frozen=True)
class Rows:
    """Numbers of a CSV file.

    Attributes:
        values: shape (rows, columns); NaN where a cell is blank or not finite.
        first_line: number of the line that the first row stands on, counted from 1.
        corrections: what was left out, in words.
    """

    values: np.ndarray
    first_line: int
    corrections: tuple[str, ...]


def read_rows(source: Source, header_lines: int, columns: list[int], width: int) -> Rows:
    """Read the rows below a header.

    A last line without a line end may be cut anywhere, also inside a number: it is left out, and said so.

    Args:
        source: the file.
        header_lines: how many lines the header has.
        columns: which columns to read, counted from 0, ascending.
        width: how many cells a row has.

    Raises:
        InputError: no rows, too many values, a row with more or fewer cells, a cell that is no number.
    """
    start = 0
    for _ in range(header_lines):
        start = source.raw.find(b"\n", start) + 1 or len(source.raw)
    stop, corrections = _whole_lines(source, start)
    _check_first(source, start, stop, header_lines, width)
    count = source.raw.count(b"\n", start, stop)
    if count == 0:
        raise source.error("a header and no rows below it", header_lines + 1)
    if width > MAX_COLUMNS or count * width > MAX_VALUES:
        raise source.error(
            f"{count} rows of {width} cells; at most {MAX_COLUMNS} columns and {MAX_VALUES} cells are read"
        )
    values = _parse(source, start, stop, header_lines, columns, width)
    if not len(values):
        raise source.error("a header and no rows below it", header_lines + 1)
    endless = np.isinf(values)
    if endless.any():
        corrections += (f"{int(endless.sum())} infinite numbers: taken as not seen",)
        values[endless] = np.nan
    return Rows(values, header_lines + 1, corrections)


def _check_first(source: Source, start: int, stop: int, header_lines: int, width: int) -> None:
    """Refuse by the first row alone, before all the others are looked at."""
    end = source.raw.find(b"\n", start, stop)
    first = source.raw[start : max(end, start)]
    cells = first.count(b",") + 1
    if first.strip() and b'"' not in first and cells != width:
        raise source.error(f"{cells} cells where the header has {width}", header_lines + 1)


def _whole_lines(source: Source, start: int) -> tuple[int, tuple[str, ...]]:
    raw = source.raw
    if raw.endswith(b"\n") or start >= len(raw):
        return len(raw), ()
    stop = max(start, raw.rfind(b"\n") + 1)
    line = raw.count(b"\n", 0, stop) + 1
    return stop, (f"line {line}, the last, has no line end and may be cut: left out",)


def _parse(
    source: Source, start: int, stop: int, header_lines: int, columns: list[int], width: int
) -> np.ndarray:
    import pyarrow as pa
    from pyarrow import csv

    names = [str(k) for k in range(width)]
    wrong: list[tuple[int, int]] = []

    def refuse(row: Any) -> str:
        wrong.append((row.number or 0, row.actual_columns))
        return "error"

    try:
        table = csv.read_csv(
            pa.py_buffer(memoryview(source.raw)[start:stop]),
            # One thread: only then does Arrow know on which row a fault lies.
            read_options=csv.ReadOptions(column_names=names, use_threads=False, block_size=_BLOCK),
            parse_options=csv.ParseOptions(invalid_row_handler=refuse, newlines_in_values=False),
            convert_options=csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.float64()),
                include_columns=[names[k] for k in columns],
                null_values=BLANK,
                quoted_strings_can_be_null=True,
            ),
        )
    except (pa.ArrowException, OSError) as error:
        if wrong:
            line, cells = header_lines + wrong[0][0], wrong[0][1]
            raise source.error(f"{cells} cells where the header has {width}", line) from error
        raise _bad_cell(source, start, stop, header_lines, columns, str(error)) from error
    read = [table.column(k).to_numpy() for k in range(len(columns))]
    return np.stack(read, axis=1) if len(table) else np.empty((0, len(columns)))


def _bad_cell(
    source: Source, start: int, stop: int, header_lines: int, columns: list[int], said: str
) -> Exception:
    """Return an error with the place of the first cell that is no number, from Arrow's word for it."""
    found = re.search(r"column #(\d+):(?: Row #(\d+):)?.*invalid value '(.{0,60})", said, re.DOTALL)
    if found is None:
        return source.error(f"no rows of numbers ({' '.join(said.split())[:200]})", header_lines + 1)
    # Arrow counts the columns of the file, blank lines not at all.
    column, text = int(found[1]), found[3].partition("'")[0]
    line = None
    for number, each in enumerate(source.raw[start:stop].split(b"\n"), start=header_lines + 1):
        cells = each.decode("utf-8", "replace").rstrip("\r").split(",")
        if column < len(cells) and cells[column].strip('"') == text and not _is_number(text):
            line = number
            break
    return source.error(f"'{text}' is no number; a number or nothing is wanted", line, column + 1)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


_NAME = re.compile(
    r"\s*([A-Za-z][A-Za-z_]*?)(?:_(\d{1,3})([a-z])?)?(?:_([A-Za-z]+)|\s*[(\[]\s*(\w+)\s*[)\]])?\s*"
)


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        place: counted from 0.
        name: base name, e.g. "x".
        number: 1 and on; 0 where the name has none.
        which: letter behind the number ("a", "b" for two markers), or empty.
        unit: as the name gives it, lower case; empty where it gives none.
        text: the whole name.
    """

    place: int
    name: str
    number: int
    which: str
    unit: str
    text: str


def read_columns(
    source: Source, known: Mapping[str, Mapping[str, float]]
) -> tuple[list[Column], int, list[str]]:
    """Read the header of a plain CSV file.

    Args:
        source: the file.
        known: base name → its units (name → factor to SI); empty for what has no unit.

    Returns:
        The known columns; the number of cells in a row; names of the columns that are none of them.

    Raises:
        InputError: no header, another separator, a name twice, or a unit that is not known.
    """
    line = source.head(1)[0]
    try:
        cells = next(csv.reader([line], strict=True), [])
    except csv.Error as error:
        raise source.error(f"no line of a CSV file ({error})", 1) from error
    for separator, called in ((";", "semicolons"), ("\t", "tabs")):
        if separator in line and len(cells) == 1:
            raise source.error(
                f"cells are separated by {called}; save it with commas, and points in numbers", 1
            )
    found: list[Column] = []
    others: list[str] = []
    seen: dict[tuple[str, int, str], str] = {}
    for place, text in enumerate(cells):
        column = _column(place, text, known)
        if column is None:
            others.append(text.strip()[:40])
            continue
        units = known[column.name]
        if column.unit and column.unit not in units:
            allowed = ", ".join(units) or "none"
            raise source.error(f"{text}: unit '{column.unit}' is not known; allowed: {allowed}", 1, place + 1)
        key = (column.name, column.number, column.which)
        if key in seen:
            raise source.error(f"{text}: the same as column '{seen[key]}'", 1, place + 1)
        seen[key] = text
        found.append(column)
    return found, len(cells), others


def _column(place: int, text: str, known: Mapping[str, Mapping[str, float]]) -> Column | None:
    match = _NAME.fullmatch(text)
    if match is None:
        return None
    name, number, which, trailing, bracketed = match.groups()
    unit = (trailing or bracketed or "").lower()
    if name.lower() not in known and trailing and f"{name}_{trailing}".lower() in known and number is None:
        name, unit = f"{name}_{trailing}", ""
    if name.lower() not in known:
        return None
    return Column(place, name.lower(), int(number or 0), which or "", unit, text.strip())
