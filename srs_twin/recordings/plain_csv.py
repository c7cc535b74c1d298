"""Plain CSV of a motion: a header of names, ``time`` and ``x_1,y_1…`` (head first), and rows of numbers.

A unit stands in the name: ``time_ms``, ``x_1_mm`` or ``x_1 (mm)``; without one it is s and m. ``z_1`` may be
there as well. Two markers on a connector are ``x_1a,y_1a,x_1b,y_1b``.
"""

from __future__ import annotations

import numpy as np

from srs_twin.recordings.source import Source
from srs_twin.recordings.tables import LENGTHS, TIMES, Column, read_columns, read_rows
from srs_twin.recordings.tracking import MarkerTable, believable

_KNOWN = {"time": TIMES, "t": TIMES, "x": LENGTHS, "y": LENGTHS, "z": LENGTHS}


def parse_plain(source: Source) -> MarkerTable:
    """Read the markers of a plain CSV file.

    Raises:
        InputError: no such header, a coordinate or a number missing in it, or as `read_rows`.
    """
    columns, width, others = read_columns(source, _KNOWN)
    clock = [each for each in columns if each.name in ("time", "t")]
    if not clock:
        raise source.error(
            "neither a Motive export (its first line begins 'Format Version,1.2') nor a plain CSV file "
            "(its first line names the columns: time,x_1,y_1,x_2,y_2,…)",
            1,
        )
    marks = _marks(source, [each for each in columns if each.name not in ("time", "t")])
    chosen = [clock[0], *(each for mark in marks.values() for each in mark)]
    order = sorted(chosen, key=lambda each: each.place)
    rows = read_rows(source, 1, [each.place for each in order], width)
    place = {each.text: k for k, each in enumerate(order)}
    time = rows.values[:, place[clock[0].text]] * TIMES[clock[0].unit or "s"]
    missing = np.flatnonzero(np.isnan(time))
    if missing.size:
        raise source.error("a row without a time", rows.first_line + int(missing[0]), clock[0].place + 1)
    axes = [
        np.stack([rows.values[:, place[each.text]] * LENGTHS[each.unit or "m"] for each in mark], axis=-1)
        for mark in marks.values()
    ]
    points, unbelievable = believable(np.stack(axes, axis=1))
    return MarkerTable(
        kind="plain CSV",
        time=time,
        points=points,
        labels=tuple(f"{number}{which}" for number, which in marks),
        connectors=tuple(number for number, _ in marks),
        header_frames=None,
        sha256=source.sha256,
        name=source.name,
        corrections=(*rows.corrections, *_said(chosen, others), *unbelievable),
    )


def _marks(source: Source, columns: list[Column]) -> dict[tuple[int, str], list[Column]]:
    """Return the columns of each marker's coordinates, head first."""
    marks: dict[tuple[int, str], list[Column]] = {}
    for each in sorted(columns, key=lambda column: (column.number, column.which, column.name)):
        if each.number == 0:
            raise source.error(
                f"{each.text}: a number is wanted: {each.name}_1 at the head", 1, each.place + 1
            )
        marks.setdefault((each.number, each.which), []).append(each)
    if not marks:
        raise source.error("no positions: columns x_1,y_1,x_2,y_2,… are wanted, head first", 1)
    solid = any(len(mark) == 3 for mark in marks.values())
    for (number, which), mark in marks.items():
        have = {each.name for each in mark}
        missing = next((axis for axis in ("xyz" if solid else "xy") if axis not in have), None)
        if missing:
            raise source.error(f"{mark[0].text}: {missing}_{number}{which} is missing", 1, mark[0].place + 1)
    numbers = sorted({number for number, _ in marks})
    if numbers != list(range(1, len(numbers) + 1)):
        hole = next(k for k in range(1, len(numbers) + 2) if k not in numbers)
        raise source.error(f"x_{hole} is missing; connectors are numbered from 1 at the head", 1)
    return marks


def _said(columns: list[Column], others: list[str]) -> list[str]:
    said = []
    units = sorted({each.unit for each in columns if each.unit and each.unit not in ("m", "s")})
    if units:
        said.append(f"converted from {', '.join(units)} to SI")
    unstated = [each.text for each in columns if not each.unit]
    if unstated:
        said.append(f"{len(unstated)} columns without a unit taken as s and m ({unstated[0]}, …)")
    if others:
        shown = ", ".join(others[:5]) + (", …" if len(others) > 5 else "")
        said.append(f"{len(others)} columns not used: {shown}")
    return said
