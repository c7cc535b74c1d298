"""Plain CSV with the columns ``time`` and ``x_1,y_1…`` (head first), or with other names.

The unit is in the name: ``time_ms``, ``x_1_mm`` or ``x_1 (mm)``; without a unit it is s or m. ``z_1`` is
optional. Two markers on a connector are ``x_1a,y_1a,x_1b,y_1b``.
"""

from __future__ import annotations

import re
from dataclasses import replace

from srs_twin.recordings.csv_table import (
    CLOCK,
    CsvColumn,
    CsvTable,
    RecordedFile,
    laid_out,
    not_used,
    read_table,
)
from srs_twin.recordings.formats.base import Unstated, axis_columns, marker_table
from srs_twin.recordings.marker_table import MarkerTable
from srs_twin.recordings.signals.units import LENGTHS, is_clock

NAME = "plain CSV"
_NUMBERED = re.compile(r"[xyz]_\d+(?![A-Za-z0-9]{2})", re.IGNORECASE)


def recognizes(start: RecordedFile) -> bool:
    """Return whether a file starts with the names of columns of a time or of positions."""
    names = start.names
    return any(_NUMBERED.match(name) or is_clock(name) for name in names) or bool(axis_columns(names))


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read the markers of a plain CSV file.

    Raises:
        InputError: the file is damaged, has no positions, or its units contradict each other; the message
            names line and column.
    """
    rate_hz, unit = unstated.rate_hz, unstated.unit
    file = laid_out(file, unstated.dialect)
    numbered = any(_NUMBERED.match(name) for name in file.names)
    table = read_table(file, CLOCK | dict.fromkeys("xyz" if numbered else "", LENGTHS))
    markers = _marker_columns(table, numbered)
    clock = [column for column in table.columns if column.name in CLOCK]
    if not clock and not rate_hz:
        raise file.error(
            "no column 'time' (the first line must name the columns: time,x_1,y_1,x_2,y_2,…), and no rate_hz "
            "or --rate is given",
            file.header_lines or 1,
        )
    if unit == "px" and not unstated.scale_m:
        raise file.error("units px need scale_m, the size of a pixel in m")
    scale = unstated.scale_m if unit == "px" else LENGTHS.get(unit or "m")
    chosen = []
    for column in (column for columns in markers.values() for column in columns):
        if unit and column.unit not in ("", unit):
            conflict = (
                f"'{column.text}' is in {column.unit} according to its name, but in {unit} according to the "
                "map or --units"
            )
            raise table.error(column, f"{conflict}; correct one of them")
        chosen.append(column if column.unit else replace(column, factor=scale or 1.0))
    time, values, notes, epoch_ns = table.read_timed(clock[0] if clock else None, chosen, rate_hz)
    used = [*clock, *chosen]
    units = sorted({column.unit or unit or "" for column in used} - {"", "m", "s"})
    if units:
        notes.append(f"converted from {', '.join(units)} to SI")
    without = [column.text for column in used if not column.unit]
    if without and not unit:
        notes.append(f"{len(without)} columns without a unit assumed to be in s and m ({without[0]}, …)")
    others = {*range(len(file.names))} - {column.place for column in used}
    notes += not_used([file.names[index] or "''" for index in sorted(others)])
    places: tuple[tuple[int, str], ...] = ()
    if numbered:
        places = tuple((2 * (columns[0].number - 1), "") for columns in markers.values())
    points = values.reshape(len(time), len(markers), -1)
    result = marker_table(file, NAME, time, points, list(markers), notes, places=places, epoch_ns=epoch_ns)
    return replace(result, unit=unit or min({column.unit for column in chosen} - {""}, default="m"))


def _marker_columns(table: CsvTable, numbered: bool) -> dict[str, list[CsvColumn]]:
    """Return the columns x, y and, if they exist, z of each marker; numbered markers head first."""
    file, line = table.file, table.file.header_lines or 1
    markers: dict[str, dict[str, CsvColumn]] = {}
    columns = [column for column in table.columns if column.name not in CLOCK]
    for column in sorted(columns, key=lambda column: (column.number, column.letter)):
        if column.number == 0:
            raise table.error(column, f"{column.text} needs a number: {column.name}_1 at the head")
        markers.setdefault(f"{column.number}{column.letter}", {})[column.name] = column
    for name, axes in {} if numbered else axis_columns(file.names).items():
        for axis, (index, unit) in axes.items():
            column = CsvColumn(index, axis, 0, "", unit, LENGTHS.get(unit, 1.0), file.names[index])
            markers.setdefault(name, {})[axis] = column
            if file.names.count(column.text) > 1:
                raise table.error(column, f"{column.text}: two columns have this name")
    if not markers:
        required = "columns x_1,y_1,x_2,y_2,… (head first) or NAME_x,NAME_y"
        raise file.error(f"the file has no positions; it must have {required}", line)
    letters = "xyz" if any("z" in marker for marker in markers.values()) else "xy"
    missing = ((name, axis) for name, marker in markers.items() for axis in letters if axis not in marker)
    for name, axis in missing:
        if numbered:
            first = next(iter(markers[name].values()))
            raise table.error(first, f"{first.text}: {axis}_{name} is missing")
        raise file.error(f"{name}_{axis} is missing, although other markers have one", line)
    numbers = {column.number for marker in markers.values() for column in marker.values()}
    if numbered and len(numbers) < max(numbers):
        first_missing = min({*range(1, max(numbers))} - numbers)
        raise file.error(f"x_{first_missing} is missing; connectors are numbered from 1 at the head", line)
    return {name: [marker[axis] for axis in letters] for name, marker in markers.items()}
