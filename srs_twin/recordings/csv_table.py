"""Plain tables whose columns are converted to SI units.

The first line of a plain table contains the column names, for example ``x_1``,
``x_1_mm``, ``pressure_plus_2 (kPa)`` or ``time_ms``. A column without a unit in its
name is assumed to be in SI units.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from difflib import get_close_matches
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError, UnknownNameError, named_in_errors
from srs_twin.io.files import StrPath
from srs_twin.recordings.recorded_file import RecordedFile, laid_out, read_file
from srs_twin.recordings.signals.units import (
    TIMES,
    Meaning,
    bracketed,
    clean,
    is_clock,
    stated_unit,
    symbol,
    unit_of,
)

CLOCK = {"time": TIMES}
"""Base name of the time column and its accepted units."""

_LISTED = 5
_MISSPELT_RATIO = 0.85
"""Minimum similarity of a misspelt name to the correct name, from 0 to 1."""
_NAME = re.compile(
    r"([A-Za-z][A-Za-z_]*?)(?:_(\d{1,3}))?(?:[_ ]+([^\W\d_]+(?:/\w+)?|%))?"
)


class TimedRows(NamedTuple):
    """Rows of a table with their times.

    Attributes:
        values: cell values in SI units, shape (rows, columns).
        epoch_ns: Unix time that corresponds to a time of 0 s, ns, or None if the file
            contains no Unix times.
    """

    time: np.ndarray
    values: np.ndarray
    notes: list[str]
    epoch_ns: int | None


def first_line_names(path: StrPath) -> list[str]:
    """Return the column names of a table in lower case (empty without a header)."""
    return [name.lower() for name in laid_out(read_file(path)).names]


@dataclass(frozen=True)
class CsvColumn:
    """Column of a plain table.

    Attributes:
        name: base name, for example "x".
        number: number in the column name, for example 1 in "x_1_mm", or 0 if there is
            none.
        unit: unit symbol from the column name or the recording map, or an empty string
            if no unit is stated.
    """

    place: int
    name: str
    number: int
    unit: str
    factor: float
    text: str


@dataclass(frozen=True)
class CsvTable:
    """Plain table with its recognized columns and the names of its unused columns."""

    file: RecordedFile
    columns: tuple[CsvColumn, ...]
    unused: tuple[str, ...]
    notes: tuple[str, ...] = ()

    def error(
        self, column: CsvColumn, problem: str, row: int | None = None
    ) -> InputError:
        """Return an error that points to a cell of a column.

        `row` is the row index, counted from 0, or None for the column header.
        """
        if row is None:
            line = self.file.header_lines or 1
        else:
            line = self.file.line_of_row(row, self.file.header_lines)
        return self.file.error(problem, line, column.place + 1)

    def check_units(self, columns: Sequence[CsvColumn]) -> None:
        """Raise an error if only some columns of a quantity state a unit."""
        without = [column for column in columns if not column.unit]
        if 0 < len(without) < len(columns):
            stated = next(column for column in columns if column.unit)
            raise self.error(
                without[0],
                f"the column '{without[0].text}' has no unit, but '{stated.text}' is in"
                f" {stated.unit}; add the unit to the name, or state it in a map",
            )

    def check_range(
        self,
        column: CsvColumn,
        values: np.ndarray,
        limits: tuple[float, float],
        rule: str,
    ) -> None:
        """Raise an error if a value is below the first limit or above the second one.

        `values` and `limits` are in SI units. The text `rule` contains {} in the place
        of the allowed range.
        """
        wrong = (values < limits[0]) | (values > limits[1])
        if wrong.any():
            row = int(wrong.argmax())
            value, low, high = np.array([values[row], *limits]) / column.factor
            unit = column.unit or "in SI units"
            allowed = rule.format(f"between {low:g} and {high:g} {unit}")
            problem = f"{column.text}: {value:g} is not allowed; {allowed}"
            raise self.error(column, problem, row)

    def check_misspelt(self, absent: Sequence[str]) -> None:
        """Raise an error if an unused column has nearly the name of an absent column."""
        for name in self.unused:
            if close := get_close_matches(name, absent, 1, _MISSPELT_RATIO):
                line = self.file.header_lines or 1
                problem = f"unknown column '{name}'; did you mean {close[0]}?"
                raise self.file.error(problem, line)

    def decimal_step(self, column: CsvColumn, values: np.ndarray) -> float:
        """Return the smallest decimal step of the numbers in a column, in SI units.

        `values` contains the values of the column, with NaN for blank cells.
        """
        cells = np.array(self.file.texts(column.place))[np.isfinite(values)]
        exponents = [int(Decimal(cell).as_tuple().exponent) for cell in cells.tolist()]
        return column.factor * 10.0 ** min(exponents, default=0)

    def clock(self, missing: str) -> CsvColumn:
        """Return the time column.

        `missing` is the error message for a table without a time column.
        """
        column = next((column for column in self.columns if column.name in CLOCK), None)
        if column is None:
            raise self.file.error(missing, self.file.header_lines or 1)
        return column

    def per_segment(
        self, names: Sequence[str], robot: str, segments: int
    ) -> list[CsvColumn]:
        """Return the columns with the given base names, ordered by segment."""
        by_key = {
            (column.name, column.number): column
            for column in self.columns
            if column.name in names
        }
        required = [
            (name, segment) for segment in range(1, segments + 1) for name in names
        ]
        for name, segment in required:
            if (name, segment) not in by_key:
                raise self.file.error(
                    f"the column '{name}_{segment}' is missing; {robot} has"
                    f" {segments} segments",
                    self.file.header_lines or 1,
                )
        for key, column in by_key.items():
            if key not in required:
                raise self.error(
                    column,
                    f"the column '{column.text}' does not match any segment;"
                    f" {robot} has {segments} segments",
                )
        return [by_key[key] for key in required]

    def read(self, columns: Sequence[CsvColumn]) -> tuple[np.ndarray, list[str]]:
        """Return the column values in SI units, shape (rows, columns), and notes."""
        places = [column.place for column in columns]
        file = self.file
        values, notes = file.rows(file.header_lines, places, len(file.names))
        with np.errstate(over="ignore"):  # the caller reports infinite values
            values = values * [column.factor for column in columns]
        return values, [*file.notes, *self.notes, *notes]

    def read_timed(
        self,
        clock: CsvColumn | None,
        columns: Sequence[CsvColumn],
        rate_hz: float | None = None,
    ) -> TimedRows:
        """Read columns in SI units with their times.

        If `clock` is None, the times are computed from the row numbers and the frame
        rate `rate_hz`.
        """
        values, notes = self.read(columns)
        if clock is None:
            rate = rate_hz or 1.0
            counted = f"times computed from row numbers at {rate:g} frames per second"
            time = np.arange(len(values)) / rate
            return TimedRows(time, values, [*notes, counted], None)
        times = self.file.times(clock.place, clock.unit)
        notes = list(dict.fromkeys([*notes, *times.notes]))
        return TimedRows(times.time, values, notes, times.epoch_ns)


def not_used(names: Sequence[str]) -> list[str]:
    """Return a list with a note on unused columns, or an empty list."""
    if not names:
        return []
    listed = [*names[:_LISTED], *["…"] * (len(names) > _LISTED)]
    return [f"{len(names)} columns not used: {', '.join(listed)}"]


def read_table(
    file: RecordedFile,
    known: Mapping[str, Mapping[str, float]],
    meanings: Mapping[str, Meaning] | None = None,
) -> CsvTable:
    """Read the header of a plain table.

    `known` maps each base name to its accepted units and their factors to SI units.
    `meanings` maps each column name to the meaning that a recording map states.
    """
    file = laid_out(file)
    line = file.header_lines or 1
    if file.problem:
        raise file.error(file.problem, file.header_lines + (not file.names))
    with named_in_errors(f"{file.name}:{line}"):
        mapped = _mapped_names(file, meanings or {}, timed="time" in known)
    taken = {meaning.key for meaning in mapped.values()}
    columns: dict[tuple[str, int], CsvColumn] = {}
    unused = []
    notes = []
    for place, text in enumerate(file.names):
        try:
            if meaning := mapped.get(text):
                column, note = _mapped_column(place, text, known, meaning)
                if note:
                    notes.append(note)
            elif bracketed(text)[0] in taken:  # a column in the map has priority
                column = None
            else:
                column = _own_column(place, text, known)
        except InputError as error:
            raise file.error(str(error), line, place + 1) from error
        if column is None:
            unused.append(text[:40])
            continue
        first = columns.setdefault((column.name, column.number), column)
        if first is not column:
            problem = (
                f"the column '{text}' has the same meaning as the column"
                f" '{file.names[first.place]}'; remove one of them"
            )
            raise file.error(problem, line, place + 1)
    table = CsvTable(file, tuple(columns.values()), tuple(unused), tuple(notes))
    for units in known.values():
        table.check_units(
            [column for column in table.columns if known[column.name] == units]
        )
    return table


def _mapped_names(
    file: RecordedFile, meanings: Mapping[str, Meaning], *, timed: bool
) -> dict[str, Meaning]:
    mapped = {clean(name): meaning for name, meaning in meanings.items()}
    for name in mapped:
        if name not in file.names:
            raise UnknownNameError("column", name, file.names)
    if not timed or any(meaning.kind == "time" for meaning in mapped.values()):
        return mapped
    clocks = [name for name in file.names if is_clock(name) and name not in mapped]
    usual = [name for name in clocks if name.lower() in ("time", "t")]
    return mapped | dict.fromkeys([*usual, *clocks][:1], Meaning("time", "time"))


def _own_column(
    place: int, text: str, known: Mapping[str, Mapping[str, float]]
) -> CsvColumn | None:
    bare, bracket = bracketed(text)
    match = _NAME.fullmatch(bare)
    if match is None:
        return None
    name, number, trailing = match[1].lower(), match[2], match[3]
    if name not in known and trailing and number is None:
        # The last word is part of the name, not a unit.
        name = f"{name}_{trailing.lower()}"
        trailing = None
    if name not in known or name == "time":
        return None
    units = known[name]
    unit = ""
    for stated in filter(None, (trailing, bracket)):
        found = symbol(stated, units)
        if not found:
            raise InputError(
                f"{text}: unknown unit '{stated}'; allowed units:"
                f" {', '.join(units) or 'none'}"
            )
        if unit and found != unit:
            raise InputError(f"{text}: two units, {unit} and {found}; remove one")
        unit = found
    factor = units.get(unit, 1.0)
    return CsvColumn(place, name, int(number or 0), unit, factor, text)


def _mapped_column(
    place: int, text: str, known: Mapping[str, Mapping[str, float]], meaning: Meaning
) -> tuple[CsvColumn, str]:
    units = known[meaning.name]
    unit, note = unit_of(text, stated_unit(text, units), units, meaning)
    factor = units.get(unit, 1.0)
    return CsvColumn(place, meaning.name, meaning.number, unit, factor, text), note
