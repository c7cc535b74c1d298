"""Plain CSV: ``time`` and ``x_1,y_1…`` (head first) in the first line, or columns named by anybody.

A unit stands in the name: ``time_ms``, ``x_1_mm`` or ``x_1 (mm)``; without one it is s and m. ``z_1`` may be
there as well. Two markers on a connector are ``x_1a,y_1a,x_1b,y_1b``.
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
    """Say whether a file starts with the names of columns: of a clock, or of positions."""
    names = start.names
    return any(_NUMBERED.match(name) or is_clock(name) for name in names) or bool(axis_columns(names))


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read the markers of a plain CSV file.

    Raises:
        InputError: damaged, no positions, or units that contradict each other; with line and column.
    """
    rate_hz, unit = unstated.rate_hz, unstated.unit
    file = laid_out(file, unstated.dialect)
    numbered = any(_NUMBERED.match(name) for name in file.names)
    table = read_table(file, CLOCK | dict.fromkeys("xyz" if numbered else "", LENGTHS))
    marks = _marks(table, numbered)
    clock = [each for each in table.columns if each.name in CLOCK]
    if not clock and not rate_hz:
        how = "(the first line names the columns: time,x_1,y_1,x_2,y_2,…), and no rate_hz or --rate"
        raise file.error(f"no column 'time' {how}", file.header_lines or 1)
    if unit == "px" and not unstated.scale_m:
        raise file.error("units px need scale_m, the size of a pixel in m")
    scale = unstated.scale_m if unit == "px" else LENGTHS.get(unit or "m")
    chosen = []
    for each in (column for mark in marks.values() for column in mark):
        if unit and each.unit not in ("", unit):
            what = f"'{each.text}' is in {each.unit} by its name, in {unit} by the map or --units"
            raise table.error(each, f"{what}; correct one")
        chosen.append(each if each.unit else replace(each, factor=scale or 1.0))
    time, values, notes, epoch_ns = table.read_timed(clock[0] if clock else None, chosen, rate_hz)
    used = [*clock, *chosen]
    units = sorted({each.unit or unit or "" for each in used} - {"", "m", "s"})
    if units:
        notes.append(f"converted from {', '.join(units)} to SI")
    without = [each.text for each in used if not each.unit]
    if without and not unit:
        notes.append(f"{len(without)} columns without a unit taken as s and m ({without[0]}, …)")
    others = {*range(len(file.names))} - {each.place for each in used}
    notes += not_used([file.names[place] or "''" for place in sorted(others)])
    places = tuple((2 * (column.number - 1), "") for column, *_ in marks.values()) if numbered else ()
    points = values.reshape(len(time), len(marks), -1)
    found = marker_table(file, NAME, time, points, list(marks), notes, places=places, epoch_ns=epoch_ns)
    return replace(found, unit=unit or min({each.unit for each in chosen} - {""}, default="m"))


def _marks(table: CsvTable, numbered: bool) -> dict[str, list[CsvColumn]]:
    """Return the columns x, y, and z where it is there, of each marker; numbered ones head first."""
    file, line = table.file, table.file.header_lines or 1
    marks: dict[str, dict[str, CsvColumn]] = {}
    columns = [each for each in table.columns if each.name not in CLOCK]
    for each in sorted(columns, key=lambda column: (column.number, column.letter)):
        if each.number == 0:
            raise table.error(each, f"{each.text}: a number is wanted: {each.name}_1 at the head")
        marks.setdefault(f"{each.number}{each.letter}", {})[each.name] = each
    for name, found in {} if numbered else axis_columns(file.names).items():
        for axis, (place, unit) in found.items():
            each = CsvColumn(place, axis, 0, "", unit, LENGTHS.get(unit, 1.0), file.names[place])
            marks.setdefault(name, {})[axis] = each
            if file.names.count(each.text) > 1:
                raise table.error(each, f"{each.text}: two columns have this name")
    if not marks:
        what = "no positions: columns x_1,y_1,x_2,y_2,… (head first) or NAME_x,NAME_y are wanted"
        raise file.error(what, line)
    axes = "xyz" if any("z" in mark for mark in marks.values()) else "xy"
    for name, axis in ((name, axis) for name, mark in marks.items() for axis in axes if axis not in mark):
        if numbered:
            first = next(iter(marks[name].values()))
            raise table.error(first, f"{first.text}: {axis}_{name} is missing")
        raise file.error(f"{name}_{axis} is missing, other markers have one", line)
    numbers = {column.number for mark in marks.values() for column in mark.values()}
    if numbered and len(numbers) < max(numbers):
        hole = min({*range(1, max(numbers))} - numbers)
        raise file.error(f"x_{hole} is missing; connectors are numbered from 1 at the head", line)
    return {name: [mark[axis] for axis in axes] for name, mark in marks.items()}
