"""Columns of a plain CSV file: names like ``x_1``, ``x_1_mm``, ``pressure_plus_2 (kPa)`` and ``time_ms``."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass

from srs_twin.identification.source import Source

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
