"""Table of pulls with a spring car, from a plain CSV file.

One pull a row: ``along_mm`` or ``across_mm``, the spring's largest deformation (m without a unit; a blank
cell: not pulled that way). ``spring_n_per_m`` and ``mass_kg`` are the same in every row that has them, as
are their standard errors ``spring_error_n_per_m`` and ``mass_error_kg``, which may be left out.
"""

from __future__ import annotations

import os

import numpy as np

from srs_twin.identification.cells import Rows, read_rows
from srs_twin.identification.columns import Column, read_columns
from srs_twin.identification.pulls import Pulls
from srs_twin.identification.source import Source, read_source
from srs_twin.identification.units import LENGTHS

WAYS = ("along", "across")
_SPRING, _MASS = "spring_n_per_m", "mass_kg"
_SPRING_ERROR, _MASS_ERROR = "spring_error_n_per_m", "mass_error_kg"
_KNOWN = {way: LENGTHS for way in WAYS} | {
    name: {} for name in (_SPRING, _MASS, _SPRING_ERROR, _MASS_ERROR)
}  # fmt: skip
_LONGEST = 10.0  # m: no spring of a scale deforms that much
_EXAMPLE = "along_mm,across_mm,spring_n_per_m,mass_kg"


def is_pulls(path: str | os.PathLike[str]) -> bool:
    """Say whether a file's first line names a column of pulls.

    Raises:
        InputError: the file cannot be read.
    """
    names = (cell.strip().lower() for cell in "".join(read_source(path).head(1)).split(","))
    return any(name == way or name.startswith((f"{way}_", f"{way} ")) for name in names for way in WAYS)


def read_pulls(path: str | os.PathLike[str]) -> Pulls:
    """Read a table of pulls.

    Raises:
        InputError: no such file, columns missing or of other units, cells that are no such number.
    """
    source = read_source(path)
    columns, width, _ = read_columns(source, _KNOWN)
    found = {each.name: each for each in columns}
    for each in columns:
        if each.number or each.which:
            raise source.error(f"{each.text}: these columns have no numbers; {_EXAMPLE}", 1, each.place + 1)
    if not any(way in found for way in WAYS):
        raise source.error(f"neither 'along' nor 'across'; a table of pulls has {_EXAMPLE}", 1)
    for name in (_SPRING, _MASS):
        if name not in found:
            raise source.error(f"no column '{name}'; a table of pulls has {_EXAMPLE}", 1)
    order = sorted(columns, key=lambda each: each.place)
    rows = read_rows(source, 1, [each.place for each in order], width)
    place = {each.name: k for k, each in enumerate(order)}

    def pulled(way: str) -> list[float]:
        return _pulled(source, rows, found[way], place[way]) if way in found else []

    def constant(name: str) -> float:
        return _constant(source, rows, found[name], place[name]) if name in found else 0.0

    return Pulls(
        along=pulled("along"),
        across=pulled("across"),
        stiffness=constant(_SPRING),
        mass=constant(_MASS),
        stiffness_error=constant(_SPRING_ERROR),
        mass_error=constant(_MASS_ERROR),
        name=source.name,
        sha256=source.sha256,
    )


def _pulled(source: Source, rows: Rows, column: Column, place: int) -> list[float]:
    """Return the deformations in a column, m, without its blank cells."""
    values = rows.values[:, place] * LENGTHS[column.unit or "m"]
    wrong = np.flatnonzero((values < 0) | (values > _LONGEST))
    if wrong.size:
        row = int(wrong[0])
        raise source.error(
            f"{column.text}: {rows.values[row, place]:g} is not allowed; a deformation of 0 to "
            f"{_LONGEST / LENGTHS[column.unit or 'm']:g} {column.unit or 'm'}",
            rows.first_line + row,
            column.place + 1,
        )
    return [float(each) for each in values if np.isfinite(each)]


def _constant(source: Source, rows: Rows, column: Column, place: int) -> float:
    """Return the one number that a column holds."""
    values = rows.values[:, place]
    given = np.flatnonzero(np.isfinite(values))
    if not given.size:
        raise source.error(f"{column.text}: no number in it", rows.first_line, column.place + 1)
    first = float(values[given[0]])
    other = given[values[given] != first]
    if other.size:
        row = int(other[0])
        raise source.error(
            f"{column.text}: {values[row]:g} here and {first:g} before; one file, one spring and one mass",
            rows.first_line + row,
            column.place + 1,
        )
    return first
