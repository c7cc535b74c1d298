"""Plain CSV: ``time`` and ``x_1,y_1…`` (head first) in the first line, or columns named by anybody.

A unit stands in the name: ``time_ms``, ``x_1_mm`` or ``x_1 (mm)``; without one it is s and m. ``z_1`` may be
there as well. Two markers on a connector are ``x_1a,y_1a,x_1b,y_1b``.
"""

from __future__ import annotations

import os
import re

import numpy as np

from srs_twin.recordings.csv_table import (
    CLOCK,
    CsvColumn,
    CsvTable,
    laid_out,
    not_used,
    read_file,
    read_table,
)
from srs_twin.recordings.formats.base import Start, Unstated, axis_columns
from srs_twin.recordings.marker_table import MarkerTable, plausible
from srs_twin.recordings.signals.units import LENGTHS, is_clock

NAME = "plain CSV"
_NUMBERED = re.compile(r"[xyz]_\d+(?![A-Za-z0-9]{2})", re.IGNORECASE)


def recognizes(start: Start) -> bool:
    """Say whether a file starts with the names of columns: of a clock, or of positions."""
    names = start.table.names
    return any(_NUMBERED.match(name) or is_clock(name) for name in names) or bool(axis_columns(names))


def read(path: str | os.PathLike[str], unstated: Unstated) -> MarkerTable:
    """Read the markers of a plain CSV file."""
    rate_hz, unit = unstated.rate_hz, unstated.unit
    file = laid_out(read_file(path), unstated.dialect)
    numbered = any(_NUMBERED.match(name) for name in file.names)
    table = read_table(file, CLOCK | dict.fromkeys("xyz" if numbered else "", LENGTHS))
    clock = next((each for each in table.columns if each.name in CLOCK), None)
    marks = _marks(table) if numbered else _foreign(table)
    if clock is None and not rate_hz:
        how = "(the first line names the columns: time,x_1,y_1,x_2,y_2,…), and no rate_hz or --rate"
        raise file.error(f"no column 'time' {how}", file.header_lines or 1)
    chosen = [column for mark in marks.values() for column in mark]
    for each in chosen if unit else ():
        if each.unit and each.unit != unit:
            what = f"'{each.text}' is in {each.unit} by its name, in {unit} by the map or --units"
            raise table.error(each, f"{what}; correct one")
    epoch_ns = None
    if clock is not None:
        time, values, notes, epoch_ns = table.read_timed(clock, chosen)
    else:
        values, notes = table.read(chosen)
        time = np.arange(len(values)) / float(rate_hz or 1.0)
        notes.append(f"frames counted, {rate_hz:g} a second")
    if unit == "px" and not unstated.scale_m:
        raise file.error("units px need scale_m, the size of a pixel in m")
    if unit:
        factor = unstated.scale_m if unit == "px" else LENGTHS[unit]
        values = values * np.array([1.0 if each.unit else factor for each in chosen])
    timed = [clock] if clock is not None else []
    units = sorted({each.unit or unit or "" for each in [*timed, *chosen]} - {"", "m", "s"})
    if units:
        notes.append(f"converted from {', '.join(units)} to SI")
    without = [each.text for each in [*timed, *chosen] if not each.unit]
    if without and not unit:
        notes.append(f"{len(without)} columns without a unit taken as s and m ({without[0]}, …)")
    points, implausible = plausible(values.reshape(len(time), len(marks), -1))
    used = {each.place for each in [*timed, *chosen]}
    notes += not_used([name or "''" for place, name in enumerate(file.names) if place not in used])
    places = tuple((2 * (column.number - 1), "") for column, *_ in marks.values()) if numbered else ()
    return MarkerTable(
        file.name, file.sha256, NAME, time, points, tuple(marks), (*notes, *implausible), places,
        epoch_ns=epoch_ns,
    )  # fmt: skip


def _foreign(table: CsvTable) -> dict[str, list[CsvColumn]]:
    """Return the columns of each marker named by anybody: NAME_x, NAME_y, and z where it is there."""
    file, line = table.file, table.file.header_lines or 1
    marks = axis_columns(file.names)
    if not marks:
        what = "no positions: columns x_1,y_1,x_2,y_2,… (head first) or NAME_x,NAME_y are wanted"
        raise file.error(what, line)
    axes = "xyz" if any("z" in each for each in marks.values()) else "xy"
    found: dict[str, list[CsvColumn]] = {}
    for name, each in marks.items():
        if len(each) < len(axes):
            raise file.error(f"{name}_z is missing, other markers have one", line)
        for place, unit in (each[axis] for axis in axes):
            text = file.names[place]
            if file.names.count(text) > 1:
                raise file.error(f"{text}: two columns have this name", line, place + 1)
            found.setdefault(name, []).append(CsvColumn(place, "", 0, "", unit, LENGTHS.get(unit, 1.0), text))
    return found


def _marks(table: CsvTable) -> dict[str, list[CsvColumn]]:
    """Return the columns of each marker's coordinates, head first."""
    marks: dict[tuple[int, str], list[CsvColumn]] = {}
    for each in sorted(table.columns, key=lambda column: (column.number, column.letter, column.name)):
        if each.name in CLOCK:
            continue
        if each.number == 0:
            raise table.error(each, f"{each.text}: a number is wanted: {each.name}_1 at the head")
        marks.setdefault((each.number, each.letter), []).append(each)
    if not marks:
        raise table.file.error("no positions: columns x_1,y_1,x_2,y_2,… are wanted, head first")
    axes = "xyz" if any(len(mark) == 3 for mark in marks.values()) else "xy"
    for (number, letter), mark in marks.items():
        missing = [axis for axis in axes if axis not in [each.name for each in mark]]
        if missing:
            raise table.error(mark[0], f"{mark[0].text}: {missing[0]}_{number}{letter} is missing")
    numbers = {number for number, _ in marks}
    hole = next(k for k in range(1, len(numbers) + 2) if k not in numbers)
    if hole <= len(numbers):
        raise table.file.error(
            f"x_{hole} is missing; connectors are numbered from 1 at the head",
            table.file.header_lines or 1,
        )
    return {f"{number}{letter}": mark for (number, letter), mark in marks.items()}
