"""Columns of plain tables: names with units, their meanings in a map, and values in SI.

A plain table names its columns in the first line: ``x_1``, ``x_1_mm``,
``pressure_plus_2 (kPa)``, ``time_ms``. Columns without a unit are in SI.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.files import StrPath
from srs_twin.recordings.recorded_file import (
    AS_FOUND,
    Dialect,
    RecordedFile,
    laid_out,
    read_file,
)
from srs_twin.recordings.signals.units import (
    TIMES,
    bracketed,
    clean,
    is_clock,
    symbol,
    unit_of,
)

CLOCK = {"time": TIMES}
"""Column of the time; `is_clock` lists its names."""

_LISTED = 5
"""Largest number of columns in a message."""
_NAME = re.compile(
    r"([A-Za-z][A-Za-z_]*?)(?:_(\d{1,3}))?(?:[_ ]+([^\W\d_]+(?:/\w+)?|%))?"
)


class TimedRows(NamedTuple):
    """Rows of a table with their times.

    Attributes:
        time: shape (rows,), s.
        values: shape (rows, columns).
        notes: notes on rows and times.
        epoch_ns: value subtracted from times since 1970, ns; None for other times.
    """

    time: np.ndarray
    values: np.ndarray
    notes: list[str]
    epoch_ns: int | None


def first_line_names(path: StrPath, dialect: Dialect = AS_FOUND) -> list[str]:
    """Return the names of a table's columns in lower case; empty if it has none.

    Raises:
        InputError: the file cannot be read.
    """
    return [name.lower() for name in laid_out(read_file(path), dialect).names]


@dataclass(frozen=True)
class CsvColumn:
    """Column of a plain table.

    Attributes:
        place: index, counted from 0.
        name: base name, for example "x".
        number: 1 or more; 0 if the name has none.
        unit: symbol of the unit in the name or a map; empty if there is none.
        factor: factor to SI.
        text: full name.
    """

    place: int
    name: str
    number: int
    unit: str
    factor: float
    text: str


@dataclass(frozen=True)
class CsvTable:
    """Plain table with its columns.

    Attributes:
        file: file of the table.
        columns: known columns.
        unused: names of the other columns.
        notes: notes on units.
    """

    file: RecordedFile
    columns: tuple[CsvColumn, ...]
    unused: tuple[str, ...]
    notes: tuple[str, ...] = ()

    def error(
        self, column: CsvColumn, problem: str, row: int | None = None
    ) -> InputError:
        """Return an error at a column's name, or at its cell in a row counted from 0."""
        if row is None:
            line = self.file.header_lines or 1
        else:
            line = self.file.header_lines + 1 + row
        return self.file.error(problem, line, column.place + 1)

    def clock(self, missing: str) -> CsvColumn:
        """Return the column of the time.

        Raises:
            InputError: there is none, with the message `missing`.
        """
        column = next((column for column in self.columns if column.name in CLOCK), None)
        if column is None:
            raise self.file.error(missing, self.file.header_lines or 1)
        return column

    def per_segment(
        self, names: Sequence[str], robot: str, segments: int
    ) -> list[CsvColumn]:
        """Return the columns of these names, segment by segment from the head.

        Raises:
            InputError: a column is missing, or belongs to a segment that the robot does
                not have.
        """
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
                    f"{name}_{segment} is missing; {robot} has {segments} segments", 1
                )
        for key, column in by_key.items():
            if key not in required:
                raise self.error(
                    column, f"{column.text}: {robot} has {segments} segments"
                )
        return [by_key[key] for key in required]

    def read(self, columns: Sequence[CsvColumn]) -> tuple[np.ndarray, list[str]]:
        """Return the numbers of columns in SI, shape (rows, columns), and notes.

        Raises:
            InputError: as `RecordedFile.rows`.
        """
        places = [column.place for column in columns]
        values, notes = self.file.rows(
            self.file.header_lines, places, len(self.file.names)
        )
        with np.errstate(over="ignore"):  # callers check for values that are too large
            return values * [column.factor for column in columns], [
                *self.file.notes,
                *self.notes,
                *notes,
            ]

    def read_timed(
        self,
        clock: CsvColumn | None,
        columns: Sequence[CsvColumn],
        rate_hz: float | None = None,
    ) -> TimedRows:
        """Return the numbers of columns in SI with their times; without a time column, rows are counted.

        Raises:
            InputError: as `RecordedFile.times`.
        """
        values, notes = self.read(columns) if columns else (np.empty((0, 0)), [])
        if clock is None:
            rate = rate_hz or 1.0
            counted = f"frames counted, {rate:g} per second"
            return TimedRows(
                np.arange(len(values)) / rate, values, [*notes, counted], None
            )
        time, noted, epoch_ns = self.file.times(clock.place, clock.unit)
        return TimedRows(time, values, list(dict.fromkeys([*notes, *noted])), epoch_ns)


def not_used(names: Sequence[str]) -> list[str]:
    """Return a note on the columns that were not used; empty if all were."""
    listed = ", ".join(names[:_LISTED]) + (", …" if len(names) > _LISTED else "")
    if names:
        return [f"{len(names)} columns not used: {listed}"]
    return []


class Meaning(NamedTuple):
    """Meaning of a column with another name, from a map.

    Attributes:
        name: ``pressure_plus_1``, ``time``.
        default: unit if the name of the column states none.
        unit: unit of the column; empty if the map does not state it.
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
        file: the table, with or without its layout.
        known: base name → its units (name → factor to SI); empty if the quantity has no
            unit.
        names: column → meaning, for other names.

    Raises:
        UnknownNameError: a column in `names` does not exist.
        InputError: there is no header, a name occurs twice, or a unit is unknown.
    """
    file = laid_out(file)
    if file.problem:
        raise file.error(file.problem, file.header_lines + (not file.names))
    meanings = {clean(name): meaning for name, meaning in (names or {}).items()}
    for name in meanings:
        if name not in file.names:
            raise UnknownNameError("column", name, file.names)
    taken = {meaning.name for meaning in meanings.values()}
    if "time" in known.keys() - taken:
        clocks = [
            text for text in file.names if is_clock(text) and text not in meanings
        ]
        clock = min(
            clocks, key=lambda text: text.lower() not in ("time", "t"), default=""
        )
        meanings |= {clock: Meaning("time")} if clock else {}
    seen: dict[tuple[str, int], CsvColumn] = {}
    unused = []
    notes = []
    for index, text in enumerate(file.names):
        meaning = meanings.get(text)
        # A column that the map does not mention is ignored if the map gives its
        # quantity to another column.
        own = meaning is None and bracketed(text)[0] not in taken
        try:
            column, note = (
                _column(index, text, known, meaning) if meaning or own else (None, "")
            )
        except InputError as error:
            raise file.error(str(error), file.header_lines or 1, index + 1) from error
        notes += [note] if note else []
        if column is None:
            unused.append(text[:40])
            continue
        first = seen.setdefault((column.name, column.number), column)
        if first is not column:
            problem = f"{text}: the same as column '{file.names[first.place]}'"
            raise file.error(problem, file.header_lines or 1, index + 1)
    return CsvTable(file, tuple(seen.values()), tuple(unused), tuple(notes))


def _column(
    place: int,
    text: str,
    known: Mapping[str, Mapping[str, float]],
    meaning: Meaning | None,
) -> tuple[CsvColumn | None, str]:
    """Return a known column, and a note on its unit."""
    bare, bracket = bracketed(text)
    match = _NAME.fullmatch(meaning.name if meaning else bare)
    name, number, trailing = match.groups() if match else [""] * 3
    unit = trailing or bracket or ""
    note = ""
    if name.lower() not in known and trailing and number is None:
        name, unit = (
            f"{name}_{trailing}",
            bracket,
        )  # the last word of the name, not a unit
    units = known.get(name.lower())
    if units is None or (meaning is None and name.lower() == "time"):
        return None, ""
    if meaning is not None and units:
        unit, note = unit_of(text, units, meaning.default, meaning.unit)
    elif meaning is None and unit and not symbol(unit, units):
        raise InputError(
            f"{text}: unit '{unit}' is not known; allowed: {', '.join(units) or 'none'}"
        )
    unit = symbol(unit, units)
    number = int(number or 0)
    return (
        CsvColumn(place, name.lower(), number, unit, units.get(unit, 1.0), text),
        note,
    )
