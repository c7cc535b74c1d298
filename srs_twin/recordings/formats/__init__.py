"""Formats of motion recordings: which one a file has, and its reader.

Each module of this package reads one format: `NAME`, `recognizes(start)`, and `read(path, unstated)`. Lengths
come out in m and times in s, in the file's own axes. Damaged files of any format raise one `InputError` that
names the file. The libraries `c3d` and `mcap` are the extra `recordings`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from srs_twin.errors import InputError
from srs_twin.io.files import printable
from srs_twin.recordings.csv_table import AS_FOUND, Dialect
from srs_twin.recordings.formats import c3d, deeplabcut, mcap, motive, plain_csv, qualisys, vicon
from srs_twin.recordings.formats.base import Start, Unstated, start_of
from srs_twin.recordings.marker_table import MarkerTable


class Format(NamedTuple):
    """A format: its name, whether a file that starts so has it, and its reader."""

    name: str
    recognizes: Callable[[Start], bool]
    read: Callable[[str | os.PathLike[str], Unstated], MarkerTable]


_READERS = tuple(
    Format(module.NAME, module.recognizes, module.read)
    for module in (c3d, mcap, motive, vicon, qualisys, deeplabcut, plain_csv)
)
"""In the order in which a file is tried."""
FORMATS = tuple(each.name for each in _READERS)

_EXPORT = "export CSV or C3D instead"
# Suffix or first bytes, what that is, what to do.
_OTHERS: tuple[tuple[str | bytes, str, str], ...] = (
    (".tak", "a take of Motive", "export it there (File, Export Tracking Data, CSV)"),
    (".qtm", "a measurement of Qualisys", "export it there (File, Export, To TSV)"),
    (b"#ROSBAG", "a ROS 1 bag", "convert it: `mcap convert in.bag out.mcap`"),
    (b"SQLite format 3", "a ROS 2 bag in SQLite (.db3)", "convert it: `mcap convert in.db3 out.mcap`"),
    (b"\x89HDF", "an HDF5 file", "DeepLabCut writes a CSV beside it with save_as_csv=True"),
    (b"PK\x03\x04", "a ZIP archive or an Excel workbook (.xlsx)", "unpack it, or save the sheet as CSV"),
    (b"\xd0\xcf\x11\xe0", "an Excel workbook (.xls)", "save the sheet as CSV"),
    (b"\x1f\x8b", "a gzip archive", "unpack it"),
    (b"PathFileType", "a TRC file", _EXPORT),
    (b"HIERARCHY", "a BVH file, which holds joint angles and no markers", _EXPORT),
)


def identify(path: str | os.PathLike[str], dialect: Dialect = AS_FOUND) -> str:
    """Return the format of a recording, one of `FORMATS`, by its first bytes.

    Args:
        path: of the file.
        dialect: layout of a plain table, where it is not found.

    Raises:
        InputError: missing, a folder, empty, or of another format; says what it looks like.
    """
    return _format(path, dialect).name


def read_markers(
    path: str | os.PathLike[str],
    *,
    rate_hz: float | None = None,
    unit: str | None = None,
    scale_m: float | None = None,
    dialect: Dialect = AS_FOUND,
) -> MarkerTable:
    """Read a recording as it is, in any of `FORMATS`.

    Args:
        path: of the file.
        rate_hz: frames a second, where the file does not say (DeepLabCut, plain CSV without a time, Qualisys
            with an external clock).
        unit: of lengths, where the file does not say (DeepLabCut, plain CSV).
        scale_m: size of a pixel, m (DeepLabCut).
        dialect: layout of a plain table, where it is not found.

    Raises:
        InputError: with file, line and column, and what is allowed.
    """
    return _format(path, dialect).read(path, Unstated(rate_hz, unit, scale_m, dialect))


def _format(path: str | os.PathLike[str], dialect: Dialect = AS_FOUND) -> Format:
    start = start_of(path, dialect)
    name, raw = start.name, start.raw
    if not raw.removeprefix(b"\xef\xbb\xbf").strip():
        raise InputError(f"{name}: empty; a recording has a header and rows of numbers")
    for each in _READERS:
        if each.recognizes(start):
            return each
    for sign, what, remedy in _OTHERS:
        if raw.startswith(sign) if isinstance(sign, bytes) else Path(path).suffix.lower() == sign:
            raise InputError(f"{name}: {what}, which is not read; {remedy}. Formats: {', '.join(FORMATS)}")
    if start.table.problem and b"\0" not in raw:
        raise InputError(f"{name}:{start.table.header_lines + 1}: {start.table.problem}")
    looks = (
        "a binary file of a kind that is not known"
        if b"\0" in raw
        else f"its first line is '{start.line[:40]}'"
    )
    listed = f"formats: {', '.join(FORMATS)} (first line time,x_1,y_1,x_2,y_2,…)"
    raise InputError(printable(f"{name}:1: no motion recording that is read: {looks}; {listed}"))
