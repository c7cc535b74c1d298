"""Plain CSV: ``time`` and ``x_1,y_1…`` (head first) in the first line, or columns named by anybody.

A unit stands in the name: ``time_ms``, ``x_1_mm`` or ``x_1 (mm)``; without one it is s and m. ``z_1`` may be
there as well. Two markers on a connector are ``x_1a,y_1a,x_1b,y_1b``.
"""

from __future__ import annotations

import os
import re

import numpy as np

from srs_twin.recordings.csv_table import CLOCK, CsvColumn, CsvTable, RecordedFile, read_file, read_table
from srs_twin.recordings.formats.base import Start, Unstated, axis_columns
from srs_twin.recordings.marker_table import MarkerTable, plausible
from srs_twin.recordings.signals.units import LENGTHS, TIMES

NAME = "plain CSV"
_PLAIN_NAME = re.compile(r"\s*(?:t|time|[xyz]_\d+)(?![A-Za-z0-9])", re.IGNORECASE)
_TIME = re.compile(
    r"\W*(?:t|time|timestamp|seconds|secs?)(?:[ _]*[\[(]?(?P<unit>s|ms|us)[\])]?)?\W*", re.IGNORECASE
)


def recognizes(start: Start) -> bool:
    """Say whether a file starts with the names of columns: of a clock, or of positions."""
    return any(_PLAIN_NAME.match(cell) for cell in start.cells) or bool(axis_columns(start.cells))


def read(path: str | os.PathLike[str], unstated: Unstated) -> MarkerTable:
    """Read the markers of a plain CSV file."""
    file = read_file(path)
    rate_hz, unit = unstated.rate_hz, unstated.unit
    table = read_table(file, CLOCK | dict.fromkeys("xyz", LENGTHS))
    if all(each.name in CLOCK or not each.number for each in table.columns):
        return _foreign(file, rate_hz, unit)
    clock = table.clock(
        "no column 'time' (the first line of a plain CSV file names the columns: time,x_1,y_1,x_2,y_2,…)"
    )
    marks = _marks(table)
    chosen = [column for mark in marks.values() for column in mark]
    time, values, notes = table.read_timed(clock, chosen)
    if unit:
        values = values * np.array([1.0 if each.unit else LENGTHS[unit] for each in chosen])
    units = sorted({each.unit or unit or "" for each in [clock, *chosen]} - {"", "m", "s"})
    if units:
        notes.append(f"converted from {', '.join(units)} to SI")
    without = [each.text for each in [clock, *chosen] if not each.unit]
    if without and not unit:
        notes.append(f"{len(without)} columns without a unit taken as s and m ({without[0]}, …)")
    points, implausible = plausible(values.reshape(len(time), len(marks), -1))
    labels = tuple(f"{number}{letter}" for number, letter in marks)
    corrections = (*notes, *table.unused_columns(), *implausible)
    places = tuple((2 * (number - 1), "") for number, _ in marks)
    return MarkerTable(file.name, file.sha256, NAME, time, points, labels, corrections, places)


def _foreign(file: RecordedFile, rate_hz: float | None, unit: str | None) -> MarkerTable:
    """Read a plain CSV file whose columns are named by anybody: NAME_x, NAME_y, and z where it is there."""
    (cells,) = file.head(1)
    marks = axis_columns(cells)
    if not marks:
        raise file.error(
            "no positions: columns x_1,y_1,x_2,y_2,… (head first) or NAME_x,NAME_y are wanted", 1
        )
    clock = next(((k, match) for k, cell in enumerate(cells) if (match := _TIME.fullmatch(cell))), None)
    if clock is None and not rate_hz:
        raise file.error("no column 'time', and no rate_hz (frames a second) in a map or by --rate", 1)
    axes = "xyz" if any("z" in each for each in marks.values()) else "xy"
    flat = [(name, axis, *each.get(axis, (-1, ""))) for name, each in marks.items() for axis in axes]
    if (short := next((each for each in flat if each[2] < 0), None)) is not None:
        raise file.error(f"{short[0]}_z is missing, other markers have one", 1)
    columns = ([] if clock is None or rate_hz else [clock[0]]) + [place for _, _, place, _ in flat]
    values, notes = file.rows(1, columns, len(cells))
    if clock is None or rate_hz:
        time = np.arange(len(values)) / float(rate_hz or 1.0)
        notes.append(f"frames counted, {rate_hz:g} a second")
    else:
        time, values = values[:, 0] * TIMES[(clock[1]["unit"] or "s").lower()], values[:, 1:]
        if (missing := np.isnan(time)).any():
            raise file.error("a row without a time", 2 + int(missing.argmax()), clock[0] + 1)
    given = [each or unit or "m" for *_, each in flat]
    if not unit and not all(each for *_, each in flat):
        notes.append("columns without a unit taken as m")
    notes += [f"converted from {each} to m" for each in sorted({*given} - {"m"})]
    scaled = values * np.array([LENGTHS[each] for each in given])
    points, implausible = plausible(scaled.reshape(len(time), len(marks), -1))
    corrections = (*notes, *implausible)
    return MarkerTable(file.name, file.sha256, NAME, time, points, tuple(marks), corrections)


def _marks(table: CsvTable) -> dict[tuple[int, str], list[CsvColumn]]:
    """Return the columns of each marker's coordinates, head first."""
    marks: dict[tuple[int, str], list[CsvColumn]] = {}
    for each in sorted(table.columns, key=lambda column: (column.number, column.letter, column.name)):
        if each.name in CLOCK:
            continue
        if each.number == 0:
            raise table.error(each, f"{each.text}: a number is wanted: {each.name}_1 at the head")
        marks.setdefault((each.number, each.letter), []).append(each)
    if not marks:
        raise table.file.error("no positions: columns x_1,y_1,x_2,y_2,… are wanted, head first", 1)
    axes = "xyz" if any(len(mark) == 3 for mark in marks.values()) else "xy"
    for (number, letter), mark in marks.items():
        missing = [axis for axis in axes if axis not in [each.name for each in mark]]
        if missing:
            raise table.error(mark[0], f"{mark[0].text}: {missing[0]}_{number}{letter} is missing")
    numbers = {number for number, _ in marks}
    hole = next(k for k in range(1, len(numbers) + 2) if k not in numbers)
    if hole <= len(numbers):
        raise table.file.error(f"x_{hole} is missing; connectors are numbered from 1 at the head", 1)
    return marks
